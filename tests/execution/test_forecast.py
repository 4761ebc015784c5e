"""Time, memory and disk space of a study are forecast before anything is created."""

import math
from pathlib import Path
from typing import Any

import pytest
from support.memory import limit_memory_mb
from support.studies import small_study

from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError
from sinsjax.execution import forecast, run
from sinsjax.platform import machine
from sinsjax.study.study import Study
from sinsjax.tuning import run_tuning

TUNE = {"searches": ["grid"], "grid_points": 5, "variables": {"p0_yaw_deg": {"low": 1, "high": 80}}}
TUNE |= {"tune_draws": 4, "evaluation_draws": 8}


def huge_study(draws: int) -> Study:
    """Return a study of 896,000 variants, whose runs are too many for a list."""
    axes = {
        "phi_e0_deg": [n / 100 for n in range(896)],
        "phi_u0_deg": [n / 100 for n in range(1000)],
    }
    return small_study(study={"draws": draws}, axes=axes)


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
    line = f"^{out}: 896,000,000 runs need about 212.2 GB of disk space, but there are only 2.0 GB$"
    with limit_memory_mb(200), pytest.raises(InputError, match=line):  # a list of runs is 7,000
        run.run_into(huge_study(1000), out)
    disk(memory=5e8)
    line = "^study: 896,000 runs need about .*MB of memory, but there are only 500.0 MB$"
    with pytest.raises(InputError, match=line):
        run.run_into(huge_study(1), out)
    assert not out.exists()


def test_tuning_is_refused_if_all_runs_exceed_disk_or_memory(disk: Any, tmp_path: Path) -> None:
    study = small_study(tune=TUNE)
    expected = forecast.forecast_tuning(study)
    assert expected.runs == 5 * 4 + 2 * 8
    disk(free=35 * expected.run_bytes)
    with pytest.raises(InputError, match="out: 36 runs need about .* of disk space"):
        run_tuning.tune(study, tmp_path / "out")
    tables = {"tune": TUNE | {"searches": ["sobol", "gradient"], "sobol_points": 10**9}}
    disk(memory=1e12)
    with pytest.raises(InputError, match="of memory, but there are only 1.0 TB"):
        run_tuning.tune(small_study(**tables), tmp_path / "out")
    assert not (tmp_path / "out").exists()


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
