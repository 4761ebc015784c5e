"""Feedback between samples, and windows of relaxed resets.

`test_naive_filters.py` compares hard resets with naive ones.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sinsjax.methods.schedules import (
    CovarianceReset,
    FeedbackSchedule,
    Resets,
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
    windows = Resets(times, FULL, width)
    return jax.vmap(lambda n: reset_due(windows, n))(1.0 + jnp.arange(1000.0))


@given(st.floats(300, 700), st.floats(20, 250))
def test_shares_of_reset_window_combine_to_full_reset(time, width):
    """What its shares leave is exp(-8), and a little more where few samples have much of it."""
    left = np.log1p(-np.asarray(shares(np.array([time]), width))).sum()
    # The sum of log(1 + 8 b) is 8 - 32 sum b^2 + ..., that of b^2 being 5/7 over the width.
    assert -8 < left < -8 + 32 * 5 / 7 / width
    assert left == pytest.approx(-8 + 32 * 5 / 7 / width, abs=8**3 / 2 / width**2 + 0.002)
    assert 1 - np.exp(left) > 0.998
