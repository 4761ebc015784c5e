import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.naive import compensate, of_quaternion
from scipy import stats
from scipy.spatial.transform import Rotation

from sinsjax.strapdown import sensors

pytestmark = pytest.mark.optimised(False)
NOISE = jax.jit(sensors.draw_normal_numbers)


@given(st.integers(0, 2**32 - 1))
def test_measure_applies_scale_misalignment_bias_and_noise(seed):
    rng = np.random.default_rng(seed)
    ideal, normal = rng.normal(size=6), rng.normal(size=6).astype(np.float32)
    errors = sensors.SensorErrors(
        *rng.normal(size=(2, 3)), *rng.random(size=(2, 3)), *rng.normal(size=(2, 3, 3))
    )
    dt, split = 0.25, sensors.split_record_row
    gyro = (np.eye(3) + errors.gyro_matrix) @ ideal[:3] + errors.gyro_bias * dt
    accel = (np.eye(3) + errors.accel_matrix) @ ideal[3:] + errors.accel_bias * dt
    quiet = sensors.measure_increments(split(ideal), errors, None, dt)
    np.testing.assert_allclose(joined(quiet), [*gyro, *accel], atol=1e-13)
    noisy = sensors.measure_increments(split(ideal), errors, split(normal), dt)
    blur = np.concatenate([errors.gyro_noise, errors.accel_noise]) * normal
    np.testing.assert_allclose(joined(noisy), [*gyro, *accel] + blur, atol=1e-13)


def joined(increments):
    """The six numbers of increments, on a last axis."""
    return np.stack([*increments.dtheta, *increments.dv], axis=-1)


def test_noise_is_standard_normal_and_white_and_differs_between_axes_and_draws():
    """Of 20 draws and 3,000 samples: (draws, samples, 6)."""
    numbers = NOISE(jnp.asarray(7), jnp.arange(20), jnp.arange(3000))
    normal = joined(numbers).astype(float).swapaxes(0, 1)
    z = normal.ravel()
    assert stats.kstest(z, "norm").pvalue > 1e-3
    assert np.abs(z).max() < 5.89
    axes = normal.reshape(-1, 6)
    np.testing.assert_allclose(axes.mean(axis=0), 0, atol=4 / np.sqrt(len(axes)))
    np.testing.assert_allclose(axes.var(axis=0), 1, atol=4 * np.sqrt(2 / len(axes)))
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
    def once(seed, draw, sample):
        return joined(NOISE(jnp.asarray(seed), jnp.asarray(draw), jnp.asarray([sample])))[0]

    here = once(3, 5, 8)
    many = joined(NOISE(jnp.asarray(3), jnp.arange(2, 9), jnp.arange(4, 50)))
    assert many.shape == (46, 7, 6) and many.dtype == np.float32
    # To the last bit of single precision, which fused operations may round differently.
    np.testing.assert_allclose(here, many[4, 3], rtol=0, atol=1e-6)
    for other in (4, 5, 8), (3, 6, 8), (3, 5, 9), (5, 3, 8), (8, 5, 3), (3 + 2**32, 5, 8):
        assert not np.any(here == once(*other))


def test_compensation_matches_naive_term_by_term():
    increments = np.random.default_rng(2).normal(scale=[0.01] * 3 + [0.1] * 3, size=(50, 6))
    sample = sensors.compensate_record(increments, increments[0])
    turn, dv = compensate(increments)
    np.testing.assert_allclose(np.stack(sample.dv, axis=1), dv, rtol=0, atol=1e-16)
    matrices = of_quaternion(np.stack(sample.turn, axis=1))
    np.testing.assert_allclose(matrices, Rotation.from_rotvec(turn).as_matrix(), atol=1e-15)


def test_quantised_increment_sums_stay_within_half_quantum():
    """Sums of quantised increments are those of the exact ones to half a quantum."""
    rows = np.random.default_rng(1).normal(size=(500, 6)) * 3e-6
    errors = sensors.error_free_sensors()._replace(
        gyro_quantum=np.array([1e-6, 2e-6, 0.0]), accel_quantum=np.array([5e-6, 0.0, 1e-7])
    )

    def step(left, row):
        out, left = sensors.quantise(sensors.split_record_row(row), errors, left)
        return left, jnp.stack(jax.tree.leaves(out))

    start = sensors.split_record_row(jnp.zeros(6))
    out = np.asarray(jax.lax.scan(step, start, jnp.asarray(rows))[1])
    quanta = np.concatenate([errors.gyro_quantum, errors.accel_quantum])
    some = quanta > 0
    off = np.abs(np.cumsum(out, 0) - np.cumsum(rows, 0)).max(0)
    assert (off <= quanta / 2 + 1e-15).all() and (off[some] > quanta[some] / 4).all()
    counts = out[:, some] / quanta[some]
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
