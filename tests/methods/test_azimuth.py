"""Filters for a large azimuth, and the invariant one: their models and limits.

`test_naive_filters.py` compares them with naive ones in closed loop.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.in_engine import (
    DEG_PER_H,
    PAPER1,
    UG,
    filter_params,
    navigation,
    place,
    runner,
    site,
)
from oracles.naive import DEG, PAPER, WGS84, Filter, exp, log, of_quaternion, skew
from oracles.naive_filters import (
    about_up,
    jacobian,
    unscented_transform,
    upright,
)

from sinsjax.maths.algebra import entries_as_numbers
from sinsjax.methods import azimuth as model
from sinsjax.methods.filters.kalman import Belief
from sinsjax.methods.invariant import apply_left_jacobian
from sinsjax.methods.method import Options
from sinsjax.types import Vec3

pytestmark = pytest.mark.optimised(False)

RATE, SAMPLES, LATITUDE, DT = 100, 1000, 32 * DEG, 0.01
P0 = np.array([0.1, 0.1, 15 * DEG, 15 * DEG, 80 * DEG]) ** 2
Q = (np.array([500 * UG] * 2 + [0.1 * DEG_PER_H] * 3) / RATE) ** 2
R = 0.1**2
V0 = np.array([0.3, -0.2])

errors = st.tuples(*(st.floats(-1, 1) for _ in range(2)), *(st.floats(-0.3, 0.3) for _ in range(2)))


def attitude_rates(a, tilt, v, planet, latitude):
    """V', and the rates of tilt and azimuth, of a navigator that is off, on a base at rest.

    The rotation C_{n'}^n turns at its own rate; tilt and azimuth follow by central differences.
    """
    true = exp([0.3, -0.4, 2.2])
    w_ie, _ = planet.rates(latitude, (0.0, 0.0))
    f_b = true.T @ [0.0, 0.0, planet.g(latitude)]
    off = about_up(a) @ upright(tilt)  # C_{n'}^n
    c = off.T @ true
    w, w_en = planet.rates(latitude, v)
    acceleration = c @ f_b - np.cross(2 * w + w_en, [*v, 0.0])
    # C_{n'}^n = C_b^n (C_b^{n'})': n' turns at w_ie + w_en as it is computed, n at w_ie.
    off_dot = -skew(w_ie) @ off + off @ skew(w + w_en)
    step = 1e-4
    ends = [_tilt_and_azimuth(off + side * step * off_dot) for side in (1, -1)]
    return np.array([*acceleration[:2], *(ends[0] - ends[1]) / (2 * step)])


def _tilt_and_azimuth(off):
    up = off.T @ [0.0, 0.0, 1.0]
    up = up / np.linalg.norm(up)
    tilt = np.array([up[1], -up[0]])
    around = off @ upright(tilt).T
    return np.array([*tilt, np.arctan2(around[1, 0] - around[0, 1], around[0, 0] + around[1, 1])])


predict_errors = jax.jit(model.predict_errors)
predict_unscented = jax.jit(model.predict_unscented)
slope_by_jax = jax.jit(jax.jacfwd(lambda x, here: jnp.stack(model.predict_errors(x, here, DT))))


@pytest.mark.parametrize("planet", [WGS84, PAPER])
@given(st.floats(-3.1, 3.1), st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_error_model_matches_navigator_at_any_azimuth(planet, a, seed):
    """Exactly in the azimuth; to first order in velocity and tilt."""
    x = np.random.default_rng(seed).normal(size=4) * np.array([1e-3, 1e-3, 1e-5, 1e-5])
    here = place(planet, LATITUDE)

    def engine(x):
        return np.array(predict_errors((*x, a), here, 1.0)) - np.array((*x, a))

    def navigator(x):
        return attitude_rates(a, x[2:], x[:2], planet, LATITUDE)

    np.testing.assert_allclose(engine(0 * x), navigator(0 * x), rtol=0, atol=3e-11)
    slope = (engine(x) - engine(-x)) / 2
    np.testing.assert_allclose((navigator(x) - navigator(-x))[:4] / 2, slope[:4], atol=4e-9)
    # The azimuth's rate is of the size of w_N times the tilt.
    np.testing.assert_allclose((navigator(x) - navigator(-x))[4] / 2, slope[4], atol=1e-11)


@given(errors, st.floats(-6, 6))
@settings(max_examples=50, deadline=None)
def test_model_derivative_matches_automatic_differentiation(level, azimuth):
    x, here = (*map(jnp.asarray, level), jnp.asarray(azimuth)), place(PAPER, LATITUDE)
    slope = np.array(slope_by_jax(x, here)).T
    entries = np.eye(5)
    for at, value in entries_as_numbers(model.jacobian(x, here, DT)).items():
        entries[at] += value
    np.testing.assert_allclose(slope, entries, rtol=0, atol=1e-14)


@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 0.5, 1.0]))
@settings(max_examples=30, deadline=None)
def test_unscented_prediction_matches_textbook_transform(seed, alpha):
    rng, here = np.random.default_rng(seed), place(PAPER, LATITUDE)
    x = rng.normal(size=5) * np.array([1.0, 1.0, 0.2, 0.2, 2.0])
    root = rng.normal(size=(5, 5)) * np.array([0.1, 0.1, 0.2, 0.2, 1.0])[:, None]
    p = root @ root.T + 1e-6 * np.eye(5)

    def after(x):
        return np.array(predict_errors(tuple(x), here, 1.0))

    belief = Belief(tuple(map(jnp.asarray, x)), tuple(map(jnp.asarray, p[np.triu_indices(5)])))
    found = predict_unscented(belief, here, 1.0, alpha)
    mean, spread = unscented_transform(after, x, p, alpha)
    tolerance = 1e-9 / alpha**2 * 1e-3  # the textbook's weights cancel
    np.testing.assert_allclose(found.x, mean, rtol=0, atol=tolerance)
    np.testing.assert_allclose(found.p, spread[np.triu_indices(5)], rtol=0, atol=100 * tolerance)


@given(st.tuples(*(st.floats(-3, 3) for _ in range(6))))
@settings(max_examples=50, deadline=None)
def test_left_jacobian_matches_mean_of_rotations(numbers):
    phi, v = np.array(numbers[:3]), np.array(numbers[3:])
    found = apply_left_jacobian(Vec3(*map(jnp.asarray, phi)), Vec3(*map(jnp.asarray, v)))
    np.testing.assert_allclose(found, jacobian(phi) @ v, rtol=0, atol=1e-13)


def numbers_with(name, filt):
    params = filter_params(filt)
    return params if name == "invariant" else params._replace(extra=np.float64(0.5))


def test_correction_is_the_rotation_that_azimuth_and_tilt_define():
    """A large tilt of either sign leaves the azimuth as it is; Euler angles move it by 3.5 deg."""
    filt = model.build_filter(model.predict_linearised, Options(DT))
    for tilt_e, tilt_n in [(20 * DEG, 20 * DEG), (20 * DEG, -20 * DEG)]:
        tilt, azimuth = np.sin([tilt_e, tilt_n]), 120 * DEG
        off = about_up(azimuth) @ upright(tilt)
        nav = navigation(off.T @ PAPER1.matrix(0.0), V0, LATITUDE)
        state = filt.init(numbers_with("ekf_azimuth", Filter(P0, Q, R)), nav)
        state = state._replace(belief=Belief((0.0, 0.0, *tilt, azimuth), state.belief.p))
        corrected, _ = filt.feed_back(state, 1.0)
        for attitude in (corrected.nav.q, filt.attitude(state)):
            found = of_quaternion(np.array(attitude))
            np.testing.assert_allclose(found, PAPER1.matrix(0.0), rtol=0, atol=1e-12)


def test_invariant_error_is_linear_without_earth_rotation():
    """C C'^-1 = exp(phi) stays, V - exp(phi) V' = J(phi) (g x phi) t, from 20, 20 and 120 deg."""
    phi0 = np.array([20.0, 20.0, 120.0]) * DEG
    still = PAPER._replace(rate=0.0, a=1e15, b=1e15)
    rows = np.zeros((SAMPLES, 6))
    rows[:, 3:] = PAPER1.matrix(0.0).T @ [0.0, 0.0, still.gravity] * DT
    nav = navigation(exp(-phi0) @ PAPER1.matrix(0.0), np.zeros(2), LATITUDE)
    never = numbers_with("invariant", Filter(P0, Q, R, every=10**9))
    state, *_ = runner("invariant")(never, site(still, LATITUDE), nav, rows)
    c = of_quaternion(np.stack(state.nav.q, axis=1)[-1])
    np.testing.assert_allclose(log(PAPER1.matrix(0.0) @ c.T), phi0, rtol=0, atol=1e-9)
    v = np.array([state.nav.ve[-1], state.nav.vn[-1], state.extra[-1]])
    rho = np.linalg.solve(jacobian(phi0), -exp(phi0) @ v)
    linear = np.cross([0.0, 0.0, -still.gravity], phi0) * SAMPLES * DT
    np.testing.assert_allclose(rho, linear, rtol=0, atol=1e-9)
