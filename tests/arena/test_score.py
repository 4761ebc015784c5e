"""Results that come back: judged as any run, compared on the same draws, or refused in one line."""

import json
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
from support.stored_results import store_results
from support.studies import small_study
from support.synthetic_tables import synthetic_summary

import sinsjax
from sinsjax.analysis.tables import numeric_column
from sinsjax.arena.comparison import FAILED_ARCMIN, compare
from sinsjax.arena.export import export_study
from sinsjax.arena.frames import from_angles, to_quaternion
from sinsjax.arena.runs import add_program, condition_keys
from sinsjax.arena.score import Score, score_results
from sinsjax.errors import InputError
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

DRAWS = 8
ANGLES = ("pitch_deg", "roll_deg", "yaw_deg")
SETTINGS: dict[str, Any] = {
    "study": {
        **{"duration_s": 40.0, "rate_hz": 10.0, "draws": DRAWS, "window_s": [20, 40]},
        **{"success_band_arcmin": 600.0, "report_times_s": [20.0]},
    },
    "motion": {"yaw_center_deg": 50.0, "pitch_center_deg": 4.0, "roll_center_deg": -7.0},
    "axes": {"method": ["kalman_sincos", "inertial"], "phi_u0_deg": [5.0, 30.0]},
}
"""A study whose methods find north within some degrees."""

QUICK: dict[str, Any] = {
    "alignment": {"phi_e0_deg": 0.1, "phi_n0_deg": 0.1},
    "compass": {"level_sigma_per_s": 0.5, "level_time_s": 10.0, "azimuth_sigma_per_s": 0.1},
    "axes": {"method": ["compass", "inertial"], "phi_u0_deg": [5.0, 30.0]},
}
"""Changes to it: another method that uses the start, and is compiled more quickly."""


class Arena:
    """An exported study, its sweep, and the results of one of its methods as a program's."""

    def __init__(self, folder: Path, **changes: Any) -> None:
        self.study: Study = small_study(**(SETTINGS | changes))
        self.export = export_study(self.study, folder / "export")
        self.sweep = folder / "sweep"
        results = sinsjax.run_into(self.study, self.sweep, curves=True)
        first = pyarrow.csv.read_csv(self.export / "initial.csv")
        self.digest = first["study"][0].as_py()
        curves = results.curves
        ours = pc.is_in(curves["run_id"], first["run_id"].combine_chunks())
        self.curves = curves.filter(ours).combine_chunks()

    def history(self, *names: str) -> pa.Table:
        """The program's results at all record times."""
        names = names or ANGLES
        table = self.curves.select(["run_id", "time_s", *names])
        return table.append_column("study", pa.array([self.digest] * len(table)))

    def last(self) -> pa.Table:
        """The program's results at the end of each run."""
        table = self.history()
        return table.filter(pc.equal(table["time_s"], 40.0))

    def write(self, table: pa.Table, path: Path) -> Path:
        """Write results as CSV or Parquet."""
        write = pq.write_table if path.suffix == ".parquet" else pyarrow.csv.write_csv
        write(table, path)
        return path

    def score(self, table: pa.Table, folder: Path, **options: Any) -> Score:
        """Score some results against the sweep."""
        path = self.write(table, folder / "mine.csv")
        return score_results(
            self.export, path, against=self.sweep, out=folder / "scored", **options
        )


@pytest.fixture(scope="module")
def arena(tmp_path_factory: pytest.TempPathFactory) -> Arena:
    return Arena(tmp_path_factory.mktemp("arena"), **QUICK)


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    return command_line(monkeypatch, capsys)


def replace(table: pa.Table, **columns: Any) -> pa.Table:
    for name, values in columns.items():
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    return table


def turned(table: pa.Table, angles: Any) -> pa.Table:
    """Results with pitch, roll and yaw changed by a function of them."""
    given = [table[name].to_numpy() for name in ANGLES]
    return replace(table, **dict(zip(ANGLES, angles(*given), strict=True)))


def rows_of(score: Score, method: str) -> pa.Table:
    table = sinsjax.read_summary(score.directory)
    return table.filter(pc.equal(table["method"], method))


def test_methods_own_attitudes_get_the_methods_own_row_among_those_of_the_sweep(
    arena: Arena, tmp_path: Path
) -> None:
    score = arena.score(arena.history(), tmp_path)
    assert score.missing == [] and score.warnings == []
    mine, own = rows_of(score, "mine"), rows_of(score, "compass")
    for name in mine.column_names:
        if mine[name].type == pa.float64() and not name.startswith(("sigma", "nees", "nis", "p_")):
            found, expected = (numeric_column(rows, name) for rows in (mine, own))
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-6, err_msg=name)
    assert mine["status"].to_pylist() == own["status"].to_pylist()
    swept = sinsjax.read_summary(arena.sweep)
    for method in arena.study.methods:
        there, here = swept.filter(pc.equal(swept["method"], method)), rows_of(score, method)
        for name in there.column_names:
            if name not in ("run_id", "variant_id"):
                assert here[name].to_pylist() == there[name].to_pylist(), name


def test_some_of_the_draws_are_scored_alone(arena: Arena, tmp_path: Path) -> None:
    export = export_study(arena.study, tmp_path / "some", draws=(2, 5))
    first = pyarrow.csv.read_csv(export / "initial.csv")
    table, ids = arena.last(), first["run_id"].combine_chunks()
    digest = pa.array([first["study"][0].as_py()] * len(table))
    table = replace(table, study=digest).filter(pc.is_in(table["run_id"], ids))
    path = arena.write(table, tmp_path / "mine.csv")
    score = score_results(export, path, against=arena.sweep, out=tmp_path / "out")
    assert score.missing == [] and score.comparison.draws == 3
    whole = rows_of(arena.score(arena.last(), tmp_path), "mine")
    expected = whole["phi_u_arcmin"].to_pylist()[4:10]
    assert rows_of(score, "mine")["phi_u_arcmin"].to_pylist() == expected


def test_results_may_be_quaternions_of_the_other_frame_or_by_draw(
    arena: Arena, tmp_path: Path
) -> None:
    table = arena.last()
    angles = {name: table[name].to_numpy() for name in ANGLES}
    radians = np.radians(np.stack([*angles.values()], axis=-1))
    q = to_quaternion(from_angles(radians, "enu"), "ned")
    first = pyarrow.csv.read_csv(arena.export / "initial.csv").to_pandas().set_index("run_id")
    by_draw = first.loc[table["run_id"].to_numpy()]
    run = {"run_id": table["run_id"]}
    forms: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
        "draw": ({key: by_draw[key].to_numpy() for key in ("draw_id", "variant_id")}, angles),
        "ned": (run, angles | {"yaw_deg": -angles["yaw_deg"]}),
        "q ned": (run, {f"q_{axis}": q[:, i] for i, axis in enumerate("wxyz")}),
    }
    expected = numeric_column(rows_of(arena.score(table, tmp_path), "mine"), "phi_u_arcmin")
    for name, (runs, attitude) in forms.items():
        given = pa.table(runs | {"time_s": table["time_s"], "study": table["study"]} | attitude)
        frame = {"frame": "ned"} if "ned" in name else {}
        score = arena.score(given, tmp_path, overwrite=True, **frame)
        found = numeric_column(rows_of(score, "mine"), "phi_u_arcmin")
        np.testing.assert_allclose(found, expected, atol=1e-6, err_msg=name)


def test_sigmas_give_nees_and_the_share_of_p_above_the_error(arena: Arena, tmp_path: Path) -> None:
    table = arena.history()
    for angle, sigma in (("yaw", 2.0), ("pitch", 0.1), ("roll", 0.2)):
        table = table.append_column(f"sigma_{angle}_deg", pa.array([sigma] * len(table)))
    score = arena.score(table, tmp_path)
    rows = rows_of(score, "mine")
    e, n, u = (numeric_column(rows, f"phi_{a}_arcmin") / 60 for a in "enu")
    heading = np.radians(numeric_column(rows, "yaw_deg"))
    about_right = np.cos(heading) * e + np.sin(heading) * n
    about_front = -np.sin(heading) * e + np.cos(heading) * n
    expected = (about_right / 0.1) ** 2 + (about_front / 0.2) ** 2 + (u / 2) ** 2
    np.testing.assert_allclose(numeric_column(rows, "nees"), expected, rtol=1e-6)
    np.testing.assert_allclose(numeric_column(rows, "sigma_u_arcmin"), 120.0)
    assert score.comparison.overall.nees is not None
    alone = table.drop_columns(["sigma_pitch_deg", "sigma_roll_deg"])
    assert "no NEES, which needs" in arena.score(alone, tmp_path, overwrite=True).warnings[0]


def test_history_that_begins_late_settles_no_sooner(arena: Arena, tmp_path: Path) -> None:
    table = arena.history()
    late = table.filter(pc.greater_equal(table["time_s"], 20.0))
    rows = rows_of(arena.score(late, tmp_path), "mine")
    whole = rows_of(arena.score(table, tmp_path, overwrite=True), "mine")
    settled, expected = (numeric_column(rows, "settle_600_truth_s") for rows in (rows, whole))
    assert (expected < 20).any()
    np.testing.assert_array_equal(settled, np.maximum(expected, 20.0))


def test_missing_and_unfinished_runs_are_failures_and_listed(arena: Arena, tmp_path: Path) -> None:
    table = arena.history()
    ids = sorted(set(table["run_id"].to_pylist()))
    keep = pc.and_(
        pc.not_equal(table["run_id"], ids[3]),
        pc.or_(pc.not_equal(table["run_id"], ids[5]), pc.less(table["time_s"], 39.5)),
    )
    score = arena.score(table.filter(keep), tmp_path)
    assert score.missing == [ids[3], ids[5]]
    missing = f"2 of {len(ids)} runs have no row at their end, 40 s, and count as failures"
    assert f"{missing}: run_id {ids[3]}, {ids[5]}" in score.warnings[0]
    rows = rows_of(score, "mine").to_pandas()
    assert (rows["status"] == "nonfinite").sum() == 2
    errors = np.abs(np.nan_to_num(rows["phi_u_arcmin"], nan=FAILED_ARCMIN))
    assert score.comparison.overall.program.value == pytest.approx(errors.mean())


def test_verdict_is_the_paired_difference_to_the_best_method(arena: Arena, tmp_path: Path) -> None:
    worse = turned(arena.history(), lambda pitch, roll, yaw: (pitch, roll, yaw + 20.0))
    score = arena.score(worse, tmp_path)
    found = score.comparison
    table = sinsjax.read_summary(score.directory).to_pandas()
    table["error"] = table["phi_u_arcmin"].abs()
    errors = table.pivot_table(index="draw_id", columns="method", values="error", aggfunc="mean")
    own = errors[["compass", "inertial"]]
    halves = [own[own.index % 2 != half].mean().idxmin() for half in (0, 1)]
    rival = np.array([own.loc[draw, halves[draw % 2]] for draw in own.index])
    assert found.overall.difference.value == pytest.approx((errors["mine"] - rival).mean())
    assert found.best == own.mean().idxmin()
    assert found.is_sure and found.verdict.startswith("mine is worse than the best of 2 methods")
    assert found.enough_draws is not None and found.enough_draws <= DRAWS
    assert len(found.conditions) == 2


def test_best_method_is_chosen_by_the_draws_that_it_is_not_judged_on() -> None:
    """Each method is the better one on half of the draws, and stands for it on the others."""
    study = add_program(
        small_study(study={"draws": 8}, axes={"method": ["kalman5", "inertial"]}), "mine"
    )
    errors = [[10.0, 30.0, 42.0], [50.0, 20.0, 42.0]] * 4
    table = synthetic_summary(study, phi_u_arcmin=np.ravel(errors))
    found = compare(study, table, "mine", condition_keys(study))
    assert study.methods == ("kalman5", "inertial", "mine")
    assert found.overall.best.value == pytest.approx((30.0 + 50.0) / 2)
    assert found.overall.difference.value == pytest.approx(42.0 - 40.0)


READINGS = {
    "is yaw mirrored": lambda pitch, roll, yaw: (pitch, roll, -yaw),
    "are the angles in radians": lambda *angles: tuple(np.radians(a) for a in angles),
    "is yaw off by 90 deg": lambda pitch, roll, yaw: (pitch, roll, yaw + 90),
    "are the angles in radians and is yaw mirrored": lambda pitch, roll, yaw: tuple(
        np.radians(a) for a in (pitch, roll, -yaw)
    ),
}


@pytest.mark.nightly(fast=("is yaw mirrored", "are the angles in radians and is yaw mirrored"))
@pytest.mark.parametrize("reading", READINGS)
def test_other_convention_is_suspected_by_name(reading: str, arena: Arena, tmp_path: Path) -> None:
    score = arena.score(turned(arena.last(), READINGS[reading]), tmp_path)
    assert f"the attitudes of mine: {reading}" in score.warnings[-1]
    manifest = json.loads((score.directory / "manifest.json").read_text())
    assert manifest["warnings"] == score.warnings


def test_other_quaternions_are_suspected_by_name(arena: Arena, tmp_path: Path) -> None:
    table = arena.last()
    angles = np.stack([table[name].to_numpy() for name in ANGLES], axis=-1)
    q = to_quaternion(from_angles(np.radians(angles), "enu"), "enu")
    forms = {"is the scalar of the quaternions last": np.roll(q, -1, axis=-1)}
    forms["are the quaternions from navigation to body axes"] = q * [1, -1, -1, -1]
    for reading, values in forms.items():
        columns = {f"q_{axis}": values[:, i] for i, axis in enumerate("wxyz")}
        given = pa.table({name: table[name] for name in ("run_id", "time_s", "study")} | columns)
        score = arena.score(given, tmp_path, overwrite=True)
        assert f"the attitudes of mine: {reading}" in score.warnings[-1]


def test_second_program_joins_the_first(arena: Arena, tmp_path: Path) -> None:
    first = arena.score(arena.history(), tmp_path)
    path = arena.write(arena.last(), tmp_path / "other.csv")
    second = score_results(arena.export, path, against=first.directory, out=tmp_path / "both")
    assert second.study.methods == ("compass", "inertial", "mine", "other")
    assert second.comparison.options == 2
    mine = rows_of(second, "mine")["phi_u_arcmin"].to_pylist()
    assert mine == rows_of(first, "mine")["phi_u_arcmin"].to_pylist()


HEADER = "run_id,time_s,yaw_deg,pitch_deg,roll_deg"
BY_DRAW = HEADER.replace("run_id", "draw_id,variant_id")
ROW, LINE = "0,40,50,4,-7", "# study = DIGEST"


def text(*rows: str, header: str = HEADER, first: str = LINE) -> str:
    return "\n".join([first, header, *rows, ""])


FAULTS = {
    "is of another study: digest 0123456789abcdef there": text(
        ROW, first="# study = 0123456789abcdef"
    ),
    "is of another study: digest none there": text(ROW, first=""),
    "is of another study: digest 0123, ": text(
        f"{ROW},DIGEST", f"{ROW},0123", header=f"{HEADER},study"
    ),
    "repeats '# study =' in its header": text(ROW, first=f"{LINE}\n{LINE}"),
    "repeats '# frame =' in its header": text(ROW, first=f"{LINE}\n# frame = enu\n% frame: ned"),
    "repeats 'run_id' in its header": text(f"{ROW},1", header=f"{HEADER},run_id"),
    "row 5: repeats its run_id and time_s": text(ROW, "1,40,50,4,-7", ROW),
    "row 3: no run of the export has this run_id (see": text("777,40,50,4,-7"),
    "row 4: no run of the export has this run_id (see": text(ROW, "0.5,40,50,4,-7"),
    "row 3: no run of the export has this draw_id and": text("0,0.5,40,50,4,-7", header=BY_DRAW),
    "row 4: no run of the export has this draw_id and": text(
        f"0,{ROW}", f"0.25,{ROW}", header=BY_DRAW
    ),
    "row 3: column 'yaw_deg': is not finite (leave": text("0,40,nan,4,-7"),
    "Row #3: CSV conversion error to double": text("0,40,north,4,-7"),
    "row 4: an angle is beyond 1e+06 deg": text(ROW, "1,40,50,1.1e6,-7"),
    "row 3: time_s is beyond its run, 0 to 40 s": text("0,41,50,4,-7"),
    "Row #5: Expected 5 columns, got 3": text(ROW, "1,39,50,4,-7", "1,40,50"),
    "lacks time_s (README.txt": text(ROW, header=HEADER.replace("time_s", "time")),
    "lacks pitch_deg (README.txt": text(ROW, header=HEADER.replace("pitch_deg", "pitch_rad")),
    "row 3: sigma_yaw_deg must be": text(f"{ROW},0", header=f"{HEADER},sigma_yaw_deg"),
    "is no unit quaternion": text("0,40,1,1,0,0", header="run_id,time_s,q_w,q_x,q_y,q_z"),
    "has both angles and quaternions": text(f"{ROW},1,0,0,0", header=f"{HEADER},q_w,q_x,q_y,q_z"),
    "Empty CSV file": "",
}
"""Results files by their message."""


@pytest.mark.parametrize("message", FAULTS)
def test_faulty_results_are_one_line_and_write_nothing(
    message: str, arena: Arena, tmp_path: Path, command: Command
) -> None:
    path, out = tmp_path / "mine.csv", tmp_path / "out"
    path.write_text(FAULTS[message].replace("DIGEST", arena.digest))
    code, _, error = command("score", arena.export, path, "-o", out, "--against", arena.sweep)
    assert code == 2 and len(error.splitlines()) == 1
    assert str(path) in error and message in error
    assert not out.exists()


def test_pipe_or_another_frame_than_that_of_the_file_is_refused(
    arena: Arena, tmp_path: Path
) -> None:
    os.mkfifo(tmp_path / "pipe.csv")
    path = tmp_path / "mine.csv"
    path.write_text(text(ROW, first=f"# study = {arena.digest}\n# frame = enu"))
    for file, message in (
        ("pipe.csv", "is not a regular file"),
        ("mine.csv", "frame: 'enu and ned'"),
    ):
        with pytest.raises(InputError, match=rf"{re.escape(file)}: .*{message}"):
            score_results(arena.export, tmp_path / file, against=arena.sweep, frame="ned")


@pytest.mark.parametrize("name", ["initial.csv", "study.toml", "imu/draw_00003.csv"])
def test_export_that_has_changed_is_refused(name: str, arena: Arena, tmp_path: Path) -> None:
    changed = Path(shutil.copytree(arena.export, tmp_path / "changed"))
    (changed / name).write_text((changed / name).read_text().replace("1", "2", 1))
    path = arena.write(arena.last(), tmp_path / "mine.csv")
    with pytest.raises(InputError, match=rf"{name}: has changed since it was exported"):
        score_results(changed, path, against=arena.sweep)


def test_other_mistakes_of_a_score_are_one_line(
    arena: Arena, tmp_path: Path, command: Command
) -> None:
    path = arena.write(arena.last(), tmp_path / "mine.csv")
    other, out, against = small_study(study={"draws": 2}), tmp_path / "out", "--against"
    store_results(tmp_path / "other", other, synthetic_summary(other))
    few = arena.study.replace({"study.draws": 3})
    rows = sinsjax.read_summary(arena.sweep).slice(0, 3 * few.n_variants)
    store_results(tmp_path / "few", few, rows)
    cases = {
        "contains results of another study": (path, against, tmp_path / "other"),
        "few: has 3 whole draws, 0:8 are exported": (path, against, tmp_path / "few"),
        "there is no such file": (tmp_path / "none.csv",),
        "'inertial' is a method of sinsjax": (path, "--name", "inertial"),
        "--name: '../x' must begin with a letter or digit": (path, "--name", "../x"),
        "is read, and cannot be written to": (path, against, arena.sweep, "-o", arena.sweep),
    }
    for message, words in cases.items():
        code, _, error = command("score", arena.export, "-o", out, *words)
        assert code == 2 and len(error.splitlines()) == 1 and message in error, error
        assert not out.exists()
    assert "contains no export" in command("score", arena.sweep, path)[2]
    score = ("score", arena.export, path, "-o", out, against, arena.sweep)
    assert command(*score)[0] == 0
    again = command(*score)
    assert again[0] == 2 and "already contains results" in again[2]


@pytest.mark.nightly
def test_drawn_starts_and_environments_find_their_runs(tmp_path: Path) -> None:
    drawn = {"phi_u0_deg": {"uniform": [-20.0, 20.0]}, "latitude_deg": {"uniform": [-40.0, 40.0]}}
    arena = Arena(
        tmp_path,
        axes={"gyro_bias_deg_per_h": [0.0, 0.5], "method": ["kalman_sincos"]},
        alignment={"phi_u0_deg": None},
        earth={"latitude_deg": None},
        drawn=drawn,
    )
    score = arena.score(arena.history(), tmp_path)
    mine, own = rows_of(score, "mine"), rows_of(score, "kalman_sincos")
    for name in ("phi_u_arcmin", "phi_u0_deg", "latitude_deg", "gyro_bias_deg_per_h"):
        np.testing.assert_allclose(numeric_column(mine, name), numeric_column(own, name), atol=1e-6)


def test_program_joins_cases_and_zips_with_every_condition() -> None:
    cases = [
        {"case": "a", "method": "kalman5", "phi_u0_deg": 5.0},
        {"case": "b", "method": "inertial", "phi_u0_deg": 5.0},
        {"case": "c", "method": "kalman5", "phi_u0_deg": 30.0},
    ]
    zipped = {"some": {key: [case[key] for case in cases] for key in ("method", "phi_u0_deg")}}
    for study in (small_study(cases=cases), small_study(axes=zipped)):
        joined = add_program(study, "mine")
        found = zip(joined.values("method"), joined.values("phi_u0_deg"), strict=True)
        assert [point for point in found if point[0] == "mine"] == [("mine", 5.0), ("mine", 30.0)]
        assert joined.n_variants == 5
    with pytest.raises(InputError, match="has results of 'mine' already"):
        add_program(joined, "mine")
