"""A study is checked and its cost forecast before anything is created."""

import math

import numpy as np
import pytest
from support.memory import limit_memory_mb
from support.record_files import write_psins
from support.studies import recorded_study, small_study, swing_deg, write_swing_record

import sinsjax as package
from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError
from sinsjax.execution import forecast
from sinsjax.execution.prepare import prepare_job
from sinsjax.platform import machine
from sinsjax.study.load import study_to_toml

pytestmark = pytest.mark.optimised(False)


@pytest.fixture
def recorded(tmp_path):
    """A record, its study file, and the study."""
    study = recorded_study(alignment={"phi_u0_deg": 3.0}, record={"start_s": [0.0, 1.0]})
    write_psins(package.simulated_record(small_study()), tmp_path / "log.imu")
    (tmp_path / "swing.toml").write_text(study_to_toml(study))
    return tmp_path / "log.imu", tmp_path / "swing.toml", study


@pytest.mark.nightly
def test_python_align_gives_rows_of_command(sinsjax, recorded, tmp_path):
    log, config, study = recorded
    code, _, error = sinsjax("align", log, config, "-o", tmp_path / "out")
    assert code == 0 and error.count("\n") == error.count("cannot be determined") == 1
    stored, curves = package.read_summary(tmp_path / "out"), package.read_curves(tmp_path / "out")
    for results in (package.align(log, config), package.align(str(log), study)):
        assert results.summary.cast(stored.schema).equals(stored)
        assert results.curves.cast(curves.schema).equals(curves) and curves.num_rows
    changed = package.align(log, config, overrides={"record.start_s": [1.0]}, curves=False)
    assert changed.summary["start_s"].to_pylist() == [1.0] and changed.curves.num_rows == 0
    stored = package.load_increments(study, log)
    assert package.align(stored, study).summary.equals(package.align(log, study).summary)
    write_swing_record(tmp_path)
    options = ("--reference", tmp_path / "true.csv", "-o", tmp_path / "judged")
    assert sinsjax("align", tmp_path / "swing.imu", config, *options)[0] == 0
    judged = package.read_summary(tmp_path / "judged")
    error = np.array(judged["yaw_deg"]) - swing_deg(np.array([5.0, 6.0]))[:, 2]
    # phi is the vector of C_true C_hat^T: about minus the error in yaw for small level angles.
    np.testing.assert_allclose(-np.array(judged["phi_u_arcmin"]) / 60, error, rtol=0.02)


def test_command_and_python_refuse_alike(sinsjax, recorded, tmp_path):
    log, config, study = recorded
    out, late = tmp_path / "out", "record.start_s=[100.0]"
    code, _, error = sinsjax("align", log, config, "-o", out, "--set", late)
    with pytest.raises(InputError) as refused:
        package.align(log, config, overrides={"record.start_s": [100.0]})
    assert (code, error) == (2, f"error: {refused.value}\n")
    with pytest.raises(InputError, match=r"swing: \[record\]: the study needs a record \("):
        package.run(study)
    with pytest.raises(InputError, match=r"has no \[record\] section to read .*log.imu with"):
        package.align(log, small_study())
    job = prepare_job(small_study(), directory=out)
    assert job.directory == out and job.forecast.runs == 3
    assert not out.exists()


@pytest.mark.parametrize(("draws", "kept"), [(1024, True), (1025, None)])
def test_curves_are_kept_of_a_thousand_runs(draws, kept):
    job = prepare_job(small_study(study={"draws": draws}), keeps_few_curves=True)
    assert job.curves is kept and len(job.notes) == (not kept)


@pytest.fixture
def has(monkeypatch):
    """A function that sets the free disk space and the memory, bytes."""

    def has(disk=math.inf, memory=math.inf):
        monkeypatch.setattr(machine, "free_disk_bytes", lambda folder: float(disk))
        monkeypatch.setattr(machine, "available_memory_bytes", lambda: memory)
        monkeypatch.setattr(forecast.runtime, "usable_cores", lambda: 2)

    return has


def test_study_that_exceeds_disk_or_memory_is_refused_without_listing_runs(has, tmp_path):
    """896,000 variants, whose runs are too many for a list."""
    out, hundredths = tmp_path / "out", [n / 100 for n in range(1000)]
    axes = {"phi_e0_deg": hundredths[:896], "phi_u0_deg": hundredths}
    has(disk=2e9)
    line = f"^{out}: 896,000,000 runs need about 212.2 GB of disk space, but there are only 2.0 GB$"
    with limit_memory_mb(200), pytest.raises(InputError, match=line):  # a list of runs is 7,000
        package.run_into(small_study(study={"draws": 1000}, axes=axes), out)
    has(memory=5e8)
    line = "^study: 896,000 runs need about .*MB of memory, but there are only 500.0 MB$"
    with pytest.raises(InputError, match=line):
        package.run_into(small_study(study={"draws": 1}, axes=axes), out)
    assert not out.exists()


def test_tuning_is_refused_if_all_runs_exceed_disk_or_memory(has, tmp_path):
    tune = {"searches": ["grid"], "grid_points": 5, "tune_draws": 4, "evaluation_draws": 8}
    tune |= {"variables": {"p0_yaw_deg": {"low": 1, "high": 80}}}
    study, out = small_study(tune=tune), tmp_path / "out"
    expected = forecast.forecast_tuning(study)
    assert expected.runs == 5 * 4 + 2 * 8
    has(disk=35 * expected.run_bytes)
    with pytest.raises(InputError, match="out: 36 runs need about .* of disk space"):
        package.tune(study, out)
    tune |= {"searches": ["sobol", "gradient"], "sobol_points": 10**9}
    has(memory=1e12)
    with pytest.raises(InputError, match="of memory, but there are only 1.0 TB"):
        package.tune(small_study(tune=tune), out)
    assert not out.exists()


@pytest.mark.parametrize(
    ("axes", "programs"),
    [
        ({}, 1),
        ({"method": ["kalman5", "kalman10"], "phi_u0_deg": [1, 2, 3]}, 2),
        ({"gyro_scale_ppm": [0, 10, 20]}, 2),
    ],
)
def test_forecast_program_count_matches_engine(axes, programs, monkeypatch):
    monkeypatch.setattr(forecast.runtime, "usable_cores", lambda: 2)
    study = small_study(axes=axes)
    found, least = (forecast.forecast_sweep(one) for one in (study, small_study()))
    assert found.programs == programs == len(set(Scenario(study).specs))
    assert (found.memory - least.memory > 20e6) == (programs > 1)
