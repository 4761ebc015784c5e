"""Samples of a tile's draws, made some at a time.

Few draws alone would not fill a vector, and the samples of a whole record interval of many draws
would not stay in the first-level cache. Numbers of all draws and samples of a piece are made in one
row wherever that is faster.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from sinsjax.engine.measurements import (
    Ahead,
    Read,
    driving,
    following,
    from_rows,
    ideal,
    in_turn,
    integrated,
    look_back,
    noise,
    nothing_read,
    read_back,
)
from sinsjax.engine.reading import turned_on
from sinsjax.engine.realisations import Draw, Environment, Static
from sinsjax.engine.stepping import Make
from sinsjax.methods import passes
from sinsjax.methods.passes import PassReading
from sinsjax.strapdown.base_motion import Sensed
from sinsjax.types import Array, Count, Increments, Sample

SAMPLES_A_PIECE = 64
"""Samples times draws that are made at a time: fewer leave the vector units idle, more leave the
first-level cache."""


def piece(static: Static, draws: Draw) -> int:
    """Samples that are made at a time; a record interval is cut into equal pieces."""
    every = static.record_every
    most = SAMPLES_A_PIECE // draws.draw_id.size
    return max(n for n in range(1, max(1, min(most, every)) + 1) if every % n == 0)


def axes_of(draws: Draw) -> Any:
    """The axis of draws in each leaf, for `jax.vmap`; None for what is the same for all."""
    return jax.tree.map(lambda a: 0 if jnp.ndim(a) else None, draws)


def maker(
    static: Static,
    environment: Environment,
    draws: Draw,
    read: PassReading,
    record: Increments | None = None,
) -> Make:
    """The function that makes a piece of the samples of a record interval.

    Args:
        static: program.
        environment: shared by all.
        draws: of the tile, with what follows from them.
        read: how the interval is read.
        record: what is read where it is kept, leaves (samples, draws).

    Returns:
        See `stepping.Make`; samples with leaves (samples, draws).
    """
    size = piece(static, draws)
    measure = measurer(static, environment, draws, read.samples)
    compensate = jax.vmap(jax.vmap(partial(passes.compensate, backward=read.backward)))

    def make(before: Read, number: Count) -> tuple[Sample, Read]:
        places = number * size + jnp.arange(size)
        if record is None:
            now, later = measure(before, places)
        else:
            now, later = read_back(static, record, read.samples[places]), before
        earlier, last = look_back(now, before.last)
        samples = compensate(now, earlier)
        return samples, later._replace(last=last, turn=turned_on(static, before.turn, samples))

    return make


def measurer(
    static: Static, environment: Environment, draws: Draw, samples: Array
) -> Callable[[Read, Array], tuple[Increments, Read]]:
    """The function that measures some samples in a row, for all draws of a tile.

    Args:
        static: program.
        environment: shared by all.
        draws: of the tile, with what follows from them.
        samples: numbers of which it takes some, by their places.

    Returns:
        (what was read before n samples, (n,) places) -> measured increments, leaves (n, draws),
        and what is read then.
    """
    shared = integrated(static, environment, draws, samples)
    own = None if draws.made.nodes is None else 0  # axis of what is made ahead for each draw
    step = jax.vmap(
        partial(following, static, environment), in_axes=(axes_of(draws), 0, None, 0, own, 0)
    )

    def measure(before: Read, places: Array) -> tuple[Increments, Read]:
        numbers = samples[places]
        exact = swayed(static, environment, draws, numbers)
        if shared is not None:
            exact = jax.tree.map(lambda a: a[places], shared)
        ahead = Ahead(
            numbers,
            noise(static, environment, draws, numbers),
            exact,
            driving(environment, draws, numbers),
        )
        return in_turn(environment, draws, partial(step, draws), before, ahead)

    return measure


def record_of(static: Static, environment: Environment, draws: Draw) -> Increments:
    """Measured increments of the records that the draws of a tile keep, leaves (samples, draws)."""
    size = piece(static, draws)
    measure = measurer(static, environment, draws, jnp.arange(static.kept))

    def some(before: Read, number: Count) -> tuple[Read, Array]:
        now, before = measure(before, number * size + jnp.arange(size))
        # One array: several XLA would copy with every piece.
        return before, jnp.stack(jax.tree.leaves(now), axis=1)

    before = jax.vmap(partial(nothing_read, environment), in_axes=(axes_of(draws),))(draws)
    _, rows = jax.lax.scan(some, before, jnp.arange(static.kept // size))
    return from_rows(rows.reshape(static.kept, *rows.shape[2:]))


def swayed(static: Static, environment: Environment, draws: Draw, numbers: Array) -> Sensed | None:
    """What ideal sensors measure on the swaying bases of draws over n samples, (n, draws).

    None where draws have no such base. Samples of all draws are made in one row.
    """
    if draws.made.nodes is None:
        return None
    shape = (numbers.size, draws.draw_id.size)

    def repeated(a: Array) -> Array:
        return jnp.tile(a, (len(numbers), *(1 for _ in a.shape[1:]))) if jnp.ndim(a) else a

    row = jax.vmap(partial(ideal, static, environment), in_axes=(axes_of(draws), 0))(
        jax.tree.map(repeated, draws), jnp.repeat(numbers, shape[1])
    )
    return jax.tree.map(lambda a: a.reshape(shape), row)
