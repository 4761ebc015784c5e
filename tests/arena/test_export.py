"""Draws as files: what a program reads is what the engine measures, and where a run starts."""

import csv
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from support.commands import Command, command_line
from support.studies import small_study

import sinsjax
from sinsjax.arena import export
from sinsjax.arena.export import (
    export_study,
    from_angles,
    from_quaternion,
    to_angles,
    to_quaternion,
)
from sinsjax.errors import InputError
from sinsjax.maths.rotations import misalignment
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

STARTS = {"phi_u0_deg": [5.0, 30.0]}


def study(**changes: Any) -> Study:
    return small_study(**({"axes": STARTS} | changes))


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    return command_line(monkeypatch, capsys)


def read_initial(folder: Path) -> list[dict[str, str]]:
    with (folder / "initial.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("kind", export.FORMATS)
def test_exported_record_has_the_engines_increments_to_the_bit(kind: str, tmp_path: Path) -> None:
    out = export_study(study(), tmp_path / "out", format=kind)
    for draw, path in enumerate(sorted(out.glob("imu/*"))):
        made = sinsjax.simulated_record(study(), draw)
        if kind == "psins":  # seven columns without names, the time last
            numbers = np.roll(np.loadtxt(path), 1, axis=1)
        else:
            table = pq.read_table(path) if kind == "parquet" else pyarrow.csv.read_csv(path)
            assert table.column_names[:2] == ["time_s", "gyro_x_rad"]
            assert table.column_names[-1] == "accel_z_m_per_s"
            numbers = np.stack([column.to_numpy() for column in table.columns], axis=-1)
        np.testing.assert_array_equal(numbers, np.c_[np.arange(1, 601) / 100, made.dtheta, made.dv])
    assert draw == 2


def test_increments_of_ned_axes_are_front_right_down(tmp_path: Path) -> None:
    folder = export_study(study(), tmp_path / "out", frame="ned")
    made = sinsjax.simulated_record(study(), 0)
    numbers = np.loadtxt(folder / "imu" / "draw_00000.csv", delimiter=",", skiprows=1)
    right, front, up = made.dtheta.T
    np.testing.assert_array_equal(numbers[:, 1:4], np.stack([front, right, -up], -1))
    assert 100 * numbers[:, 6].mean() == pytest.approx(-9.8, abs=0.01)  # specific force, z down


@pytest.mark.parametrize("frame", ["enu", "ned"])
def test_first_attitude_is_the_true_one_with_the_runs_misalignment(
    frame: str, tmp_path: Path
) -> None:
    made = study(motion={"yaw_center_deg": 40.0, "yaw_amplitude_deg": 0.0, "pitch_center_deg": 3.0})
    rows = read_initial(export_study(made, tmp_path / "out", frame=frame))
    assert [int(row["run_id"]) for row in rows] == list(range(6))
    angles = np.radians(
        [[float(row[f"{a}_deg"]) for a in ("pitch", "roll", "yaw")] for row in rows]
    )
    q = np.array([[float(row[f"q_{axis}"]) for axis in "wxyz"] for row in rows])
    from_euler, given = from_angles(angles, frame), from_quaternion(q, frame)
    truth = from_angles(np.radians([[3.0, 0.0, 40.0]] * 6), "enu")
    for attitude in (from_euler, given):
        phi = np.degrees(np.stack(jax.vmap(misalignment)(truth, attitude), -1))
        np.testing.assert_allclose(phi, [[5, 5, 5], [5, 5, 30]] * 3, atol=1e-9)
    assert {row["latitude_deg"] for row in rows} == {"32"}


def test_frames_agree_with_matrices_written_out() -> None:
    pitch, roll, heading = np.radians([10.0, -20.0, 50.0])
    (cp, cr, ch), (sp, sr, sh) = np.cos([pitch, roll, heading]), np.sin([pitch, roll, heading])
    about_down = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
    about_right = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_front = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    ned = about_down @ about_right @ about_front
    axes = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    attitude = from_angles(np.array([[pitch, roll, heading]]), "ned")
    w, x, y, z = (part[0] for part in attitude)
    enu = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(axes @ enu @ axes, ned, atol=1e-14)
    for frame in ("enu", "ned"):
        back = from_quaternion(to_quaternion(attitude, frame), frame)
        np.testing.assert_allclose(np.stack(back), np.stack(attitude), atol=1e-15)
        again = from_angles(to_angles(attitude, frame), frame)
        np.testing.assert_allclose(np.stack(again), np.stack(attitude), atol=1e-14)


def test_variants_that_differ_in_methods_alone_are_one_run_without_a_start_if_none_has_one(
    tmp_path: Path,
) -> None:
    methods = {"method": ["kalman5", "inertial"], **STARTS}
    rows = read_initial(export_study(study(axes=methods), tmp_path / "both"))[:2]
    assert [row["run_id"] for row in rows] == ["0", "1"] and rows[0]["yaw_deg"] != "nan"
    made = small_study(alignment={"method": "inertial"})
    row = read_initial(export_study(made, tmp_path / "none"))[0]
    assert row["yaw_deg"] == row["q_w"] == "nan"


@pytest.mark.nightly
def test_environments_and_drawn_latitudes_have_records_of_their_own(tmp_path: Path) -> None:
    made = study(
        axes={"gyro_bias_deg_per_h": [0.0, 10.0]},
        drawn={"latitude_deg": {"uniform": [-60.0, 60.0]}},
        earth={"latitude_deg": None},
    )
    folder = export_study(made, tmp_path / "out")
    rows = read_initial(folder)
    assert len({row["file"] for row in rows}) == len(rows) == 6
    assert len({row["latitude_deg"] for row in rows}) == 3
    biases = {}
    for row in rows[:2]:
        numbers = np.loadtxt(folder / row["file"], delimiter=",", skiprows=1)
        biases[row["variant_id"]] = numbers[:, 1]
    np.testing.assert_allclose(biases["1"] - biases["0"], np.radians(10 / 3600) / 100, rtol=1e-6)


def test_interrupted_export_is_unfinished(tmp_path: Path) -> None:
    def stop(progress: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_study(study(), tmp_path / "out", on_progress=stop)
    with pytest.raises(InputError, match="an unfinished one"):
        export.read_export(tmp_path / "out")
    with pytest.raises(InputError, match="is not empty"):
        export_study(study(), tmp_path / "out")


MISTAKES = {
    "format: 'mat' is not one of psins, csv, parquet": ["--format", "mat"],
    "frame: 'nwu' is not one of enu, ned": ["--frame", "nwu"],
    "[passes]: a program reads a record once": ["--set", "passes.stored_s=100"],
}


@pytest.mark.parametrize("message", MISTAKES)
def test_mistake_is_one_line_and_writes_nothing(
    message: str, command: Command, tmp_path: Path
) -> None:
    code, _, error = command("export", "paper1_resets", "-o", tmp_path / "out", *MISTAKES[message])
    assert code == 2 and len(error.splitlines()) == 1 and message in error
    assert not (tmp_path / "out").exists()


@pytest.mark.nightly
def test_filter_of_plain_numpy_finds_north_and_is_scored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    tables = sinsjax.load_study("arena").to_dict()
    tables["study"] |= {"duration_s": 20.0, "window_s": [10.0, 20.0], "draws": 2}
    tables["study"]["report_times_s"] = [10.0]
    made = sinsjax.study_from_dict(tables | {"cases": tables["cases"][:1]})
    draws = export_study(made, tmp_path / "draws", format="psins")
    script = Path(__file__).parents[2] / "docs" / "studies" / "comparison" / "numpy_filter.py"
    content = script.read_text(encoding="utf-8")
    assert len(content.splitlines()) <= 61 and "sinsjax" not in content.split('"""')[2]
    names: dict[str, Any] = {"__name__": "filter"}
    exec(compile(content, str(script), "exec"), names)
    names["main"](draws, "results.csv")
    score = sinsjax.score_results(draws, "results.csv", name="numpy filter")
    assert score.warnings == ()
    rows = score.summary.to_pandas()
    ours = rows[rows["method"] == "numpy filter"]["phi_u_arcmin"].to_numpy()
    own = rows[rows["case"] == "kalman5"]["phi_u_arcmin"].to_numpy()
    # The same filter and noise, but for the order of integration and feedback.
    np.testing.assert_allclose(ours, own, rtol=0.1)
    assert np.median(np.abs(ours)) < 1500  # from 30 and 80 deg, after 20 s
