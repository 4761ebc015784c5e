"""The vibrating housing of the sensors: one rigid body on the base.

The housing is turned by a rotation vector a against the base, C_h^n = C_b^n exp(a x), and moves
along the axes of the base. Gyros, accelerometers, lever arm and the true attitude of a run are
those of the housing.

Vibration is too fast for two samples to show its coning: at 30 Hz it has a third of a cycle within
a sample of 100 Hz. Inertial units therefore integrate coning and sculling inside, at 1 kHz and
more, before they give out increments (P. G. Savage, "Strapdown Inertial Navigation Integration
Algorithm Design", Journal of Guidance, Control, and Dynamics 21, 1998, parts 1 and 2). So does the
simulated unit: it gives out the increments from which the rule of `sensors.compensate_sample`
restores the rotation of the housing over the sample, to rounding, and the velocity that the
specific force adds, to the fourth order of the angle of a sample. How the housing moves between
two samples does not matter.
"""

from typing import NamedTuple

from sinsjax.maths.algebra import add, cross, dot, scale
from sinsjax.maths.rotations import conjugate, exp_of_sample, log_of_sample, multiply, rotate
from sinsjax.strapdown.base_motion import Axes, IdealSample, transport_rate
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.sensors import compensate_sample
from sinsjax.types import Increments, Quat, Scalar, Vec3


class HousingMotion(NamedTuple):
    """The motion of the housing relative to the base at one time; None for what is absent.

    Attributes:
        angle: rotation vector a from the base to the housing, rad.
        rate: its time derivative, rad/s.
        velocity: along the axes of the base, m/s.
    """

    angle: Vec3 | None
    rate: Vec3 | None
    velocity: Vec3 | None


class HousingState(NamedTuple):
    """The housing between two samples.

    Attributes:
        turn: rotation from the housing to the base; None if it does not rotate.
        velocity: of the sensors over that of a rigid base at their place, in b, m/s; None if the
            housing rotates about the sensors and does not move.
        base: increments of sensors on the rigid base over the sample before; None like ``turn``.
        sensed: increments that the sensors gave for it; likewise.
    """

    turn: Quat | None
    velocity: Vec3 | None
    base: Increments | None
    sensed: Increments | None


def start_housing(
    motion: HousingMotion, lever: Vec3 | None, base_rate: Vec3, none: Increments
) -> HousingState:
    """Return the housing before the first sample.

    Args:
        motion: at that time.
        lever: from the centre of the sway to the sensors, in b, m; None if they are there or the
            housing does not rotate.
        base_rate: angular rate of the base, in b, rad/s.
        none: zeros, for the samples before.
    """
    if motion.angle is None:
        return HousingState(None, motion.velocity, None, None)
    turn = exp_of_sample(motion.angle)
    return HousingState(turn, _velocity_over_rigid_base(motion, turn, lever, base_rate), none, none)


def vibrate_housing(
    state: HousingState,
    sensed: IdealSample,
    motion: HousingMotion,
    lever: Vec3 | None,
    place: Place,
    dt: Scalar,
) -> tuple[HousingState, Increments]:
    """Return the housing one sample later, and the increments of ideal sensors in it.

    Args:
        state: before the sample.
        sensed: at the sensors on the rigid base; with axes if a housing with a lever arm rotates.
        motion: of the housing at the end of the sample.
        lever: see `start_housing`.
        place: Earth rates and curvatures.
        dt: sample time, s.
    """
    base, before = sensed.increments, state.velocity
    if motion.angle is None:
        assert before and motion.velocity
        mean = scale(0.5, add(before, motion.velocity))
        # Third-order terms are left out: 5e-5 m/s in 900 s at 1 g of vibration on a swaying base.
        moved = add(add(motion.velocity, scale(-1.0, before)), cross(base.dtheta, mean))
        shaken = base._replace(dv=add(base.dv, moved))
        return state._replace(velocity=motion.velocity), shaken
    assert state.turn and state.base and state.sensed
    turn = exp_of_sample(motion.angle)
    velocity = _velocity_over_rigid_base(motion, turn, lever, scale(1 / dt, base.dtheta))
    if lever is not None:
        assert velocity and before and sensed.axes
        base = _add_transport_and_coriolis(
            base, scale(0.5, add(velocity, before)), sensed.axes, place, dt
        )
    rotation, added = compensate_sample(base, state.base)
    if velocity and before:
        added = add(added, add(rotate(rotation, velocity), scale(-1.0, before)))
    back = conjugate(state.turn)
    rotation, added = multiply(back, multiply(rotation, turn)), rotate(back, added)
    increments = _uncompensated_increments(log_of_sample(rotation), added, state.sensed)
    return HousingState(turn, velocity, base, increments), increments


def _add_transport_and_coriolis(
    base: Increments, velocity: Vec3, axes: Axes, place: Place, dt: Scalar
) -> Increments:
    """Return increments with the transport rate and the Coriolis acceleration of a mean velocity.

    Without a lever arm the velocity is too small for either: 3e-7 m/s in 900 s at 5,000 ug.
    """
    east, north = dot(axes.east, velocity), dot(axes.north, velocity)
    earth = add(scale(2 * place.rate_n, axes.north), scale(2 * place.rate_u, axes.up))
    return Increments(
        add(base.dtheta, scale(dt, transport_rate(place, axes, east, north))),
        add(base.dv, scale(dt, cross(earth, velocity))),
    )


def _velocity_over_rigid_base(
    motion: HousingMotion, turn: Quat, lever: Vec3 | None, base_rate: Vec3
) -> Vec3 | None:
    """Return the velocity of the sensors over that of a rigid base, in b, m/s; None if zero.

    The sensors are at R(a) l from the centre of the sway. That vector changes by the cross product
    with the rate of the housing, a' + a x a'/2 + a x (a x a')/6, and the base carries it.
    """
    if lever is None:
        return motion.velocity
    assert motion.angle and motion.rate
    place = rotate(turn, lever)
    bend = cross(motion.angle, motion.rate)
    rate = add(motion.rate, add(scale(0.5, bend), scale(1 / 6, cross(motion.angle, bend))))
    carried = cross(base_rate, add(place, scale(-1.0, lever)))
    swung = add(cross(rate, place), carried)
    return swung if motion.velocity is None else add(swung, motion.velocity)


def _uncompensated_increments(angle: Vec3, velocity: Vec3, before: Increments) -> Increments:
    """Return the increments from which `sensors.compensate_sample` gives a rotation and a velocity.

    ``angle`` is the rotation vector over the sample, rad; ``velocity`` is added over it, in the
    axes at its beginning, m/s; ``before`` are the increments of the sample before.
    """
    earlier = scale(1 / 12, before.dtheta)
    theta = _solve_with_cross(earlier, angle)
    half = add(scale(0.5, theta), earlier)
    rest = add(velocity, scale(1 / 12, cross(theta, before.dv)))
    # Without the double product first; it is small, and so is what it changes of itself.
    dv = _solve_with_cross(half, rest)
    double = scale(-1 / 6, cross(theta, cross(theta, dv)))
    return Increments(theta, add(dv, add(double, cross(double, half))))


def _solve_with_cross(a: Vec3, b: Vec3) -> Vec3:
    """Return the x of x + a x x = b."""
    total = add(b, add(scale(-1.0, cross(a, b)), scale(dot(a, b), a)))
    return scale(1 / (1 + dot(a, a)), total)
