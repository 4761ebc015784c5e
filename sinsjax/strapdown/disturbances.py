"""What moves the base and drifts the sensors at random, from sample to sample.

Surge and vibration move the base: they are part of what ideal sensors measure. Bias instability and
random walks are errors of the sensors, and so is what their digits leave out. All of it runs with a
draw's samples, from the first one of its record, and is shared by its variants.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.maths.algebra import add, cross, scale
from sinsjax.strapdown import processes
from sinsjax.strapdown.base_motion import Sensed, transport
from sinsjax.strapdown.earth import Place
from sinsjax.types import Array, Count, Increments, Scalar, Vec3


class Disturbances(NamedTuple):
    """Processes of a draw, or a state, or numbers for each of them; None for what there is not.

    Attributes:
        surge: velocity of the base in n, m/s.
        gyro_instability: mean bias over a sample, rad/s.
        accel_instability: likewise, m/s^2.
        gyro_walk: likewise, rad/s.
        accel_walk: likewise, m/s^2.
        shaking: velocity of the box in b, m/s.
        rocking: angle of the box in b, rad.
    """

    surge: Any = None
    gyro_instability: Any = None
    accel_instability: Any = None
    gyro_walk: Any = None
    accel_walk: Any = None
    shaking: Any = None
    rocking: Any = None


_TRIADS = Disturbances(0, 2, 3, 4, 5, 6, 7)
"""The triad of driving numbers that each takes, whatever others there are."""


class Disturbed(NamedTuple):
    """What disturbances do over a sample; None for what there is not.

    Attributes:
        before: velocity of the base at the sample's beginning, in n, m/s.
        after: at its end.
        rocked: change of the box's angle, in b, rad.
        shaken: change of its velocity, in b, m/s.
        gyro_drift: angle that the gyros drift, in b, rad.
        accel_drift: velocity that the accelerometers drift, in b, m/s.
    """

    before: Vec3 | None
    after: Vec3 | None
    rocked: Vec3 | None
    shaken: Vec3 | None
    gyro_drift: Vec3 | None
    accel_drift: Vec3 | None


def driving(
    disturbances: Disturbances, seed: Count, draw_id: Array, samples: Array
) -> Disturbances:
    """What drives the processes of one draw or of many, leaves (n, *draws), see `processes`."""
    made = processes.driving(seed, draw_id, samples, _triads(disturbances))
    return Disturbances(*(made.get(triad) for triad in _TRIADS))


def begin(disturbances: Disturbances, seed: Count, draw_id: Count) -> Disturbances:
    """The states of one draw's processes before its first sample."""
    made = processes.beginning(seed, draw_id, _triads(disturbances))
    normal = Disturbances(*(made.get(triad) for triad in _TRIADS))
    return _each(processes.begin, disturbances, normal)


def _triads(disturbances: Disturbances) -> tuple[int, ...]:
    return tuple(t for t, one in zip(_TRIADS, disturbances, strict=True) if one is not None)


def advance(
    disturbances: Disturbances, states: Disturbances, normal: Disturbances, dt: Scalar
) -> tuple[Disturbances, Disturbed]:
    """One sample of one draw: the states after it, and what happened meanwhile."""
    later = _each(processes.advance, disturbances, states, normal)
    begins = _each(processes.output, disturbances, states)
    ends = _each(processes.output, disturbances, later)
    means = _each(processes.output, disturbances, states, normal)
    return later, Disturbed(
        begins.surge,
        ends.surge,
        _change(begins.rocking, ends.rocking),
        _change(begins.shaking, ends.shaking),
        _drift(means.gyro_instability, means.gyro_walk, dt),
        _drift(means.accel_instability, means.accel_walk, dt),
    )


def _each(function: Callable[..., Any], *trees: Disturbances) -> Disturbances:
    """A function of each process there is, and of what belongs to it."""
    rows = zip(*trees, strict=True)
    return Disturbances(*(None if row[0] is None else function(*row) for row in rows))


def _change(before: Vec3 | None, after: Vec3 | None) -> Vec3 | None:
    if before is None or after is None:
        return None
    return add(after, scale(-1.0, before))


def _drift(instability: Vec3 | None, walk: Vec3 | None, dt: Scalar) -> Vec3 | None:
    rate = plus(instability, walk) if instability is not None else walk
    return None if rate is None else scale(dt, rate)


def plus(a: Vec3, b: Vec3 | None) -> Vec3:
    """The sum of a vector and one that there may not be."""
    return a if b is None else add(a, b)


def moved(sensed: Sensed, disturbed: Disturbed, place: Place, dt: Scalar) -> Increments:
    """What ideal sensors measure on a base that surges and a box that vibrates.

    Velocities and angles change evenly over the sample: the acceleration of the surge and the
    Coriolis acceleration of its mean velocity are integrated as the axes turn, and n turns over
    the Earth.

    Args:
        sensed: on the swaying base, with the mean axes of n in b.
        disturbed: what happens over the sample.
        place: Earth rates and curvatures.
        dt: sample time, s.
    """
    dtheta, dv = sensed.increments
    if disturbed.before is not None and disturbed.after is not None:
        assert sensed.axes is not None
        axes, before, after = sensed.axes, disturbed.before, disturbed.after
        mean = scale(0.5, add(before, after))
        rate = Vec3(jnp.zeros_like(mean.x), 2 * place.rate_n, 2 * place.rate_u)
        change = plus(scale(dt, cross(rate, mean)), _change(before, after))
        level = add(scale(change.x, axes.east), scale(change.y, axes.north))
        dv = add(dv, add(level, scale(change.z, axes.up)))
        dtheta = add(dtheta, scale(dt, transport(place, axes, mean.x, mean.y)))
    return Increments(plus(dtheta, disturbed.rocked), plus(dv, disturbed.shaken))


def drifted(measured: Increments, disturbed: Disturbed) -> Increments:
    """Measured increments with the drifts of the biases."""
    return Increments(
        plus(measured.dtheta, disturbed.gyro_drift), plus(measured.dv, disturbed.accel_drift)
    )
