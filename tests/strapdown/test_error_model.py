import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.in_engine import place
from oracles.naive import (
    DEG,
    PAPER,
    WGS84,
    error_matrix,
    error_matrix_10,
    exp,
    of_quaternion,
    quaternion,
    skew,
)

from sinsjax.maths import rotations
from sinsjax.maths.algebra import entries_as_numbers
from sinsjax.methods.zero_velocity import subtract_biases, ten_state_transition
from sinsjax.strapdown import mechanisation, sensors
from sinsjax.strapdown.error_model import five_state_transition
from sinsjax.types import Navigation, Quat, Sample, Vec3

pytestmark = pytest.mark.optimised(False)

DT = 0.01
TRANSITIONS = {"kalman5": (five_state_transition, 5), "kalman10": (ten_state_transition, 10)}
FORCE_B = np.array([1.4, -2.3, 9.6])
RATE_B = np.array([0.05, -0.03, 0.04])


def engine_matrix(method, c, v, f, planet, latitude):
    """A of the engine, dense."""
    nav = Navigation(Quat(*quaternion(c)), *v, latitude, 0.0)
    transition, states = TRANSITIONS[method]
    entries = transition(nav, place(planet, latitude), Vec3(*(DT * f)), DT)
    a = np.zeros((states, states))
    for entry, value in entries_as_numbers(entries).items():
        a[entry] = value / DT
    return a


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
    phi_dot = -np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]) / 2
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
    f = c @ FORCE_B
    numeric = np.zeros((5, 10))
    for j, size in enumerate(SIZES):
        x = np.zeros(10)
        x[j] = size
        numeric[:, j] = (
            error_rate(x, c, v, planet, latitude) - error_rate(-x, c, v, planet, latitude)
        ) / (2 * size)
    ten = engine_matrix("kalman10", c, v, f, planet, latitude)
    five = engine_matrix("kalman5", c, v, f, planet, latitude)
    # Rows of velocity, rows of phi; columns of velocity, phi and biases.
    tolerance = np.empty((5, 10))
    tolerance[:2], tolerance[2:] = 1e-8, 1e-11
    tolerance[:, :2] *= 1e-5
    excess = np.abs(ten[:5] - numeric) / (tolerance + 1e-9 * np.abs(numeric))
    assert excess.max() < 1, excess
    np.testing.assert_array_equal(ten[5:], 0.0)
    np.testing.assert_array_equal(ten[:5, :5], five)


def test_transition_is_derivative_of_engine_step():
    """The step differentiated by JAX: I + A dt to first order in dt."""
    c, v, latitude = exp([0.3, -0.4, 2.2]), np.array([12.0, -7.0]), 32 * DEG
    here, q = place(WGS84, latitude), Quat(*map(jnp.asarray, quaternion(c)))
    n = 10
    theta, dv = Vec3(*map(jnp.asarray, RATE_B * DT)), Vec3(*map(jnp.asarray, FORCE_B * DT))
    sample = Sample(rotations.exp(theta), dv)

    def after(x):
        off = Navigation(
            rotations.misalign(Vec3(*x[2:5]), q), v[0] + x[0], v[1] + x[1], latitude, 0.0
        )
        # What is left in the increments is what has not been taken out of them.
        biased = subtract_biases(sample, tuple(-b for b in x[5:]), DT)
        nav, f_dt = mechanisation.advance_navigation(off, biased, here, DT)
        return nav, f_dt

    def error_after(x):
        (nav, _), (true, _) = after(x), after(jnp.zeros(n))
        phi = rotations.misalignment(true.q, nav.q)
        return jnp.stack([nav.ve - true.ve, nav.vn - true.vn, *phi, *x[5:]])

    start = Navigation(q, *map(jnp.asarray, v), jnp.asarray(latitude), jnp.asarray(0.0))
    _, f_dt = mechanisation.advance_navigation(start, sample, here, DT)
    entries = ten_state_transition(start, here, f_dt, DT)
    phi = np.eye(n)
    for entry, value in entries_as_numbers(entries).items():
        phi[entry] += value
    jacobian = np.array(jax.jit(jax.jacfwd(error_after))(jnp.zeros(n)))
    np.testing.assert_allclose(jacobian[:5, :5], phi[:5, :5], rtol=0, atol=1e-7)
    # Gyro biases turn the body by half a step's rotation more: second order in dt.
    np.testing.assert_allclose(jacobian, phi, rtol=0, atol=DT * np.linalg.norm(RATE_B) * DT)


angles = st.floats(-3, 3)


@given(angles, angles, angles, st.floats(-300, 300), st.floats(-300, 300), st.floats(-80, 80))
def test_error_matrix_matches_printed_matrix(a, b, c, ve, vn, latitude_deg):
    attitude, v, latitude = exp([a, b, c]), np.array([ve, vn]), latitude_deg * DEG
    f = attitude @ FORCE_B
    printed = error_matrix(v, f, WGS84, latitude)
    mine = engine_matrix("kalman5", attitude, v, f, WGS84, latitude)
    np.testing.assert_allclose(mine, printed, rtol=1e-9, atol=1e-18)
    printed = error_matrix_10(v, f, WGS84, latitude, attitude)
    mine = engine_matrix("kalman10", attitude, v, f, WGS84, latitude)
    np.testing.assert_allclose(mine, printed, rtol=1e-9, atol=1e-15)


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3))
@settings(max_examples=10)
def test_tilt_enters_acceleration_with_sign_of_exp_minus_phi(direction):
    """A tilt of the navigator by phi shows in its level acceleration as f x phi."""
    phi = 1e-6 * np.array(direction)
    c, f = exp([0.1, 0.2, 0.3]), np.array([0.5, -0.4, 9.8])
    nav = Navigation(Quat(*quaternion(exp(-phi) @ c)), 0.0, 0.0, 0.5, 0.0)
    seen = of_quaternion(nav.q) @ c.T @ f - f
    a = engine_matrix("kalman5", c, (0.0, 0.0), f, PAPER, 0.5)
    np.testing.assert_allclose(seen[:2], a[:2, 2:] @ phi, rtol=0, atol=1e-11)


def test_correct_sample_removes_known_biases():
    """As increments that never had them, but for half a step's turn of dv: eps g dt / 2."""
    rng = np.random.default_rng(5)
    clean = np.concatenate([RATE_B, FORCE_B]) * DT + rng.normal(scale=1e-4, size=(50, 6))
    nabla, eps = np.array([5e-3, -3e-3]), np.array([5e-7, -2e-7, 4e-7])
    biased = clean + DT * np.array([*eps, *nabla, 0.0])
    expected = sensors.compensate_record(clean, clean[0])
    raw = sensors.compensate_record(biased, biased[0])
    sample = jax.vmap(lambda s: subtract_biases(s, (*nabla, *eps), DT))(raw)
    bound = np.linalg.norm(eps) * np.linalg.norm(FORCE_B) * DT**2
    off = np.array(sample.dv) - np.array(expected.dv)
    assert np.linalg.norm(off, axis=0).max() < bound + 2 * np.linalg.norm(RATE_B * DT * nabla[0])
    turned = rotations.multiply(rotations.conjugate(expected.turn), sample.turn)
    assert np.abs(2 * np.array(turned[1:])).max() < np.linalg.norm(RATE_B) * 6e-7 * DT**2
    uncorrected = rotations.multiply(rotations.conjugate(expected.turn), raw.turn)
    np.testing.assert_allclose(2 * np.array(uncorrected[1:]).T, [eps * DT] * 50, atol=1e-11)
