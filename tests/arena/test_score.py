"""Results that come back: judged as any run, compared on the same draws, or refused in one line."""

import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from support.commands import Command, command_line
from support.studies import small_study

import sinsjax
from sinsjax.analysis.tables import numeric_column
from sinsjax.arena.export import export_study, from_angles, to_quaternion
from sinsjax.arena.runs import add_program
from sinsjax.arena.score import score_results
from sinsjax.errors import InputError
from sinsjax.execution.results import Results
from sinsjax.report.monte_carlo import build_report
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

ANGLES = ("pitch_deg", "roll_deg", "yaw_deg")
SETTINGS: dict[str, Any] = {
    "study": {
        **{"duration_s": 40.0, "rate_hz": 10.0, "draws": 8, "window_s": [20, 40]},
        **{"success_band_arcmin": 600.0, "report_times_s": [20.0]},
    },
    "motion": {"yaw_center_deg": 50.0, "pitch_center_deg": 4.0, "roll_center_deg": -7.0},
    "alignment": {"phi_e0_deg": 0.1, "phi_n0_deg": 0.1},
    "compass": {"level_sigma_per_s": 0.5, "level_time_s": 10.0, "azimuth_sigma_per_s": 0.1},
    "axes": {"method": ["compass", "inertial"], "phi_u0_deg": [5.0, 30.0]},
}
"""A study whose methods find north within some degrees."""


class Arena:
    """An exported study, its own results, and those of one of its methods as a program's."""

    def __init__(self, folder: Path, **changes: Any) -> None:
        self.study: Study = small_study(**(SETTINGS | changes))
        self.export = export_study(self.study, folder / "export")
        self.own = sinsjax.run_into(self.export / "study.toml", self.export / "own", curves=True)
        first = pyarrow.csv.read_csv(self.export / "initial.csv")
        self.digest = first["study"][0].as_py()
        curves = self.own.curves
        ours = pc.is_in(curves["run_id"], first["run_id"].combine_chunks())
        self.curves = curves.filter(ours).combine_chunks()

    def history(self) -> pa.Table:
        """The program's results at all record times."""
        table = self.curves.select(["run_id", "time_s", *ANGLES])
        return table.append_column("study", pa.array([self.digest] * len(table)))

    def last(self) -> pa.Table:
        """The program's results at the end of each run."""
        table = self.history()
        return table.filter(pc.equal(table["time_s"], 40.0))

    def score(self, table: pa.Table, folder: Path) -> Results:
        """Score some results, as "mine"."""
        pyarrow.csv.write_csv(table, folder / "mine.csv")
        return score_results(self.export, folder / "mine.csv")


@pytest.fixture(scope="module")
def arena(tmp_path_factory: pytest.TempPathFactory) -> Arena:
    return Arena(tmp_path_factory.mktemp("arena"))


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    return command_line(monkeypatch, capsys)


def replaced(table: pa.Table, angles: Any) -> pa.Table:
    """Results with pitch, roll and yaw, deg (rows, 3), changed by a function of them."""
    values = angles(np.stack([table[name].to_numpy() for name in ANGLES], axis=-1))
    names = ANGLES if values.shape[1] == 3 else ("q_w", "q_x", "q_y", "q_z")
    columns = {name: table[name] for name in ("run_id", "time_s", "study")}
    return pa.table(columns | dict(zip(names, values.T, strict=True)))


def quaternions(angles: np.ndarray, frame: str = "enu") -> np.ndarray:
    return to_quaternion(from_angles(np.radians(angles), "enu"), frame)


def rows_of(score: Results, method: str) -> pa.Table:
    return score.summary.filter(pc.equal(score.summary["method"], method))


def test_methods_own_attitudes_get_the_methods_own_row_among_those_of_the_sweep(
    arena: Arena, tmp_path: Path
) -> None:
    score = arena.score(arena.history(), tmp_path)
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
def test_results_may_be_quaternions_in_a_parquet_file_or_of_the_other_frame(
    frame: str, arena: Arena, tmp_path: Path
) -> None:
    table = arena.last()
    expected = numeric_column(rows_of(arena.score(table, tmp_path), "mine"), "phi_u_arcmin")
    export = export_study(arena.study, tmp_path / frame, frame=frame)
    shutil.copytree(arena.export / "own", export / "own")
    path = tmp_path / "mine.parquet"
    pq.write_table(replaced(table, lambda angles: quaternions(angles, frame)), path)
    found = numeric_column(rows_of(score_results(export, path), "mine"), "phi_u_arcmin")
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_sigma_of_the_heading_is_judged_by_the_error(arena: Arena, tmp_path: Path) -> None:
    table = arena.history()
    table = table.append_column("sigma_yaw_deg", pa.array([2.0] * len(table)))
    rows = rows_of(arena.score(table, tmp_path), "mine")
    error = numeric_column(rows, "phi_u_arcmin") - numeric_column(rows, "floor_arcmin")
    np.testing.assert_allclose(numeric_column(rows, "nis_u"), (error / 120) ** 2, rtol=1e-6)
    np.testing.assert_allclose(numeric_column(rows, "sigma_u_arcmin"), 120.0)


def test_history_that_begins_late_settles_no_sooner(arena: Arena, tmp_path: Path) -> None:
    table = arena.history()
    late = table.filter(pc.greater_equal(table["time_s"], 20.0))
    rows = rows_of(arena.score(late, tmp_path), "mine")
    whole = rows_of(arena.score(table, tmp_path), "mine")
    settled, expected = (numeric_column(rows, "settle_600_truth_s") for rows in (rows, whole))
    assert (expected < 19).any()
    np.testing.assert_array_equal(settled, np.maximum(expected, 19.0))


def test_missing_and_unfinished_runs_are_failures_and_listed(arena: Arena, tmp_path: Path) -> None:
    table = arena.history()
    ids = sorted(set(table["run_id"].to_pylist()))
    keep = pc.and_(
        pc.not_equal(table["run_id"], ids[3]),
        pc.or_(pc.not_equal(table["run_id"], ids[5]), pc.less(table["time_s"], 39.5)),
    )
    score = arena.score(table.filter(keep), tmp_path)
    missing = f"2 of {len(ids)} runs have no row at their end, 40 s, and count as failures"
    assert f"{missing}: run_id {ids[3]}, {ids[5]}" in score.warnings[0]
    rows = rows_of(score, "mine").to_pandas()
    assert (rows["status"] == "nonfinite").sum() == 2
    errors = np.abs(np.nan_to_num(rows["phi_u_arcmin"], nan=180 * 60))
    assert f"mean heading error {errors.mean():.0f} " in report_of(score)


def report_of(score: Results) -> str:
    """The lines of the report about the program."""
    (fact,) = (f for f in build_report(score, with_tables=False).facts if f.label == "Program")
    return fact.text


def test_report_has_the_paired_difference_to_the_best_method(arena: Arena, tmp_path: Path) -> None:
    worse = replaced(arena.history(), lambda angles: angles + [0.0, 0.0, 20.0])
    score = arena.score(worse, tmp_path)
    table = score.summary.to_pandas()
    table["error"] = table["phi_u_arcmin"].abs()
    errors = table.pivot_table(index="draw_id", columns="method", values="error", aggfunc="mean")
    best = errors[["compass", "inertial"]].mean().idxmin()
    more = (errors["mine"] - errors[best]).mean()
    text = rf"on the same draws {more:.0f} \[\S+ \S+\]' more than that of {best}"
    assert re.search(text, report_of(score))


READINGS = {
    "is yaw mirrored": lambda angles: angles * [1, 1, -1],
    "are the angles in radians": np.radians,
    "is yaw off by 90 deg": lambda angles: angles + [0, 0, 90],
    "is the scalar of the quaternions last": lambda a: np.roll(quaternions(a), -1, axis=-1),
    "are the quaternions from navigation to body axes": lambda a: quaternions(a) * [1, -1, -1, -1],
}


@pytest.mark.nightly(fast=("is yaw mirrored", "is the scalar of the quaternions last"))
@pytest.mark.parametrize("reading", READINGS)
def test_other_convention_is_suspected_by_name(reading: str, arena: Arena, tmp_path: Path) -> None:
    score = arena.score(replaced(arena.last(), READINGS[reading]), tmp_path)
    assert f"mine: {reading}" in score.warnings[-1]


HEADER = "run_id,time_s,yaw_deg,pitch_deg,roll_deg,study"
ROW = "0,40,50,4,-7,DIGEST"


def text(*rows: str, header: str = HEADER) -> str:
    return "\n".join([header, *rows, ""])


FAULTS = {
    "is of another study: digest DIGEST, 0123 there": text(ROW, "1,40,50,4,-7,0123"),
    "must name its columns in the first line": "# study = DIGEST\n" + text(ROW),
    "repeats column 'run_id'": text(f"{ROW},1", header=f"{HEADER},run_id"),
    "row 4: repeats its run_id and time_s": text(ROW, "1,40,50,4,-7,DIGEST", ROW),
    "row 3: no run of the export has this run_id (see": text(ROW, "0.5,40,50,4,-7,DIGEST"),
    "row 2: column 'yaw_deg': is not finite (leave": text("0,40,nan,4,-7,DIGEST"),
    "Row #2: CSV conversion error to double": text("0,40,north,4,-7,DIGEST"),
    "row 3: an angle is beyond 1e+06 deg": text(ROW, "1,40,50,1.1e6,-7,DIGEST"),
    "row 2: time_s is beyond its run, 0 to 40 s": text("0,41,50,4,-7,DIGEST"),
    "Row #4: Expected 6 columns, got 3": text(ROW, "1,39,50,4,-7,DIGEST", "1,40,50"),
    "lacks pitch_deg in": text(ROW, header=HEADER.replace("pitch_deg", "pitch_rad")),
    "row 2: sigma_yaw_deg must be": text(f"{ROW},0", header=f"{HEADER},sigma_yaw_deg"),
    "is no unit quaternion": text(
        "0,40,1,1,0,0,DIGEST", header="run_id,time_s,q_w,q_x,q_y,q_z,study"
    ),
    "Empty CSV file": "",
}
"""Results files by their message."""


@pytest.mark.parametrize("message", FAULTS)
def test_faulty_results_are_one_line_and_write_nothing(
    message: str, arena: Arena, tmp_path: Path, command: Command
) -> None:
    path = tmp_path / "faulty.csv"
    path.write_text(FAULTS[message].replace("DIGEST", arena.digest))
    code, _, error = command("score", arena.export, path)
    assert code == 2 and len(error.splitlines()) == 1
    assert str(path) in error and message.replace("DIGEST", arena.digest) in error
    assert not (arena.export / "scores" / "faulty").exists()


@pytest.mark.parametrize("name", ["initial.csv", "study.toml", "imu/draw_00003.csv"])
def test_export_that_has_changed_is_refused(name: str, arena: Arena, tmp_path: Path) -> None:
    changed = Path(shutil.copytree(arena.export, tmp_path / "changed"))
    (changed / name).write_text((changed / name).read_text().replace("1", "2", 1))
    with pytest.raises(InputError, match=rf"{name}: has changed since it was exported"):
        score_results(changed, tmp_path / "mine.csv")


def test_other_mistakes_of_a_score_are_one_line(
    arena: Arena, tmp_path: Path, command: Command
) -> None:
    path = tmp_path / "mine.csv"
    pyarrow.csv.write_csv(arena.last(), path)
    os.mkfifo(tmp_path / "pipe.csv")
    cases = {
        "there is no such file": (arena.export, tmp_path / "none.csv"),
        "is not a regular file": (arena.export, tmp_path / "pipe.csv"),
        "contains no export": (arena.export / "own", path),
        "'inertial' is a method of sinsjax": (arena.export, path, "--name", "inertial"),
        "--name: '../x' must begin with a letter or digit": (arena.export, path, "--name", "../x"),
    }
    for message, words in cases.items():
        code, _, error = command("score", *words)
        assert code == 2 and len(error.splitlines()) == 1 and message in error, error
    code, out, _ = command("score", arena.export, path)
    assert code == 0 and "Program" in out


@pytest.mark.nightly
def test_drawn_starts_and_environments_find_their_runs(tmp_path: Path) -> None:
    drawn = {"phi_u0_deg": {"uniform": [-20.0, 20.0]}, "latitude_deg": {"uniform": [-40.0, 40.0]}}
    arena = Arena(
        tmp_path,
        axes={"gyro_bias_deg_per_h": [0.0, 0.5], "method": ["compass"]},
        alignment=SETTINGS["alignment"] | {"phi_u0_deg": None},
        earth={"latitude_deg": None},
        drawn=drawn,
    )
    score = arena.score(arena.history(), tmp_path)
    mine, own = rows_of(score, "mine"), rows_of(score, "compass")
    for name in ("phi_u_arcmin", "phi_u0_deg", "latitude_deg", "gyro_bias_deg_per_h"):
        np.testing.assert_allclose(numeric_column(mine, name), numeric_column(own, name), atol=1e-6)


def test_program_joins_cases_with_every_condition() -> None:
    cases = [
        {"case": "a", "method": "kalman5", "phi_u0_deg": 5.0},
        {"case": "b", "method": "inertial", "phi_u0_deg": 5.0},
        {"case": "c", "method": "kalman5", "phi_u0_deg": 30.0},
    ]
    joined = add_program(small_study(cases=cases), "mine")
    found = zip(joined.values("method"), joined.values("phi_u0_deg"), strict=True)
    assert [point for point in found if point[0] == "mine"] == [("mine", 5.0), ("mine", 30.0)]
    assert joined.n_variants == 5
    zipped = {"some": {key: [case[key] for case in cases] for key in ("method", "phi_u0_deg")}}
    with pytest.raises(InputError, match=r"\[axes\]: zips methods with other keys"):
        add_program(small_study(axes=zipped), "mine")
