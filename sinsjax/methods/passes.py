"""Repeated passes over a stored record, forward and backward in turn.

A backward pass, [P2] section 2.3, is navigation in an environment where time is reversed: the
samples are read last to first and reversed (`sensors.reverse_sample`), the Earth rotates the other
way, and velocity has the opposite sign. Method and mechanisation are the same in both directions;
the method decides what becomes of its state at a direction reversal (`Passes.reverse`).

Fine alignment that replays the data of coarse alignment starts from an attitude that is propagated
back to the beginning, by the rotation that the gyros measured and that of the Earth.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import select_tree
from sinsjax.methods.method import Site
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
    backward: Flag | None = None  # whether the pass is backward; None of a record read once
    opens_pass: Flag | None = None  # whether it opens the second or a later pass; likewise


def read_interval(interval: Count, pass_intervals: Count | None, every: int) -> PassReading:
    """Return the samples of an interval, from 0; of a record read once if no pass has a length."""
    if pass_intervals is None:
        return PassReading(interval * every + jnp.arange(every))
    number, place = interval // pass_intervals, interval % pass_intervals
    opens_pass = (place == 0) & (number > 0)
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


def accumulate_rotation(rotation: Quat, samples: Sample) -> Quat:
    """Return C_b^{b0}, leaves (...), after further compensated samples, leaves (n, ...)."""

    def over_sample(so_far: Quat, turn: Quat) -> tuple[Quat, None]:
        return rotations.multiply(so_far, turn), None

    return jax.lax.scan(over_sample, rotation, samples.turn)[0]


def rewind_attitude(q: Quat, rotation: Quat, place: Place, time: Scalar) -> Quat:
    """Return the attitude at the beginning of the record from that at a later time, s.

    C(0) = exp(w_ie t x) C(t) C_b^{b0}' of a base that does not travel, with the rotation C_b^{b0}
    of the body since then.
    """
    earth_turn = Vec3(jnp.zeros_like(place.rate_n), place.rate_n * time, place.rate_u * time)
    q = rotations.multiply(rotations.exp(earth_turn), q)
    return rotations.normalise(rotations.multiply(q, rotations.conjugate(rotation)))
