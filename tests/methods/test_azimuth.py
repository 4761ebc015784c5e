"""Filters for any azimuth: their models against a navigator, and what they are good for.

`test_naive_filters.py` compares them with naive ones in closed loop.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.in_engine import dense, place
from oracles.naive import DEG, PAPER, WGS84, exp, skew
from oracles.naive_filters import about_up, unscented_transform, upright

from sinsjax.methods import azimuth as model
from sinsjax.methods import sincos
from sinsjax.methods.filters.kalman import Belief

pytestmark = pytest.mark.optimised(False)

LATITUDE, DT, SURGE_S = 32 * DEG, 0.01, 2.0


def rates_at_rest(a, x, planet):
    """V', and the rates of tilt and azimuth, of a navigator that is off, on a base at rest.

    The rotation C_{n'}^n turns at its own rate; the azimuth follows by central differences.
    """
    v, tilt, up = x[:2], x[2:], np.array([0.0, 0.0, 1.0])
    true = exp([0.3, -0.4, 2.2])
    w_ie, _ = planet.rates(LATITUDE, (0.0, 0.0))
    f_b = true.T @ [0.0, 0.0, planet.g(LATITUDE)]
    off = about_up(a) @ upright(tilt)  # C_{n'}^n
    w, w_en = planet.rates(LATITUDE, v)
    acceleration = off.T @ true @ f_b - np.cross(2 * w + w_en, [*v, 0.0])
    # C_{n'}^n = C_b^n (C_b^{n'})': n' turns at w_ie + w_en as it is computed, n at w_ie.
    off_dot = -skew(w_ie) @ off + off @ skew(w + w_en)
    east, north, _ = off_dot.T @ up  # of the vertical as it is seen in n'
    ahead, behind = (azimuth_of(off + step * off_dot) for step in (1e-4, -1e-4))
    return np.array([*acceleration[:2], north, -east, (ahead - behind) / 2e-4])


def azimuth_of(off):
    east, north, up = off.T @ [0.0, 0.0, 1.0]
    around = off @ upright(np.array([north, -east]) / np.linalg.norm([east, north, up])).T
    return np.arctan2(around[1, 0] - around[0, 1], around[0, 0] + around[1, 1])


predict_errors = jax.jit(model.predict_errors)
predict_unscented = jax.jit(model.predict_unscented)
slope_by_jax = jax.jit(jax.jacfwd(lambda x, here: jnp.stack(model.predict_errors(x, here, DT))))


@pytest.mark.parametrize("planet", [WGS84, PAPER])
@given(st.floats(-3.1, 3.1), st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_error_models_match_navigator_at_any_azimuth(planet, a, seed):
    """Exactly in the azimuth; to first order in velocity and tilt."""
    x = np.random.default_rng(seed).normal(size=4) * np.array([1e-3, 1e-3, 1e-5, 1e-5])
    here = place(planet, LATITUDE)

    def engine(x):
        return np.array(predict_errors((*x, a), here, 1.0)) - np.array((*x, a))

    level, one, other = (rates_at_rest(a, each, planet) for each in (0 * x, x, -x))
    np.testing.assert_allclose(engine(0 * x), level, rtol=0, atol=3e-11)
    slope, expected = (engine(x) - engine(-x)) / 2, (one - other) / 2
    np.testing.assert_allclose(expected[:4], slope[:4], atol=4e-9)
    # The azimuth's rate is of the size of w_N times the tilt.
    np.testing.assert_allclose(expected[4], slope[4], atol=1e-11)

    whole = dense(sincos.transition(here, 1.0), 6)
    heading = whole[:4, 4:] @ [np.sin(a), 1 - np.cos(a)]
    np.testing.assert_allclose((one + other)[2:4] / 2, heading[2:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(expected[:4], whole[:4, :4] @ x, rtol=2e-3, atol=3e-9)
    np.testing.assert_array_equal(whole[4:], 0.0)


errors = st.tuples(*(st.floats(-1, 1) for _ in range(2)), *(st.floats(-0.3, 0.3) for _ in range(2)))


@given(errors, st.floats(-6, 6))
@settings(max_examples=50, deadline=None)
def test_model_derivative_matches_automatic_differentiation(level, azimuth):
    x, here = (*map(jnp.asarray, level), jnp.asarray(azimuth)), place(PAPER, LATITUDE)
    slope = np.array(slope_by_jax(x, here)).T
    entries = np.eye(5) + dense(model.jacobian(x, here, DT), 5)
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
