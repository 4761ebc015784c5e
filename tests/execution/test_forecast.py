"""Time, memory and disk space of a study are forecast before anything is created."""

import math
from pathlib import Path
from typing import Any

import pytest
from support.memory import limit_memory_mb
from support.stored_results import write_manifest
from support.studies import small_study

from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError
from sinsjax.execution import forecast, run
from sinsjax.platform import machine
from sinsjax.study.study import Study
from sinsjax.tuning import from_python

TUNE = {"searches": ["grid"], "grid_points": 5, "variables": {"p0_yaw_deg": {"low": 1, "high": 80}}}
TUNE |= {"tune_draws": 4, "evaluation_draws": 8}


def huge_study(**changes: Any) -> Study:
    """Return a study of 896 million runs, too many for a list."""
    return small_study(
        study={"draws": 1000} | changes,
        axes={
            "phi_e0_deg": [n / 100 for n in range(896)],
            "phi_u0_deg": [n / 100 for n in range(1000)],
        },
    )


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that sets the free disk space and the memory."""

    def has(free: float = math.inf, memory: float = math.inf) -> None:
        monkeypatch.setattr(machine, "free_disk_bytes", lambda folder: float(free))
        monkeypatch.setattr(machine, "available_memory_bytes", lambda: memory)

    return has


def refusal_line(study: Study, out: Path, **options: Any) -> str:
    with pytest.raises(InputError) as caught:
        run.run_into(study, out, **options)
    assert not out.exists() or not (out / "study.toml").exists()
    return str(caught.value)


def test_896_million_runs_are_refused_without_listing_them(disk: Any, tmp_path: Path):
    disk(free=2e9)
    with limit_memory_mb(200):  # a list of the runs is 7,000
        line = refusal_line(huge_study(), tmp_path / "out")
    assert line == (
        f"{tmp_path / 'out'}: the results of 896,000,000 runs need about 212 GB, but the disk has"
        " only 2 GB free"
    )


def test_study_that_exceeds_memory_is_refused(disk: Any, tmp_path: Path):
    disk(memory=5e8)
    line = refusal_line(huge_study(draws=1), tmp_path / "out")
    assert line.startswith("study: 896,000 runs need about ")
    assert line.endswith("MB of memory, but this machine has only 500 MB")


def test_study_is_refused_only_if_disk_space_is_short(disk: Any, tmp_path: Path):
    expected = forecast.forecast_sweep(small_study())
    disk(free=3 * expected.run_bytes, memory=expected.memory)
    study = small_study()
    forecast.check_resources(study, expected, tmp_path, overwrite=False, resume=False)
    disk(free=2.9 * expected.run_bytes)
    with pytest.raises(InputError, match="the results of 3 runs need about"):
        forecast.check_resources(study, expected, tmp_path, overwrite=False, resume=False)


def test_resume_needs_disk_space_for_missing_runs_only(disk: Any, tmp_path: Path):
    study, expected = small_study(), forecast.forecast_sweep(small_study())
    write_manifest(tmp_path, study, runs_done=2)
    disk(free=1.1 * expected.run_bytes)
    forecast.check_resources(study, expected, tmp_path, overwrite=False, resume=True)
    with pytest.raises(InputError, match="free"):
        forecast.check_resources(study, expected, tmp_path, overwrite=False, resume=False)


def test_overwrite_counts_replaced_files_as_free_space(disk: Any, tmp_path: Path):
    study, expected = small_study(), forecast.forecast_sweep(small_study())
    (tmp_path / "summary").mkdir()
    (tmp_path / "summary" / "part-0000-000000.parquet").write_bytes(b"0" * 10_000)
    disk(free=0.0)
    forecast.check_resources(study, expected, tmp_path, overwrite=True, resume=False)
    with pytest.raises(InputError, match="0 B free"):
        forecast.check_resources(study, expected, tmp_path, overwrite=False, resume=False)


def test_stop_when_study_needs_disk_space_for_first_check_only(disk: Any, tmp_path: Path):
    stop = {"statistic": "success_rate", "half_width": 0.01}
    study = small_study(study={"draws": 10**6}, stop_when=stop)
    expected = forecast.forecast_sweep(study)
    assert expected.describe(2).startswith("At most 1,000,000 runs of up to 6 s: ")
    disk(free=65 * expected.run_bytes)
    forecast.check_resources(study, expected, tmp_path, overwrite=False, resume=False)


def test_tuning_is_refused_if_all_runs_exceed_disk_or_memory(disk: Any, tmp_path: Path):
    study = small_study(tune=TUNE)
    expected = forecast.forecast_tuning(study)
    assert expected.runs == 5 * 4 + 2 * 8
    disk(free=35 * expected.run_bytes)
    with pytest.raises(InputError, match="the results of 36 runs need about"):
        from_python.tune(study, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    tables = {"tune": TUNE | {"searches": ["sobol", "gradient"], "sobol_points": 10**9}}
    disk(memory=1e12)
    with pytest.raises(InputError, match="of memory, but this machine has only 1 TB"):
        from_python.tune(small_study(**tables), tmp_path / "out")


@pytest.mark.parametrize(
    ("tables", "programs"),
    [
        ({}, 1),
        ({"axes": {"method": ["kalman5", "kalman10"], "phi_u0_deg": [1, 2, 3]}}, 2),
        ({"axes": {"gyro_scale_ppm": [0, 10, 20]}}, 2),
    ],
)
def test_forecast_program_count_matches_engine(tables: Any, programs: int):
    study = small_study(**tables)
    assert forecast.forecast_sweep(study).programs == programs == len(set(Scenario(study).specs))
