import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.in_engine import ARCMIN
from oracles.naive import DEG, exp, judge, log, quaternion
from scipy.spatial.transform import Rotation

from sinsjax.engine import metrics
from sinsjax.engine.metrics import Criteria, Observation
from sinsjax.methods.floors import BiasFloor
from sinsjax.methods.method import AttitudeCovariance
from sinsjax.types import Quat, Vec3

pytestmark = pytest.mark.optimised(False)

BANDS = np.array([60.0, 10.0, 3.0]) * ARCMIN
FLOOR = -26.0 * ARCMIN
N, STEP = 60, 0.5
TIMES = STEP * np.arange(1, N + 1)


@jax.jit
def outcome(criteria, values, sigma, p, floor):
    """Outcome of curves: values (N, 6) as phi e, n, u, pitch, roll, yaw; sigma (N, 3).

    P is the same at all times.
    """
    covariance = AttitudeCovariance(*p[np.triu_indices(3)])

    def observation(value, sigma):
        return Observation(Vec3(*value[:3]), Vec3(*sigma), *value[3:])

    def record(so_far, xs):
        time, value, s = xs
        now = observation(value, s)
        so_far = metrics.accumulate(so_far, criteria, now, floor=floor, time=time)
        return metrics.store_reported_times(so_far, criteria, covariance, time / STEP), None

    start = metrics.start(criteria, np.float64(0.0))
    so_far, _ = jax.lax.scan(record, start, (TIMES, values, sigma))
    limit = BiasFloor(Vec3(0.0, 0.0, floor), jnp.asarray(0.0), jnp.asarray(False))
    return metrics.finish(so_far, covariance, limit)


def criteria(window=(10.0, 25.0), after=5.0, steady=20.0):
    return Criteria(BANDS, *map(np.float64, (*window, after, steady)))


def random_curves(seed):
    """Errors that settle at some time and may come back; angles that pass +-180 deg."""
    rng = np.random.default_rng(seed)
    values = np.empty((N, 6))
    decay = np.exp(-TIMES / rng.uniform(1, 10))[:, None]
    values[:, :3] = decay * rng.normal(scale=3 * DEG, size=3)
    values[:, :3] += rng.normal(scale=rng.choice([1, 10]) * ARCMIN, size=(N, 3))
    values[:, 2] += FLOOR
    walk = rng.normal(scale=3 * DEG, size=(N, 3)).cumsum(axis=0)
    values[:, 3:] = rng.uniform(-np.pi, np.pi, 3) + walk
    values[:, 3:] = np.arctan2(np.sin(values[:, 3:]), np.cos(values[:, 3:]))
    sigma = decay * 2 * DEG + rng.uniform(0, 40) * ARCMIN * np.ones(3)
    half = rng.normal(scale=10 * ARCMIN, size=(3, 5))
    return values, sigma, half @ half.T


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([(10.0, 25.0), (0.0, 30.0), (29.0, 30.0), (9.9, 15.1)]),
    st.sampled_from([0.0, 4.9, 5.0]),
)
def test_streamed_metrics_match_whole_curve_metrics(seed, window, after):
    values, sigma, p = random_curves(seed)
    got = outcome(criteria(window, after, 20.0), values, sigma, p, FLOOR)
    expected = judge(
        TIMES,
        values,
        sigma[:, 2],
        p=p,
        floor=FLOOR,
        bands=BANDS,
        window=window,
        after=(after, after, 20.0),
    )
    np.testing.assert_array_equal(got.outside_until, expected.outside_until)
    off = np.array(got.mean) - expected.mean
    np.testing.assert_allclose(np.arctan2(np.sin(off), np.cos(off)), 0, atol=1e-13)
    assert np.all(np.abs(got.mean) <= np.pi)
    np.testing.assert_allclose(got.std, expected.std, rtol=1e-9)
    np.testing.assert_allclose(got.above_share, expected.above_share, rtol=1e-14)
    np.testing.assert_allclose(got.nees, expected.nees, rtol=1e-8)
    np.testing.assert_allclose(got.nis_u, expected.nis_u, rtol=1e-12)
    np.testing.assert_array_equal(got.floor.phi.z, FLOOR)
    np.testing.assert_array_equal((*got.last.phi, *got.last[2:]), values[-1])
    np.testing.assert_array_equal(got.last.sigma, sigma[-1])


def test_report_samples_give_requested_records_and_nan_after_end():
    values, sigma, p = random_curves(1)
    at = np.array([7.0, 1.0, N, N + 1])
    got = outcome(criteria()._replace(report_samples=at), values, sigma, p, FLOOR)
    k = at[:3].astype(int) - 1
    phi = values[k, :3]
    expected = [values[k, 2], sigma[k, 2], np.sum(phi * np.linalg.solve(p, phi.T).T, axis=1)]
    np.testing.assert_allclose(got.at_times[:3], np.transpose(expected), rtol=1e-8)
    assert np.isnan(got.at_times[3]).all()
    assert outcome(criteria(), values, sigma, p, FLOOR).at_times is None


def curves(phi_u):
    """All zero but phi_u."""
    values = np.zeros((N, 6))
    values[:, 2] = phi_u
    return values, np.full((N, 3), ARCMIN), np.eye(3)


@pytest.mark.parametrize(
    ("off_arcmin", "until"),
    [
        # Outside at all, a little, and never.
        (np.full(N, 61.0), (30.0, 30.0, 30.0)),
        (np.full(N, 2.9), (0.0, 0.0, 0.0)),
        # One excursion at the 20th record, 10 s: the end of the last interval outside.
        (np.where(np.arange(N) == 19, -30.0, 0.0), (0.0, 10.0, 10.0)),
        # The first record alone, and the last alone.
        (np.where(np.arange(N) == 0, 90.0, 0.0), (0.5, 0.5, 0.5)),
        (np.where(np.arange(N) == N - 1, 5.0, 0.0), (0.0, 0.0, 30.0)),
        # NaN is outside every band.
        (np.where(np.arange(N) == 4, np.nan, 0.0), (2.5, 2.5, 2.5)),
    ],
)
def test_settling_time_ends_last_interval_outside_band(off_arcmin, until):
    got = outcome(criteria(), *curves(FLOOR + off_arcmin * ARCMIN), FLOOR)
    np.testing.assert_array_equal(got.outside_until[0], until)
    from_truth = outcome(criteria(), *curves(off_arcmin * ARCMIN), FLOOR)
    np.testing.assert_array_equal(from_truth.outside_until[1], until)


def test_error_on_band_edge_counts_as_inside():
    got = outcome(criteria(), *curves(np.full(N, BANDS[1])), 0.0)
    np.testing.assert_array_equal(got.outside_until, [(0.0, 0.0, 30.0)] * 2)


def test_small_std_about_large_mean_keeps_precision():
    values, sigma, p = curves(np.zeros(N))
    values[:, 5] = 3.0 + 1e-9 * np.where(np.arange(N) % 2, 1.0, -1.0)
    got = outcome(criteria((0.0, 30.0)), values, sigma, p, 0.0)
    np.testing.assert_allclose(got.std[5], 1e-9 * np.sqrt(N / (N - 1)), rtol=1e-6)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_yaw_statistics_across_180_deg(side):
    values, sigma, p = curves(np.zeros(N))
    swing = 0.1 * np.sin(2 * np.pi * TIMES / 3.0)
    yaw = side * (np.pi - 0.001) + swing
    values[:, 5] = np.arctan2(np.sin(yaw), np.cos(yaw))
    got = outcome(criteria((6.0, 30.0)), values, sigma, p, 0.0)
    np.testing.assert_allclose(got.mean[5], side * (np.pi - 0.001), rtol=1e-12)
    np.testing.assert_allclose(got.std[5], np.std(swing[12:], ddof=1), rtol=1e-12)


def test_statistics_of_too_few_records_are_nan():
    got = outcome(criteria((30.0, 40.0), 30.0, 30.0), *curves(np.zeros(N)), 0.0)
    assert np.all(np.isnan([*got.mean, *got.std, *got.above_share]))
    one = outcome(criteria((29.5, 30.0)), *curves(np.full(N, 0.1)), 0.0)
    np.testing.assert_allclose(one.mean[2], 0.1, rtol=1e-15)
    assert np.isnan(one.std[2])


def test_missing_reference_gives_nan_phi_but_attitude_statistics():
    values, sigma, p = curves(np.zeros(N))
    values[:, :3], values[:, 5] = np.nan, np.linspace(0.1, 0.2, N)
    got = outcome(criteria(), values, sigma, p, 0.0)
    np.testing.assert_array_equal(got.outside_until, 30.0)
    assert np.all(np.isnan([*got.mean[:3], *got.std[:3], got.nees, got.nis_u]))
    assert np.all(np.isnan(got.above_share))
    inside = values[(TIMES > 10) & (TIMES <= 25), 5]
    np.testing.assert_allclose(got.mean[5], inside.mean(), rtol=1e-13)
    np.testing.assert_allclose(got.std[5], inside.std(ddof=1), rtol=1e-10)


def test_nan_outside_window_does_not_affect_statistics():
    phi = np.where((TIMES > 10) & (TIMES <= 25), 0.1, np.nan)
    got = outcome(criteria((10.0, 25.0)), *curves(phi), 0.0)
    np.testing.assert_allclose(got.mean[2], 0.1, rtol=1e-14)
    np.testing.assert_allclose(got.std[2], 0.0, atol=1e-15)


def test_nees_and_nis_are_nan_without_covariance():
    values, sigma, p = curves(np.zeros(N))
    got = outcome(criteria(), values, np.nan * sigma, np.nan * p, 0.0)
    assert np.isnan(got.nees) and np.isnan(got.nis_u)
    np.testing.assert_allclose(got.mean[2], 0.0, atol=0)


@given(st.integers(0, 2**32 - 1))
def test_observe_matches_rotation_vector_and_euler_angles(seed):
    rng = np.random.default_rng(seed)
    angles = rng.uniform([-1.4, -np.pi, -np.pi], [1.4, np.pi, np.pi])
    c_hat = Rotation.from_euler("ZXY", angles[[2, 0, 1]]).as_matrix()
    phi = rng.normal(scale=0.8, size=3)
    c_true = exp(phi) @ c_hat
    variances = rng.random(6)
    now = metrics.observe(
        Quat(*map(jnp.asarray, quaternion(c_true))),
        Quat(*map(jnp.asarray, quaternion(c_hat))),
        AttitudeCovariance(*variances),
    )
    # The rotation vector of C_true C_hat^T.
    np.testing.assert_allclose(now.phi, log(c_true @ c_hat.T), atol=1e-7)
    np.testing.assert_allclose((now.pitch, now.roll, now.yaw), angles, atol=1e-12)
    np.testing.assert_allclose(now.sigma, np.sqrt(variances[[0, 3, 5]]), rtol=1e-15)


# Relaxed settling times


def relaxed_until(off, sharpness):
    """When the errors ``off`` from the floor (N,) were last outside each band, relaxed."""
    values = jnp.zeros((N, 6)).at[:, 2].set(FLOOR + off)
    relaxed = criteria()._replace(sharpness=sharpness)
    return outcome(relaxed, values, jnp.full((N, 3), ARCMIN), jnp.eye(3), FLOOR).outside_until[0]


@given(st.integers(0, 2**32 - 1))
def test_relaxed_settling_times_match_whole_curve_formula(seed):
    """Each record is outside with a share of x^k / (1 + x^k), x being the error over the band."""
    off, k = random_curves(seed)[0][:, 2] - FLOOR, 5.0
    for band, got in zip(BANDS, relaxed_until(off, k), strict=True):
        share = (np.abs(off) / band) ** k / (1 + (np.abs(off) / band) ** k)
        # The time of each record, by the share of it that no later record has taken over.
        later = np.append(np.cumprod((1 - share)[::-1])[-2::-1], 1.0)
        np.testing.assert_allclose(got, np.sum(TIMES * share * later), rtol=1e-9)


@pytest.mark.parametrize("sharpness", [2.0, 8.0])
def test_settling_time_derivative_matches_finite_differences(sharpness):
    off = (90 * np.exp(-TIMES / 6) * np.cos(TIMES) + 2) * ARCMIN
    k = np.float64(sharpness)
    for way in (np.cos(3 * TIMES) * ARCMIN, off):
        _, got = jax.jvp(lambda at: relaxed_until(at, k), (off,), (way,))
        h = 1e-5
        ahead, behind = (relaxed_until(off + sign * h * way, k) for sign in (1, -1))
        assert np.all(np.isfinite(got)) and np.all(np.asarray(got) != 0)
        np.testing.assert_allclose(got, (ahead - behind) / (2 * h), rtol=1e-5)


@pytest.mark.parametrize("sharpness", [1.0, 2.0, 8.0])
def test_relaxed_settling_time_slope_is_zero_at_zero_error(sharpness):
    off, k = np.zeros(N), np.float64(sharpness)
    until, slope = jax.jvp(lambda at: relaxed_until(at, k), (off,), (off + ARCMIN,))
    np.testing.assert_allclose(until, 0, atol=1e-9)
    np.testing.assert_allclose(slope, 0, atol=1e-9)
