import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from oracles.naive import euler_matrix, exp, of_quaternion
from scipy.spatial.transform import Rotation

from sinsjax.maths import rotations
from sinsjax.types import Quat, Vec3

seeds = st.integers(0, 2**32 - 1)
lengths = st.sampled_from(
    [0.0, 1e-300, 1e-20, 1e-12, 1e-8, 1e-4, np.pi - 1e-9, np.pi, np.pi + 1e-9, 2 * np.pi]
) | st.floats(0, 2 * np.pi)


def direction(seed):
    v = np.random.default_rng(seed).normal(size=3)
    return v / np.linalg.norm(v)


def random_quat(seed):
    return Quat(*Rotation.random(rng=np.random.default_rng(seed)).as_quat(scalar_first=True))


def vec(v):
    return Vec3(*(jnp.asarray(x) for x in v))


def rows(q):
    return np.array(rotations.matrix(q))


@given(lengths, seeds)
def test_exp_matches_half_angle_formula_up_to_full_turn(length, seed):
    v = length * direction(seed)
    q = np.array(rotations.exp(vec(v)))
    np.testing.assert_allclose(np.linalg.norm(q), 1, atol=1e-14)
    # Up to the full turn the scalar part keeps its sign: cos(|phi|/2).
    np.testing.assert_allclose(q[0], np.cos(length / 2), atol=2e-15)
    np.testing.assert_allclose(q[1:], np.sin(length / 2) * direction(seed), atol=2e-15)


@given(st.floats(0, 2), seeds)
def test_exp_of_sample_equals_exp_for_small_rotations(length, seed):
    """The same bits up to 0.3 rad in a sample, 1,700 deg/s at 100 Hz."""
    v = vec(length * direction(seed))
    q, whole = np.array(rotations.exp_of_sample(v)), np.array(rotations.exp(v))
    np.testing.assert_allclose(q, whole, rtol=0, atol=3e-15 if length <= 0.6 else 1e-11)
    assert length > 0.3 or (q == whole).all()


@given(st.floats(0, np.pi) | lengths.filter(lambda a: a <= np.pi), seeds, st.booleans())
def test_log_inverts_exp_for_either_quaternion_sign(length, seed, negative):
    v = length * direction(seed)
    q = rotations.exp(vec(v))
    back = np.array(rotations.log(Quat(*(-c for c in q)) if negative else q))
    if length > np.pi - 1e-12:  # v and -v are the same rotation
        back = back * np.sign(back @ v)
    np.testing.assert_allclose(back, v, rtol=1e-13, atol=1e-15)
    assert np.linalg.norm(back) <= np.pi * (1 + 1e-15)


@jax.jit
@jax.jacfwd
def there_and_back_derivative(v):
    return jnp.stack(rotations.log(rotations.exp(Vec3(*v))))


@pytest.mark.parametrize("length", [1e-9, 0.99e-8, 2.01e-8, 1e-3, 3.0])
def test_log_derivative_is_correct_around_small_angle_branch(length):
    jacobian = there_and_back_derivative(length * direction(3))
    np.testing.assert_allclose(jacobian, np.eye(3), atol=1e-7)


@given(seeds, seeds)
def test_quaternion_operations_match_rotation_matrices(one, two):
    a, b = random_quat(one), random_quat(two)
    ca, cb = of_quaternion(a), of_quaternion(b)
    np.testing.assert_allclose(rows(a), ca, atol=1e-15)
    np.testing.assert_allclose(rows(rotations.multiply(a, b)), ca @ cb, atol=4e-15)
    np.testing.assert_allclose(rows(rotations.conjugate(a)), ca.T, atol=1e-15)
    v = 10 * direction(two)
    np.testing.assert_allclose(rotations.rotate(a, Vec3(*v)), ca @ v, atol=2e-14)


@given(seeds, st.floats(1e-3, 1e3))
def test_normalise_recovers_unit_quaternion(seed, length):
    q = random_quat(seed)
    np.testing.assert_allclose(rotations.normalise(Quat(*(length * c for c in q))), q, atol=1e-15)


@given(seeds, seeds)
def test_rotate_small_matches_exact_rotation_to_third_order(one, two):
    h, q = 1e-4 * direction(one), random_quat(two)
    turned = rotations.rotate_small(Vec3(*h), q)
    np.testing.assert_allclose(np.linalg.norm(turned), 1, rtol=0, atol=1e-15)
    np.testing.assert_allclose(rows(turned), exp(2 * h) @ of_quaternion(q), atol=2e-12)
    still = rotations.rotate_small(Vec3(*(1e-4 * h)), q)
    np.testing.assert_allclose(rows(still), exp(2e-4 * h) @ of_quaternion(q), atol=4e-15)


angle = st.floats(-np.pi, np.pi)
pitches = st.floats(-1.57, 1.57)


@given(pitches, angle, angle)
@example(0.3, np.pi, -np.pi)
@example(-0.3, 0.0, np.pi)
def test_euler_angles_match_scipy_and_round_trip(pitch, roll, yaw):
    q = rotations.from_euler(pitch, roll, yaw)
    c = Rotation.from_euler("ZXY", [yaw, pitch, roll]).as_matrix()
    np.testing.assert_allclose(rows(q), c, atol=2e-15)
    np.testing.assert_allclose(euler_matrix(pitch, roll, yaw), c, atol=2e-15)
    back = np.array(rotations.to_euler(q))
    off = np.array([pitch, roll, yaw]) - back
    off = np.arctan2(np.sin(off), np.cos(off))
    np.testing.assert_allclose(off, 0, atol=1e-14 / np.cos(pitch) ** 2)


@pytest.mark.parametrize("sign", [-1, 1])
def test_to_euler_is_finite_at_vertical_pitch(sign):
    pitch, roll, yaw = rotations.to_euler(rotations.from_euler(sign * np.pi / 2, 0.2, 0.5))
    np.testing.assert_allclose(pitch, sign * np.pi / 2, atol=1e-7)
    assert np.isfinite(roll) and np.isfinite(yaw)


@given(lengths.filter(lambda a: a < 3.14), seeds, seeds)
def test_misalign_applies_exp_minus_phi_and_correct_inverts_it(length, one, two):
    phi, q = length * direction(one), random_quat(two)
    off = rotations.misalign(vec(phi), q)
    np.testing.assert_allclose(rows(off), exp(-phi) @ of_quaternion(q), atol=5e-15)
    np.testing.assert_allclose(rotations.misalignment(q, off), phi, rtol=1e-12, atol=2e-15)
    np.testing.assert_allclose(rows(rotations.correct(vec(phi), off)), rows(q), atol=5e-15)


@pytest.mark.parametrize(("most", "error"), [(np.pi / 4, 2.3e-16), (1.0, 1e-12)])
def test_sin_cos_near_zero_matches_numpy(most, error):
    x = np.linspace(-most, most, 2001)
    sin, cos = jax.jit(jax.vmap(rotations.sin_cos_near_zero))(x)
    np.testing.assert_allclose(sin, np.sin(x), rtol=0, atol=error)
    np.testing.assert_allclose(cos, np.cos(x), rtol=0, atol=error)
