"""Commands as a user types them: their results, and one clear line for every mistake."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import tomli_w
from support.commands import Command, command_line
from support.studies import BASE, small_study, swing_deg, with_paper_values
from support.sweep_directories import read_files_and_times

from sinsjax.arena.simulated_record import simulated_record
from sinsjax.execution.results import read_curves, read_summary
from sinsjax.records import (
    Record,
    write_psins,
)

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]


@pytest.fixture
def sinsjax(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Run a command line in this process; gives exit code, output and error output."""
    return command_line(monkeypatch, capsys)


def write_study(folder: Path, **changes: Any) -> Path:
    """A small study file with sections changed; a key set to None is left out."""
    data: dict[str, Any] = {name: dict(section) for name, section in BASE.items()}
    for name, change in changes.items():
        if change is None:
            del data[name]
        elif isinstance(change, dict):
            merged = data.get(name, {}) | change
            data[name] = {key: value for key, value in merged.items() if value is not None}
        else:
            data[name] = change
    path = folder / "study.toml"
    path.write_text(tomli_w.dumps(with_paper_values(data)), encoding="utf-8")
    return path


TWO: dict[str, Any] = {
    "axes": {"phi_u0_deg": [0.0, 30.0]},
    "resets": {"reset_times_s": [2.5]},
}
"""Two variants, 6 runs: tests share the compiled program."""

RECORDED: dict[str, Any] = {
    "study": {"duration_s": 2.0, "draws": None, "window_s": [0, 2]},
    "motion": None,
    "sensors": None,
    "alignment": {"phi_e0_deg": 1.0, "phi_n0_deg": 0.0, "phi_u0_deg": 3.0},
    "record": {"format": "psins", "start_s": [0.0, 1.0]},
    "coarse": {"coarse_duration_s": 3.0},
}


@pytest.fixture(scope="module")
def record() -> Record:
    return simulated_record(small_study())


def test_run_writes_results_and_figures_and_prints_table(sinsjax: Command, tmp_path: Path) -> None:
    config = write_study(tmp_path, **TWO)
    out = tmp_path / "out"
    code, told, _ = sinsjax("run", config, "-o", out)
    assert code == 0
    summary, curves = read_summary(out), read_curves(out)
    assert summary["run_id"].to_pylist() == list(range(6))
    assert summary["phi_u0_deg"].to_pylist() == [0.0, 30.0] * 3
    assert curves.num_rows == 6 * 6
    last = curves.filter(pa.compute.equal(curves["time_s"], 6.0))
    np.testing.assert_array_equal(last["phi_u_arcmin"], summary["phi_u_arcmin"])
    assert list((out / "figures").glob("*.png"))
    assert "Settling" in told and "phi_u0_deg" not in told
    code, told, _ = sinsjax("report", out, "--full")
    assert code == 0 and "phi_u0_deg" in told
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["runs"] == manifest["runs_done"] == 6 and manifest["seed"] == 1
    assert (manifest["state"], manifest["config"]) == ("complete", config.name)
    assert manifest["devices"] == 2
    assert manifest["devices_are"] == "threads over one program"
    assert manifest["versions"].keys() >= {"sinsjax", "jaxlib", "pyarrow"}


def test_existing_results_are_overwritten_only_on_request(sinsjax: Command, tmp_path: Path) -> None:
    config, out = write_study(tmp_path, **TWO), tmp_path / "out"
    assert sinsjax("sweep", config, "-o", out)[0] == 0
    before = (out / "manifest.json").read_bytes()
    code, _, error = sinsjax("sweep", config, "-o", out)
    assert (code, error.count("\n")) == (2, 1)
    assert str(out) in error and "--overwrite" in error
    assert (out / "manifest.json").read_bytes() == before
    (out / "notes.txt").write_text("mine")
    assert sinsjax("sweep", config, "-o", out, "--overwrite")[0] == 0
    assert (out / "notes.txt").read_text() == "mine"


def test_resume_computes_only_missing_runs(sinsjax: Command, tmp_path: Path) -> None:
    config, out = write_study(tmp_path, **TWO, study={"draws": 100}), tmp_path / "out"
    words = ("sweep", config, "-o", out, "--resume")
    code, told, _ = sinsjax(*words, "--chunk-runs", 64)
    assert code == 0 and f"{out}: no results to resume, all runs are new." in told
    before = read_files_and_times(out)
    lost, *kept = sorted(out.glob("summary/*.parquet"))
    assert len(kept) == 1
    lost.unlink()
    code, told, _ = sinsjax(*words)
    assert code == 0 and "no results to resume" not in told
    assert "study: 72 of 200 runs already done" in told
    assert "study: 200 of 200 runs" in told
    assert {k: v[0] for k, v in read_files_and_times(out).items() if "summary" in k} == {
        k: v[0] for k, v in before.items() if "summary" in k
    }
    assert kept[0].stat().st_mtime_ns == before[str(kept[0].relative_to(out))][1]
    code, told, _ = sinsjax(*words)
    assert code == 0 and "study: 200 of 200 runs already done" in told
    assert "study: 200 runs in" in told


def test_invalid_executor_options_are_refused_in_one_line(sinsjax: Command, tmp_path: Path) -> None:
    words = ("sweep", write_study(tmp_path), "-o", tmp_path / "out")
    address = ("--scheduler", "tcp://127.0.0.1:1")
    none = tmp_path / "out"
    assert_refused(sinsjax(*words, "--devices", 1, *address), none, "--devices")
    assert_refused(sinsjax(*words, "--devices", 4096), none, "--devices", "4096")


def test_page_names_study_file_and_set_overrides(
    sinsjax: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    config = write_study(tmp_path / "mine", **TWO).relative_to(tmp_path)
    assert sinsjax("sweep", config, "-o", "out", "--set", "study.seed=3")[0] == 0
    assert sinsjax("report", "out", "--html", "page.html")[0] == 0
    assert "<p>mine/study.toml with study.seed=3; " in Path("page.html").read_text()


@pytest.mark.nightly
def test_align_with_reference_reports_true_misalignment(
    sinsjax: Command, tmp_path: Path, record: Record
) -> None:
    """The reference is the true attitude of the simulated swing, so phi is the true error."""
    write_psins(record, tmp_path / "swing.imu")
    times = np.arange(0, 6.01, 0.01)
    rows = np.column_stack([times, swing_deg(times)])
    header = "time_s,pitch_deg,roll_deg,yaw_deg"
    np.savetxt(tmp_path / "true.csv", rows, delimiter=",", header=header, comments="")
    config, out = write_study(tmp_path, **RECORDED), tmp_path / "out"
    words = ("align", tmp_path / "swing.imu", config, "--reference", tmp_path / "true.csv")
    assert sinsjax(*words, "-o", out)[0] == 0
    summary = read_summary(out)
    truth = 10 + 2.8 * np.sin(2 * np.pi * np.array([5.0, 6.0]) / 10)
    error = np.array(summary["yaw_deg"]) - truth
    # phi is the vector of C_true C_hat^T: about minus the error in yaw for small level angles.
    np.testing.assert_allclose(-np.array(summary["phi_u_arcmin"]) / 60, error, rtol=0.02)


MISTAKES: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "misspelt key": ({"alignment": {"phi_u0_degs": 3}}, ("phi_u0_degs", "phi_u0_deg")),
    "no heading": ({"motion": {"yaw_center_deg": None}}, ("yaw_center_deg", "required")),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_invalid_study_is_refused_in_one_line(sinsjax: Command, tmp_path: Path, name: str) -> None:
    changes, named = MISTAKES[name]
    config, out = write_study(tmp_path, **changes), tmp_path / "out"
    assert_refused(sinsjax("sweep", config, "-o", out), out, str(config), *named)


SPOILT: dict[str, tuple[Callable[[list[str]], list[str]], tuple[str, ...]]] = {
    "NaN": (lambda lines: [*lines[:299], "1 2 nan 4 5 6", *lines[300:]], ("row 300", "finite")),
    "too short": (lambda lines: lines[:500], ("5",)),
}


@pytest.mark.parametrize("name", SPOILT)
def test_corrupt_record_is_refused_in_one_line(
    sinsjax: Command, tmp_path: Path, record: Record, name: str
) -> None:
    change, named = SPOILT[name]
    path = tmp_path / "swing.imu"
    write_psins(record, path)
    lines = change(path.read_text().splitlines())
    path.write_text("".join(f"{line}\n" for line in lines))
    config, out = write_study(tmp_path, **RECORDED), tmp_path / "out"
    assert_refused(sinsjax("align", path, config, "-o", out), out, str(path), *named)


def test_missing_file_or_wrong_command_is_refused_in_one_line(
    sinsjax: Command, tmp_path: Path, record: Record
) -> None:
    out = tmp_path / "out"
    config = write_study(tmp_path)
    assert_refused(sinsjax("sweep", tmp_path / "no.toml", "-o", out), out, "no.toml")
    assert_refused(sinsjax("report", tmp_path / "nothing"), out, "nothing")
    assert_refused(sinsjax("align", tmp_path / "no.imu", config, "-o", out), out, "[record]")
    recorded = write_study(tmp_path, **RECORDED)
    assert_refused(sinsjax("align", tmp_path / "no.imu", recorded, "-o", out), out, "no.imu")
    assert_refused(sinsjax("sweep", recorded, "-o", out), out, "align")


def test_unwritable_output_is_refused_in_one_line(sinsjax: Command, tmp_path: Path) -> None:
    config = write_study(tmp_path)
    (tmp_path / "file").write_text("in the way")
    for out in (tmp_path / "file", tmp_path / "file" / "below", tmp_path / ("x" * 300)):
        assert_refused(sinsjax("sweep", config, "-o", out), tmp_path / "none", str(out))
    assert (tmp_path / "file").read_text() == "in the way"


def assert_refused(told: tuple[int, str, str], out: Path, *named: str) -> None:
    """Check for exit code 2, one line that names the mistake, no traceback, no files."""
    code, _, error = told
    assert code == 2, error
    (line,) = [line for line in error.splitlines() if not line.startswith("Warning: ")]
    assert line.startswith("error: "), error
    assert "Traceback" not in error
    for word in named:
        assert word in error, (word, error)
    assert not out.exists()
