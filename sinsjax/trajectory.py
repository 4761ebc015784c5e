"""True motion of the base, and what ideal sensors would integrate over each sample.

The base does not travel; it sways about a centre attitude. Angular rate and specific force are
known in closed form at any time, and are integrated over each sample by Gauss quadrature: the
increments owe nothing to the mechanisation that will be tested with them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.earth import Place
from sinsjax.rotations import conjugate, from_euler, rotate
from sinsjax.types import Array, Quat, Scalar, Vec3

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)


class Sway(NamedTuple):
    """One Euler angle over time: center + amplitude sin(2 pi t / period + phase).

    Attributes:
        center: rad.
        amplitude: rad; zero is a static base.
        period: s.
        phase: rad.
    """

    center: Scalar
    amplitude: Scalar
    period: Scalar
    phase: Scalar

    def angle(self, t: Scalar) -> Scalar:
        """Angle at time t (s), rad."""
        return self.center + self.amplitude * jnp.sin(self._argument(t))

    def rate(self, t: Scalar) -> Scalar:
        """Time derivative of the angle at t (s), rad/s."""
        omega = 2 * jnp.pi / self.period
        return self.amplitude * omega * jnp.cos(self._argument(t))

    def _argument(self, t: Scalar) -> Scalar:
        return 2 * jnp.pi * t / self.period + self.phase


class Motion(NamedTuple):
    """Attitude of the base over time, C_b^n = Rz(yaw) Rx(pitch) Ry(roll)."""

    pitch: Sway
    roll: Sway
    yaw: Sway


def attitude(motion: Motion, t: Scalar) -> Quat:
    """True attitude, body to navigation frame, at time t (s)."""
    return from_euler(motion.pitch.angle(t), motion.roll.angle(t), motion.yaw.angle(t))


def rate_and_force(motion: Motion, place: Place, t: Scalar) -> tuple[Vec3, Vec3]:
    """Angular rate of b against inertial space (rad/s) and specific force (m/s^2), both in b.

    w_nb^b follows from the Euler rates: yaw rate seen through pitch and roll, pitch rate through
    roll. The base has no velocity, so that f^n = (0, 0, g) and w_in^n is the Earth rate alone.
    """
    to_body = conjugate(attitude(motion, t))
    pitch, roll = motion.pitch.angle(t), motion.roll.angle(t)
    pitch_rate, roll_rate, yaw_rate = (sway.rate(t) for sway in motion)
    earth = rotate(to_body, Vec3(0.0, place.rate_n, place.rate_u))
    across = yaw_rate * jnp.cos(pitch)
    rate = Vec3(
        earth.x + pitch_rate * jnp.cos(roll) - across * jnp.sin(roll),
        earth.y + roll_rate + yaw_rate * jnp.sin(pitch),
        earth.z + pitch_rate * jnp.sin(roll) + across * jnp.cos(roll),
    )
    return rate, rotate(to_body, Vec3(0.0, 0.0, place.gravity))


def increments(motion: Motion, place: Place, rate_hz: Scalar, samples: int) -> Array:
    """Ideal sensor increments from t = 0.

    Args:
        motion: of the base.
        place: Earth rates and gravity.
        rate_hz: samples a second.
        samples: how many.

    Returns:
        (samples, 6): three angle increments (rad) and three velocity increments (m/s) in b. Sample
        k spans k/rate to (k+1)/rate.
    """

    def one(k: Scalar) -> Array:
        t = (k + 0.5 + 0.5 * jnp.asarray(_NODES)) / rate_hz
        rate, force = jax.vmap(lambda time: rate_and_force(motion, place, time))(t)
        return jnp.asarray(_WEIGHTS) @ jnp.stack([*rate, *force], axis=-1) / (2 * rate_hz)

    return jax.lax.map(one, jnp.arange(samples, dtype=float), batch_size=1000)
