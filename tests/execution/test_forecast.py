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
from sinsjax.tuning import run_tuning

TUNE = {"searches": ["grid"], "grid_points": 5, "variables": {"p0_yaw_deg": {"low": 1, "high": 80}}}
TUNE |= {"tune_draws": 4, "evaluation_draws": 8}


def huge_study(**changes: Any) -> Study:
    """Return a study of 896 million runs, too many for a list."""
    axes = {
        "phi_e0_deg": [n / 100 for n in range(896)],
        "phi_u0_deg": [n / 100 for n in range(1000)],
    }
    return small_study(study={"draws": 1000} | changes, axes=axes)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that sets the free disk space and the memory."""

    def has(free: float = math.inf, memory: float = math.inf) -> None:
        monkeypatch.setattr(machine, "free_disk_bytes", lambda folder: float(free))
        monkeypatch.setattr(machine, "available_memory_bytes", lambda: memory)

    return has


def test_study_that_exceeds_disk_or_memory_is_refused_without_listing_runs(
    disk: Any, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    disk(free=2e9)
    line = f"^{out}: the results of 896,000,000 runs need about 212 GB, but the disk has only 2 GB"
    with limit_memory_mb(200), pytest.raises(InputError, match=line):  # a list of runs is 7,000
        run.run_into(huge_study(), out)
    disk(memory=5e8)
    line = "^study: 896,000 runs need about .*MB of memory, but this machine has only 500 MB$"
    with pytest.raises(InputError, match=line):
        run.run_into(huge_study(draws=1), out)
    assert not out.exists()


def test_only_disk_space_of_missing_runs_is_needed(disk: Any, tmp_path: Path) -> None:
    """With --overwrite the space of what is replaced is free."""
    study, expected = small_study(), forecast.forecast_sweep(small_study())

    def is_enough(runs: float, **options: bool) -> bool:
        disk(free=runs * expected.run_bytes, memory=expected.memory)
        chosen = {"overwrite": False, "resume": False} | options
        try:
            forecast.check_resources(study.name, expected, tmp_path, **chosen)
        except InputError as error:
            assert "the results of 3 runs need about" in str(error)
            return False
        return True

    assert is_enough(3) and not is_enough(2.9)
    write_manifest(tmp_path, study, runs_done=2)
    assert is_enough(1.1, resume=True) and not is_enough(1.1)
    (tmp_path / "summary").mkdir()
    (tmp_path / "summary" / "part-0000-000000.parquet").write_bytes(b"0" * 10_000)
    assert is_enough(0.0, overwrite=True) and not is_enough(0.0)
    stop = {"statistic": "success_rate", "half_width": 0.01}
    study = small_study(study={"draws": 10**6}, stop_when=stop)
    expected = forecast.forecast_sweep(study)
    assert expected.describe(2).startswith("At most 1,000,000 runs of up to 6 s: ")
    assert is_enough(65)  # of the first interim analysis


def test_tuning_is_refused_if_all_runs_exceed_disk_or_memory(disk: Any, tmp_path: Path) -> None:
    study = small_study(tune=TUNE)
    expected = forecast.forecast_tuning(study)
    assert expected.runs == 5 * 4 + 2 * 8
    disk(free=35 * expected.run_bytes)
    with pytest.raises(InputError, match="the results of 36 runs need about"):
        run_tuning.tune(study, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    tables = {"tune": TUNE | {"searches": ["sobol", "gradient"], "sobol_points": 10**9}}
    disk(memory=1e12)
    with pytest.raises(InputError, match="of memory, but this machine has only 1 TB"):
        run_tuning.tune(small_study(**tables), tmp_path / "out")


@pytest.mark.parametrize(
    ("tables", "programs"),
    [
        ({}, 1),
        ({"axes": {"method": ["kalman5", "kalman10"], "phi_u0_deg": [1, 2, 3]}}, 2),
        ({"axes": {"gyro_scale_ppm": [0, 10, 20]}}, 2),
    ],
)
def test_forecast_program_count_matches_engine(tables: Any, programs: int) -> None:
    study = small_study(**tables)
    assert forecast.forecast_sweep(study).programs == programs == len(set(Scenario(study).specs))
