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
    made = processes.driving_noise(seed, draw_id, samples, _triads(disturbances))
    return Disturbances(*(made.get(triad) for triad in _TRIADS))


def initial_states(disturbances: Disturbances, seed: Count, draw_id: Count) -> Disturbances:
    """Return the states of one draw's processes before its first sample."""
    made = processes.initial_normal_numbers(seed, draw_id, _triads(disturbances))
    normal = Disturbances(*(made.get(triad) for triad in _TRIADS))
    return _map_present(processes.initial_state, disturbances, normal)


def _triads(disturbances: Disturbances) -> tuple[int, ...]:
    return tuple(t for t, one in zip(_TRIADS, disturbances, strict=True) if one is not None)


def advance_processes(
    disturbances: Disturbances, states: Disturbances, normal: Disturbances, dt: Scalar
) -> tuple[Disturbances, SampleDisturbance]:
    """Return the states of one draw one sample later, and the disturbance over the sample."""
    later = _map_present(processes.advance_process, disturbances, states, normal)
    begins = _map_present(processes.process_output, disturbances, states)
    ends = _map_present(processes.process_output, disturbances, later)
    means = _map_present(processes.process_output, disturbances, states, normal)
    return later, SampleDisturbance(
        begins.surge,
        ends.surge,
        housing_motion(disturbances, later),
        _drift_over_sample(means.gyro_instability, means.gyro_walk, dt),
        _drift_over_sample(means.accel_instability, means.accel_walk, dt),
    )


def housing_motion(disturbances: Disturbances, states: Disturbances) -> HousingMotion | None:
    """Return the motion of the housing in some states of one draw; None if it does not vibrate."""
    shaking, rocking = disturbances.shaking, disturbances.rocking
    if shaking is None and rocking is None:
        return None
    velocity = None if shaking is None else processes.process_output(shaking, states.shaking)
    if rocking is None:
        return HousingMotion(None, None, velocity)
    angle = processes.process_output(rocking, states.rocking)
    return HousingMotion(angle, processes.process_derivative(rocking, states.rocking), velocity)


def _map_present(function: Callable[..., Any], *trees: Disturbances) -> Disturbances:
    """Apply a function to each process that is present, with its entries of other trees."""
    rows = zip(*trees, strict=True)
    return Disturbances(*(None if row[0] is None else function(*row) for row in rows))


def _drift_over_sample(instability: Vec3 | None, walk: Vec3 | None, dt: Scalar) -> Vec3 | None:
    rate = add_optional(instability, walk) if instability is not None else walk
    return None if rate is None else scale(dt, rate)


def add_optional(a: Vec3, b: Vec3 | None) -> Vec3:
    """Return the sum of a vector and an optional one."""
    return a if b is None else add(a, b)


def disturb_motion(
    sensed: IdealSample, disturbed: SampleDisturbance, place: Place, dt: Scalar
) -> Increments:
    """Return the increments of ideal sensors on a base that surges.

    The velocity changes evenly over the sample: the acceleration of the surge and the Coriolis
    acceleration of its mean velocity are integrated as the axes turn, and n turns over the Earth.

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
        change = add(scale(dt, cross(rate, mean)), add(after, scale(-1.0, before)))
        level = add(scale(change.x, axes.east), scale(change.y, axes.north))
        dv = add(dv, add(level, scale(change.z, axes.up)))
        dtheta = add(dtheta, scale(dt, transport_rate(place, axes, mean.x, mean.y)))
    return Increments(dtheta, dv)


def add_drifts(measured: Increments, disturbed: SampleDisturbance) -> Increments:
    """Return measured increments with the drifts of the biases."""
    return Increments(
        add_optional(measured.dtheta, disturbed.gyro_drift),
        add_optional(measured.dv, disturbed.accel_drift),
    )
