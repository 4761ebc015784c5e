"""From ideal to measured increments (sensor errors), and to samples (coning and sculling)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths import rng
from sinsjax.maths.algebra import add, cross, dot, scale
from sinsjax.maths.rotations import conjugate, exp_of_sample, rotate
from sinsjax.types import Array, Count, Increments, Sample, Scalar, Vec3


class SensorErrors(NamedTuple):
    """True errors of the sensors, as opposed to a filter's assumptions about them.

    Attributes:
        gyro_bias: (3,) rad/s.
        accel_bias: (3,) m/s^2.
        gyro_noise: (3,) standard deviation of one angle increment, rad.
        accel_noise: (3,) standard deviation of one velocity increment, m/s.
        gyro_matrix: (3, 3) scale factor errors on the diagonal, axis misalignments (rad) off it.
        accel_matrix: (3, 3) likewise.
        gyro_quantum: (3,) quantum of the angle, rad; zero for none, None if no sensor has one.
        accel_quantum: (3,) of the velocity, m/s; likewise.
    """

    gyro_bias: Array
    accel_bias: Array
    gyro_noise: Array
    accel_noise: Array
    gyro_matrix: Array
    accel_matrix: Array
    gyro_quantum: Array | None = None
    accel_quantum: Array | None = None


def error_free_sensors() -> SensorErrors:
    """Return error-free sensors, as for recorded data, which contain their errors."""
    return SensorErrors(*(jnp.zeros(3),) * 4, jnp.zeros((3, 3)), jnp.zeros((3, 3)))


def draw_normal_numbers(seed: Count, draw_id: Array, numbers: Array) -> Increments:
    """Return standard normal numbers for the samples of one draw or of many.

    A function of seed, draw and sample alone: apart from the last bit, no record interval, run
    length, tile, chunk, device or worker can change it. Single precision is far finer than any
    sensor. All numbers are generated in one row, to fill the vector units.

    Args:
        seed: the study's seed, below 2^63.
        draw_id: () or (draws,), below 2^32.
        numbers: (n,) sample numbers in the run, below 2^32 / 3; leaves are (n, *draws).
    """
    # A sample uses three consecutive counters, each giving a pair of numbers.
    counters = 3 * jnp.asarray(numbers)[None] + jnp.arange(3)[:, None]
    (gx, gz, ay), (gy, ax, az) = rng.random_numbers(rng.normal_pair, seed, draw_id, counters)
    return Increments(Vec3(gx, gy, gz), Vec3(ax, ay, az))


def measure_increments(
    ideal: Increments,
    errors: SensorErrors,
    normal: Increments | None,
    dt: Scalar,
    *,
    distorted: bool = True,
) -> Increments:
    """Return measured increments from ideal ones, rad and m/s in b, over a sample time (s).

    Standard normal numbers give the noise; None adds none. Unless ``distorted``, no scale factor or
    axis is off, and they cost nothing.
    """
    gyro, accel = ideal
    if distorted:
        gyro = add(gyro, Vec3(*(dot(Vec3(*row), gyro) for row in errors.gyro_matrix)))
        accel = add(accel, Vec3(*(dot(Vec3(*row), accel) for row in errors.accel_matrix)))
    gyro = add(gyro, Vec3(*(errors.gyro_bias * dt)))
    accel = add(accel, Vec3(*(errors.accel_bias * dt)))
    if normal is None:
        return Increments(gyro, accel)
    return Increments(
        _add_noise(gyro, errors.gyro_noise, normal.dtheta),
        _add_noise(accel, errors.accel_noise, normal.dv),
    )


def _add_noise(exact: Vec3, sigma: Array, normal: Vec3) -> Vec3:
    return Vec3(*(x + s * z.astype(x.dtype) for x, s, z in zip(exact, sigma, normal, strict=True)))


def quantise(
    increments: Increments, errors: SensorErrors, left: Increments
) -> tuple[Increments, Increments]:
    """Return increments in whole quanta, and the remainder of the integrals for the next sample.

    Measured ones (rad and m/s) are added to the remainder ``left`` by the samples before.
    """
    assert errors.gyro_quantum is not None and errors.accel_quantum is not None
    total = jax.tree.map(jnp.add, increments, left)
    quanta = Increments(Vec3(*errors.gyro_quantum), Vec3(*errors.accel_quantum))

    def whole(a: Scalar, quantum: Scalar) -> Scalar:
        some = jnp.where(quantum > 0, quantum, 1.0)
        return jnp.where(quantum > 0, some * jnp.round(a / some), a)

    out = jax.tree.map(whole, total, quanta)
    return out, jax.tree.map(jnp.subtract, total, out)


def split_record_row(row: Array) -> Increments:
    """Return the increments of a record's row (6,): gyros, then accelerometers."""
    return Increments(Vec3(*row[:3]), Vec3(*row[3:]))


def compensate_sample(now: Increments, before: Increments) -> Sample:
    """Return a sample with coning and sculling compensated by the previous one.

    Rotation vector dtheta + (dtheta_prev x dtheta)/12; velocity in the body frame at the start of
    the sample dv + dtheta x dv/2 + dtheta x (dtheta x dv)/6 + (dtheta_prev x dv + dv_prev x
    dtheta)/12. The double product is the next order of the rotation term: without it the velocity
    on a swaying base drifts by 1e-4 m/s in 900 s.
    """
    theta, dv = now
    coning = scale(1 / 12, cross(before.dtheta, theta))
    rotation = cross(theta, dv)
    sculling = scale(1 / 12, add(cross(before.dtheta, dv), cross(before.dv, theta)))
    body = add(dv, add(scale(0.5, rotation), scale(1 / 6, cross(theta, rotation))))
    return Sample(turn=exp_of_sample(add(theta, coning)), dv=add(body, sculling))


def reverse_sample(sample: Sample) -> Sample:
    """Return the compensated sample of the same motion in reversed time.

    The rotation is inverted and the velocity increment is resolved in the body frame at the end of
    the sample: [P2] section 2.3 changes the sign of the gyro; this is exact for any rotation.
    """
    back = conjugate(sample.turn)
    return Sample(turn=back, dv=rotate(back, sample.dv))


def compensate_record(rows: Array, previous: Array) -> Sample:
    """Return the compensated samples of a record (n, 6), leaves (n,), and a row (6,) before it."""
    before = jnp.concatenate([previous[None], rows[:-1]])
    split = jax.vmap(split_record_row)
    return jax.vmap(compensate_sample)(split(rows), split(before))
