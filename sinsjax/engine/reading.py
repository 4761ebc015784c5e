"""How a draw's record is read in passes, and how its body turns meanwhile."""

from collections.abc import Callable

import jax.numpy as jnp

from sinsjax.engine import measurements
from sinsjax.engine.measurements import Read
from sinsjax.engine.realisations import Draw, Environment, Static, method_of
from sinsjax.methods import passes
from sinsjax.methods.passes import BodyTurn, PassReading
from sinsjax.types import Count, Sample


def nothing_read(static: Static, environment: Environment, draw: Draw) -> Read:
    """Before the first sample of a draw, see `measurements.nothing_read`."""
    nothing = measurements.nothing_read(environment, draw)
    if not static.winds_back:
        return nothing
    zero = jnp.zeros((), environment.dtype)
    turn = passes.no_turn(zero, biased=passes.estimates_gyro_bias(method_of(static)))
    return nothing._replace(turn=turn)


def turned_on(static: Static, turn: BodyTurn | None, samples: Sample) -> BodyTurn | None:
    """How the body has turned after further samples, leaves (n, ...)."""
    return None if turn is None else passes.turned_on(turn, samples, static.options.dt)


def reading(static: Static, environment: Environment, number: Count) -> PassReading:
    """Which samples of the stored record a record interval reads, and in which direction."""
    every = static.record_every
    if static.repeats:
        read = passes.reading_forward if static.rewinds else passes.reading
        return read(number, environment.pass_records, every)
    return PassReading(number * every + jnp.arange(every))


def as_pass_begins(
    static: Static, read: PassReading, before: Read, nothing: Callable[[], Read]
) -> Read:
    """What was read as a record interval begins: nothing where that begins the record."""
    return passes.where(read.opens_pass, nothing(), before) if static.rewinds else before
