"""Random motion of the base and random drifts of the sensors, from sample to sample.

Surge moves the base and vibration the housing of the sensors (`housing`): they are part of what
ideal sensors measure. Bias instability and random walks are errors of the sensors, and so is what
their digits leave out. All of it runs with a draw's samples, from the first one of its record, and
is shared by its variants.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.maths.algebra import add, cross, scale
from sinsjax.strapdown import processes
from sinsjax.strapdown.base_motion import IdealSample, transport_rate
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.housing import HousingMotion
from sinsjax.types import Array, Count, Increments, Scalar, Vec3


class Disturbances(NamedTuple):
    """The processes of a draw, or a state or numbers for each; None for those that are absent.

    Attributes:
        surge: velocity of the base in n, m/s.
        gyro_instability: mean bias over a sample, rad/s.
        accel_instability: likewise, m/s^2.
        gyro_walk: likewise, rad/s.
        accel_walk: likewise, m/s^2.
        shaking: velocity of the housing along the axes of the base, m/s.
        rocking: rotation vector from the base to the housing, rad.
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


class SampleDisturbance(NamedTuple):
    """The effect of disturbances over a sample; None for those that are absent.

    Attributes:
        before: velocity of the base at the sample's beginning, in n, m/s.
        after: at its end.
        housing: motion of the housing at the sample's end.
        gyro_drift: angle that the gyros drift, in b, rad.
        accel_drift: velocity that the accelerometers drift, in b, m/s.
    """

    before: Vec3 | None
    after: Vec3 | None
    housing: HousingMotion | None
    gyro_drift: Vec3 | None
    accel_drift: Vec3 | None


def driving_noise(
    disturbances: Disturbances, seed: Count, draw_id: Array, samples: Array
) -> Disturbances:
    """Return the driving noise of one draw or of many, leaves (n, *draws), see `processes`."""
    return _by_process(processes.driving_noise(seed, draw_id, samples, _triads(disturbances)))


def initial_states(disturbances: Disturbances, seed: Count, draw_id: Count) -> Disturbances:
    """Return the states of one draw's processes before its first sample."""
    normal = processes.standard_normals_for_initial_states(seed, draw_id, _triads(disturbances))
    return _map_present(processes.initial_state, disturbances, _by_process(normal))


def _triads(disturbances: Disturbances) -> tuple[int, ...]:
    return tuple(t for t, one in zip(_TRIADS, disturbances, strict=True) if one is not None)


def _by_process(by_triad: dict[int, Any]) -> Disturbances:
    return Disturbances(*map(by_triad.get, _TRIADS))


def advance_processes(
    disturbances: Disturbances, states: Disturbances, normal: Disturbances, dt: Scalar
) -> tuple[Disturbances, SampleDisturbance]:
    """Return the states of one draw one sample later, and the disturbance over the sample."""
    later = _map_present(processes.advance_process, disturbances, states, normal)
    begins = _map_present(processes.process_output, disturbances, states)
    ends = _map_present(processes.process_output, disturbances, later)
    means = _map_present(processes.process_output, disturbances, states, normal)
    gyro = _add_optional(means.gyro_instability, means.gyro_walk)
    accel = _add_optional(means.accel_instability, means.accel_walk)
    drifts = (rate and scale(dt, rate) for rate in (gyro, accel))
    housing = housing_motion(disturbances, later)
    return later, SampleDisturbance(begins.surge, ends.surge, housing, *drifts)


def housing_motion(disturbances: Disturbances, states: Disturbances) -> HousingMotion | None:
    """Return the motion of the housing in some states of one draw; None if it does not vibrate."""
    shaking, rocking = disturbances.shaking, disturbances.rocking
    if shaking is None and rocking is None:
        return None
    rate = rocking and rocking._replace(output=rocking.derivative)
    rows = (rocking, states.rocking), (rate, states.rocking), (shaking, states.shaking)
    return HousingMotion(*(one and processes.process_output(one, state) for one, state in rows))


def _map_present(function: Callable[..., Any], *trees: Disturbances) -> Disturbances:
    """Apply a function to each process that is present, with its entries of other trees."""
    rows = zip(*trees, strict=True)
    return Disturbances(*(None if row[0] is None else function(*row) for row in rows))


def _add_optional(a: Any, b: Any) -> Any:
    """Return the sum of two vectors of which either may be None, for zero."""
    return a if b is None else b if a is None else add(a, b)


def add_surge(
    sensed: IdealSample, disturbed: SampleDisturbance, place: Place, dt: Scalar
) -> Increments:
    """Return the increments of ideal sensors on a base that surges, from those of one that sways.

    The velocity changes evenly over the sample of ``dt`` s: the acceleration of the surge and the
    Coriolis acceleration of its mean velocity are integrated as the axes turn, and n turns over the
    Earth.
    """
    dtheta, dv = sensed.increments
    before, after, axes = disturbed.before, disturbed.after, sensed.axes
    if before is None or after is None:
        return Increments(dtheta, dv)
    assert axes is not None
    mean = scale(0.5, add(before, after))
    rate = Vec3(jnp.zeros_like(mean.x), 2 * place.rate_n, 2 * place.rate_u)
    change = add(scale(dt, cross(rate, mean)), add(after, scale(-1.0, before)))
    level = add(scale(change.x, axes.east), scale(change.y, axes.north))
    dv = add(dv, add(level, scale(change.z, axes.up)))
    dtheta = add(dtheta, scale(dt, transport_rate(place, axes, mean.x, mean.y)))
    return Increments(dtheta, dv)


def add_drifts(measured: Increments, disturbed: SampleDisturbance) -> Increments:
    """Return measured increments with the drifts of the biases."""
    drifts = disturbed.gyro_drift, disturbed.accel_drift
    return Increments(*map(_add_optional, measured, drifts))
