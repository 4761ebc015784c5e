"""Repeated passes over a stored record: forward and backward in turn, or forward every time.

A backward pass, [P2] section 2.3, is navigation in an environment where time is reversed: the
samples come last to first and reversed (`sensors.reverse`), the Earth turns the other way, velocity
has the opposite sign. Method and mechanisation are the same in both directions; what happens to a
method's state at a direction reversal is its own affair (`Method.turn`).

To read the record forward again, the attitude is wound back to its beginning: by the turns that the
gyros measured, and by the turn of the Earth. What a method keeps is its own affair again
(`Method.rewind`).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import add, scale
from sinsjax.methods.base import Method, Site
from sinsjax.strapdown import earth, sensors
from sinsjax.strapdown.earth import Place
from sinsjax.types import Array, Count, Flag, Increments, Quat, Sample, Scalar, Vec3


class PassReading(NamedTuple):
    """How one record interval reads the stored record.

    Attributes:
        samples: (n,) numbers in the record, in the order in which they are read. Backward they run
            one ahead of what is navigated, as a sample is compensated with the one before it; -1
            stands for what is before the record.
        backward: whether it belongs to a backward pass; None of a run that has none.
        opens_pass: whether it is the first of a pass other than the first; None of a run that has
            one pass.
    """

    samples: Array
    backward: Flag | None = None
    opens_pass: Flag | None = None


def reading(record: Count, pass_records: Count, every: int) -> PassReading:
    """How the stored record is read in a record interval of repeated passes.

    Args:
        record: its number, from 0.
        pass_records: record intervals a pass.
        every: samples a record interval.
    """
    number, place = record // pass_records, record % pass_records
    backward = number % 2 == 1
    ahead = jnp.arange(every)
    first = jnp.where(backward, (pass_records - place) * every - 2, place * every)
    samples = first + jnp.where(backward, -ahead, ahead)
    return PassReading(samples, backward, (place == 0) & (number > 0))


def reading_forward(record: Count, pass_records: Count, every: int) -> PassReading:
    """`reading` of a record that is read forward in every pass."""
    place = record % pass_records
    samples = place * every + jnp.arange(every)
    return PassReading(samples, opens_pass=(place == 0) & (record > 0))


def site_of_pass(site: Site, backward: Flag | None) -> Site:
    """The site, with the Earth turning the other way in a backward pass."""
    if backward is None:
        return site
    sign = jnp.where(backward, -1.0, 1.0)
    turned = site.earth._replace(rate=sign * site.earth.rate)
    return site._replace(earth=turned, place=earth.reverse(site.place, sign))


def compensate(now: Increments, before: Increments, backward: Flag | None) -> Sample:
    """The compensated sample in the direction of the pass: forward ``now``, backward ``before``."""
    if backward is None:
        return sensors.compensate(now, before)
    later = where(backward, before, now)
    earlier = where(backward, now, before)
    sample = sensors.compensate(later, earlier)
    return where(backward, sensors.reverse(sample), sample)


def estimates_gyro_bias(method: Method) -> bool:
    """Return whether a method estimates gyro biases, which are removed from a stored record."""
    return method.passes is not None and method.passes.gyro_bias is not None


class BodyTurn(NamedTuple):
    """How the body has turned in inertial space since the beginning of the record, b0.

    Attributes:
        measured: C_b^{b0}, the product of the samples' turns.
        axes_s: the body's axes seen in b0, each integrated over time, s: a constant gyro bias has
            turned the product by their sum, weighted with it. None where no bias is estimated.
    """

    measured: Quat
    axes_s: tuple[Vec3, Vec3, Vec3] | None


def no_turn(zero: Array, *, biased: bool) -> BodyTurn:
    """At the beginning of the record, in zeros of the shape given; whether a bias is estimated."""
    none = Vec3(zero, zero, zero)
    return BodyTurn(Quat(zero + 1, zero, zero, zero), (none, none, none) if biased else None)


def turned_on(so_far: BodyTurn, samples: Sample, dt: Scalar) -> BodyTurn:
    """The turn after further samples.

    Args:
        so_far: before them, leaves (...).
        samples: compensated, leaves (n, ...).
        dt: sample time, s.
    """

    def over(turn: BodyTurn, sample: Quat) -> tuple[BodyTurn, None]:
        measured = rotations.multiply(turn.measured, sample)
        if turn.axes_s is None:
            return BodyTurn(measured, None), None
        now = rotations.matrix(measured)
        x, y, z = (
            add(total, scale(dt, Vec3(*(row[axis] for row in now))))
            for axis, total in enumerate(turn.axes_s)
        )
        return BodyTurn(measured, (x, y, z)), None

    return jax.lax.scan(over, so_far, samples.turn)[0]


def wound_back(q: Quat, turn: BodyTurn, place: Place, time: Scalar, bias: Vec3 | None) -> Quat:
    """The attitude at the beginning of the record that has led to one at a later time.

    C(0) = exp(w_ie t x) C(t) C_b^{b0}' of a base that does not travel, with the measured turn freed
    from the gyro bias to first order: what is left is of the second order in its angle over the
    record, 1e-9 rad for 0.1 deg/h over 100 s.

    Args:
        q: attitude at the later time.
        turn: since the beginning.
        place: Earth rates.
        time: since the beginning, s.
        bias: estimated gyro bias in b, rad/s; None where none is estimated.
    """
    earth_turn = Vec3(jnp.zeros_like(place.rate_n), place.rate_n * time, place.rate_u * time)
    q = rotations.multiply(rotations.exp(earth_turn), q)
    q = rotations.multiply(q, rotations.conjugate(turn.measured))
    if bias is not None and turn.axes_s is not None:
        x, y, z = (scale(rate, axis) for rate, axis in zip(bias, turn.axes_s, strict=True))
        q = rotations.multiply(q, rotations.exp(add(add(x, y), z)))
    return rotations.normalise(q)


def where(flag: Flag, one: Any, other: Any) -> Any:
    """One of two trees of the same structure."""
    return jax.tree.map(lambda a, b: jnp.where(flag, a, b), one, other)
