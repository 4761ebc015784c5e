import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sinsjax.bounds import information as bounds
from sinsjax.units import ARCMIN, DEG, DEG_PER_H, MICRO

G = 9.8
EARTH_RATE = 15.041067 * DEG_PER_H
PAPER2 = {
    "gyro_noise": 0.006 * DEG_PER_H,
    "accel_noise": 50 * MICRO * G,
    "rate_hz": 200.0,
    "gravity": G,
    "rate_n": EARTH_RATE * math.cos(32.057313 * DEG),
}
PAPER1 = {
    "gyro_noise": 0.1 * DEG_PER_H,
    "accel_noise": 500 * MICRO * G,
    "rate_hz": 100.0,
    "gravity": G,
    "rate_n": EARTH_RATE * math.cos(32.0 * DEG),
}


def best_sigma(n, *, gyro_noise, accel_noise, rate_hz, gravity, rate_n):
    """Heading, 1 sigma, of generalised least squares for the ramp in n samples of the force."""
    dt = 1 / rate_hz
    k = np.arange(1, n + 1)
    walk = np.minimum(k[:, None], k) * (gravity * gyro_noise * dt) ** 2
    covariance = walk + accel_noise**2 * np.eye(n)
    design = np.column_stack([np.ones(n), gravity * rate_n * k * dt])
    information = design.T @ np.linalg.solve(covariance, design)
    return math.sqrt(np.linalg.inv(information)[1, 1])


@pytest.mark.parametrize(
    ("sensors", "stored_s", "arcmin"),
    [
        (PAPER2, 80, 0.95),
        (PAPER2, 300, 0.13),
        (PAPER1, 80, 13.5),
        (PAPER1, 300, 1.86),
        (PAPER1, 900, 0.37),
    ],
)
def test_heading_bound_of_paper_sensors_matches_known_values(sensors, stored_s, arcmin):
    assert bounds.record_bound(stored_s, **sensors) / ARCMIN == pytest.approx(arcmin, rel=0.01)


@pytest.mark.parametrize("sensors", [PAPER1, PAPER2])
def test_least_squares_reaches_bound_for_paper_sensors(sensors):
    # A hundredth of the samples with a tenth of the noise hold the same densities.
    thin = sensors | {
        "rate_hz": sensors["rate_hz"] / 100,
        "gyro_noise": sensors["gyro_noise"] / 10,
        "accel_noise": sensors["accel_noise"] / 10,
    }
    n = round(300 * thin["rate_hz"])
    assert bounds.record_bound(300, **sensors) == pytest.approx(bounds.record_bound(300, **thin))
    assert 1 <= best_sigma(n, **thin) / bounds.record_bound(300, **thin) < 1.03


@given(st.floats(-3, 3), st.integers(10, 120), st.floats(0.1, 100))
def test_best_linear_unbiased_estimator_never_beats_bound(decades, n, rate_hz):
    noise = {"gyro_noise": 1e-6 * 10**decades, "accel_noise": 1e-5}
    sensors = {**noise, "rate_hz": rate_hz, "gravity": G, "rate_n": 6e-5}
    bound = float(bounds.record_bound(n / rate_hz, **sensors))
    assert best_sigma(n, **sensors) >= bound * (1 - 1e-6)


@pytest.mark.parametrize("only", ["gyro_noise", "accel_noise"])
def test_bound_is_tight_for_single_noise_source(only):
    sensors = PAPER2 | {"gyro_noise": 1e-15, "accel_noise": 1e-9} | {only: PAPER2[only]}
    found = best_sigma(400, **sensors) / bounds.record_bound(2.0, **sensors)
    assert 1 <= found < 1.005


def test_swing_with_unknown_biases_leaves_bound_unchanged():
    rate, seconds = 10.0, 80.0
    t = np.arange(1, round(rate * seconds) + 1) / rate
    yaw, pitch = 2.8 * DEG * np.sin(2 * np.pi * t / 10), 1.8 * DEG * np.sin(2 * np.pi * t / 6)
    # North row of C_b^n for roll 0: the biases of right, front and up as nuisances.
    north = np.column_stack(
        [np.sin(yaw), np.cos(yaw) * np.cos(pitch), -np.cos(yaw) * np.sin(pitch)]
    )
    ramp = G * PAPER2["rate_n"] * t
    left = ramp - north @ np.linalg.lstsq(north, ramp, rcond=None)[0]
    sigma = PAPER2["accel_noise"] / np.linalg.norm(left)
    expected = bounds.record_bound(seconds, **PAPER2 | {"gyro_noise": 0.0, "rate_hz": rate})
    assert sigma == pytest.approx(float(expected), rel=0.02)


def test_bounds_broadcast_and_fall_with_record_length():
    records = np.array([[20.0, 40.0, 80.0]])
    latitude = np.array([[0.0], [60.0]])
    found = bounds.record_bound(records, **PAPER2 | {"rate_n": EARTH_RATE * np.cos(latitude * DEG)})
    assert found.shape == (2, 3)
    np.testing.assert_allclose(found[1], 2 * found[0])
    assert np.all(np.diff(found) < 0)


def test_share_outside_band_matches_normal_distribution():
    sigma = np.array([0.3, 0.95, 4.0])
    expected = 2 * stats.norm.sf(1.2 / sigma)
    np.testing.assert_allclose(bounds.share_outside(sigma, 1.2), expected, rtol=1e-12)
    assert bounds.share_outside(0.95, 1.2) == pytest.approx(0.2, abs=0.01)
