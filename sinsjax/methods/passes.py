"""Repeated passes over a stored record: forward and backward in turn, or forward every time.

A backward pass, [P2] section 2.3, is navigation in an environment where time is reversed: the
samples are read last to first and reversed (`sensors.reverse_sample`), the Earth rotates the other
way, and velocity has the opposite sign. Method and mechanisation are the same in both directions;
the method decides what becomes of its state at a direction reversal (`Passes.reverse`).

To read the record forward again, the attitude is propagated back to its beginning, by the rotation
that the gyros measured and that of the Earth; the method decides what it keeps (`Passes.rewind`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import add, scale, select_tree
from sinsjax.methods.method import Program, Site
from sinsjax.strapdown import earth, sensors
from sinsjax.strapdown.earth import Place
from sinsjax.types import Array, Count, Flag, Increments, Quat, Sample, Scalar, Vec3


class PassReading(NamedTuple):
    """The samples that one record interval reads.

    Their (n,) numbers in the record are in the order in which they are read. Backward they are one
    ahead of navigation, since a sample is compensated with the one before it; -1 is before the
    record.
    """

    samples: Array
    backward: Flag | None = None  # whether the pass is backward; None if all are forward
    opens_pass: Flag | None = None  # whether it opens the second or a later pass; None of one pass


def read_interval(passes: str, interval: Count, pass_intervals: Count, every: int) -> PassReading:
    """Return the samples of an interval, from 0, of a record read as `ProgramSpec.passes` says."""
    if passes == "once":
        return PassReading(interval * every + jnp.arange(every))
    number, place = interval // pass_intervals, interval % pass_intervals
    opens_pass = (place == 0) & (number > 0)
    if passes == "rewind":
        return PassReading(place * every + jnp.arange(every), opens_pass=opens_pass)
    backward = number % 2 == 1
    first = jnp.where(backward, (pass_intervals - place) * every - 2, place * every)
    samples = first + jnp.where(backward, -1, 1) * jnp.arange(every)
    return PassReading(samples, backward, opens_pass)


def site_of_pass(site: Site, backward: Flag | None) -> Site:
    """Return the site, with the Earth rotating the other way in a backward pass."""
    if backward is None:
        return site
    sign = jnp.where(backward, -1.0, 1.0)
    reversed_ = site.earth._replace(rate=sign * site.earth.rate)
    return site._replace(earth=reversed_, place=earth.reverse_rotation(site.place, sign))


def compensate(now: Increments, before: Increments, backward: Flag | None) -> Sample:
    """Return the compensated sample in the direction of the pass: ``now``, backward ``before``."""
    if backward is None:
        return sensors.compensate_sample(now, before)
    later, earlier = select_tree(backward, (before, now), (now, before))
    sample = sensors.compensate_sample(later, earlier)
    return select_tree(backward, sensors.reverse_sample(sample), sample)


class BodyRotation(NamedTuple):
    """The rotation of the body in inertial space since the beginning of the record, b0.

    ``axes_s`` are time integrals of the body's axes in b0, s: a constant gyro bias has rotated the
    product by their sum, weighted with the bias. None if no bias is estimated.
    """

    measured: Quat  # C_b^{b0}, the product of the samples' rotations
    axes_s: tuple[Vec3, ...] | None


def initial_rotation(program: Program, zero: Array) -> BodyRotation:
    """Return the rotation at the beginning of the record, of the shape of a zero."""
    estimates_bias = program.passes is not None and program.passes.gyro_bias is not None
    none = (Vec3(zero, zero, zero),) * 3
    return BodyRotation(Quat(zero + 1, zero, zero, zero), none if estimates_bias else None)


def accumulate_rotation(rotation: BodyRotation, samples: Sample, dt: Scalar) -> BodyRotation:
    """Return the rotation, leaves (...), after further compensated samples, leaves (n, ...)."""

    def over_sample(so_far: BodyRotation, turn: Quat) -> tuple[BodyRotation, None]:
        measured = rotations.multiply(so_far.measured, turn)
        if so_far.axes_s is None:
            return BodyRotation(measured, None), None
        axes = zip(so_far.axes_s, zip(*rotations.matrix(measured), strict=True), strict=True)
        axes_s = tuple(add(total, scale(dt, Vec3(*axis))) for total, axis in axes)
        return BodyRotation(measured, axes_s), None

    return jax.lax.scan(over_sample, rotation, samples.turn)[0]


def rewind_attitude(
    q: Quat, rotation: BodyRotation, place: Place, time: Scalar, bias: Vec3 | None
) -> Quat:
    """Return the attitude at the beginning of the record from that at a later time.

    C(0) = exp(w_ie t x) C(t) C_b^{b0}' of a base that does not travel, with the estimated gyro bias
    (in b, rad/s; None if none is estimated) removed from the measured rotation to first order; the
    second order of its angle over the record is 1e-9 rad for 0.1 deg/h over 100 s.
    """
    earth_turn = Vec3(jnp.zeros_like(place.rate_n), place.rate_n * time, place.rate_u * time)
    q = rotations.multiply(rotations.exp(earth_turn), q)
    q = rotations.multiply(q, rotations.conjugate(rotation.measured))
    if bias is not None and rotation.axes_s is not None:
        x, y, z = (scale(rate, axis) for rate, axis in zip(bias, rotation.axes_s, strict=True))
        q = rotations.multiply(q, rotations.exp(add(add(x, y), z)))
    return rotations.normalise(q)
