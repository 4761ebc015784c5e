"""Repeated passes over a stored record, forward and backward in turn, [P2] section 2.3.

A backward pass is navigation in an environment where time is reversed: the samples come last to
first and reversed (`sensors.reverse`), the Earth turns the other way, velocity has the opposite
sign. Method and mechanisation are the same in both directions; what happens to a method's state at
a direction reversal is its own affair (`Method.turn`).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.alignment.base import Site
from sinsjax.strapdown import earth, sensors
from sinsjax.types import Array, Count, Flag, Increments, Sample


class PassReading(NamedTuple):
    """How one record interval reads the stored record.

    Attributes:
        samples: (n,) numbers in the record, in the order in which they are read. Backward they run
            one ahead of what is navigated, as a sample is compensated with the one before it; -1
            stands for what is before the record.
        backward: whether it belongs to a backward pass; None of a run that has none.
        opens_pass: whether it is the first of a pass other than the first.
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


def where(flag: Flag, one: Any, other: Any) -> Any:
    """One of two trees of the same structure."""
    return jax.tree.map(lambda a, b: jnp.where(flag, a, b), one, other)
