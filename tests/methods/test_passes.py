"""Passes over a record: what is read, pure navigation there and back, and the error model back.

`test_zero_velocity.py`, `test_naive_filters.py` and `test_compass.py` have naive passes.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.in_engine import (
    DEG_PER_H,
    PAPER2,
    UG,
    follow,
    loops,
    navigation,
    place,
    site,
    swing_increments,
)
from oracles.naive import DEG, SECOND_PAPER, WGS84, Loops, exp, log, of_quaternion, updates

from sinsjax.maths.algebra import entries_as_numbers
from sinsjax.methods import passes, zero_velocity
from sinsjax.methods.compass import REVERSALS
from sinsjax.methods.method import Options
from sinsjax.strapdown import earth, mechanisation
from sinsjax.types import Vec3

pytestmark = pytest.mark.optimised(False)

EARTH = SECOND_PAPER
LATITUDE = 32.057313 * DEG

# What is read


@given(st.integers(1, 6), st.integers(1, 5), st.integers(1, 20))
@settings(max_examples=15)
def test_every_stored_sample_is_read_once_per_pass(stored: int, every: int, records: int) -> None:
    """Forward in order, backward in reverse; each is compensated with the one before it."""
    paired, before, turns = [], -1, []
    for record in range(records):
        read = passes.read_interval("alternate", jnp.asarray(record), jnp.asarray(stored), every)
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


# There and back


@pytest.mark.parametrize("position", ["fixed", "integrated"])
def test_backward_pass_retraces_forward_navigation(position: str) -> None:
    """Same attitude and place, mirrored velocity, at all stored times of [P2]'s swing: navigation.

    A step takes the rates at its start, which is the other end on the way back; at 200 Hz that
    leaves 1e-7 rad and 1e-4 m/s of a start that is off in everything.
    """
    rate, stored_s = 200, 80
    phi, v = np.array([1.0, -1.0, 30.0]) * DEG, np.array([0.5, -1.0])
    errors = {"gyro": (0.0, 0.006 * DEG_PER_H), "accel": (0.0, 50 * UG)}
    rows = swing_increments(PAPER2, EARTH, LATITUDE, rate=rate, samples=rate * stored_s, **errors)
    no_gains = Loops((0.0, 0.0, 0.0), ((np.inf, (0.0, 0.0, 0.0, 0.0)),))
    free = loops(no_gains, REVERSALS["velocity"])
    options = Options(1 / rate, position=position)
    start, here = (PAPER2.matrix(0.0), phi, v), site(EARTH, LATITUDE)
    passes = {"every": rate, "records": 2 * stored_s, "stored": stored_s}
    nav = follow("compass", free, rows, here, start, options=options, **passes).nav
    first = exp(-phi) @ PAPER2.matrix(0.0)
    c = np.concatenate([first[None], of_quaternion(np.stack(nav.q, axis=1))])
    velocity = np.concatenate([[v], np.stack([nav.ve, nav.vn], axis=1)])
    place = np.stack([nav.latitude - LATITUDE, nav.longitude], axis=1)
    place = np.concatenate([[[0.0, 0.0]], place])
    assert np.abs(log(c @ np.swapaxes(c[::-1], 1, 2))).max() < 1e-7
    assert np.abs(velocity[:stored_s] + velocity[:stored_s:-1]).max() < 1e-4
    # From 1 deg of tilt it is 500 m away after 80 s.
    assert np.abs(place - place[::-1]).max() < 1e-7
    assert (np.abs(place[stored_s]).max() > 1e-6) == (position == "integrated")


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


def dense(entries, n):
    matrix = np.zeros((n, n))
    for place_, value in entries_as_numbers(entries).items():
        matrix[place_] = value
    return matrix
