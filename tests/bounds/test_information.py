"""The information bound against generalised least squares with the whole covariance of the data."""

import numpy as np
import pytest
from oracles.white_noise_bound import white_noise_bound
from scipy.linalg import toeplitz

from sinsjax.bounds.information import heading_bound
from sinsjax.strapdown import earth, processes
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.sensors import error_free_sensors
from sinsjax.units import DEG, DEG_PER_H, MICRO

DT = 0.25
PLACE = earth.place(earth.wgs84(), 50 * DEG)
ACCEL, GYRO = 500 * MICRO * 9.8 * 0.05, 0.5 * DEG_PER_H * DT  # of an increment, m/s and rad
OF_SURGE = {
    "third order": processes.bounded_velocity_process(np.array([0.1, 0.2, 0.1]), 5.0, 0.5, DT),
    "gauss-markov": processes.gauss_markov_process(np.array([0.1, 0.2, 0.1]), 5.0, DT),
}


def errors(accel=(ACCEL,) * 3, gyro=(GYRO,) * 3):
    return error_free_sensors()._replace(accel_noise=np.array(accel), gyro_noise=np.array(gyro))


def bound(times_s, disturbances=None, **changes):
    given = {"place": PLACE, "errors": errors(), "dt": DT} | changes
    return heading_bound(times_s, disturbances=disturbances or Disturbances(), **given)


def at_rest():
    """I + A dt of a base at rest, written out: level velocity error, then misalignment."""
    a = np.zeros((5, 5))
    g, wn, wu = PLACE.gravity, PLACE.rate_n, PLACE.rate_u
    a[0, 1], a[1, 0] = 2 * wu, -2 * wu
    a[0, 3], a[1, 2] = -g, g
    a[2, 1], a[3, 0], a[4, 0] = (
        -PLACE.curvature_n,
        PLACE.curvature_e,
        PLACE.tan_latitude * PLACE.curvature_e,
    )
    a[2, 3], a[3, 2] = wu, -wu
    a[2, 4], a[4, 2] = -wn, wn
    return np.eye(5) + a * DT


def responses(n):
    """(n + 1, 5, 5) powers of `at_rest`."""
    powers = [np.eye(5)]
    for _ in range(n):
        powers.append(at_rest() @ powers[-1])
    return np.array(powers)


def by_impulses(n, axis):
    """(2 n, n) what an error of one increment, of 0-2 velocity or 2-4 angle, does to u later."""
    powers = responses(n)
    out = np.zeros((n, 2, n))
    for j in range(n):
        out[j:, :, j] = powers[: n - j, :2, axis]
    return out.reshape(2 * n, n)


def autocovariance(process, n):
    """(n + 1,) of the process at unit scale, from its stationary covariance."""
    c, x, out = process.output, process.begin @ process.begin.T @ process.output, []
    for _ in range(n + 1):
        out.append(c @ x)
        x = process.transition @ x
    return np.array(out)


def batch(n, surge=None, drift=None):
    """The rows d (2 n, 3) and the covariance C (2 n, 2 n) of u, sample by sample."""
    d = responses(n)[1:, :2, 2:].reshape(2 * n, 3)
    c = np.zeros((2 * n, 2 * n))
    for axes, sigma in ((range(2), ACCEL), (range(2, 5), GYRO)):
        for axis in axes:
            moved = by_impulses(n, axis)
            c += sigma**2 * moved @ moved.T
    for axis in range(2 if surge else 0):
        changes = np.hstack([-np.eye(n), np.zeros((n, 1))]) + np.hstack(
            [np.zeros((n, 1)), np.eye(n)]
        )
        moved = by_impulses(n, axis) @ changes
        c += surge.scale[axis] ** 2 * moved @ toeplitz(autocovariance(surge, n)) @ moved.T
    for name, process in (drift or {}).items():
        first, end = (2, 5) if name == "gyro_instability" else (0, 2)
        for axis in range(first, end):
            moved = by_impulses(n, axis) * DT * process.scale[axis - first]
            c += moved @ toeplitz(autocovariance(process, n - 1)) @ moved.T
    return d, c


def least_squares(n, surge=None, drift=None):
    """Generalised least squares: the estimator's rows (3, 2 n), and its covariance."""
    d, c = batch(n, surge, drift)
    whitened = np.linalg.solve(c, d)
    covariance = np.linalg.inv(d.T @ whitened)
    return covariance @ whitened.T, covariance


@pytest.mark.parametrize("name", [None, *OF_SURGE])
def test_information_bound_matches_generalised_least_squares(name):
    surge, counts = OF_SURGE.get(name), (40, 200)
    found = bound([n * DT for n in counts], Disturbances(surge=surge))
    expected = [np.sqrt(least_squares(n, surge)[1][2, 2]) for n in counts]
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "rms"),
    [("gyro_instability", DEG_PER_H), ("accel_instability", 9.8e-3)],
    ids=["gyro", "accel"],
)
def test_bound_with_drifts_matches_generalised_least_squares(name, rms):
    drift = {name: processes.gauss_markov_process(rms * np.array([1.0, 0.5, 0.7]), 5.0, DT)}
    found = bound([100 * DT], Disturbances(**drift))
    assert found > 1.1 * bound([100 * DT])
    expected = np.sqrt(least_squares(100, drift=drift)[1][2, 2])
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize("name", OF_SURGE)
def test_least_squares_on_simulated_data_reaches_bound(name):
    """Each realisation is stepped through, sample by sample."""
    surge, n, draws, rng = OF_SURGE[name], 200, 4000, np.random.default_rng(1)
    x = np.einsum("ij,djk->dik", surge.begin, rng.standard_normal((draws, len(surge.drive), 2)))
    phi0 = np.array([0.01, -0.02, 0.3])
    state, data = np.tile(np.r_[0.0, 0.0, phi0], (draws, 1)), []
    for _ in range(n):
        before = np.einsum("i,dik->dk", surge.output, x)
        w = rng.standard_normal((draws, 1, 2))
        x = np.einsum("ij,djk->dik", surge.transition, x) + surge.drive[:, None] * w
        state = state @ at_rest().T
        state[:, :2] += ACCEL * rng.standard_normal((draws, 2))
        state[:, :2] += (np.einsum("i,dik->dk", surge.output, x) - before) * surge.scale[:2]
        state[:, 2:] += GYRO * rng.standard_normal((draws, 3))
        data.append(state[:, :2].copy())
    weights, _ = least_squares(n, surge)
    estimates = np.stack(data, axis=1).reshape(draws, 2 * n) @ weights[2]
    (sigma,) = bound([n * DT], Disturbances(surge=surge))
    assert np.std(estimates) == pytest.approx(sigma, rel=5 / (2 * draws) ** 0.5)
    assert np.mean(estimates) == pytest.approx(phi0[2], abs=4 * sigma / draws**0.5)


@pytest.mark.parametrize(("gyro", "most"), [(0.1 * GYRO, 1.01), (GYRO, 1.1)])
def test_white_noise_bound_is_near_closed_form(gyro, most):
    """A bound of the bound, and close to it where one of two noises dominates."""
    times = [100.0, 300.0]
    closed = white_noise_bound(
        np.array(times),
        gyro_noise=gyro / DT,
        accel_noise=ACCEL / DT,
        rate_hz=1 / DT,
        gravity=PLACE.gravity,
        rate_n=PLACE.rate_n,
    )
    ratio = bound(times, errors=errors(gyro=(gyro,) * 3)) / closed
    assert np.all((ratio > 0.999) & (ratio < most))


def test_bound_grows_with_surge_correlation_time():
    def of(time_s, rms=0.1):
        surge = processes.gauss_markov_process(np.full(3, rms), time_s, DT)
        return bound([60.0], Disturbances(surge=surge))[0]

    assert bound([60.0])[0] < of(0.5) < of(5.0)
    assert of(5.0, rms=1e-6) == pytest.approx(bound([60.0])[0], rel=1e-3)


def test_bounded_vibration_barely_raises_bound():
    shaking = processes.resonance_process(np.full(3, 1e-3), 1.5, 0.1, DT)
    rocking = processes.resonance_process(np.full(3, 1e-6), 1.5, 0.1, DT)
    alone, shaken = bound([120.0])[0], bound([120.0], Disturbances(shaking=shaking))[0]
    assert alone < shaken < 1.01 * alone
    assert bound([120.0], Disturbances(rocking=rocking))[0] == alone  # the gyros measure it


def test_gyro_random_walk_raises_bound():
    walk = processes.sampled_mean_of_random_walk(np.full(3, 1e-8), DT)
    assert bound([300.0], Disturbances(gyro_walk=walk))[0] > 1.5 * bound([300.0])[0]


def test_sensor_noise_axes_rotate_with_body():
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # heading 90 deg
    ahead = bound([60.0], errors=errors((ACCEL, 3 * ACCEL, ACCEL), (GYRO, 2 * GYRO, GYRO)))
    aside = bound(
        [60.0], errors=errors((3 * ACCEL, ACCEL, ACCEL), (2 * GYRO, GYRO, GYRO)), to_n=turned
    )
    np.testing.assert_allclose(ahead, aside, rtol=1e-12)


def test_one_sample_carries_almost_no_heading_information():
    assert np.all(bound([DT, 10.0])[0] > 100 * bound([10.0]))
