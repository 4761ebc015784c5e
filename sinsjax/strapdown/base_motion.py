"""True motion of the base, and what ideal sensors would integrate over each sample.

The base does not travel; it sways about a centre attitude. Angular rate and specific force are
known in closed form at any time, and are integrated over each sample by Gauss quadrature: the
increments owe nothing to the mechanisation that will be tested with them.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.maths.algebra import add, scale
from sinsjax.maths.rotations import from_euler, sin_cos, sin_cos_near_zero
from sinsjax.strapdown.earth import Place
from sinsjax.types import Array, Increments, Quat, Scalar, Vec3

_COUNT = 6
_NODES, _SHARES = (a[_COUNT // 2 :] for a in np.polynomial.legendre.leggauss(_COUNT))
_SHARES = 0.5 * _SHARES
"""Nodes later than the middle, in half samples, and their shares of the mean over a sample."""

_BATCH = 1000


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
    return _felt(place, _seen(now, *(sway.rate(t) for sway in motion)))


class Sines(NamedTuple):
    """Sine and cosine of each Euler angle."""

    pitch: tuple[Scalar, Scalar]
    roll: tuple[Scalar, Scalar]
    yaw: tuple[Scalar, Scalar]


class Seen(NamedTuple):
    """What a base with an attitude and a rate feels, before the Earth is known.

    Attributes:
        north: unit vector to the north, in b.
        up: unit vector up, in b.
        turn: angular rate of b against n, in b, rad/s.
    """

    north: Vec3
    up: Vec3
    turn: Vec3


def _seen(now: Sines, pitch_rate: Scalar, roll_rate: Scalar, yaw_rate: Scalar) -> Seen:
    """What is felt at an attitude with rates (rad/s) of its angles."""
    (sp, cp), (sr, cr), (sy, cy) = now
    across, tilted = yaw_rate * cp, cy * sp
    return Seen(
        north=Vec3(sy * cr + tilted * sr, cy * cp, sy * sr - tilted * cr),
        up=Vec3(-cp * sr, sp, cp * cr),
        turn=Vec3(
            pitch_rate * cr - across * sr,
            roll_rate + yaw_rate * sp,
            pitch_rate * sr + across * cr,
        ),
    )


def _felt(place: Place, seen: Seen) -> tuple[Vec3, Vec3]:
    """Angular rate (rad/s) and specific force (m/s^2) in b; of their integrals over a time, too."""
    earth = add(scale(place.rate_n, seen.north), scale(place.rate_u, seen.up))
    return add(earth, seen.turn), scale(place.gravity, seen.up)


class Advance(NamedTuple):
    """How far the argument of a `Sway` is at the later nodes of a sample from its middle.

    Attributes:
        sin: (nodes / 2,) sine of the advance; at the earlier nodes it is the negative.
        versed: (nodes / 2,) its cosine, less one.
    """

    sin: Array
    versed: Array


class Nodes(NamedTuple):
    """`Advance` of each angle: what is the same for all samples of a motion."""

    pitch: Advance
    roll: Advance
    yaw: Advance


def nodes(motion: Motion, rate_hz: Scalar) -> Nodes:
    """What `increment` needs of a motion, at ``rate_hz`` samples a second."""

    def advance(sway: Sway, node: Scalar) -> Advance:
        sin, cos = sin_cos(0.5 * jnp.pi * node / (sway.period * rate_hz))
        return Advance(2 * sin * cos, -2 * sin * sin)

    return Nodes(*(jax.vmap(partial(advance, sway))(jnp.asarray(_NODES)) for sway in motion))


def increment(motion: Motion, ahead: Nodes, place: Place, rate_hz: Scalar, k: Scalar) -> Increments:
    """Ideal sensor increments over one sample, by Gauss quadrature.

    Angles and their rates at the nodes follow from those at the middle of the sample, by the sum
    of angles: few sines are made in full, which is what the time goes into. The others are of how
    far an angle moves within half a sample: where that is more than 1 rad they are less accurate
    than a sine should be, and so is the quadrature.

    Args:
        motion: of the base.
        ahead: of that motion at that rate, see `nodes`.
        place: Earth rates and gravity.
        rate_hz: samples a second.
        k: number of the sample, which spans k/rate to (k+1)/rate.

    Returns:
        Angle increments (rad) and velocity increments (m/s) in b.
    """
    middle = (k + 0.5) / rate_hz
    waves = []
    for sway in motion:
        sin, cos = (sway.amplitude * part for part in sway.phase_at(middle))
        waves.append((sin, cos, 2 * jnp.pi / sway.period, sin_cos(sway.center + sin)))

    def at_pair(ahead: Nodes) -> Seen:
        sides = []
        for side in (-1.0, 1.0):
            sines, rates = [], []
            for (sin, cos, omega, here), advance in zip(waves, ahead, strict=True):
                later, versed = side * advance.sin, advance.versed
                sines.append(_sum(here, sin_cos_near_zero(sin * versed + cos * later)))
                rates.append(omega * (cos + (cos * versed - sin * later)))
            sides.append(_seen(Sines(*sines), *rates))
        return jax.tree.map(jnp.add, *sides)

    # Mapped, not unrolled: half the code to compile.
    pairs = jax.vmap(at_pair)(ahead)
    # Neither a product of matrices nor a sum over an axis, whose loops would not be vectorised.
    mean = jax.tree.map(lambda a: sum(w * a[i] for i, w in enumerate(_SHARES)), pairs)
    return Increments(*(scale(1 / rate_hz, felt) for felt in _felt(place, mean)))


def _sum(a: tuple[Scalar, Scalar], b: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
    """Sine and cosine of a sum of angles, from those of each."""
    return a[0] * b[1] + a[1] * b[0], a[1] * b[1] - a[0] * b[0]


def increments(motion: Motion, place: Place, rate_hz: Scalar, samples: int) -> Array:
    """Ideal sensor increments of samples 0 to ``samples`` - 1, (samples, 6), see `increment`.

    Made in batches of one size, two or more: a rest, or one batch, whose loop the compiler would
    leave out, would be compiled to other bits.
    """
    ahead = nodes(motion, rate_hz)
    batches = max(2, -(-samples // _BATCH))
    numbers = jnp.arange(batches * _BATCH, dtype=float)

    def row(k: Scalar) -> Array:
        return jnp.stack(jax.tree.leaves(increment(motion, ahead, place, rate_hz, k)))

    return jax.lax.map(row, numbers, batch_size=_BATCH)[:samples]
