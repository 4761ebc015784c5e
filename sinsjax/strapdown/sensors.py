"""From ideal increments to what the navigator receives: sensor errors, and coning and sculling."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths.algebra import add, cross, dot, scale
from sinsjax.maths.rng import normal_pair, threefry
from sinsjax.maths.rotations import conjugate, exp, rotate
from sinsjax.types import Array, Count, Increments, Sample, Scalar, Vec3


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


def noise(seed: Count, draw_id: Array, numbers: Array) -> Increments:
    """Standard normal numbers for samples of one draw or of many.

    A function of seed, draw and sample alone: neither record interval, run length, tile, chunk,
    device nor worker can change it, but for the last bit. In single precision, which is far finer
    than any sensor. All of them are made in one row, which fills the vector units.

    Args:
        seed: of the study, below 2^63.
        draw_id: () or (draws,), below 2^32.
        numbers: (n,) of the samples in the run, below 2^32 / 3.

    Returns:
        `Increments` with leaves (n, *draws).
    """
    wide = jnp.asarray(seed).astype(jnp.uint64)
    key = ((wide >> 32).astype(jnp.uint32), wide.astype(jnp.uint32))
    draw, first = jnp.asarray(draw_id), 3 * jnp.asarray(numbers)
    shape = (3, *first.shape, *draw.shape)
    # A sample takes three counters in a row, a pair of numbers each.
    counter = (first[None] + jnp.arange(3)[:, None]).reshape(3, -1, *(1 for _ in draw.shape))
    row = (jnp.broadcast_to(a, shape).astype(jnp.uint32).reshape(-1) for a in (draw, counter))
    pairs = jax.vmap(lambda *counter: normal_pair(threefry(key, counter)))(*row)
    (gx, gz, ay), (gy, ax, az) = (pair.reshape(shape) for pair in pairs)
    return Increments(Vec3(gx, gy, gz), Vec3(ax, ay, az))


def measure(
    ideal: Increments, errors: SensorErrors, normal: Increments | None, dt: Scalar
) -> Increments:
    """Measured increments from ideal ones and standard normal numbers, None for no noise."""
    gyro = _distort(ideal.dtheta, errors.gyro_matrix, errors.gyro_bias * dt)
    accel = _distort(ideal.dv, errors.accel_matrix, errors.accel_bias * dt)
    if normal is None:
        return Increments(gyro, accel)
    return Increments(
        _blur(gyro, errors.gyro_noise, normal.dtheta), _blur(accel, errors.accel_noise, normal.dv)
    )


def _distort(ideal: Vec3, matrix: Array, bias: Array) -> Vec3:
    return add(add(ideal, Vec3(*(dot(Vec3(*row), ideal) for row in matrix))), Vec3(*bias))


def _blur(exact: Vec3, sigma: Array, normal: Vec3) -> Vec3:
    return Vec3(*(x + s * z.astype(x.dtype) for x, s, z in zip(exact, sigma, normal, strict=True)))


def split(row: Array) -> Increments:
    """A row (6,) of a record: gyros, then accelerometers."""
    return Increments(Vec3(*row[:3]), Vec3(*row[3:]))


def compensate(now: Increments, before: Increments) -> Sample:
    """Coning and sculling with the previous sample.

    Rotation vector dtheta + (dtheta_prev x dtheta)/12; velocity in the body frame at the sample's
    start dv + dtheta x dv/2 + dtheta x (dtheta x dv)/6 + (dtheta_prev x dv + dv_prev x dtheta)/12.
    The double product is the rotation term's next order: without it a swinging base drifts by
    1e-4 m/s in 900 s.

    Args:
        now: measured increments.
        before: those of the sample before.
    """
    theta, dv = now
    coning = scale(1 / 12, cross(before.dtheta, theta))
    rotation = cross(theta, dv)
    sculling = scale(1 / 12, add(cross(before.dtheta, dv), cross(before.dv, theta)))
    body = add(dv, add(scale(0.5, rotation), scale(1 / 6, cross(theta, rotation))))
    return Sample(turn=exp(add(theta, coning)), dv=add(body, sculling))


def reverse(sample: Sample) -> Sample:
    """The compensated sample as the same motion run backward in time feels it.

    The turn is undone, and the same velocity increment is seen from where the sample ended: what
    [P2] section 2.3 does by the sign of the gyro, exact for any rotation within a sample.
    """
    back = conjugate(sample.turn)
    return Sample(turn=back, dv=rotate(back, sample.dv))


def compensate_record(rows: Array, previous: Array) -> Sample:
    """Compensated samples of a record.

    Args:
        rows: (n, 6) measured increments.
        previous: (6,) the increments before the first of them.

    Returns:
        `Sample` with leaves of shape (n,).
    """
    before = jnp.concatenate([previous[None], rows[:-1]])
    return jax.vmap(lambda a, b: compensate(split(a), split(b)))(rows, before)
