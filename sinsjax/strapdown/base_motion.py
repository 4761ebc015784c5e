"""True motion of the base, and the increments that ideal sensors would measure.

The base stays in place and sways about a mean attitude. Angular rate and specific force are known
in closed form at any time and are integrated over each sample by Gauss quadrature, so the
increments are independent of the mechanisation under test.
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
_NODES, _WEIGHTS = (a[_COUNT // 2 :] for a in np.polynomial.legendre.leggauss(_COUNT))
_WEIGHTS = 0.5 * _WEIGHTS
"""Gauss nodes after mid-sample, in half samples, and their weights in the mean over a sample."""

_BATCH = 1000


class Sway(NamedTuple):
    """One Euler angle over time: center + amplitude sin(2 pi t / period + phase).

    Attributes:
        center: rad.
        amplitude: rad; zero for a static base.
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
    """Angular rate of b relative to inertial space (rad/s) and specific force (m/s^2), both in b.

    w_nb^b follows from the Euler rates: the yaw rate resolved through pitch and roll, the pitch
    rate through roll. The base has no velocity, so f^n = (0, 0, g) and w_in^n is the Earth rate
    alone.
    """
    now = Sines(*(sin_cos(sway.angle(t)) for sway in motion))
    return _inertial(place, _in_body(now, *(sway.rate(t) for sway in motion)))


class Sines(NamedTuple):
    """Sine and cosine of each Euler angle."""

    pitch: tuple[Scalar, Scalar]
    roll: tuple[Scalar, Scalar]
    yaw: tuple[Scalar, Scalar]


class InBody(NamedTuple):
    """Navigation axes and rate in the body frame, before Earth rate and gravity are applied.

    Attributes:
        north: unit vector to the north, in b.
        up: unit vector up, in b.
        rate: angular rate of b relative to n, in b, rad/s.
    """

    north: Vec3
    up: Vec3
    rate: Vec3


def _in_body(now: Sines, pitch_rate: Scalar, roll_rate: Scalar, yaw_rate: Scalar) -> InBody:
    """Axes and rate in b at an attitude, from the rates of its Euler angles (rad/s)."""
    (sp, cp), (sr, cr), (sy, cy) = now
    across, tilted = yaw_rate * cp, cy * sp
    return InBody(
        north=Vec3(sy * cr + tilted * sr, cy * cp, sy * sr - tilted * cr),
        up=Vec3(-cp * sr, sp, cp * cr),
        rate=Vec3(
            pitch_rate * cr - across * sr,
            roll_rate + yaw_rate * sp,
            pitch_rate * sr + across * cr,
        ),
    )


def _inertial(place: Place, body: InBody) -> tuple[Vec3, Vec3]:
    """Angular rate w_ib (rad/s) and specific force (m/s^2) in b.

    Both are linear in ``body``: the mean over a time gives the mean rate and force.
    """
    earth = add(scale(place.rate_n, body.north), scale(place.rate_u, body.up))
    return add(earth, body.rate), scale(place.gravity, body.up)


class Advance(NamedTuple):
    """Phase advance of a `Sway` from mid-sample to the later Gauss nodes.

    Attributes:
        sin: (nodes / 2,) sine of the advance; its negative holds at the earlier nodes.
        versed: (nodes / 2,) cosine of the advance minus 1.
    """

    sin: Array
    versed: Array


class Nodes(NamedTuple):
    """`Advance` of each Euler angle, the same for all samples of a motion."""

    pitch: Advance
    roll: Advance
    yaw: Advance


def nodes(motion: Motion, rate_hz: Scalar) -> Nodes:
    """Phase advances that `increment` takes, for a motion sampled at ``rate_hz``."""

    def advance(sway: Sway, node: Scalar) -> Advance:
        sin, cos = sin_cos(0.5 * jnp.pi * node / (sway.period * rate_hz))
        return Advance(2 * sin * cos, -2 * sin * sin)

    return Nodes(*(jax.vmap(partial(advance, sway))(jnp.asarray(_NODES)) for sway in motion))


def increment(motion: Motion, ahead: Nodes, place: Place, rate_hz: Scalar, k: Scalar) -> Increments:
    """Ideal sensor increments over one sample, by Gauss quadrature.

    Angles and rates at the nodes follow from those at mid-sample by the angle-sum formulas, because
    full sines dominate the cost. The remaining sines are of the change of an angle within half a
    sample: where it exceeds 1 rad they lose accuracy, and so does the quadrature.

    Args:
        motion: motion of the base.
        ahead: its phase advances at this sample rate, see `nodes`.
        place: Earth rates and gravity.
        rate_hz: sample rate, Hz.
        k: number of the sample, which spans k/rate to (k+1)/rate.

    Returns:
        Angle increments (rad) and velocity increments (m/s) in b.
    """
    middle = (k + 0.5) / rate_hz
    waves = []
    for sway in motion:
        sin, cos = (sway.amplitude * part for part in sway.phase_at(middle))
        waves.append((sin, cos, 2 * jnp.pi / sway.period, sin_cos(sway.center + sin)))

    def at_pair(ahead: Nodes) -> InBody:
        sides = []
        for side in (-1.0, 1.0):
            sines, rates = [], []
            for (sin, cos, omega, here), advance in zip(waves, ahead, strict=True):
                later, versed = side * advance.sin, advance.versed
                sines.append(_sum(here, sin_cos_near_zero(sin * versed + cos * later)))
                rates.append(omega * (cos + (cos * versed - sin * later)))
            sides.append(_in_body(Sines(*sines), *rates))
        return jax.tree.map(jnp.add, *sides)

    # Mapped rather than unrolled: half the code to compile.
    pairs = jax.vmap(at_pair)(ahead)
    # A matrix product or a sum over an axis would become a loop that is not vectorised.
    mean = jax.tree.map(lambda a: sum(w * a[i] for i, w in enumerate(_WEIGHTS)), pairs)
    return Increments(*(scale(1 / rate_hz, part) for part in _inertial(place, mean)))


def _sum(a: tuple[Scalar, Scalar], b: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
    """Sine and cosine of a sum of angles, from those of each."""
    return a[0] * b[1] + a[1] * b[0], a[1] * b[1] - a[0] * b[0]


def increments(motion: Motion, place: Place, rate_hz: Scalar, samples: int) -> Array:
    """Ideal sensor increments of samples 0 to ``samples`` - 1, (samples, 6), see `increment`.

    Computed in two or more batches of equal size: a shorter last batch, or a single one whose loop
    the compiler removes, would give different bits.
    """
    ahead = nodes(motion, rate_hz)
    batches = max(2, -(-samples // _BATCH))
    numbers = jnp.arange(batches * _BATCH, dtype=float)

    def row(k: Scalar) -> Array:
        return jnp.stack(jax.tree.leaves(increment(motion, ahead, place, rate_hz, k)))

    return jax.lax.map(row, numbers, batch_size=_BATCH)[:samples]
