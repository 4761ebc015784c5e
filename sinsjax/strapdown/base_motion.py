"""True motion of the base, and the increments that ideal sensors would measure.

The base stays in place, sways about a mean attitude and may be turned, the sensors at a lever arm
from the centre of the sway, which the axis of the turns passes through. Angular rate and specific
force are known in closed form at any time and are integrated over each sample by Gauss quadrature,
so the increments are independent of the mechanisation under test.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.maths.algebra import add, cross, dot, scale
from sinsjax.maths.rotations import from_euler, multiply, sin_cos, sin_cos_near_zero
from sinsjax.strapdown.attitude_path import AttitudePath
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.turns import AngleRates, SampleTurn, Turns
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

    def acceleration(self, t: Scalar) -> Scalar:
        """Second time derivative of the angle at t (s), rad/s^2."""
        omega = 2 * jnp.pi / self.period
        return -self.amplitude * omega * omega * jnp.sin(self._argument(t))

    def phase_at(self, t: Scalar) -> tuple[Scalar, Scalar]:
        """Sine and cosine of the argument at time t (s)."""
        return sin_cos(self._argument(t))

    def _argument(self, t: Scalar) -> Scalar:
        return 2 * jnp.pi * t / self.period + self.phase


class Motion(NamedTuple):
    """Attitude over time, C_b^n = Rz(yaw + vertical) Rx(pitch) Ry(roll) Rz(table).

    Attributes:
        pitch: angle over time.
        roll: likewise.
        yaw: likewise.
        lever: from the centre of the sway to the sensors, in b, m; None where they are in it.
        vertical: turns about the vertical; None without any.
        table: turns about the z axis of b, of a turntable that sways with the base; None without.
        path: angles in addition to those of the sways; None without a given attitude.
    """

    pitch: Sway
    roll: Sway
    yaw: Sway
    lever: Vec3 | None = None
    vertical: Turns | None = None
    table: Turns | None = None
    path: AttitudePath | None = None

    @property
    def angles(self) -> tuple[Sway, Sway, Sway]:
        """Pitch, roll and yaw."""
        return self.pitch, self.roll, self.yaw

    @property
    def turns(self) -> bool:
        """Return whether the base does not only sway, so that its motion has no mean attitude."""
        return any(part is not None for part in (self.vertical, self.table, self.path))

    def added_angles(self, t: Scalar) -> tuple[AngleRates | None, ...]:
        """Return what is added to pitch, roll and yaw of the sways at a time (s); None: nothing."""
        return _add_yaw(
            (None,) * 3 if self.path is None else self.path.at(t),
            None if self.vertical is None else self.vertical.at(t),
        )


def attitude(motion: Motion, t: Scalar) -> Quat:
    """Return the true attitude, body to navigation frame, at time t (s)."""
    angles = [sway.angle(t) for sway in motion.angles]
    for axis, added in enumerate(motion.added_angles(t)):
        if added is not None:
            angles[axis] = angles[axis] + added.angle
    q = from_euler(*angles)
    if motion.table is None:
        return q
    half = 0.5 * motion.table.at(t).angle
    zero = jnp.zeros_like(half)
    return multiply(q, Quat(jnp.cos(half), zero, zero, jnp.sin(half)))


def rate_and_force(motion: Motion, place: Place, t: Scalar) -> tuple[Vec3, Vec3]:
    """Angular rate of b relative to inertial space (rad/s) and specific force (m/s^2), both in b.

    w_nb^b follows from the Euler rates: the yaw rate resolved through pitch and roll, the pitch
    rate through roll. The centre of the sway has no velocity.
    """
    angles = [sway.angle(t) for sway in motion.angles]
    rates = [sway.rate(t) for sway in motion.angles]
    bends = [sway.acceleration(t) for sway in motion.angles]
    for axis, added in enumerate(motion.added_angles(t)):
        if added is not None:
            angles[axis] = angles[axis] + added.angle
            rates[axis] = rates[axis] + added.rate
            bends[axis] = bends[axis] + added.acceleration
    now = Sines(*map(sin_cos, angles))
    table = None if motion.table is None else motion.table.at(t)
    body = _motion_in_body(place, motion.lever, now, EulerRates(*rates), EulerRates(*bends), table)
    return _rate_and_force_in_body(place, body)


def _add_yaw(
    angles: tuple[AngleRates | None, ...], turn: AngleRates | None
) -> tuple[AngleRates | None, ...]:
    """Return pitch, roll and yaw with a turn about the vertical."""
    pitch, roll, yaw = angles
    if turn is None or yaw is None:
        return pitch, roll, turn if yaw is None else yaw
    return pitch, roll, AngleRates(*map(jnp.add, yaw, turn))


class Sines(NamedTuple):
    """Sine and cosine of each Euler angle."""

    pitch: tuple[Scalar, Scalar]
    roll: tuple[Scalar, Scalar]
    yaw: tuple[Scalar, Scalar]


class EulerRates(NamedTuple):
    """Time derivative of each Euler angle, rad/s; or the second one, rad/s^2."""

    pitch: Scalar
    roll: Scalar
    yaw: Scalar


class Axes(NamedTuple):
    """Unit vectors of n, in b; or their means over a sample."""

    east: Vec3
    north: Vec3
    up: Vec3


class InBody(NamedTuple):
    """The motion of the sensors in the body frame, before Earth rate and gravity are applied.

    Attributes:
        axes: of n.
        rate: angular rate of b relative to the Earth, in b, rad/s.
        force: specific force apart from gravity, in b, m/s^2; None without a lever arm.
    """

    axes: Axes
    rate: Vec3
    force: Vec3 | None


def _motion_in_body(
    place: Place,
    lever: Vec3 | None,
    now: Sines,
    rates: EulerRates,
    bends: EulerRates,
    table: AngleRates | None = None,
) -> InBody:
    """Return the motion at an attitude from the first two derivatives of its Euler angles.

    Args:
        place: Earth rates.
        lever: from the centre of the sway to the sensors, in b, m; None where they are in it.
        now: Euler angles of the vehicle.
        rates: their first derivatives.
        bends: their second derivatives.
        table: angle of b in the vehicle, about the z axis of both; None without a turntable.
    """
    axes, rate = axes_in_body(now), _rate_in_body(now, rates)
    swing = rate
    if table is not None:
        sines = sin_cos(table.angle)
        axes, swing = Axes(*(_on_table(sines, axis) for axis in axes)), _on_table(sines, rate)
        rate = swing._replace(z=swing.z + table.rate)
    if lever is None:
        return InBody(axes, rate, None)
    turning = Sines(
        *((cos * w, -sin * w) for (sin, cos), w in zip(now, rates, strict=True))
    )  # derivatives of the sines
    _, bend = jax.jvp(_rate_in_body, (now, rates), (turning, bends))
    if table is not None:
        across = Vec3(table.rate * swing.y, -table.rate * swing.x, table.acceleration)
        bend = add(_on_table(sines, bend), across)
    velocity = cross(rate, lever)
    earth = add(scale(2 * place.rate_n, axes.north), scale(2 * place.rate_u, axes.up))
    force = add(cross(bend, lever), cross(add(rate, earth), velocity))
    east, north = dot(axes.east, velocity), dot(axes.north, velocity)
    return InBody(axes, add(rate, transport_rate(place, axes, east, north)), force)


def _on_table(sines: tuple[Scalar, Scalar], a: Vec3) -> Vec3:
    """Return a vector of the vehicle in the axes of a body turned about its z axis."""
    sin, cos = sines
    return Vec3(cos * a.x + sin * a.y, cos * a.y - sin * a.x, a.z)


def _rate_in_body(now: Sines, rates: EulerRates) -> Vec3:
    """Return w_nb^b from the Euler rates."""
    (sp, cp), (sr, cr), _ = now
    across = rates.yaw * cp
    return Vec3(
        rates.pitch * cr - across * sr,
        rates.roll + rates.yaw * sp,
        rates.pitch * sr + across * cr,
    )


def axes_in_body(now: Sines) -> Axes:
    """Return the axes of n in b: the rows of C_b^n."""
    (sp, cp), (sr, cr), (sy, cy) = now
    tilted, leaning = cy * sp, sy * sp
    return Axes(
        east=Vec3(cy * cr - leaning * sr, -sy * cp, cy * sr + leaning * cr),
        north=Vec3(sy * cr + tilted * sr, cy * cp, sy * sr - tilted * cr),
        up=Vec3(-cp * sr, sp, cp * cr),
    )


def transport_rate(place: Place, axes: Axes, east: Scalar, north: Scalar) -> Vec3:
    """Return the rate of n over the Earth at a velocity (m/s), in b, rad/s."""
    about_up = east * place.curvature_e * place.tan_latitude
    level = add(
        scale(-north * place.curvature_n, axes.east), scale(east * place.curvature_e, axes.north)
    )
    return add(level, scale(about_up, axes.up))


def _rate_and_force_in_body(place: Place, body: InBody) -> tuple[Vec3, Vec3]:
    """Angular rate w_ib (rad/s) and specific force (m/s^2) in b.

    Both are linear in ``body``: the mean over a time gives the mean rate and force.
    """
    earth = add(scale(place.rate_n, body.axes.north), scale(place.rate_u, body.axes.up))
    gravity = scale(place.gravity, body.axes.up)
    force = gravity if body.force is None else add(gravity, body.force)
    return add(earth, body.rate), force


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


def integration_nodes(motion: Motion, rate_hz: Scalar) -> Nodes:
    """Return the phase advances from mid-sample to the Gauss nodes, for samples at ``rate_hz``."""

    def advance(sway: Sway, node: Scalar) -> Advance:
        sin, cos = sin_cos(0.5 * jnp.pi * node / (sway.period * rate_hz))
        return Advance(2 * sin * cos, -2 * sin * sin)

    return Nodes(*(jax.vmap(partial(advance, sway))(jnp.asarray(_NODES)) for sway in motion.angles))


class IdealSample(NamedTuple):
    """Increments of ideal sensors over a sample, and the axes of n meanwhile.

    Attributes:
        increments: rad and m/s, in b.
        axes: of n in b, mean over the sample; None where nobody asks for them.
    """

    increments: Increments
    axes: Axes | None


def ideal_sample(
    motion: Motion, ahead: Nodes, place: Place, rate_hz: Scalar, k: Scalar
) -> IdealSample:
    """Ideal sensor increments over one sample, by Gauss quadrature.

    Angles and rates at the nodes follow from those at mid-sample by the angle-sum formulas, because
    full sines dominate the cost. The remaining sines are of the change of an angle within half a
    sample: where it exceeds 1 rad they lose accuracy, and so does the quadrature.

    Args:
        motion: motion of the base.
        ahead: its phase advances at this sample rate, see `integration_nodes`.
        place: Earth rates and gravity.
        rate_hz: sample rate, Hz.
        k: number of the sample, which spans k/rate to (k+1)/rate.
    """
    middle = (k + 0.5) / rate_hz
    added_at, table = _added_in_sample(motion, rate_hz, k)
    waves = []
    for sway, turn in zip(motion.angles, added_at(0.0), strict=True):
        sin, cos = (sway.amplitude * part for part in sway.phase_at(middle))
        angle = sway.center + sin if turn is None else sway.center + sin + turn.angle
        waves.append((sin, cos, 2 * jnp.pi / sway.period, sin_cos(angle), turn))

    def at_pair(ahead: Nodes, node: Any) -> InBody:
        sides = []
        for side in (-1.0, 1.0):
            sines, rates, bends = [], [], []
            added = added_at(side * node) if motion.turns else (None,) * 3
            for (sin, cos, omega, here, turn), advance, there in zip(
                waves, ahead, added, strict=True
            ):
                later, versed = side * advance.sin, advance.versed
                change = sin * versed + cos * later
                rate = omega * (cos + (cos * versed - sin * later))
                bend = -omega * omega * (sin + change)
                if turn is not None and there is not None:
                    change = change + (there.angle - turn.angle)
                    rate, bend = rate + there.rate, bend + there.acceleration
                sines.append(_sin_cos_of_sum(here, sin_cos_near_zero(change)))
                rates.append(rate)
                bends.append(bend)
            sides.append(
                _motion_in_body(
                    place,
                    motion.lever,
                    Sines(*sines),
                    EulerRates(*rates),
                    EulerRates(*bends),
                    None if table is None else table.at(side * node, rate_hz),
                )
            )
        return jax.tree.map(jnp.add, *sides)

    # Mapped rather than unrolled: half the code to compile.
    pairs = jax.vmap(at_pair)(ahead, jnp.asarray(_NODES) if motion.turns else None)
    # A matrix product or a sum over an axis would become a loop that is not vectorised.
    mean = jax.tree.map(lambda a: sum(w * a[i] for i, w in enumerate(_WEIGHTS)), pairs)
    increments = Increments(
        *(scale(1 / rate_hz, part) for part in _rate_and_force_in_body(place, mean))
    )
    return IdealSample(increments, mean.axes)


def _added_in_sample(
    motion: Motion, rate_hz: Scalar, k: Scalar
) -> tuple[Callable[[Scalar], tuple[AngleRates | None, ...]], SampleTurn | None]:
    """Return `Motion.added_angles` of a node of sample k, and the turn of the table during it."""
    vertical, table = (
        None if turns is None else turns.of_sample(rate_hz, k)
        for turns in (motion.vertical, motion.table)
    )

    def added(node: Scalar) -> tuple[AngleRates | None, ...]:
        time = (k + (0.5 + 0.5 * node)) / rate_hz
        return _add_yaw(
            (None,) * 3 if motion.path is None else motion.path.at(time),
            None if vertical is None else vertical.at(node, rate_hz),
        )

    return added, table


def increment(motion: Motion, ahead: Nodes, place: Place, rate_hz: Scalar, k: Scalar) -> Increments:
    """Return the increments of `ideal_sample`: angles (rad) and velocities (m/s) in b."""
    return ideal_sample(motion, ahead, place, rate_hz, k).increments


def _sin_cos_of_sum(a: tuple[Scalar, Scalar], b: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
    """Sine and cosine of a sum of angles, from those of each."""
    return a[0] * b[1] + a[1] * b[0], a[1] * b[1] - a[0] * b[0]


def ideal_increments(
    motion: Motion, place: Place, rate_hz: Scalar, samples: int, first: Scalar = 0.0
) -> Array:
    """Ideal sensor increments of samples from ``first`` on, (samples, 6), see `ideal_sample`."""
    return _increment_rows(motion, place, rate_hz, samples, first, with_axes=False)


def ideal_increments_and_axes(
    motion: Motion, place: Place, rate_hz: Scalar, samples: int, first: Scalar = 0.0
) -> Array:
    """Increments of samples from number ``first`` on, and the axes meanwhile, (samples, 15)."""
    return _increment_rows(motion, place, rate_hz, samples, first, with_axes=True)


def _increment_rows(
    motion: Motion, place: Place, rate_hz: Scalar, samples: int, first: Scalar, *, with_axes: bool
) -> Array:
    """Return rows of samples, computed in two or more batches of equal size.

    A shorter last batch, or a single one whose loop the compiler removes, would give other bits.
    """
    batches = max(2, -(-samples // _BATCH))
    numbers = first + jnp.arange(batches * _BATCH, dtype=float)
    ahead = integration_nodes(motion, rate_hz)

    def row(k: Scalar) -> Array:
        made = ideal_sample(motion, ahead, place, rate_hz, k)
        return jnp.stack(jax.tree.leaves(made if with_axes else made.increments))

    return jax.lax.map(row, numbers, batch_size=_BATCH)[:samples]
