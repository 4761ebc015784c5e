from functools import partial

import numpy as np
import pytest
from oracles.in_engine import dense, navigation, place
from oracles.naive import DEG, PAPER, WGS84, exp, skew

from sinsjax.methods.zero_velocity import ten_state_transition
from sinsjax.strapdown.mechanisation import five_state_transition
from sinsjax.types import Vec3

pytestmark = pytest.mark.optimised(False)

DT = 0.01
FORCE_B = np.array([1.4, -2.3, 9.6])
RATE_B = np.array([0.05, -0.03, 0.04])


def rates(c, v, w_b, f_b, planet, latitude):
    """C' and V' of the nonlinear navigator, VU = 0."""
    w_ie, w_en = planet.rates(latitude, v)
    acceleration = c @ f_b - np.cross(2 * w_ie + w_en, [*v, 0.0])
    return c @ skew(w_b) - skew(w_ie + w_en) @ c, acceleration[:2]


def error_rate(x, c, v, planet, latitude):
    """Rate of (dV, phi) of a navigator that is off by x: dV, phi and sensor biases."""
    phi, nabla, eps = x[2:5], np.array([*x[5:7], 0.0]), x[7:]
    off = exp(-phi) @ c
    c_dot, v_dot = rates(c, v, RATE_B, FORCE_B, planet, latitude)
    off_dot, off_v_dot = rates(off, v + x[:2], RATE_B + eps, FORCE_B + nabla, planet, latitude)
    # exp(-phi x) = C' C^T, whose antisymmetric part is -phi x to second order.
    m = off_dot @ c.T + off @ c_dot.T
    phi_dot = np.array([m[1, 2] - m[2, 1], m[2, 0] - m[0, 2], m[0, 1] - m[1, 0]]) / 2
    return np.concatenate([off_v_dot - v_dot, phi_dot])


# The navigator is quadratic in velocity, so that a long step there costs nothing.
SIZES = np.array([10.0] * 2 + [1e-5] * 3 + [1e-3] * 2 + [1e-6] * 3)


@pytest.mark.parametrize("planet", [WGS84, PAPER])
@pytest.mark.parametrize("latitude_deg", [32.0, -61.0])
@pytest.mark.parametrize(
    ("v", "turn"), [((12.0, -7.0), (0.3, -0.4, 2.2)), ((-250.0, 180.0), (-0.1, 0.2, -0.9))]
)
def test_error_matrix_is_derivative_of_nonlinear_navigator(planet, latitude_deg, v, turn):
    c, v, latitude = exp(turn), np.array(v), latitude_deg * DEG
    rate = partial(error_rate, c=c, v=v, planet=planet, latitude=latitude)
    numeric = np.column_stack([(rate(x) - rate(-x)) / (2 * x.sum()) for x in np.diag(SIZES)])
    now = navigation(c, v, latitude), place(planet, latitude), Vec3(*(DT * c @ FORCE_B)), DT
    ten = dense(ten_state_transition(*now), 10) / DT
    five = dense(five_state_transition(*now), 5) / DT
    # Rows of velocity, rows of phi; columns of velocity, phi and biases.
    tolerance = np.outer([1e-8] * 2 + [1e-11] * 3, [1e-5] * 2 + [1.0] * 8)
    excess = np.abs(ten[:5] - numeric) / (tolerance + 1e-9 * np.abs(numeric))
    assert excess.max() < 1, excess
    np.testing.assert_array_equal(ten[5:], 0.0)
    np.testing.assert_array_equal(ten[:5, :5], five)
