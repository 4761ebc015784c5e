"""From ideal increments to what the navigator receives: sensor errors, and coning and sculling."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.algebra import add, cross, scale
from sinsjax.rotations import exp
from sinsjax.types import Array, Count, Sample, Scalar, Vec3

NOISE_BLOCK = 100
"""Samples a noise block: fixed for ever, since the drawn numbers depend on it."""


class SensorErrors(NamedTuple):
    """What the sensors do, as opposed to what a filter believes of them.

    Attributes:
        gyro_bias: (3,) rad/s.
        accel_bias: (3,) m/s^2.
        gyro_noise: (3,) standard deviation of one angle increment, rad.
        accel_noise: (3,) standard deviation of one velocity increment, m/s.
        gyro_matrix: (3, 3) scale factors on, misalignments off the diagonal; zero is perfect.
        accel_matrix: (3, 3) likewise.
    """

    gyro_bias: Array
    accel_bias: Array
    gyro_noise: Array
    accel_noise: Array
    gyro_matrix: Array
    accel_matrix: Array


def perfect() -> SensorErrors:
    """Sensors without error: what a recorded file is read with."""
    return SensorErrors(*(jnp.zeros(3),) * 4, jnp.zeros((3, 3)), jnp.zeros((3, 3)))


def noise(seed: Count, draw_id: Count, block: Count) -> Array:
    """Standard normal numbers of one block of one draw: (100, 6), gyros then accelerometers.

    A function of seed, draw and block alone: neither record interval, run length, tile, chunk,
    device nor worker can change it. Drawn in single precision (24-bit uniforms, |z| < 5.5), which
    costs a third and is far finer than any sensor.
    """
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), draw_id), block)
    return jax.random.normal(key, (NOISE_BLOCK, 6), dtype=jnp.float32)


def measure(ideal: Array, errors: SensorErrors, normal: Array, dt: Scalar) -> Array:
    """Measured increments (n, 6) from ideal ones and standard normal numbers of the same shape."""
    bias = jnp.concatenate([errors.gyro_bias, errors.accel_bias]) * dt
    sigma = jnp.concatenate([errors.gyro_noise, errors.accel_noise])
    scaled = jnp.concatenate(
        [_times(errors.gyro_matrix, ideal[:, :3]), _times(errors.accel_matrix, ideal[:, 3:])],
        axis=1,
    )
    return ideal + scaled + bias[None] + sigma[None] * normal.astype(ideal.dtype)


def _times(matrix: Array, rows: Array) -> Array:
    """Matrix times each row; a plain sum, since a library product may order additions by shape."""
    terms = [rows[:, j : j + 1] * matrix[None, :, j] for j in range(3)]
    return terms[0] + terms[1] + terms[2]


def compensate(increments: Array, previous: Array) -> Sample:
    """Coning and sculling with the previous sample; once a record, for all its variants.

    Rotation vector dtheta + (dtheta_prev x dtheta)/12; velocity in the body frame at the sample's
    start dv + dtheta x dv/2 + dtheta x (dtheta x dv)/6 + (dtheta_prev x dv + dv_prev x dtheta)/12.
    The double product is the rotation term's next order: without it a swinging base drifts by
    1e-4 m/s in 900 s.

    Args:
        increments: (n, 6) measured increments.
        previous: (6,) the increments before the first of them.

    Returns:
        `Sample` with leaves of shape (n,).
    """
    return jax.vmap(_one_sample)(increments, jnp.concatenate([previous[None], increments[:-1]]))


def _one_sample(now: Array, before: Array) -> Sample:
    theta, dv = Vec3(*now[:3]), Vec3(*now[3:])
    theta_before, dv_before = Vec3(*before[:3]), Vec3(*before[3:])
    coning = scale(1 / 12, cross(theta_before, theta))
    rotation = cross(theta, dv)
    sculling = scale(1 / 12, add(cross(theta_before, dv), cross(dv_before, theta)))
    body = add(dv, add(scale(0.5, rotation), scale(1 / 6, cross(theta, rotation))))
    return Sample(turn=exp(add(theta, coning)), dv=add(body, sculling))
