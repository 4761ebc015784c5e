"""Metrics that follow a run record by record are those of its whole curves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.in_engine import ARCMIN
from oracles.naive import DEG, judge

from sinsjax.engine import metrics
from sinsjax.engine.metrics import Criteria, Observation
from sinsjax.methods.floors import BiasFloor
from sinsjax.methods.method import AttitudeCovariance
from sinsjax.types import Vec3

pytestmark = pytest.mark.optimised(False)

BANDS = np.array([60.0, 10.0, 3.0]) * ARCMIN
FLOOR = -26.0 * ARCMIN
N, STEP = 60, 0.5
TIMES = STEP * np.arange(1, N + 1)


@jax.jit
def outcome(criteria, values, sigma, p, floor):
    """Outcome of curves: values (N, 6) as phi e, n, u, pitch, roll, yaw; sigma (N, 3); one P."""
    covariance = AttitudeCovariance(*p[np.triu_indices(3)])

    def record(so_far, xs):
        time, value, s = xs
        now = Observation(Vec3(*value[:3]), Vec3(*s), *value[3:])
        return metrics.accumulate(so_far, criteria, now, floor=floor, time=time), None

    start = metrics.initial_metrics(criteria, np.float64(0.0))
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
    judged = {"p": p, "floor": FLOOR, "bands": BANDS, "window": window}
    expected = judge(TIMES, values, sigma[:, 2], after=(after, after, 20.0), **judged)
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


def curves(angle, place=2):
    """All zero but phi_u, or another angle."""
    values = np.zeros((N, 6))
    values[:, place] = angle
    return values, np.full((N, 3), ARCMIN), np.eye(3)


@pytest.mark.parametrize(
    ("off_arcmin", "until"),
    [
        # One excursion at the 20th record, 10 s: the end of the last interval outside.
        (np.where(np.arange(N) == 19, -30.0, 0.0), (0.0, 10.0, 10.0)),
        # NaN is outside every band, and the edge of a band within it.
        (np.where(np.arange(N) == 4, np.nan, 0.0), (2.5, 2.5, 2.5)),
        (np.full(N, 10.0), (0.0, 0.0, 30.0)),
    ],
)
def test_settling_time_ends_last_interval_outside_band(off_arcmin, until):
    """About the truth; and about the floor, here zero, to which no rounding adds."""
    for row, floor in enumerate((0.0, FLOOR)):
        got = outcome(criteria(), *curves(off_arcmin * ARCMIN), floor)
        np.testing.assert_array_equal(got.outside_until[row], until)


def test_unknown_values_give_nan_where_they_matter_only():
    few = outcome(criteria((30.0, 40.0), 30.0, 30.0), *curves(np.zeros(N)), 0.0)
    assert np.all(np.isnan([*few.mean, *few.std, *few.above_share]))
    one = outcome(criteria((29.5, 30.0)), *curves(np.full(N, 0.1)), 0.0)
    assert one.mean[2] == pytest.approx(0.1, rel=1e-15) and np.isnan(one.std[2])
    inside = (TIMES > 10) & (TIMES <= 25)
    before = outcome(criteria(), *curves(np.where(inside, 0.1, np.nan)), 0.0)
    np.testing.assert_allclose([before.mean[2], before.std[2]], [0.1, 0.0], atol=1e-15)
    values, sigma, p = curves(np.linspace(0.1, 0.2, N), 5)
    untrusting = outcome(criteria(), values, np.nan * sigma, np.nan * p, 0.0)
    assert np.isnan([untrusting.nees, untrusting.nis_u]).all() and untrusting.mean[2] == 0
    values[:, :3] = np.nan  # no reference
    got = outcome(criteria(), values, sigma, p, 0.0)
    np.testing.assert_array_equal(got.outside_until, 30.0)
    unknown = [*got.mean[:3], *got.std[:3], *got.above_share, got.nees, got.nis_u]
    assert np.all(np.isnan(unknown))
    yaw = values[inside, 5]
    np.testing.assert_allclose([got.mean[5], got.std[5]], [yaw.mean(), yaw.std(ddof=1)], rtol=1e-10)


def relaxed_until(off, sharpness):
    """When the errors ``off`` from the floor (N,) were last outside each band, relaxed."""
    values = jnp.zeros((N, 6)).at[:, 2].set(FLOOR + off)
    relaxed = criteria()._replace(sharpness=np.float64(sharpness))
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
    none = np.zeros(N)
    until, slope = jax.jvp(lambda at: relaxed_until(at, 1.0), (none,), (none + ARCMIN,))
    np.testing.assert_allclose([until, slope], 0, atol=1e-9)  # and not nan
