"""Feedback between samples, and windows of relaxed resets, which tend to hard ones.

`test_zero_velocity.py` compares hard resets with naive ones.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.in_engine import (
    PAPER1,
    filter_params,
    navigation,
    paper_filter,
    runner,
    site,
    swing_increments,
)
from oracles.naive import DEG, PAPER, exp

from sinsjax.methods.schedules import (
    CovarianceReset,
    FeedbackSchedule,
    Resets,
    Windows,
    next_feedback,
    reset_due,
)

pytestmark = pytest.mark.optimised(False)

FULL = CovarianceReset(*map(np.float64, (0.0, 0.0, 1.0, 1.0)))


def test_feedback_keeps_its_interval_between_samples():
    every = jnp.asarray(2.5)
    schedule, at, samples = FeedbackSchedule(every, jnp.asarray(1.0), None), every, []
    for n in range(1, 16):
        samples += [n] if n >= at else []
        at = next_feedback(schedule, at, jnp.asarray(False), jnp.asarray(float(n)))
    assert samples == [3, 5, 8, 10, 13, 15]


@jax.jit
def shares(times, width):
    """Shares of a reset at samples 1 to 1000."""
    windows = Windows(times, width, FULL)
    return jax.vmap(lambda n: reset_due(windows, n))(1.0 + jnp.arange(1000.0))


@given(st.floats(300, 700), st.floats(20, 250))
def test_shares_of_reset_window_combine_to_full_reset(time, width):
    """What its shares leave is exp(-8), and a little more where few samples have much of it."""
    left = np.log1p(-np.asarray(shares(np.array([time]), width))).sum()
    # The sum of log(1 + 8 b) is 8 - 32 sum b^2 + ..., that of b^2 being 5/7 over the width.
    assert -8 < left < -8 + 32 * 5 / 7 / width
    assert left == pytest.approx(-8 + 32 * 5 / 7 / width, abs=8**3 / 2 / width**2 + 0.002)
    assert 1 - np.exp(left) > 0.998


# In the filter: 300 samples of [P1]'s swing, at large misalignment

RATE, LATITUDE = 50, 0.5


@cache
def rows():
    return swing_increments(PAPER1, PAPER, LATITUDE, rate=RATE, samples=300)


def run(resets):
    """What is left of a run at its end: variances over those of the start, attitude, x."""
    filt = filter_params(paper_filter(5, every=9, gain=0.4))._replace(resets=resets)
    off = exp(-np.array([5.0, 5.0, 30.0]) * DEG)
    nav = navigation(off @ PAPER1.matrix(0.0), (0.3, -0.2), LATITUDE)
    state, attitude, _ = runner("kalman5", rate=RATE)(filt, site(PAPER, LATITUDE), nav, rows())
    variances = (state.belief.p[k] for k in (0, 5, 9, 12, 14))
    p = [p / start for p, start in zip(variances, filt.p0, strict=True)]
    return jnp.stack([one[-1] for one in (*p, *attitude, *state.belief.x)])


@pytest.mark.nightly
@pytest.mark.parametrize("time", [150.0, 150.5])
def test_relaxed_reset_converges_to_hard_reset_as_window_narrows(time):
    """P, and attitude and x, are the nearer the narrower the window is."""
    hard, none = (run(Resets(np.array([at]), FULL)) for at in (150.0, np.inf))
    widths = np.array([128.0, 64.0, 32.0, 16.0])
    off = np.abs([run(Windows(np.array([time]), w, FULL)) - hard for w in widths])
    for kind in (slice(5), slice(5, None)):
        far = np.abs(none - hard)[kind].max()
        near = off[:, kind].max(axis=1) / far
        assert np.all(near[1:] < near[:-1] / 2) and near[-1] < 0.2
    assert off[-1, :5].max() < 2e-3
