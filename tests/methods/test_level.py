"""Accelerometer levelling against plain NumPy, and a study of it that has no heading."""

import numpy as np
import pytest
from oracles.in_engine import ARCMIN, DEG_PER_H, UG, follow, place, shown, site
from oracles.naive import DEG, WGS84, exp, of_quaternion
from scipy.spatial.transform import Rotation

from sinsjax.methods.method import Options

pytestmark = pytest.mark.optimised(False)

RATE, SECONDS, LATITUDE = 100, 20, 45 * DEG
PITCH, ROLL = 1.0, -2.0  # deg
TILT = np.float64(5e-3)  # rad, by the assumed accelerometer bias
GRAVITY = place(WGS84, LATITUDE).gravity


def noisy_record(gyro_bias: float = 0.0) -> np.ndarray:
    """Increments (n, 6) of a base at rest: rad, m/s; the bias is in deg/h."""
    c = Rotation.from_euler("ZXY", [130.0, PITCH, ROLL], degrees=True).as_matrix()
    rate_n, rate_u = WGS84.rates(LATITUDE, (0.0, 0.0))[0][1:]
    rng = np.random.default_rng(3)
    n = RATE * SECONDS
    force = c.T @ [0.0, 0.0, GRAVITY] + 2000 * UG * rng.normal(size=(n, 3))
    rate = c.T @ [0.0, rate_n, rate_u] + gyro_bias * DEG_PER_H
    return np.hstack([np.broadcast_to(rate, (n, 3)), force]) / RATE


def attitudes(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """C_b^n (n, 3, 3) and the covariance (n, 6) after every sample."""
    start = exp([1.0, -2.0, 3.0]), np.zeros(3), (0.3, -0.4)
    options, here = Options(1 / RATE), site(WGS84, LATITUDE)
    state = follow("level", TILT, rows, here, start, options=options, records=len(rows))
    q, covariance = shown("level", options, state)
    return of_quaternion(np.stack(q, axis=1)), np.stack(covariance, axis=1)


@pytest.mark.parametrize("gyro_bias", [0.0, 1000.0])
def test_level_is_that_of_mean_force_whatever_the_gyros(gyro_bias: float) -> None:
    rows = noisy_record(gyro_bias)
    c, _ = attitudes(rows)
    for n in (1, 100, len(rows)):
        right, front, up = rows[:n, 3:].mean(axis=0)
        pitch = np.arcsin(front / np.linalg.norm([right, front, up]))
        roll = -np.arctan2(right, up)
        found = Rotation.from_matrix(c[n - 1]).as_euler("ZXY")
        # Coning and sculling terms are of second order in the rotation of a sample.
        np.testing.assert_allclose(found, [0.0, pitch, roll], rtol=0, atol=1e-4 * ARCMIN)
    assert abs(pitch - PITCH * DEG) < 0.3 * ARCMIN and abs(roll - ROLL * DEG) < 0.3 * ARCMIN


def test_sigma_is_that_of_assumed_bias_and_scatter_of_force() -> None:
    rows = noisy_record()
    _, covariance = attitudes(rows)
    for n in (1, 100, len(rows)):
        force = rows[:n, 3:] * RATE
        scatter = force.var(axis=0).sum() / np.sum(force.mean(axis=0) ** 2)
        level = TILT**2 + scatter * 1.0 / (n / RATE)
        expected = [level, 0, 0, level, 0, np.pi**2 / 3]
        np.testing.assert_allclose(covariance[n - 1], expected, rtol=1e-7)
    noise = np.sqrt(3) * 2000 * UG / GRAVITY / np.sqrt(SECONDS)
    assert np.sqrt(level - TILT**2) == pytest.approx(noise, rel=0.05)
