"""Accelerometer levelling: pitch and roll of a base at rest from its mean specific force.

On a base at rest the specific force is the reaction to gravity, and its mean f in b points up:

    pitch = atan2(f_front, sqrt(f_right^2 + f_up^2)),    roll = atan2(-f_right, f_up).

The gyros do not enter, so that biases far above the Earth rate leave the level as it is; nothing
shows the heading, and yaw is set to zero. On a base that sways, the result is the mean level.

Constant accelerometer biases b tilt the result by b/g. Noise and vibration add the variance v of
the specific force about its mean, summed over three axes, as if correlated over `CORRELATION_S`:

    sigma^2 = (b/g)^2 + (v/g^2) CORRELATION_S / T    about east and about north, after the time T.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.maths.algebra import add, cross, dot, scale, select_tree
from sinsjax.maths.rotations import from_euler
from sinsjax.methods import method
from sinsjax.methods.floors import BiasFloor, MeanBiases, bias_floor
from sinsjax.strapdown.earth import Place
from sinsjax.types import Flag, Navigation, Quat, Sample, Scalar, Vec3
from sinsjax.value_types import AccelSigma, Section, key_field

CORRELATION_S = 1.0
"""Time over which noise and vibration count as correlated, far above that of white noise, s."""


class LevelSection(Section):
    """[level]: assumption of accelerometer levelling."""

    level_accel_bias_ug: AccelSigma = key_field(
        "accelerometer bias assumed in the 1 sigma of pitch and roll", 5000.0
    )


class LevelState(NamedTuple):
    """A run between two samples."""

    nav: Navigation  # initial solution, whose attitude is the result before the first sample
    bias_tilt: Scalar  # tilt by the assumed accelerometer bias, rad
    sum: Vec3  # of the velocity increments in b, m/s; ``squares`` that of their squared magnitudes
    squares: Scalar
    count: Scalar


def build(options: method.Options) -> method.Program:
    """Return the program, whose params are `LevelState.bias_tilt`."""

    def covariance(state: LevelState) -> method.AttitudeCovariance:
        n = jnp.maximum(state.count, 1.0)
        mean = scale(1 / n, state.sum)
        gravity = jnp.where(state.count > 0, dot(mean, mean), 1.0)  # squared, of one sample
        scatter = jnp.maximum(state.squares / n - dot(mean, mean), 0.0) / gravity
        level = state.bias_tilt**2 + scatter * CORRELATION_S / (n * options.dt)
        zero = jnp.zeros_like(level)
        unknown = zero + method.UNKNOWN_ANGLE
        level = jnp.where(state.count > 0, level, unknown)
        return method.AttitudeCovariance(level, zero, zero, level, zero, unknown)

    return method.Program(_init, _sum_forces, _attitude, covariance=covariance, floor=_bias_floor)


def _init(bias_tilt: Scalar, nav: Navigation) -> LevelState:
    zero = jnp.zeros_like(nav.ve)
    return LevelState(nav, bias_tilt + zero, Vec3(zero, zero, zero), zero, zero)


def _sum_forces(
    params: Any, site: method.Site, state: LevelState, sample: Sample, n: Scalar
) -> LevelState:
    # `Sample.dv` is in b at the start of the sample, carried there over half the rotation that the
    # gyros measured. The same half carries it back to the middle, so that a gyro bias cancels.
    half = Vec3(*sample.turn[1:])  # the vector part of the quaternion, to first order
    dv = add(sample.dv, scale(-1.0, cross(half, sample.dv)))
    return state._replace(
        sum=add(state.sum, dv), squares=state.squares + dot(dv, dv), count=state.count + 1
    )


def _attitude(state: LevelState) -> Quat:
    right, front, up = state.sum
    seen = state.count > 0
    across = jnp.sqrt(jnp.where(seen, right**2 + up**2, 1.0))
    pitch = jnp.arctan2(front, across)
    roll = jnp.arctan2(-right, jnp.where(seen, up, 1.0))
    return select_tree(seen, from_euler(pitch, roll, jnp.zeros_like(pitch)), state.nav.q)


def _bias_floor(
    params: Any, place: Place, biases: MeanBiases, n: Scalar, backward: Flag
) -> BiasFloor:
    floor = bias_floor(place, biases)
    return floor._replace(no_north=jnp.ones_like(floor.no_north))  # no run finds it


LEVEL = method.Method(
    name="level",
    summary="pitch and roll from the mean specific force, for gyros that cannot find north; no"
    " heading",
    source="accelerometer levelling, Groves (2013) section 5.6.2",
    sections={"level": LevelSection},
    build=build,
    params=lambda keys, xp: keys.si("level_accel_bias_ug") / keys.site.place.gravity,
    needs_start=False,
    finds_heading=False,
    step_s=3e-9,
    compile_s=2.5,
)
