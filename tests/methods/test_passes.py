"""Passes over a record: the way there and back, and what a turn makes of a method's state."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.in_engine import (
    DEG_PER_H,
    PAPER1,
    PAPER2,
    UG,
    covariances,
    loops,
    measured,
    navigation,
    one_run,
    paper_filter,
    params,
    place,
    record_world,
    site,
    swing_increments,
    trail,
)
from oracles.naive import (
    DEG,
    SECOND_PAPER,
    WGS84,
    Loops,
    Swing,
    azimuth_gains,
    closed_loop,
    exp,
    level_gains,
    log,
    of_quaternion,
    updates,
)

from sinsjax.engine.run import Static
from sinsjax.maths.algebra import entries_as_numbers
from sinsjax.methods import passes
from sinsjax.methods.compass import REVERSALS, Reversal
from sinsjax.methods.method import Options
from sinsjax.strapdown import earth, mechanisation, sensors
from sinsjax.strapdown.error_model import MODELS
from sinsjax.types import Vec3

pytestmark = pytest.mark.optimised(False)

EARTH = SECOND_PAPER
LATITUDE = 32.057313 * DEG
STILL = Swing(*np.zeros((2, 3)), np.ones(3), np.zeros(3))
NEVER = np.inf

# What is read


@given(st.integers(1, 6), st.integers(1, 5), st.integers(1, 20))
@settings(max_examples=15)
def test_every_stored_sample_is_read_once_per_pass(stored: int, every: int, records: int) -> None:
    """Forward in order, backward in reverse; each is compensated with the one before it."""
    paired, before, turns = [], -1, []
    for record in range(records):
        read = passes.read_alternately(jnp.asarray(record), jnp.asarray(stored), every)
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


def test_backward_sample_undoes_forward_sample() -> None:
    """After both, a body is where it was, and has gained twice the velocity, seen from there."""
    rng = np.random.default_rng(1)
    now, before = (
        sensors.split_record_row(np.concatenate(rng.normal(size=(2, 3)) * [[0.1], [1.0]]))
        for _ in "ab"
    )
    forward = passes.compensate(now, before, jnp.asarray(False))
    # Backward the sample before it on the record comes last.
    backward = passes.compensate(before, now, jnp.asarray(True))
    alone = sensors.compensate_sample(now, before)
    jax.tree.map(np.testing.assert_array_equal, forward, alone)
    there, back = (of_quaternion(np.array(s.turn)) for s in (forward, backward))
    np.testing.assert_allclose(there @ back, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(there @ np.array(backward.dv), np.array(forward.dv), atol=1e-15)


def test_earth_rate_is_reversed_in_backward_pass() -> None:
    here = site(WGS84, LATITUDE)
    there = passes.site_of_pass(here, jnp.asarray(True))
    turned = earth.place(there.earth, LATITUDE)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14), there.place, turned)
    assert there.place.rate_n == -here.place.rate_n and there.place.rate_u == -here.place.rate_u
    assert there.place.gravity == here.place.gravity
    same = passes.site_of_pass(here, jnp.asarray(False))
    jax.tree.map(np.testing.assert_array_equal, same, here)


# There and back: pure navigation over 80 s of [P2]'s swing at 200 Hz

FREE = loops(Loops((0.0, 0.0, 0.0), ((NEVER, (0.0, 0.0, 0.0, 0.0)),)), REVERSALS["velocity"])
RATE, STORED_S = 200, 80


@cache
def swing_record(rate: int, noise: float) -> np.ndarray:
    errors = {"gyro": (0.0, noise * 0.006 * DEG_PER_H), "accel": (0.0, noise * 50 * UG)}
    return swing_increments(PAPER2, EARTH, LATITUDE, rate=rate, samples=rate * STORED_S, **errors)


def there_and_back(phi, v=(0.0, 0.0), *, noise=0.0, position="fixed", rate=RATE):
    """Attitudes off (rad, n), velocities (m/s), positions (rad) every second, over two passes."""
    options = Options(1 / rate, position=position)
    static = Static("compass", options, rate, 2 * STORED_S, curves=False, passes="alternate")
    environment = record_world(
        swing_record(rate, noise), site(EARTH, LATITUDE), pass_records=STORED_S
    )
    nav = trail(static, environment, one_run(PAPER2.matrix(0.0), phi, v, FREE)).nav
    start = exp(-np.asarray(phi, dtype=float)) @ PAPER2.matrix(0.0)
    c = np.concatenate([start[None], of_quaternion(np.stack(nav.q, axis=1))])
    v = np.concatenate([[v], np.stack([nav.ve, nav.vn], axis=1)])
    place = np.stack([nav.latitude - LATITUDE, nav.longitude], axis=1)
    # The same stored times on the way there and on the way back.
    off = log(c @ np.swapaxes(c[::-1], 1, 2))
    return off, v, np.concatenate([[[0.0, 0.0]], place])


@pytest.mark.nightly(fast=("phi_deg1-v1-1.0-bounds1-integrated",))
@pytest.mark.parametrize("position", ["fixed", "integrated"])
@pytest.mark.parametrize(
    ("phi_deg", "v", "noise", "bounds"),
    [
        # Attitude, rad, and velocity, m/s.
        ((0, 0, 0), (0, 0), 0.0, (1e-13, 1e-10)),
        ((0, 0, 0), (0, 0), 1.0, (1e-12, 1e-9)),
        ((1, 0, 0), (0, 0), 0.0, (1e-7, 1e-4)),
        ((1, -1, 30), (0.5, -1), 1.0, (1e-7, 1e-4)),
    ],
)
def test_backward_pass_retraces_forward_navigation(phi_deg, v, noise, bounds, position):
    """Same attitude, mirrored velocity, same place, at every stored time of the way."""
    phi = np.array(phi_deg) * DEG
    off, velocity, place = there_and_back(phi, v, noise=noise, position=position)
    assert np.abs(off).max() < bounds[0]
    assert np.abs(velocity[:STORED_S] + velocity[:STORED_S:-1]).max() < bounds[1]
    # From 1 deg of tilt it is 500 m away after 80 s.
    assert np.abs(place - place[::-1]).max() < bounds[0]
    assert (np.abs(place[STORED_S]).max() > 1e-6) == (position == "integrated" and any(phi))


@pytest.mark.nightly
def test_round_trip_error_is_first_order_in_sample_time():
    """A step takes the rates at its start, which is the other end on the way back."""
    coarse, fine = (there_and_back((DEG, 0, 0), rate=rate)[0][-1] for rate in (100, 200))
    assert np.abs(coarse).max() > 1e-9
    np.testing.assert_allclose(coarse, 2 * fine, rtol=0, atol=1e-3 * np.abs(coarse).max())


# The compass loop over a stored record, static base, [P2] section 3.2

LEVEL, AZIMUTH = level_gains(0.02, EARTH), azimuth_gains(0.01, EARTH)


def heading_errors(turn: Reversal, stored_s, *, smoothing_s, latitude=LATITUDE):
    """phi_U (deg) every 80 s of updates up to 640 s; 80 s of them level."""
    rate, every = 50, 80
    rows = still_record(latitude, rate)
    static = Static("compass", Options(1 / rate), rate * every, 8, False, passes="alternate")
    environment = record_world(rows, site(EARTH, latitude), pass_records=stored_s // every)
    given = Loops(LEVEL, ((80 * rate, AZIMUTH),), -np.expm1(-2 / (rate * smoothing_s)))
    phi = np.array([0.1, 0.1, 1.5]) * DEG
    state = trail(static, environment, one_run(np.eye(3), phi, (0, 0), loops(given, turn)))
    return -log(of_quaternion(np.stack(state.nav.q, axis=1)))[:, 2] / DEG


@cache
def still_record(latitude: float, rate: int) -> np.ndarray:
    return swing_increments(STILL, EARTH, latitude, rate=rate, samples=rate * 640)


@pytest.mark.nightly
def test_reflected_compass_loop_continues_as_without_turn():
    """Exactly so where omega_U does not couple the channels and the low pass does not lag."""
    for latitude, smoothing_s, bound in ((0.0, 1e-3, 0.002), (LATITUDE, 1e-3, 0.02)):
        case = {"smoothing_s": smoothing_s, "latitude": latitude}
        on = heading_errors(REVERSALS["keep"], 640, **case)
        reflected = heading_errors(REVERSALS["reflect"], 80, **case)
        assert np.abs(on).max() > 1.4
        np.testing.assert_allclose(reflected, on, rtol=0, atol=bound)
    # A low pass of 2 s tells what the tilt was 2 s before.
    lagging = heading_errors(REVERSALS["reflect"], 80, smoothing_s=2.0)
    on = heading_errors(REVERSALS["keep"], 640, smoothing_s=2.0)
    assert 0.1 < np.abs(lagging - on).max() < 0.3
    assert abs(lagging[-1]) < 0.15  # a tenth of what it began with


@pytest.mark.parametrize("rule", ["velocity", "velocity_and_rate", "velocity_drop_rate"])
def test_velocity_flip_rules_do_not_converge_with_paper_gains(rule):
    """With sigma T_p = 0.8 the spectral radius of a cycle is 0.993 or more."""
    stuck = heading_errors(REVERSALS[rule], 80, smoothing_s=2.0)
    assert np.all(np.abs(stuck[1:]) > 1)


# Filters over a stored record


@given(
    st.sampled_from(sorted(MODELS)),
    st.tuples(*[st.floats(-30, 30)] * 2),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.floats(-80, 80),
)
def test_backward_error_model_is_reversed_forward_model(name, v, phi, latitude_deg):
    """Errors backward are T x, so that A backward is -T A T: one model for both directions."""
    model, dt = MODELS[name], 0.01
    here = place(WGS84, latitude_deg * DEG)
    nav = navigation(exp(phi), v, latitude_deg * DEG)
    f_dt = Vec3(0.3 * dt, -0.2 * dt, 9.9 * dt)
    forward, backward = (
        dense(model.transition(n, p, f_dt, dt), len(model.states))
        for n, p in (
            (nav, here),
            (mechanisation.reverse_velocity(nav), earth.reverse_rotation(here, -1.0)),
        )
    )
    t = np.diag(model.reversal)
    np.testing.assert_allclose(backward, -t @ forward @ t, rtol=1e-13, atol=1e-25)
    assert np.array_equal(t @ t, np.eye(len(model.states)))


def dense(entries, n):
    matrix = np.zeros((n, n))
    for place_, value in entries_as_numbers(entries).items():
        matrix[place_] = value
    return matrix


@pytest.mark.nightly  # test_naive_filters.py has a fast one
@pytest.mark.parametrize(
    ("turn", "clock"),
    [
        *((turn, {}) for turn in ("carried", "inflated", "reset", "rewind")),
        ("carried", {"restarts": True}),
        ("rewind", {"at_feedback": True}),
    ],
)
@pytest.mark.parametrize(
    ("name", "planet", "position"), [("kalman5", EARTH, "fixed"), ("kalman10", WGS84, "integrated")]
)
def test_three_filter_passes_match_naive_loop(name, planet, position, turn, clock):
    """With feedback over the turn, a reset, biases fed back, and P carried, inflated or reset.

    Or all three forward, rewound from what biases and feedback leave at their ends.
    """
    rate, samples, phi, v = 100, 600, np.array([1.0, -2.0, 5.0]) * DEG, np.array([0.3, -0.2])
    n = {"kalman5": 5, "kalman10": 10}[name]
    filt = paper_filter(
        n, every=130, gain=0.7, resets=(250, 1500), position=position, turn=turn, turn_factor=3.0
    )
    filt = filt._replace(**clock)
    rows = measured(planet, LATITUDE, samples, rate)
    start = exp(-phi) @ PAPER1.matrix(0.0)
    case = {"latitude": LATITUDE, "c": start, "v": v, "filt": filt}
    naive = closed_loop(rows, 1 / rate, planet, stored=samples, count=3 * samples, **case)
    static = Static(name, Options(1 / rate, position=position), 50, 36, False, passes="alternate")
    static = static._replace(passes="rewind" if turn == "rewind" else "alternate")
    environment = record_world(rows, site(planet, LATITUDE), pass_records=samples // 50)
    state = trail(static, environment, one_run(PAPER1.matrix(0.0), phi, v, params(filt)))

    at, close = np.arange(50, 3 * samples + 1, 50) - 1, {"rtol": 0, "atol": 1e-9}
    np.testing.assert_allclose(of_quaternion(np.stack(state.nav.q, axis=1)), naive.c[at], **close)
    got = np.stack([state.nav.ve, state.nav.vn], axis=1)
    np.testing.assert_allclose(got, naive.v[at], **close)
    np.testing.assert_allclose(state.nav.latitude, naive.latitude[at], rtol=0, atol=1e-15)
    sigma = np.sqrt(np.diagonal(naive.p[at], axis1=1, axis2=2))
    np.testing.assert_allclose(
        np.stack(state.belief.x, axis=1) / sigma, naive.x[at] / sigma, **close
    )
    p = covariances(state.belief.p)
    unit = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(p / unit, naive.p[at] / unit, **close)
    if n == 10:
        unit = np.sqrt(filt.p0[5:])
        np.testing.assert_allclose(
            np.stack(state.bias, axis=1) / unit, naive.bias[at] / unit, **close
        )
