"""Every check of a study runs once, with the same result for command line and Python."""

import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import Command, command_line
from support.stored_results import store_results
from support.studies import PAPER, small_study
from support.synthetic_tables import synthetic_summary

import sinsjax
from sinsjax.arena.simulated_record import simulated_record
from sinsjax.errors import InputError
from sinsjax.execution.prepare import RunOptions, prepare_job
from sinsjax.records import write_psins
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict, study_to_toml
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

ONCE = (
    "prepare.prepare_job",
    "checks.check_plugins",
    "checks.study_warnings",
    "forecast.forecast_sweep",
    "forecast.check_resources",
    "resume.check_available",
    "directory.check_unlocked",
    "directory.lock_directory",
)


def count_calls(action: Callable[[], Any]) -> Counter[str]:
    """Return how often each function of sinsjax is called, by module and name."""
    calls: Counter[str] = Counter()

    def note(frame: Any, event: str, argument: Any) -> None:
        code = frame.f_code
        if event == "call" and "/sinsjax/" in code.co_filename:
            calls[f"{Path(code.co_filename).stem}.{code.co_qualname}"] += 1

    sys.setprofile(note)
    try:
        action()
    finally:
        sys.setprofile(None)
    return calls


@pytest.fixture
def run_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Run a command line in this process; return exit code, output and error output."""
    return command_line(monkeypatch, capsys)


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[Path, Path, Study]:
    """A record, its study file, and the study."""
    study = study_from_dict(
        {
            "study": {"duration_s": 2.0, "window_s": [0, 2]},
            "alignment": {"phi_u0_deg": 3.0},
            "earth": {"latitude_deg": 32.0},
            "record": {"format": "psins", "start_s": [0.0, 1.0]},
            "coarse": {"coarse_duration_s": 3.0},
            "filter": PAPER,
        },
        "swing",
    )
    write_psins(simulated_record(small_study()), tmp_path / "log.imu")
    (tmp_path / "swing.toml").write_text(study_to_toml(study))
    return tmp_path / "log.imu", tmp_path / "swing.toml", study


def test_sweep_runs_every_check_once(run_command: Command, tmp_path: Path) -> None:
    config, out = tmp_path / "small.toml", tmp_path / "out"
    config.write_text(study_to_toml(small_study()))
    calls = count_calls(lambda: run_command("sweep", config, "-o", out))
    expected = dict.fromkeys(ONCE, 1)
    assert {name: calls[name] for name in ONCE} == expected
    assert calls["load.load_study"] == 2  # its file, and that of the results for the report
    calls = count_calls(lambda: run_command("sweep", config, "-o", out, "--resume"))
    assert {name: calls[name] for name in ONCE} == expected


@pytest.mark.nightly
def test_align_analyses_its_record_once(
    run_command: Command, recorded: tuple[Path, Path, Study], tmp_path: Path
) -> None:
    log, config, _ = recorded
    calls = count_calls(lambda: run_command("align", log, config, "-o", tmp_path / "out"))
    expected = dict.fromkeys(ONCE, 1) | {"checks.study_warnings": 0}
    assert {name: calls[name] for name in ONCE} == expected
    assert calls["psins.read_psins"] == 1
    assert calls["checks.check_record"] == calls["checks.check_stationary"] == 1


@pytest.mark.nightly
def test_python_align_gives_rows_of_command(
    run_command: Command, recorded: tuple[Path, Path, Study], tmp_path: Path
) -> None:
    log, config, study = recorded
    code, _, error = run_command("align", log, config, "-o", tmp_path / "out")
    assert code == 0 and error.count("\n") == error.count("cannot be determined") == 1
    stored, curves = sinsjax.read_summary(tmp_path / "out"), sinsjax.read_curves(tmp_path / "out")
    for results in (sinsjax.align(log, config), sinsjax.align(str(log), study)):
        assert results.summary.cast(stored.schema).equals(stored)
        assert results.curves.cast(curves.schema).equals(curves) and curves.num_rows
    changed = sinsjax.align(log, config, overrides={"record.start_s": [1.0]}, curves=False)
    assert changed.summary["start_s"].to_pylist() == [1.0] and changed.curves.num_rows == 0
    stored = sinsjax.load_increments(study, log)
    assert sinsjax.align(stored, study).summary.equals(sinsjax.align(log, study).summary)


def test_command_and_python_refuse_alike(
    run_command: Command, recorded: tuple[Path, Path, Study], tmp_path: Path
) -> None:
    log, config, study = recorded
    late = {"record.start_s": [100.0]}
    code, _, error = run_command(
        "align", log, config, "-o", tmp_path / "out", "--set", "record.start_s=[100.0]"
    )
    with pytest.raises(InputError) as refused:
        sinsjax.align(log, config, overrides=late)
    assert (code, error) == (2, f"error: {refused.value}\n")
    with pytest.raises(InputError, match=r"swing: \[record\]: the study needs a record \("):
        sinsjax.run(study)
    with pytest.raises(InputError, match=r"has no \[record\] section to read .*log.imu with"):
        sinsjax.align(log, small_study())
    assert not (tmp_path / "out").exists()


def test_refused_study_leaves_directory_as_it_was(tmp_path: Path) -> None:
    out = tmp_path / "out"
    wrong = small_study()
    stored = StoredRecord(simulated_record(wrong), None)
    with pytest.raises(InputError, match=r"has no \[record\] section"):
        prepare_job(wrong, record=stored, options=RunOptions(out))
    job = prepare_job(wrong, options=RunOptions(out))
    assert job.directory == out and job.forecast is not None and job.forecast.runs == 3
    assert not out.exists()


def test_added_axis_value_is_refused_with_way_on(tmp_path: Path) -> None:
    first = small_study(axes={"p0_yaw_deg": [10.0, 40.0]})
    more = small_study(axes={"p0_yaw_deg": [10.0, 40.0, 60.0]})
    out = store_results(tmp_path / "out", first, synthetic_summary(first))
    with pytest.raises(InputError) as refused:
        sinsjax.run_into(more, out, resume=True)
    line = str(refused.value)
    assert "[axes] p0_yaw_deg: [10.0, 40.0] there, [10.0, 40.0, 60.0] here" in line
    assert "axes.p0_yaw_deg=[60.0], into another directory" in line


@pytest.mark.nightly
def test_axis_value_in_another_directory_has_rows_of_whole_axis(tmp_path: Path) -> None:
    """The way on that the refusal of an added value names."""
    more = small_study(axes={"p0_yaw_deg": [10.0, 40.0, 60.0]})
    sinsjax.run_into(small_study(axes={"p0_yaw_deg": [10.0, 40.0]}), tmp_path / "out")
    sinsjax.run_into(small_study(axes={"p0_yaw_deg": [60.0]}), tmp_path / "more")
    whole = sinsjax.run(more).summary
    there = [sinsjax.read_summary(tmp_path / name) for name in ("out", "more")]
    errors = np.sort(np.concatenate([table["phi_u_arcmin"].to_numpy() for table in there]))
    assert np.array_equal(errors, np.sort(whole["phi_u_arcmin"].to_numpy()))
