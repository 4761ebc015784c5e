"""True motion of the base, and what ideal sensors would integrate over each sample.

The base does not travel; it sways about a centre attitude. Angular rate and specific force are
known in closed form at any time, and are integrated over each sample by Gauss quadrature: the
increments owe nothing to the mechanisation that will be tested with them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.algebra import add, scale
from sinsjax.earth import Place
from sinsjax.rotations import from_euler, sin_cos
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

    def phase_at(self, t: Scalar) -> tuple[Scalar, Scalar]:
        """Sine and cosine of the argument at time t (s)."""
        return sin_cos(self._argument(t))

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
    now = Sines(*(sin_cos(sway.angle(t)) for sway in motion))
    return _felt(place, now, *(sway.rate(t) for sway in motion))


class Sines(NamedTuple):
    """Sine and cosine of each Euler angle."""

    pitch: tuple[Scalar, Scalar]
    roll: tuple[Scalar, Scalar]
    yaw: tuple[Scalar, Scalar]


def _felt(
    place: Place, now: Sines, pitch_rate: Scalar, roll_rate: Scalar, yaw_rate: Scalar
) -> tuple[Vec3, Vec3]:
    """Rate and force in b of an attitude and the rates of its angles."""
    (sp, cp), (sr, cr), (sy, cy) = now
    north = Vec3(sy * cr + cy * sp * sr, cy * cp, sy * sr - cy * sp * cr)  # seen from b
    up = Vec3(-cp * sr, sp, cp * cr)
    across = yaw_rate * cp
    turn = Vec3(
        pitch_rate * cr - across * sr,
        roll_rate + yaw_rate * sp,
        pitch_rate * sr + across * cr,
    )
    earth = add(scale(place.rate_n, north), scale(place.rate_u, up))
    return add(earth, turn), scale(place.gravity, up)


def increment(motion: Motion, place: Place, rate_hz: Scalar, k: Scalar) -> Array:
    """Ideal sensor increments over one sample, by Gauss quadrature.

    Angles and their rates at the nodes follow from those at the middle of the sample, by the sum
    of angles: few sines are made, which is what the time goes into.

    Args:
        motion: of the base.
        place: Earth rates and gravity.
        rate_hz: samples a second.
        k: number of the sample, which spans k/rate to (k+1)/rate.

    Returns:
        (6,): three angle increments (rad) and three velocity increments (m/s) in b.
    """
    middle = (k + 0.5) / rate_hz
    omegas = [2 * jnp.pi / sway.period for sway in motion]
    phases = [sway.phase_at(middle) for sway in motion]
    moved = zip(motion, phases, strict=True)
    middles = [sin_cos(sway.center + sway.amplitude * sin) for sway, (sin, _) in moved]

    def at_node(later: Scalar) -> Array:
        sines, rates = [], []
        for sway, omega, phase, here in zip(motion, omegas, phases, middles, strict=True):
            there = _sum(phase, sin_cos(omega * later))
            sines.append(_sum(here, sin_cos(sway.amplitude * (there[0] - phase[0]))))
            rates.append(sway.amplitude * omega * there[1])
        rate, force = _felt(place, Sines(*sines), *rates)
        return jnp.stack([*rate, *force])

    # Mapped, not unrolled: a sixth of the code to compile.
    felt = jax.vmap(at_node)(jnp.asarray(_NODES) * (0.5 / rate_hz))
    # A product of matrices would be a call, which breaks the loop that this is part of.
    return jnp.sum(jnp.asarray(_WEIGHTS / 2)[:, None] * felt, axis=0) / rate_hz


def _sum(a: tuple[Scalar, Scalar], b: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
    """Sine and cosine of a sum of angles, from those of each."""
    return a[0] * b[1] + a[1] * b[0], a[1] * b[1] - a[0] * b[0]


def increments(motion: Motion, place: Place, rate_hz: Scalar, samples: int) -> Array:
    """Ideal sensor increments of samples 0 to ``samples`` - 1, (samples, 6), see `increment`."""
    numbers = jnp.arange(samples, dtype=float)
    return jax.lax.map(lambda k: increment(motion, place, rate_hz, k), numbers, batch_size=1000)
