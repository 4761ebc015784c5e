"""Passes over a record: what is read, and the error model back.

`test_naive_filters.py` and `test_compass.py` have naive passes.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.in_engine import dense, navigation, place
from oracles.naive import DEG, WGS84, exp, updates

from sinsjax.engine.stepping import order_samples
from sinsjax.methods import zero_velocity
from sinsjax.strapdown import earth, mechanisation
from sinsjax.types import Vec3

pytestmark = pytest.mark.optimised(False)

# What is read


@given(st.integers(1, 6), st.integers(1, 5), st.integers(1, 20))
@settings(max_examples=15)
def test_every_stored_sample_is_read_once_per_pass(stored: int, every: int, records: int) -> None:
    """Forward in order, backward in reverse; each is compensated with the one before it."""
    paired, before, turns = [], -1, []
    for record in range(records):
        read = order_samples(jnp.asarray(record), jnp.asarray(stored), every)
        turns += [bool(read.opens_pass)] + [False] * (every - 1)
        for now in map(int, read.samples):
            later, earlier = (before, now) if read.backward else (now, before)
            paired.append((later, earlier, -1 if read.backward else 1))
            before = now
    expected = list(updates(np.zeros((stored * every, 6)), count=records * every))
    numbers = [u.k - 1 for u in expected]
    length = stored * every
    places = [
        n % length if u.way > 0 else length - 1 - n % length
        for n, u in zip(numbers, expected, strict=True)
    ]
    assert paired == [(k, k - 1, u.way) for k, u in zip(places, expected, strict=True)]
    assert turns == [u.turns for u in expected]


# Filters over a stored record


@given(
    st.booleans(),
    st.tuples(*[st.floats(-30, 30)] * 2),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.floats(-80, 80),
)
def test_backward_error_model_is_reversed_forward_model(with_biases, v, phi, latitude_deg):
    """Errors backward are T x, so that A backward is -T A T: one model for both directions."""
    dt, model, states = 0.01, zero_velocity.five_state_transition, zero_velocity.FIVE_STATES
    if with_biases:
        model, states = zero_velocity.ten_state_transition, zero_velocity.TEN_STATES
    reversal = [kind.sign for kind in states]
    here = place(WGS84, latitude_deg * DEG)
    nav = navigation(exp(phi), v, latitude_deg * DEG)
    f_dt = Vec3(0.3 * dt, -0.2 * dt, 9.9 * dt)
    forward, backward = (
        dense(model(n, p, f_dt, dt), len(reversal))
        for n, p in (
            (nav, here),
            (mechanisation.reverse_velocity(nav), earth.reverse_rotation(here, -1.0)),
        )
    )
    t = np.diag(reversal)
    np.testing.assert_allclose(backward, -t @ forward @ t, rtol=1e-13, atol=1e-25)
    assert np.array_equal(t @ t, np.eye(len(reversal)))
