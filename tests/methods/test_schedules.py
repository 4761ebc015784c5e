"""Schedules: hard resets, relaxed ones that tend to them, and what P becomes."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.in_engine import (
    PAPER1,
    navigation,
    paper_filter,
    params,
    site,
    step_and_close,
    swing_increments,
)
from oracles.naive import DEG, PAPER, exp

from sinsjax.methods.method import Options
from sinsjax.methods.registry import METHODS
from sinsjax.methods.schedules import (
    CovarianceReset,
    Resets,
    Windows,
    interpolate,
    reset_covariance,
    reset_due,
)
from sinsjax.strapdown import sensors

pytestmark = pytest.mark.optimised(False)

FULL = CovarianceReset(0.0, 0.0, 1.0, 1.0)
KINDS = {
    "full": FULL,
    "yaw": CovarianceReset(1.0, 0.0, 0.0, 1.0),
    "scale": CovarianceReset(10.0, 10.0, 0.0, 0.0),
    "shrunk": CovarianceReset(0.01, 0.01, 0.0, 0.0),
}


@jax.jit
def shares(times, width):
    """Shares of a reset at samples 1 to 1000."""
    windows = Windows(times, width, FULL)
    return jax.vmap(lambda n: reset_due(windows, n))(1.0 + jnp.arange(1000.0))


def test_hard_resets_are_due_at_their_samples_in_any_order():
    resets = Resets(np.array([7.0, np.inf, 3.0]), FULL)
    due = [bool(reset_due(resets, np.float64(n))) for n in range(1, 11)]
    assert [n for n, hit in enumerate(due, 1) if hit] == [3, 7]
    assert not reset_due(Resets(np.array([]), FULL), np.float64(1.0))


@given(st.floats(300, 700), st.floats(0.5, 250))
def test_reset_window_has_given_width_and_is_symmetric(time, width):
    share = np.asarray(shares(np.array([time]), width))
    n = np.arange(1, 1001)
    assert np.all(share[np.abs(n - time) >= width] == 0)
    assert np.all((share >= 0) & (share < 1))
    assert np.all(share[np.abs(n - time) < 0.99 * width] > 0)
    mirrored = np.asarray(shares(np.array([1001 - time]), width))
    np.testing.assert_allclose(share, mirrored[::-1], rtol=1e-9, atol=1e-12)


@given(st.floats(300, 700), st.floats(20, 250))
def test_shares_of_reset_window_combine_to_full_reset(time, width):
    """What its shares leave is exp(-8), and a little more where few samples have much of it."""
    left = np.log1p(-np.asarray(shares(np.array([time]), width))).sum()
    # The sum of log(1 + 8 b) is 8 - 32 sum b^2 + ..., that of b^2 being 5/7 over the width.
    assert -8 < left < -8 + 32 * 5 / 7 / width
    assert left == pytest.approx(-8 + 32 * 5 / 7 / width, abs=8**3 / 2 / width**2 + 0.002)
    assert 1 - np.exp(left) > 0.998


@given(st.floats(300, 500), st.floats(0, 200), st.floats(20, 250))
def test_overlapping_reset_windows_act_in_succession(time, apart, width):
    pair = np.array([time, time + apart])
    one, other = (1 - np.asarray(shares(pair[i : i + 1], width)) for i in (0, 1))
    np.testing.assert_allclose(1 - shares(pair, width), one * other, rtol=1e-12, atol=1e-15)


mixed = jax.jit(interpolate)


# XLA on a CPU takes subnormal numbers for zero, so that an end that is one does not come back.
normal = st.floats(-1e3, 1e3, allow_subnormal=False)


@given(st.floats(0, 1), normal, normal)
def test_mix_interpolates_between_its_ends(share, one, other):
    expected = share * one + (1 - share) * other
    assert float(mixed(share, one, other)) == pytest.approx(expected, rel=1e-12, abs=1e-10)
    assert float(mixed(0.0, one, other)) == other
    assert float(mixed(True, one, other)) == one
    assert float(mixed(False, one, other)) == other
    # An infinity that a flag does not choose leaves no trace.
    assert float(mixed(True, one, np.inf)) == one and float(mixed(False, np.inf, other)) == other


@pytest.mark.parametrize("kind", KINDS)
@given(st.integers(0, 2**32 - 1))
def test_covariance_after_reset_of_each_kind(kind, seed):
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(5, 5))
    p, to = half @ half.T, rng.random(5)
    rows, across = np.triu_indices(5)
    got = reset_covariance(KINDS[kind], tuple(p[rows, across]), tuple(to), heading=(4,))
    expected = {"full": np.diag(to), "scale": 10 * p, "shrunk": 0.01 * p, "yaw": p.copy()}[kind]
    if kind == "yaw":
        expected[4], expected[:, 4] = 0, 0
        expected[4, 4] = to[4]
    np.testing.assert_allclose(got, expected[rows, across], rtol=1e-15)


# In the filter: 300 samples of [P1]'s swing, at large misalignment

RATE, SAMPLES = 50, 300
FILTER = paper_filter(5, every=9, gain=0.4)


@cache
def samples():
    rows = swing_increments(PAPER1, PAPER, 0.5, rate=RATE, samples=SAMPLES)
    return sensors.compensate_record(rows, rows[0])


def run(resets, nav, samples):
    """What is left of a run at its end: variances over those of the start, attitude, x."""
    method, here = METHODS["kalman5"](Options(1 / RATE)), site(PAPER, 0.5)
    filt = params(FILTER)._replace(resets=resets)

    def step(state, xs):
        return step_and_close(method, filt, here, state, *xs), None

    counts = 1.0 + jnp.arange(float(SAMPLES))
    state, _ = jax.lax.scan(step, method.init(filt, nav), (samples, counts))
    variances = (state.belief.p[k] for k in (0, 5, 9, 12, 14))
    p = [p / start for p, start in zip(variances, filt.p0, strict=True)]
    return jnp.stack([*p, *method.attitude(state), *state.belief.x])


FULL_RESET = CovarianceReset(*map(np.float64, KINDS["full"]))
compiled = jax.jit(run)


def start():
    off = exp(-np.array([5.0, 5.0, 30.0]) * DEG)
    return navigation(off @ PAPER1.matrix(0.0), (0.3, -0.2), 0.5)


def relaxed(times, width):
    return np.asarray(compiled(Windows(times, width, FULL_RESET), start(), samples()))


@pytest.mark.nightly
@pytest.mark.parametrize("time", [150.0, 150.5])
def test_relaxed_reset_converges_to_hard_reset_as_window_narrows(time):
    """P, and attitude and x, are the nearer the narrower the window is."""
    hard = compiled(Resets(np.array([150.0]), FULL_RESET), start(), samples())
    none = compiled(Resets(np.array([np.inf]), FULL_RESET), start(), samples())
    widths = (128.0, 64.0, 32.0, 16.0)
    off = np.abs([relaxed(np.array([time]), np.float64(w)) - hard for w in widths])
    for kind in (slice(5), slice(5, None)):
        far = np.abs(none - hard)[kind].max()
        near = off[:, kind].max(axis=1) / far
        assert np.all(near[1:] < near[:-1] / 2) and near[-1] < 0.2
    assert off[-1, :5].max() < 2e-3


@pytest.mark.nightly
def test_derivative_by_reset_times_and_width_matches_finite_difference():
    """Of windows that overlap too; no sample is at the edge of one, where the slope has a bend."""
    point = (np.array([90.37, 130.41]), np.float64(30.3))

    def at(times, width):
        return run(Windows(times, width, FULL_RESET), start(), samples())

    samples()
    slope = jax.jit(lambda point, way: jax.jvp(at, point, way)[1])
    for way in (
        (np.array([1.0, 0.0]), np.float64(0.0)),
        (np.array([0.0, 1.0]), np.float64(0.0)),
        (np.array([0.0, 0.0]), np.float64(1.0)),
    ):
        got, h = slope(point, way), 1e-3
        ahead, behind = (
            relaxed(*(p + sign * h * w for p, w in zip(point, way, strict=True)))
            for sign in (1, -1)
        )
        expected = (ahead - behind) / (2 * h)
        assert np.all(np.isfinite(got)) and np.all(np.abs(got[:9]) > 0)
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=2e-12)
