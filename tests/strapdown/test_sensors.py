import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.naive import compensate as naive_compensate
from oracles.naive import exp, of_quaternion, skew
from scipy import stats
from scipy.integrate import quad_vec, solve_ivp
from scipy.spatial.transform import Rotation

from sinsjax.maths.rng import normal_pair, threefry
from sinsjax.strapdown import sensors
from sinsjax.types import Quat

pytestmark = pytest.mark.optimised(False)

seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_measure_applies_scale_misalignment_bias_and_noise(seed):
    rng = np.random.default_rng(seed)
    ideal, normal = rng.normal(size=6), rng.normal(size=6).astype(np.float32)
    errors = sensors.SensorErrors(
        *rng.normal(size=(2, 3)), *rng.random(size=(2, 3)), *rng.normal(size=(2, 3, 3))
    )
    dt = 0.25
    gyro = (np.eye(3) + errors.gyro_matrix) @ ideal[:3] + errors.gyro_bias * dt
    accel = (np.eye(3) + errors.accel_matrix) @ ideal[3:] + errors.accel_bias * dt
    quiet = sensors.measure_increments(sensors.split_record_row(ideal), errors, None, dt)
    np.testing.assert_allclose(joined(quiet), [*gyro, *accel], atol=1e-13)
    noisy = sensors.measure_increments(
        sensors.split_record_row(ideal), errors, sensors.split_record_row(normal), dt
    )
    blur = np.concatenate([errors.gyro_noise, errors.accel_noise]) * normal
    np.testing.assert_allclose(joined(noisy), [*gyro, *accel] + blur, atol=1e-13)


def joined(increments):
    """The six numbers of increments, on a last axis."""
    return np.stack([*increments.dtheta, *increments.dv], axis=-1)


@pytest.fixture(scope="module")
def normal():
    """Noise of 20 draws and 3,000 samples: (draws, samples, 6)."""
    numbers = jax.jit(sensors.draw_normal_numbers)(jnp.asarray(7), jnp.arange(20), jnp.arange(3000))
    return joined(numbers).astype(float).swapaxes(0, 1)


def test_noise_is_standard_normal(normal):
    z = normal.ravel()
    assert stats.kstest(z, "norm").pvalue > 1e-3
    assert np.abs(z).max() < 5.89
    for axis in range(6):
        column = normal[..., axis].ravel()
        np.testing.assert_allclose(column.mean(), 0, atol=4 / np.sqrt(column.size))
        np.testing.assert_allclose(column.var(), 1, atol=4 * np.sqrt(2 / column.size))


def test_noise_is_white_and_differs_between_axes_and_draws(normal):
    axes = normal.reshape(-1, 6)
    bound = 4.5 / np.sqrt(len(axes))
    np.testing.assert_allclose(np.corrcoef(axes.T), np.eye(6), atol=bound)
    # Numbers that come from one pair of words, or from neighbouring counters, in size as well.
    np.testing.assert_allclose(np.corrcoef(np.abs(axes).T), np.eye(6), atol=bound)
    for lag in (1, 2, 100):
        product = np.mean(normal[:, lag:] * normal[:, :-lag])
        assert abs(product) < 4.5 / np.sqrt(normal[:, lag:].size)
    rows = normal.reshape(len(normal), -1)
    correlation = np.corrcoef(rows) - np.eye(len(rows))
    assert np.abs(correlation).max() < 5 / np.sqrt(rows.shape[1])


def test_noise_depends_only_on_seed_draw_and_sample():
    noise = jax.jit(sensors.draw_normal_numbers)

    def once(seed, draw, sample):
        return joined(noise(jnp.asarray(seed), jnp.asarray(draw), jnp.asarray([sample])))[0]

    here = once(3, 5, 8)
    assert here.shape == (6,) and here.dtype == np.float32
    # To the last bit of single precision, which fused operations may round differently.
    rounding = {"rtol": 0, "atol": 1e-6}
    many = noise(jnp.asarray(3), jnp.arange(2, 9), jnp.arange(4, 50))
    assert many.dv.x.shape == (46, 7)
    np.testing.assert_allclose(here, joined(many)[4, 3], **rounding)
    over_draws = jax.jit(jax.vmap(sensors.draw_normal_numbers, in_axes=(None, 0, None)))
    mapped = over_draws(jnp.asarray(3), jnp.arange(9), jnp.arange(4, 50))
    np.testing.assert_allclose(here, joined(mapped)[5, 4], **rounding)
    others = (4, 5, 8), (3, 6, 8), (3, 5, 9), (5, 3, 8), (8, 5, 3), (3 + 2**32, 5, 8)
    for other in others:
        assert not np.any(here == once(*other))


def test_noise_uses_three_counters_per_sample():
    """Pair k of a sample is the pair of counter 3 sample + k."""
    word = jnp.uint32
    now = jax.jit(sensors.draw_normal_numbers)(*map(jnp.asarray, (3 + 2**32 * 9, 5, [8])))
    pair = jax.jit(lambda number: normal_pair(threefry((word(9), word(3)), (word(5), number))))
    pairs = [pair(word(24 + k)) for k in range(3)]
    np.testing.assert_allclose(joined(now)[0], np.ravel(pairs), rtol=0, atol=1e-6)


def test_compensation_matches_naive_term_by_term():
    increments = np.random.default_rng(2).normal(scale=[0.01] * 3 + [0.1] * 3, size=(50, 6))
    sample = sensors.compensate_record(increments, increments[0])
    turn, dv = naive_compensate(increments)
    np.testing.assert_allclose(np.stack(sample.dv, axis=1), dv, rtol=0, atol=1e-16)
    matrices = of_quaternion(np.stack(sample.turn, axis=1))
    np.testing.assert_allclose(matrices, Rotation.from_rotvec(turn).as_matrix(), atol=1e-15)


@pytest.mark.parametrize(
    "optimised",
    [False, pytest.param(True, marks=[pytest.mark.optimised(True), pytest.mark.nightly])],
)
def test_compensation_of_split_record_equals_whole_record(optimised):
    compensate = sensors.compensate_record if optimised else jax.jit(sensors.compensate_record)
    increments = np.random.default_rng(3).normal(scale=0.01, size=(50, 6))
    whole = compensate(increments, increments[0])
    first = compensate(increments[:17], increments[0])
    second = compensate(increments[17:], increments[16])
    for leaf, a, b in zip(*(jax.tree.leaves(t) for t in (whole, first, second)), strict=True):
        np.testing.assert_array_equal(leaf, np.concatenate([a, b]))


def rate(t):
    """A coning and sculling motion, rad/s."""
    return np.array([0.5 * np.cos(3 * t), 0.4 * np.sin(3 * t + 0.2), 0.1 + 0.2 * np.sin(2 * t)])


def force(t):
    """Specific force in the body frame, m/s^2."""
    return np.array([np.sin(3 * t), 2 * np.cos(3 * t), 9.8 + np.sin(t)])


def compensation_error(dt):
    """Turn (rad) and velocity (m/s) off the exact ones, over one sample at about t = 1 s."""

    def motion(t, y):
        c = y[:9].reshape(3, 3)
        return np.concatenate([(c @ skew(rate(t))).ravel(), c @ force(t)])

    def integral(a, b):
        return quad_vec(lambda t: np.concatenate([rate(t), force(t)]), a, b, epsabs=1e-16)[0]

    start = np.concatenate([np.eye(3).ravel(), np.zeros(3)])
    exact = solve_ivp(motion, (1, 1 + dt), start, method="DOP853", rtol=1e-13, atol=1e-16).y[:, -1]
    sample = sensors.compensate_record(integral(1, 1 + dt)[None], integral(1 - dt, 1))
    turned = of_quaternion(np.stack(sample.turn, axis=1)[0])
    off = Rotation.from_matrix(turned @ exact[:9].reshape(3, 3).T).magnitude()
    return np.array([off, np.linalg.norm(np.stack(sample.dv, axis=1)[0] - exact[9:])])


def test_coning_and_sculling_are_compensated_to_fourth_order():
    """Exact rotation and velocity over a sample by DOP853; the error falls by 2^4 or more."""
    coarse, fine = compensation_error(0.08), compensation_error(0.04)
    assert np.all(coarse < [2e-6, 1e-4])
    assert np.all(coarse / fine > 2**3.6)


def test_steady_rotation_and_force_leave_only_fourth_order_error():
    theta, dv = np.array([0.02, -0.03, 0.01]), np.array([0.1, 0.2, 0.3])
    sample = sensors.compensate_record(
        np.concatenate([theta, dv])[None], np.concatenate([theta, dv])
    )
    exact = quad_vec(lambda s: exp(s * theta) @ dv, 0, 1, epsabs=1e-16)[0]
    off = np.stack(sample.dv, axis=1)[0] - exact
    assert np.linalg.norm(off) < np.linalg.norm(theta) ** 3 * np.linalg.norm(dv) / 23
    turn = Quat(*(c[0] for c in sample.turn))
    np.testing.assert_allclose(of_quaternion(turn), exp(theta), atol=1e-15)
