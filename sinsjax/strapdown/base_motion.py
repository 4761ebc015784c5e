"""True motion of the base, and the increments that ideal sensors would measure.

The base stays in place, sways about a mean attitude and may be turned or follow given attitudes,
the sensors at a lever arm from the centre of the sway, which the axis of the turns passes through.
Angular rate and specific
force are known in closed form at any time and are integrated over each sample by Gauss quadrature,
so the increments are independent of the mechanisation under test.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.maths.algebra import add, cross, dot, scale
from sinsjax.maths.rotations import from_euler, multiply, sin_cos, sin_cos_near_zero
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.turns import AngleRates, Turns
from sinsjax.types import Array, Increments, Quat, Scalar, Vec3

_COUNT = 6
_NODES, _WEIGHTS = (a[_COUNT // 2 :] for a in np.polynomial.legendre.leggauss(_COUNT))
_WEIGHTS = 0.5 * _WEIGHTS
"""Gauss nodes after mid-sample, in half samples, and their weights in the mean over a sample."""

_BATCH = 1000

SinCos = tuple[Scalar, Scalar]
"""Sine and cosine of an angle."""

ByAngle = tuple[Any, ...]
"""Three values: of pitch, roll and yaw."""


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

    def argument(self, t: Scalar) -> Scalar:
        """Return the argument of the sine at a time (s), rad."""
        return 2 * jnp.pi * t / self.period + self.phase

    def at(self, t: Scalar) -> AngleRates:
        """Return the angle and its derivatives at a time (s)."""
        x, omega = self.argument(t), 2 * jnp.pi / self.period
        sin, cos = jnp.sin(x), jnp.cos(x)
        return AngleRates(
            self.center + self.amplitude * sin,
            self.amplitude * omega * cos,
            -self.amplitude * omega * omega * sin,
        )


class AttitudePath(NamedTuple):
    """Cubic splines of pitch, roll and yaw.

    Attributes:
        time: (n,) knots, s, increasing.
        coefficients: (4, n - 1, 3) of the powers 3 to 0 of the time after each knot but the last,
            rad and s.
    """

    time: Array
    coefficients: Array

    def pitch_roll_yaw_at(self, t: Scalar) -> tuple[AngleRates, AngleRates, AngleRates]:
        """Return pitch, roll and yaw with their derivatives at a time (s)."""
        time, knots = jnp.asarray(self.time), len(self.time)
        place = jnp.clip(jnp.searchsorted(time, t, side="right") - 1, 0, knots - 2)
        s = t - time[place]
        a, b, c, d = jnp.asarray(self.coefficients)[:, place]
        angles = ((a * s + b) * s + c) * s + d
        rates, accelerations = (3 * a * s + 2 * b) * s + c, 6 * a * s + 2 * b
        pitch, roll, yaw = (AngleRates(angles[i], rates[i], accelerations[i]) for i in range(3))
        return pitch, roll, yaw


def attitude_path(time_s: np.ndarray, attitude_deg: np.ndarray) -> AttitudePath:
    """Return the path through pitch, roll and yaw (n, 3), deg, at increasing times (n,), s.

    Jumps by whole turns are removed.
    """
    # Slow to import, and only a file needs it.
    from scipy.interpolate import CubicSpline

    angles = np.unwrap(np.radians(attitude_deg), axis=0)
    return AttitudePath(np.asarray(time_s, float), CubicSpline(time_s, angles).c)


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

    def pitch_roll_yaw_at(self, t: Scalar) -> tuple[AngleRates, ...]:
        """Return pitch, roll and yaw with their derivatives at a time (s)."""
        added = self.added_angles(t, self.vertical and self.vertical.at(t))
        return tuple(sway.at(t).plus(more) for sway, more in zip(self.angles, added, strict=True))

    def added_angles(self, t: Scalar, turn: AngleRates | None) -> tuple[AngleRates | None, ...]:
        """Return what a turn about the vertical and the path at a time (s) add to the sways."""
        if self.path is None:
            return None, None, turn
        pitch, roll, yaw = self.path.pitch_roll_yaw_at(t)
        return pitch, roll, yaw.plus(turn)


def attitude(motion: Motion, t: Scalar) -> Quat:
    """Return the true attitude, body to navigation frame, at time t (s)."""
    q = from_euler(*(angle.angle for angle in motion.pitch_roll_yaw_at(t)))
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
    angles, rates, bends = zip(*motion.pitch_roll_yaw_at(t), strict=True)
    now, table = tuple(map(sin_cos, angles)), motion.table and motion.table.at(t)
    body = _motion_in_body(place, motion.lever, now, rates, bends, table)
    return _rate_and_force_in_body(place, body)


class Axes(NamedTuple):
    """Unit vectors of n, in b; or their means over a sample."""

    east: Vec3
    north: Vec3
    up: Vec3


InBody = tuple[Axes, Vec3, Vec3 | None]
"""The axes of n, the angular rate of b relative to the Earth (rad/s), and the specific force apart
from gravity (m/s^2), in b; None without a lever arm."""


def _motion_in_body(
    place: Place,
    lever: Vec3 | None,
    now: ByAngle,
    rates: ByAngle,
    bends: ByAngle,
    table: AngleRates | None,
) -> InBody:
    """Return the motion at an attitude, for a lever arm (m).

    ``now`` has the `SinCos` of the Euler angles of the vehicle; ``rates`` (rad/s) and ``bends``
    (rad/s^2) are their derivatives. ``table`` turns b in the vehicle, about the z axis of both.
    """
    axes, rate = _axes_in_body(now), _rate_in_body(now, rates)
    swing = rate
    if table is not None:
        sines = sin_cos(table.angle)
        axes, swing = Axes(*(_on_table(sines, axis) for axis in axes)), _on_table(sines, rate)
        rate = swing._replace(z=swing.z + table.rate)
    if lever is None:
        return axes, rate, None
    turning = tuple((cos * w, -sin * w) for (sin, cos), w in zip(now, rates, strict=True))
    _, bend = jax.jvp(_rate_in_body, (now, rates), (turning, bends))
    if table is not None:
        across = Vec3(table.rate * swing.y, -table.rate * swing.x, table.acceleration)
        bend = add(_on_table(sines, bend), across)
    velocity = cross(rate, lever)
    earth = add(scale(2 * place.rate_n, axes.north), scale(2 * place.rate_u, axes.up))
    force = add(cross(bend, lever), cross(add(rate, earth), velocity))
    east, north = dot(axes.east, velocity), dot(axes.north, velocity)
    return axes, add(rate, transport_rate(place, axes, east, north)), force


def _on_table(sines: SinCos, a: Vec3) -> Vec3:
    """Return a vector of the vehicle in the axes of a body turned about its z axis."""
    sin, cos = sines
    return Vec3(cos * a.x + sin * a.y, cos * a.y - sin * a.x, a.z)


def _rate_in_body(now: ByAngle, rates: ByAngle) -> Vec3:
    """Return w_nb^b from the Euler rates."""
    (sp, cp), (sr, cr), _ = now
    pitch, roll, yaw = rates
    across = yaw * cp
    return Vec3(pitch * cr - across * sr, roll + yaw * sp, pitch * sr + across * cr)


def _axes_in_body(now: ByAngle) -> Axes:
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
    axes, rate, force = body
    earth = add(scale(place.rate_n, axes.north), scale(place.rate_u, axes.up))
    gravity = scale(place.gravity, axes.up)
    return add(earth, rate), gravity if force is None else add(gravity, force)


Nodes = tuple[tuple[Array, Array], ...]
"""Phase advance of each `Sway` from mid-sample to the later Gauss nodes, (nodes / 2,): its sine,
whose negative holds at the earlier nodes, and its cosine minus 1. All samples share them."""


def integration_nodes(motion: Motion, rate_hz: Scalar) -> Nodes:
    """Return the phase advances from mid-sample to the Gauss nodes, for samples at ``rate_hz``."""

    def advance(sway: Sway, node: Scalar) -> tuple[Scalar, Scalar]:
        sin, cos = sin_cos(0.5 * jnp.pi * node / (sway.period * rate_hz))
        return 2 * sin * cos, -2 * sin * sin

    return tuple(jax.vmap(partial(advance, sway))(jnp.asarray(_NODES)) for sway in motion.angles)


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
        ahead: its `integration_nodes` at this sample rate.
        place: Earth rates and gravity.
        rate_hz: sample rate, Hz.
        k: number of the sample, which spans k/rate to (k+1)/rate.
    """
    middle = (k + 0.5) / rate_hz
    both = motion.vertical, motion.table
    vertical, table = (turns and turns.at_node_of_sample(rate_hz, k) for turns in both)

    def added_at(node: Scalar) -> tuple[AngleRates | None, ...]:
        time = (k + (0.5 + 0.5 * node)) / rate_hz
        return motion.added_angles(time, vertical and vertical(node))

    waves = []
    for sway, turn in zip(motion.angles, added_at(0.0), strict=True):
        sin, cos = (sway.amplitude * part for part in sin_cos(sway.argument(middle)))
        angle = sway.center + sin if turn is None else sway.center + sin + turn.angle
        waves.append((sin, cos, 2 * jnp.pi / sway.period, sin_cos(angle), turn))

    def at_node(ahead: Nodes, node: Any, sign: float) -> InBody:
        def angle_and_its_derivatives(wave: tuple, advance: Any, added: AngleRates | None) -> tuple:
            sin, cos, omega, here, turn = wave
            later, versed = sign * advance[0], advance[1]
            change = sin * versed + cos * later
            rate = omega * (cos + (cos * versed - sin * later))
            bend = -omega * omega * (sin + change)
            if added is not None:
                change = change + (added.angle - turn.angle)
                rate, bend = rate + added.rate, bend + added.acceleration
            (s, c), (ds, dc) = here, sin_cos_near_zero(change)
            return (s * dc + c * ds, c * dc - s * ds), rate, bend

        added = added_at(sign * node) if motion.turns else (None,) * 3
        now, rates, bends = zip(*map(angle_and_its_derivatives, waves, ahead, added), strict=True)
        turned = table and table(sign * node)
        return _motion_in_body(place, motion.lever, now, rates, bends, turned)

    def at_pair(ahead: Nodes, node: Any) -> InBody:
        return jax.tree.map(jnp.add, *(at_node(ahead, node, sign) for sign in (-1.0, 1.0)))

    # Mapped rather than unrolled: half the code to compile.
    pairs = jax.vmap(at_pair)(ahead, jnp.asarray(_NODES) if motion.turns else None)
    # A matrix product or a sum over an axis would become a loop that is not vectorised.
    mean = jax.tree.map(lambda a: sum(w * a[i] for i, w in enumerate(_WEIGHTS)), pairs)
    integrals = (scale(1 / rate_hz, part) for part in _rate_and_force_in_body(place, mean))
    return IdealSample(Increments(*integrals), mean[0])


def ideal_increments(
    motion: Motion,
    place: Place,
    rate_hz: Scalar,
    samples: int,
    first: Scalar = 0.0,
    *,
    with_axes: bool = False,
) -> Array:
    """Ideal sensor increments of samples from ``first`` on, (samples, 6), see `ideal_sample`.

    With axes they are followed by the `Axes` of n over each sample, (samples, 15).

    They are computed in two or more batches of equal size: a shorter last batch, or a single one
    whose loop the compiler removes, would give other bits.
    """
    batches = max(2, -(-samples // _BATCH))
    numbers = first + jnp.arange(batches * _BATCH, dtype=float)
    ahead = integration_nodes(motion, rate_hz)

    def row(k: Scalar) -> Array:
        made = ideal_sample(motion, ahead, place, rate_hz, k)
        return jnp.stack(jax.tree.leaves(made if with_axes else made.increments))

    return jax.lax.map(row, numbers, batch_size=_BATCH)[:samples]
