"""Draws as files, and results that come back: judged as any run, or refused in one line."""

import os
import shutil
from itertools import product
from pathlib import Path

import jax
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from support.studies import small_study

import sinsjax
from sinsjax.analysis.tables import numeric_column
from sinsjax.arena.export import export_study, from_angles, from_quaternion, to_quaternion
from sinsjax.arena.runs import add_program
from sinsjax.arena.score import score_results
from sinsjax.errors import InputError
from sinsjax.maths.rotations import matrix, misalignment
from sinsjax.report.monte_carlo import build_report

pytestmark = pytest.mark.optimised(False)

ANGLES = ("pitch_deg", "roll_deg", "yaw_deg")
STARTS = {"phi_u0_deg": [5.0, 30.0]}
WINDOW = {"duration_s": 40.0, "rate_hz": 10.0, "draws": 8, "window_s": [20, 40]}
SETTINGS = {
    "study": WINDOW | {"success_band_arcmin": 600.0, "report_times_s": [20.0]},
    "motion": {"yaw_center_deg": 50.0, "pitch_center_deg": 4.0, "roll_center_deg": -7.0},
    "alignment": {"phi_e0_deg": 0.1, "phi_n0_deg": 0.1},
    "compass": {"level_sigma_per_s": 0.5, "level_time_s": 10.0, "azimuth_sigma_per_s": 0.1},
    "axes": {"method": ["compass", "inertial"], **STARTS},
}
"""A study whose methods find north within some degrees."""


class Arena:
    """An exported study, its own results, and a method's as a program's: all, and the last."""

    def __init__(self, folder, **changes):
        self.study = small_study(**(SETTINGS | changes))
        self.export = export_study(self.study, folder / "export")
        self.own = sinsjax.run_into(self.export / "study.toml", self.export / "own", curves=True)
        first = pyarrow.csv.read_csv(self.export / "initial.csv")
        self.digest = first["study"][0].as_py()
        ours = pc.is_in(self.own.curves["run_id"], first["run_id"].combine_chunks())
        table = self.own.curves.filter(ours).select(["run_id", "time_s", *ANGLES])
        digests = pa.array([self.digest] * len(table))
        self.history = table.combine_chunks().append_column("study", digests)
        self.last = self.history.filter(pc.equal(self.history["time_s"], 40.0))

    def score(self, table, folder):
        """Score some results, as "mine"."""
        pyarrow.csv.write_csv(table, folder / "mine.csv")
        return score_results(self.export, folder / "mine.csv")


@pytest.fixture(scope="module")
def arena(tmp_path_factory):
    return Arena(tmp_path_factory.mktemp("arena"))


def replaced(table, angles):
    """Results with pitch, roll and yaw, deg (rows, 3), changed by a function of them."""
    values = angles(np.stack([table[name].to_numpy() for name in ANGLES], axis=-1))
    names = ANGLES if values.shape[1] == 3 else ("q_w", "q_x", "q_y", "q_z")
    columns = {name: table[name] for name in ("run_id", "time_s", "study")}
    return pa.table(columns | dict(zip(names, values.T, strict=True)))


def quaternions(angles, frame="enu"):
    return to_quaternion(from_angles(np.radians(angles), "enu"), frame)


def read_initial(folder):
    return pyarrow.csv.read_csv(folder / "initial.csv").to_pylist()


def study(**changes):
    return small_study(**({"axes": STARTS} | changes))


def rows_of(score, method):
    return score.summary.filter(pc.equal(score.summary["method"], method))


@pytest.mark.parametrize("kind", ["csv", "parquet", "psins"])
def test_exported_record_has_the_engines_increments_to_the_bit(kind, tmp_path):
    out = export_study(study(), tmp_path / "out", format=kind)
    for draw, path in enumerate(sorted(out.glob("imu/*"))):
        made = sinsjax.simulated_record(study(), draw)
        if kind == "psins":  # seven columns without names, the time last
            numbers = np.roll(np.loadtxt(path), 1, axis=1)
        else:
            table = pq.read_table(path) if kind == "parquet" else pyarrow.csv.read_csv(path)
            assert table.column_names[::6] == ["time_s", "accel_z_m_per_s"]
            numbers = np.stack([column.to_numpy() for column in table.columns], axis=-1)
        np.testing.assert_array_equal(numbers, np.c_[np.arange(1, 601) / 100, made.dtheta, made.dv])
    assert draw == 2


def test_increments_of_ned_axes_are_front_right_down(tmp_path):
    folder = export_study(study(), tmp_path / "out", frame="ned")
    made = sinsjax.simulated_record(study(), 0)
    numbers = np.loadtxt(folder / "imu" / "draw_00000.csv", delimiter=",", skiprows=1)
    right, front, up = made.dtheta.T
    np.testing.assert_array_equal(numbers[:, 1:4], np.stack([front, right, -up], -1))
    assert 100 * numbers[:, 6].mean() == pytest.approx(-9.8, abs=0.01)  # specific force, z down


@pytest.mark.parametrize("frame", ["enu", "ned"])
def test_first_attitude_is_the_true_one_with_the_runs_misalignment(frame, tmp_path):
    made = study(motion={"yaw_center_deg": 40.0, "yaw_amplitude_deg": 0.0, "pitch_center_deg": 3.0})
    rows = read_initial(export_study(made, tmp_path / "out", frame=frame))
    assert [row["run_id"] for row in rows] == list(range(6))
    angles = np.radians([[row[name] for name in ANGLES] for row in rows])
    q = np.array([[row[f"q_{axis}"] for axis in "wxyz"] for row in rows])
    from_euler, given = from_angles(angles, frame), from_quaternion(q, frame)
    truth = from_angles(np.radians([[3.0, 0.0, 40.0]] * 6), "enu")
    for attitude in (from_euler, given):
        phi = np.degrees(np.stack(jax.vmap(misalignment)(truth, attitude), -1))
        np.testing.assert_allclose(phi, [[5, 5, 5], [5, 5, 30]] * 3, atol=1e-9)
    assert {row["latitude_deg"] for row in rows} == {32}


def test_frames_agree_with_matrices_written_out():
    pitch, roll, heading = angles = np.radians([10.0, -20.0, 50.0])
    (cp, cr, ch), (sp, sr, sh) = np.cos(angles), np.sin(angles)
    about_down = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
    about_right = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_front = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    axes = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    enu = np.array(matrix(from_angles(angles[None], "ned")))[..., 0]
    ned = about_down @ about_right @ about_front
    np.testing.assert_allclose(axes @ enu @ axes, ned, atol=1e-14)


def test_variants_of_other_methods_are_one_run_that_has_a_start_if_one_of_them_has(tmp_path):
    methods = {"method": ["kalman5", "inertial"], **STARTS}
    rows = read_initial(export_study(study(axes=methods), tmp_path / "both"))[:2]
    assert [row["run_id"] for row in rows] == [0, 1] and np.isfinite(rows[0]["yaw_deg"])
    made = small_study(alignment={"method": "inertial"})
    row = read_initial(export_study(made, tmp_path / "none"))[0]
    assert row["yaw_deg"] is row["q_w"] is None  # nan


def test_interrupted_export_is_unfinished(tmp_path):
    def stop(progress):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_study(study(), tmp_path / "out", on_progress=stop)
    with pytest.raises(InputError, match="an unfinished one"):
        score_results(tmp_path / "out", tmp_path / "mine.csv")
    with pytest.raises(InputError, match="is not empty"):
        export_study(study(), tmp_path / "out")


def test_methods_own_attitudes_get_the_methods_own_row_among_those_of_the_sweep(arena, tmp_path):
    score = arena.score(arena.history, tmp_path)
    assert score.warnings == ()
    mine, own = rows_of(score, "mine"), rows_of(score, "compass")
    for name in mine.column_names:
        if mine[name].type == pa.float64() and not name.startswith(("sigma", "nees", "nis", "p_")):
            found, expected = (numeric_column(rows, name) for rows in (mine, own))
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-6, err_msg=name)
    assert mine["status"].to_pylist() == own["status"].to_pylist()
    swept = arena.own.summary
    for method in arena.study.methods:
        there, here = swept.filter(pc.equal(swept["method"], method)), rows_of(score, method)
        for name in there.column_names:
            if name not in ("run_id", "variant_id"):
                assert here[name].to_pylist() == there[name].to_pylist(), name


@pytest.mark.parametrize("frame", ["enu", "ned"])
def test_results_may_be_quaternions_in_a_parquet_file_or_of_the_other_frame(frame, arena, tmp_path):
    table = arena.last
    expected = numeric_column(rows_of(arena.score(table, tmp_path), "mine"), "phi_u_arcmin")
    export = export_study(arena.study, tmp_path / frame, frame=frame)
    shutil.copytree(arena.export / "own", export / "own")
    path = tmp_path / "mine.parquet"
    pq.write_table(replaced(table, lambda angles: quaternions(angles, frame)), path)
    found = numeric_column(rows_of(score_results(export, path), "mine"), "phi_u_arcmin")
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_sigma_of_the_heading_is_judged_by_the_error(arena, tmp_path):
    sigma = pa.array([2.0] * len(arena.history))
    table = arena.history.append_column("sigma_yaw_deg", sigma)
    rows = rows_of(arena.score(table, tmp_path), "mine")
    error = numeric_column(rows, "phi_u_arcmin") - numeric_column(rows, "floor_arcmin")
    np.testing.assert_allclose(numeric_column(rows, "nis_u"), (error / 120) ** 2, rtol=1e-6)
    np.testing.assert_allclose(numeric_column(rows, "sigma_u_arcmin"), 120.0)


def test_history_that_begins_late_settles_no_sooner(arena, tmp_path):
    table = arena.history
    late = table.filter(pc.greater_equal(table["time_s"], 20.0))
    rows = rows_of(arena.score(late, tmp_path), "mine")
    whole = rows_of(arena.score(table, tmp_path), "mine")
    settled, expected = (numeric_column(rows, "settle_600_truth_s") for rows in (rows, whole))
    assert (expected < 19).any()
    np.testing.assert_array_equal(settled, np.maximum(expected, 19.0))


def test_missing_and_unfinished_runs_are_failures_and_listed(arena, tmp_path):
    run_id, time_s = (arena.history[name].to_numpy() for name in ("run_id", "time_s"))
    ids = np.unique(run_id)
    kept = (run_id != ids[3]) & ((run_id != ids[5]) | (time_s < 39.5))
    score = arena.score(arena.history.filter(pa.array(kept)), tmp_path)
    missing = f"2 of {len(ids)} runs have no row at their end, 40 s, and count as failures"
    assert f"{missing}: run_id {ids[3]}, {ids[5]}" in score.warnings[0]
    rows = rows_of(score, "mine").to_pandas()
    assert (rows["status"] == "nonfinite").sum() == 2
    errors = np.abs(np.nan_to_num(rows["phi_u_arcmin"], nan=180 * 60))
    (fact,) = (f for f in build_report(score, with_tables=False).facts if f.label == "Program")
    assert f"mean heading error {errors.mean():.0f} " in fact.text


READINGS = {
    "is yaw mirrored": lambda angles: angles * [1, 1, -1],
    "are the angles in radians": np.radians,
    "is yaw off by 90 deg": lambda angles: angles + [0, 0, 90],
    "is the scalar of the quaternions last": lambda a: np.roll(quaternions(a), -1, axis=-1),
    "are the quaternions from navigation to body axes": lambda a: quaternions(a) * [1, -1, -1, -1],
}
SWAYING = {"yaw_center_deg": 0.0, "yaw_amplitude_deg": 20.0, "yaw_period_s": 7.0}


@pytest.mark.nightly(fast=("is yaw mirrored-None", "is the scalar of the quaternions last-None"))
@pytest.mark.parametrize(
    ("reading", "motion"), [*product(READINGS, [None]), ("is yaw mirrored", SWAYING)]
)
def test_other_convention_is_suspected_by_name(reading, motion, arena, tmp_path):
    arena = arena if motion is None else Arena(tmp_path, motion=motion)
    score = arena.score(replaced(arena.last, READINGS[reading]), tmp_path)
    assert f"mine: {reading}" in score.warnings[-1]


HEADER = "run_id,time_s,yaw_deg,pitch_deg,roll_deg,study"
ROW = "0,40,50,4,-7,DIGEST"


def text(*rows, header=HEADER):
    return "\n".join([header, *rows, ""])


FAULTS = {
    "is of another study: digest DIGEST, 0123 there": text(ROW, "1,40,50,4,-7,0123"),
    "must name its columns in the first line": "# study = DIGEST\n" + text(ROW),
    "repeats column 'run_id'": text(f"{ROW},1", header=f"{HEADER},run_id"),
    "row 4: repeats its run_id and time_s": text(ROW, "1,40,50,4,-7,DIGEST", ROW),
    "row 3: no run of the export has this run_id (see": text(ROW, "0.5,40,50,4,-7,DIGEST"),
    "row 2: column 'yaw_deg': is not finite (leave": text("0,40,nan,4,-7,DIGEST"),
    "column 3: Row #2: CSV conversion error to double": text("0,40,north,4,-7,DIGEST"),
    "row 3: an angle is beyond 1e+06 deg": text(ROW, "1,40,50,1.1e6,-7,DIGEST"),
    "row 2: time_s is beyond its run, 0 to 40 s": text("0,41,50,4,-7,DIGEST"),
    "Row #4: Expected 6 columns, got 3": text(ROW, "1,39,50,4,-7,DIGEST", "1,40,50"),
    "lacks pitch_deg in": text(ROW, header=HEADER.replace("pitch_deg", "pitch_rad")),
    "row 2: sigma_yaw_deg must be": text(f"{ROW},0", header=f"{HEADER},sigma_yaw_deg"),
    "is no unit quaternion": "run_id,time_s,q_w,q_x,q_y,q_z,study\n0,40,1,1,0,0,DIGEST\n",
    "Empty CSV file": "",
}
"""Results files by their message."""


@pytest.mark.parametrize("message", FAULTS)
def test_faulty_results_are_one_line_and_write_nothing(message, arena, tmp_path, sinsjax):
    path = tmp_path / "faulty.csv"
    path.write_text(FAULTS[message].replace("DIGEST", arena.digest))
    code, _, error = sinsjax("score", arena.export, path)
    assert code == 2 and len(error.splitlines()) == 1
    assert str(path) in error and message.replace("DIGEST", arena.digest) in error
    assert not (arena.export / "scores" / "faulty").exists()


@pytest.mark.parametrize("name", ["initial.csv", "study.toml", "imu/draw_00003.csv"])
def test_export_that_has_changed_is_refused(name, arena, tmp_path):
    changed = Path(shutil.copytree(arena.export, tmp_path / "changed"))
    (changed / name).write_text((changed / name).read_text().replace("1", "2", 1))
    with pytest.raises(InputError, match=rf"{name}: has changed since it was exported"):
        score_results(changed, tmp_path / "mine.csv")


def test_other_mistakes_are_one_line(arena, tmp_path, sinsjax):
    path = tmp_path / "mine.csv"
    pyarrow.csv.write_csv(arena.last, path)
    os.mkfifo(tmp_path / "pipe.csv")
    out = tmp_path / "out"
    export, score = ("export", "paper1_resets", "-o", out), ("score", arena.export)
    cases = {
        "format: 'mat' is not one of psins, csv, parquet": (*export, "--format", "mat"),
        "frame: 'nwu' is not one of enu, ned": (*export, "--frame", "nwu"),
        "[passes]: a program reads a record once": (*export, "--set", "passes.stored_s=100"),
        "there is no such file": (*score, tmp_path / "none.csv"),
        "is not a regular file": (*score, tmp_path / "pipe.csv"),
        "contains no export": ("score", arena.export / "own", path),
        "'inertial' is a method of sinsjax": (*score, path, "--name", "inertial"),
        "--name: '../x' must begin with a letter or digit": (*score, path, "--name", "../x"),
    }
    for message, words in cases.items():
        code, _, error = sinsjax(*words)
        assert code == 2 and len(error.splitlines()) == 1 and message in error, error
    assert not out.exists()
    code, shown, _ = sinsjax(*score, path)
    assert code == 0 and "Program" in shown


@pytest.mark.nightly
def test_drawn_starts_and_environments_find_their_runs(tmp_path):
    drawn = {"phi_u0_deg": {"uniform": [-20.0, 20.0]}, "latitude_deg": {"uniform": [-40.0, 40.0]}}
    arena = Arena(
        tmp_path,
        axes={"gyro_bias_deg_per_h": [0.0, 0.5], "method": ["compass"]},
        alignment=SETTINGS["alignment"] | {"phi_u0_deg": None},
        earth={"latitude_deg": None},
        drawn=drawn,
    )
    score = arena.score(arena.history, tmp_path)
    mine, own = rows_of(score, "mine"), rows_of(score, "compass")
    for name in ("phi_u_arcmin", "phi_u0_deg", "latitude_deg", "gyro_bias_deg_per_h"):
        np.testing.assert_allclose(numeric_column(mine, name), numeric_column(own, name), atol=1e-6)
    rows = read_initial(arena.export)
    assert len({row["file"] for row in rows}) == len(rows) == 16
    assert len({row["latitude_deg"] for row in rows}) == 8
    records = [pyarrow.csv.read_csv(arena.export / row["file"]) for row in rows[:2]]
    steady, biased = (numeric_column(record, "gyro_x_rad") for record in records)
    np.testing.assert_allclose(biased - steady, np.radians(0.5 / 3600) / 10, rtol=1e-6)


def test_program_joins_cases_with_every_condition():
    methods, starts = ["kalman5", "inertial", "kalman5"], [5.0, 5.0, 30.0]
    points = zip("abc", methods, starts, strict=True)
    cases = [dict(case=name, method=method, phi_u0_deg=start) for name, method, start in points]
    joined = add_program(small_study(cases=cases), "mine")
    assert joined.values("method") == [*methods, "mine", "mine"]
    assert joined.values("phi_u0_deg") == [*starts, 5.0, 30.0]
    zipped = {"some": {"method": methods, "phi_u0_deg": starts}}
    with pytest.raises(InputError, match=r"\[axes\]: zips methods with other keys"):
        add_program(small_study(axes=zipped), "mine")
