"""R follows the surge of the base unless its key is given."""

import tomllib
from typing import Any

import numpy as np
import pytest
from support.batches import batches_of
from support.refusals import assert_named
from support.studies import refusal_line, small_study

from sinsjax.execution.checks import describe_measurement_noise
from sinsjax.methods.filters.keys import surge_density
from sinsjax.strapdown import processes
from sinsjax.study.load import study_from_dict, study_to_toml
from sinsjax.study.search_space import effective_values
from sinsjax.study.study import Study

DT = 0.01
DT_S = 0.1
"""Sample time of the simulated surges, s."""

SURGE = {"surge_m_per_s": 0.02, "surge_time_s": 5.0}
DENSITY = 2 * 0.02**2 * 5.0


def compute_r(study: Study) -> np.ndarray:
    """(variants,) R of an update, (m/s)^2."""
    rows = {}
    for part in batches_of(study):
        r = np.asarray(part.params.method.r)
        rows |= dict(zip(part.variant_ids.tolist(), r.tolist(), strict=True))
    return np.array([rows[variant] for variant in sorted(rows)])


# Density of the surge


def simulate_spectrum(process: processes.Process, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies, Hz, and two-sided density of a process, from 768 records of 8192 samples."""
    rng, n = np.random.default_rng(5), 8192
    x = np.einsum("ij,rj->ri", process.begin, rng.standard_normal((768, len(process.drive))))
    velocity = np.empty((768, n))
    for sample in range(n):
        velocity[:, sample] = process.scale[0] * x @ process.output
        x = x @ process.transition.T + np.outer(rng.standard_normal(768), process.drive)
    window = np.hanning(n)
    spectrum = np.abs(np.fft.rfft(velocity * window)) ** 2 * dt / np.sum(window**2)
    return np.fft.rfftfreq(n, dt), spectrum.mean(axis=0)


@pytest.mark.nightly(fast=("2.0",))
@pytest.mark.parametrize("time_s", [2.0, 5.0])
def test_density_is_that_of_gauss_markov_surge_at_zero_frequency(time_s):
    process = processes.gauss_markov_process(np.full(3, 0.3), np.asarray(time_s), DT_S)
    _, density = simulate_spectrum(process, DT_S)
    assert density[:3].mean() == pytest.approx(surge_density(0.3, time_s), rel=0.06)


@pytest.mark.nightly(fast=("5.0",))
@pytest.mark.parametrize("time_s", [2.0, 5.0])
def test_density_is_largest_one_of_third_order_surge(time_s):
    """It peaks at 1/(2 pi T) Hz, and is next to nothing at zero frequency."""
    process = processes.bounded_velocity_process(
        np.full(3, 0.3), np.asarray(time_s), np.asarray(1.0), DT_S
    )
    frequency, density = simulate_spectrum(process, DT_S)
    peak = np.argmin(np.abs(frequency - 1 / (2 * np.pi * time_s)))
    b = 2 * np.pi * 1.0 * time_s
    largest = density[peak - 1 : peak + 2].mean()
    assert largest == pytest.approx(surge_density(0.3, time_s) * (1 + b / (1 + b * b)), rel=0.06)
    assert largest > 0.9 * density.max() and density[0] < 0.03 * largest


def test_density_takes_larger_horizontal_axis():
    assert surge_density((0.02, 0.04, 0.9), 5.0) == surge_density(0.04, 5.0)
    assert surge_density(None, 5.0) == surge_density(0.1, None) == 0.0


# R of a study


@pytest.mark.nightly
@pytest.mark.parametrize("rate_hz", [100.0, 200.0])
def test_omitted_r_follows_surge_of_each_variant(rate_hz):
    axes = {"surge_m_per_s": [0.0, 0.02, (0.05, 0.0, 9.0)], "surge_time_s": [5.0, 2.0]}
    study = small_study(study={"rate_hz": rate_hz}, axes=axes)
    density = np.array([0.0, 0.0, 2 * 0.02**2 * 5, 2 * 0.02**2 * 2, 2 * 0.05**2 * 5, 0.01])
    np.testing.assert_allclose(compute_r(study), 0.01 + density * rate_hz, rtol=1e-12)


@pytest.mark.nightly
@pytest.mark.parametrize("model", ["third_order", "gauss_markov"])
def test_omitted_r_follows_surge_in_both_units_and_times_its_scale(model):
    axes = {"r_reading": ["per_update", "psd"], "r_scale": [0.25, 4.0]}
    made = compute_r(small_study(motion=SURGE | {"surge_model": model}, axes=axes))
    expected = np.outer([0.01 + DENSITY / DT, (0.01 + DENSITY) / DT], [0.25, 4.0])
    np.testing.assert_allclose(made, expected.ravel(), rtol=1e-12)


@pytest.mark.nightly
def test_given_r_does_not_follow_surge():
    axes = {"surge_m_per_s": [0.0, 0.02], "r_velocity_m_per_s": [0.1, 0.3]}
    np.testing.assert_allclose(
        compute_r(small_study(axes=axes)), [0.01, 0.09, 0.01, 0.09], rtol=1e-12
    )
    changed = small_study(filter={"r_velocity_m_per_s": 0.1}).replace({"motion.surge_m_per_s": 0.1})
    np.testing.assert_allclose(compute_r(changed), 0.01)


@pytest.mark.nightly(fast=("kalman10-0.004", "kalman_surge-0.0"))
@pytest.mark.parametrize(
    ("method", "density"),
    [
        *((name, DENSITY) for name in ("kalman10", "kalman_sincos", "ekf_azimuth", "unscented")),
        ("kalman_surge", 0.0),
    ],
)
def test_all_filters_but_that_of_surge_follow_it(method, density):
    study = small_study(motion=SURGE, alignment={"method": method})
    np.testing.assert_allclose(compute_r(study), 0.01 + density / DT, rtol=1e-12)


def test_resolved_study_without_r_reloads_equal():
    study = small_study(motion=SURGE)
    text = study_to_toml(study)
    assert "r_velocity" not in text and study_from_dict(tomllib.loads(text)) == study


def test_drawn_surge_requires_r():
    drawn: dict[str, Any] = {"drawn": {"surge_m_per_s": {"uniform": [0.0, 0.1]}}}
    place = "[filter] r_velocity_m_per_s"
    assert_named(refusal_line(**drawn), place, "required", "surge_m_per_s")
    time = {"motion": SURGE | {"surge_time_s": None}, "drawn": {"surge_time_s": {"values": [2, 8]}}}
    time["motion"].pop("surge_time_s")
    assert_named(refusal_line(**time), place, "required", "surge_time_s")
    given = {"filter": {"r_velocity_m_per_s": 0.2}}
    np.testing.assert_allclose(compute_r(small_study(**drawn, **given)), 0.04)
    for method in ("inertial", "kalman_surge"):
        assert small_study(**drawn, alignment={"method": method}).drawn_keys


def test_effective_r_is_known_without_surge_alone():
    assert effective_values(small_study(), ["r_velocity_m_per_s"]) == {"r_velocity_m_per_s": 0.1}
    surging = small_study(motion=SURGE)
    assert effective_values(surging, ["r_velocity_m_per_s"]) == {"r_velocity_m_per_s": None}


# Validation


@pytest.mark.parametrize(
    ("tables", "text"),
    [
        ({"motion": SURGE}, "1"),
        ({"motion": SURGE, "filter": {"r_velocity_m_per_s": 0.1}}, "0.025"),
        ({"motion": SURGE, "filter": {"r_velocity_m_per_s": 0.1, "r_reading": "psd"}}, "2.5"),
        ({"motion": SURGE, "axes": {"r_scale": [0.25, 1.0, 4.0]}}, "0.26 to 4.1"),
        ({"axes": {"surge_m_per_s": [0.0, 0.001, 0.02]}}, "1 to 11"),
    ],
)
def test_r_is_compared_with_density_of_surge(tables, text):
    assert f" is {text} times " in describe_measurement_noise(small_study(**tables))


def test_r_is_not_compared_without_surge_or_filter_that_takes_it_for_noise():
    assert describe_measurement_noise(small_study()) is None
    for method in ("inertial", "kalman_surge"):
        study = small_study(motion=SURGE, alignment={"method": method})
        assert describe_measurement_noise(study) is None
    drawn = small_study(
        filter={"r_velocity_m_per_s": 0.2}, drawn={"surge_m_per_s": {"uniform": [0.0, 0.1]}}
    )
    assert describe_measurement_noise(drawn) is None


def test_r_of_record_is_that_of_a_base_without_surge():
    tables: dict[str, Any] = {
        "study": {"duration_s": 300.0},
        "record": {"format": "psins", "start_s": [0.0, 300.0]},
        "filter": {"q_accel_ug": 50.0, "q_gyro_deg_per_h": 0.01, "q_reading": "per_sample"},
    }
    study = study_from_dict(tables)
    assert describe_measurement_noise(study) is None
    assert effective_values(study, ["r_velocity_m_per_s"]) == {"r_velocity_m_per_s": 0.1}


# The law of resets


def test_reset_law_follows_surge_and_r():
    axes = {"surge_m_per_s": [0.0, 0.02, 0.05]}
    settings = {"duration_s": 900.0, "window_s": [600, 900]}
    own_noise = {"q_accel_ug": 500.0, "q_gyro_deg_per_h": 0.1, "q_reading": "per_sample"}
    tables: dict[str, Any] = {
        **{"study": settings, "resets": {"schedule": "law"}, "filter": own_noise},
        "alignment": {"feedback_interval_s": 0.1},
    }
    still, slow, fast = small_study(**tables, axes=axes).reset_times()
    assert len(still) == len(slow) == len(fast) == 4
    assert all(a < b < c for a, b, c in zip(still, slow, fast, strict=True))
    # With a given R the early resets stay; the last one still waits for the surge.
    tables["filter"] = own_noise | {"r_velocity_m_per_s": 0.1}
    given = small_study(**tables, axes=axes).reset_times()
    for times, before in zip(given, (still, slow, fast), strict=True):
        assert times[:3] == still[:3]
        assert times[3] - times[2] == pytest.approx(before[3] - before[2], abs=0.3)
