"""A study is prepared with the same result for command line and Python, and changes nothing."""

from pathlib import Path

import pytest
from support.commands import Command, command_line
from support.record_files import write_psins
from support.studies import PAPER, small_study

import sinsjax
from sinsjax.arena.export import simulated_record
from sinsjax.errors import InputError
from sinsjax.execution.prepare import prepare_job
from sinsjax.study.load import study_from_dict, study_to_toml
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)


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
    out, late = tmp_path / "out", {"record.start_s": [100.0]}
    words = ("align", log, config, "-o", out, "--set", "record.start_s=[100.0]")
    code, _, error = run_command(*words)
    with pytest.raises(InputError) as refused:
        sinsjax.align(log, config, overrides=late)
    assert (code, error) == (2, f"error: {refused.value}\n")
    with pytest.raises(InputError, match=r"swing: \[record\]: the study needs a record \("):
        sinsjax.run(study)
    with pytest.raises(InputError, match=r"has no \[record\] section to read .*log.imu with"):
        sinsjax.align(log, small_study())
    job = prepare_job(small_study(), directory=out)
    assert job.directory == out and job.forecast is not None and job.forecast.runs == 3
    assert not out.exists()


@pytest.mark.parametrize(("draws", "kept"), [(1024, True), (1025, None)])
def test_curves_are_kept_of_a_thousand_runs(draws: int, kept: bool | None) -> None:
    study = small_study(study={"draws": draws})
    job = prepare_job(study, keeps_few_curves=True)
    assert job.curves is kept
    assert [*job.notes] == [
        "1,025 runs: curves are kept only if [study] curves = true." for _ in range(not kept)
    ]
