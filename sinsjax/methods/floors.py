"""The bias floor: the misalignment that constant sensor biases leave, in closed form.

A method that does not estimate the biases takes the mean specific force for the vertical and the
horizontal part of the mean angular rate for north. The biases enter in n, averaged over the motion
of the base. Left out are scale factors and misalignments of the sensors: on a still base they act
as a bias of their own (1,000 ppm of Earth rate is 0.015 deg/h), on a swaying one through the sway.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.maths.rotations import misalign, misalignment
from sinsjax.strapdown.base_motion import Motion
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.sensors import SensorErrors
from sinsjax.types import Array, Flag, Quat, Scalar, Vec3


class MeanBiases(NamedTuple):
    """Mean constant biases in n.

    Attributes:
        eps: of the gyros, rad/s.
        nabla: of the accelerometers, m/s^2.
        largest_nabla: largest accelerometer bias in b, m/s^2.
    """

    eps: Vec3
    nabla: Vec3
    largest_nabla: Scalar


class BiasFloor(NamedTuple):
    """The misalignment that the constant sensor biases of a run leave.

    Attributes:
        phi: rotation vector in n, rad.
        tilt: the most that the accelerometer biases can leave of a level error, max |nabla|/g, rad.
        no_north: whether the level gyro bias exceeds the north component of the Earth rate, so
            that the measured rate may point anywhere, or the method finds no heading.
    """

    phi: Vec3
    tilt: Scalar
    no_north: Flag


NO_BIASES = MeanBiases(*(Vec3(*(np.float64(0.0),) * 3),) * 2, np.float64(0.0))

_PHASES = 2 * np.pi * np.arange(64) / 64  # exact to rounding for three amplitudes of 360 deg


def mean_biases(errors: SensorErrors, motion: Motion) -> MeanBiases:
    """Return constant biases in n, averaged over whole periods of the motion, leaves ``(...)``.

    Angles of one period keep their phase to one another; others count as independent, which is
    exact but for periods in a small whole ratio. The biases are zero in n on a base that is turned,
    where no floor is known. Of NumPy arrays the result is NumPy, so that nothing is compiled.
    """
    if motion.turns:
        zero = 0.0 * errors.gyro_bias[..., 0]
        none = Vec3(zero, zero, zero)
        return MeanBiases(none, none, abs(errors.accel_bias).max(-1))
    mean_c_bn = mean_attitude(motion)
    in_n = [(mean_c_bn @ b[..., None])[..., 0] for b in (errors.gyro_bias, errors.accel_bias)]
    eps, nabla = (Vec3(b[..., 0], b[..., 1], b[..., 2]) for b in in_n)
    return MeanBiases(eps, nabla, abs(errors.accel_bias).max(-1))


def mean_attitude(motion: Motion) -> Array:
    """Return the mean of C_b^n over the motion, ``(..., 3, 3)``, see `mean_biases`."""
    xp: Any = jnp if any(isinstance(a, jax.Array) for a in jax.tree.leaves(motion)) else np
    first, second, third = (sway.period for sway in motion.angles)
    # Angles of one period share the phase of the first that has it.
    phase_of_third = xp.where(third == first, 0, xp.where(third == second, 1, 2))
    phase_of = (xp.asarray(0), xp.where(second == first, 0, 1), phase_of_third)
    swings = []  # 1, cosine and sine of each angle about its center, (..., 3, nodes)
    for sway in motion.angles:
        swing = sway.amplitude[..., None] * xp.sin(_PHASES + sway.phase[..., None])
        swings.append(xp.stack([xp.ones_like(swing), xp.cos(swing), xp.sin(swing)], -2))
    mean: Any = 1.0  # of their products, (..., 3, 3, 3)
    for phase in range(3):
        pitch, roll, yaw = (
            xp.where((number == phase)[..., None, None], swing, 1.0)
            for number, swing in zip(phase_of, swings, strict=True)
        )
        pitch_roll = pitch[..., :, None, :] * roll[..., None, :, :]
        mean = mean * (pitch_roll[..., None, :] * yaw[..., None, None, :, :]).mean(-1)
    # About the centers last: the attitude of a still base has no sum of equal numbers. A product of
    # matrices also keeps XLA from compiling all that is in the loop over tiles as one function.
    turns = [_add_angle(xp, sway.center) for sway in motion.angles]
    mean = xp.einsum("...pa,...rb,...yc,...abc->...pry", *turns, mean)
    one, cos, sin = range(3)  # of pitch, roll and yaw
    rows = [
        mean[..., one, cos, cos] - mean[..., sin, sin, sin],
        -mean[..., cos, one, sin],
        mean[..., one, sin, cos] + mean[..., sin, cos, sin],
        mean[..., one, cos, sin] + mean[..., sin, sin, cos],
        mean[..., cos, one, cos],
        mean[..., one, sin, sin] - mean[..., sin, cos, cos],
        -mean[..., cos, sin, one],
        mean[..., sin, one, one],
        mean[..., cos, cos, one],
    ]
    return xp.stack(rows, -1).reshape(*mean.shape[:-3], 3, 3)


def _add_angle(xp: Any, angle: Any) -> Any:
    """Return the matrix that takes 1, cos x and sin x to those of x + angle, (..., 3, 3)."""
    one, cos, sin = xp.ones_like(angle), xp.cos(angle), xp.sin(angle)
    rows = [one, 0 * one, 0 * one, 0 * one, cos, -sin, 0 * one, sin, cos]
    return xp.stack(rows, -1).reshape(*angle.shape, 3, 3)


def bias_floor(place: Place, biases: MeanBiases, extra_heading_error: Scalar = 0.0) -> BiasFloor:
    """Return the bias floor of a method that attributes the effect of the biases to the Earth.

    phi_E = -nabla_N/g, phi_N = nabla_E/g and, the mean rate being felt across the tilted vertical,
    phi_U = -atan2(eps_E, omega_N + eps_N) + (nabla_E/g) tan L to first order in the tilt.

    ``extra_heading_error`` is a phi_U that the method adds, rad; the place is that of a forward
    pass. The drift of the heading by eps_U is not included. The slope of the tilt over T gives the
    heading of its middle, so that a run ends at -eps_U T/2 from here, T since the start or the last
    reset: -0.75' for 0.1 deg/h and 900 s. It depends on how much old data a method forgets.
    """
    eps, nabla, largest_nabla = biases
    tilt = Vec3(-nabla.y / place.gravity, nabla.x / place.gravity, jnp.zeros_like(nabla.x))
    up = place.rate_u + eps.z
    east, north = eps.x - up * tilt.y, place.rate_n + eps.y + up * tilt.x
    turn = extra_heading_error - jnp.arctan2(east, north)
    zero = jnp.zeros_like(turn)
    true = Quat(zero + 1, zero, zero, zero)
    phi = misalignment(true, misalign(Vec3(zero, zero, turn), misalign(tilt, true)))
    no_north = eps.x**2 + eps.y**2 > place.rate_n**2
    return BiasFloor(phi, largest_nabla / place.gravity, no_north)
