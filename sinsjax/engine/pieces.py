"""Samples of a tile's draws, made some at a time.

Few draws alone would not fill a vector, and the samples of a whole record interval of many draws
would not stay in the first-level cache. Numbers of all draws and samples of a piece are made in one
row wherever that is faster.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from sinsjax.alignment import passes
from sinsjax.alignment.passes import PassReading
from sinsjax.engine.realisations import (
    Draw,
    Environment,
    Static,
    ideal,
    integrated,
    measured,
    noise,
)
from sinsjax.engine.simulate import Read, look_back, turned_on
from sinsjax.engine.stepping import Make
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


def maker(static: Static, environment: Environment, draws: Draw, read: PassReading) -> Make:
    """The function that makes a piece of the samples of a record interval.

    Args:
        static: program.
        environment: shared by all.
        draws: of the tile, with what follows from them.
        read: how the interval is read.

    Returns:
        See `stepping.Make`; samples with leaves (samples, draws).
    """
    size = piece(static, draws)
    shared = integrated(static, environment, draws, read.samples)
    own = None if draws.made.nodes is None else 0  # axis of increments made ahead for each draw
    measure = jax.vmap(
        partial(measured, static, environment), in_axes=(axes_of(draws), None, 0, own)
    )
    compensate = jax.vmap(jax.vmap(partial(passes.compensate, backward=read.backward)))

    def make(before: Read, number: Count) -> tuple[Sample, Read]:
        places = number * size + jnp.arange(size)
        numbers = read.samples[places]
        normal = noise(static, environment, draws, numbers)
        exact = swayed(static, environment, draws, numbers)
        if shared is not None:
            exact = jax.tree.map(lambda a: a[places], shared)
        now = jax.vmap(partial(measure, draws))(numbers, normal, exact)
        earlier, last = look_back(now, before.last)
        samples = compensate(now, earlier)
        return samples, Read(last, turned_on(static, before.turn, samples))

    return make


def swayed(
    static: Static, environment: Environment, draws: Draw, numbers: Array
) -> Increments | None:
    """Increments of ideal sensors on the swaying bases of draws over n samples, (n, draws).

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
