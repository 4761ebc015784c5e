"""Measured increments of draws: what is made ahead for many samples, and one after the other."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.engine.realisations import (
    Draw,
    Environment,
    Static,
    disturbances_of,
    errors_of,
    quantised,
    site_of,
)
from sinsjax.methods import passes
from sinsjax.methods.passes import BodyTurn
from sinsjax.strapdown import base_motion, disturbances, sensors
from sinsjax.strapdown.base_motion import Sensed
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.types import Array, Count, Increments, Vec3


class Read(NamedTuple):
    """What those samples of a draw that were read leave for those to come.

    Attributes:
        last: the last increments measured, which compensation looks back at.
        states: of the processes that disturb the draw.
        left: what quantisation has left of the integrals; None without.
        turn: how the body has turned since the record began; None where nothing is wound back.
    """

    last: Increments
    states: Disturbances
    left: Increments | None
    turn: BodyTurn | None = None


def nothing_read(environment: Environment, draw: Draw) -> Read:
    """Before the first sample of a draw: with zeros to look back at nothing is compensated."""
    zero = jnp.zeros((), environment.dtype)
    zeros = Increments(Vec3(zero, zero, zero), Vec3(zero, zero, zero))
    them = disturbances_of(environment, draw)
    states = disturbances.begin(them, environment.seed, draw.draw_id)
    return Read(zeros, states, zeros if quantised(environment, draw) else None)


def noise(
    static: Static, environment: Environment, draw: Draw, numbers: Array
) -> Increments | None:
    """Standard normal numbers for n samples, None if no sensor has noise.

    Leaves (n,); (n, draws) for the ids of several draws, whose numbers are made together.
    """
    return sensors.noise(environment.seed, draw.draw_id, numbers) if static.noisy else None


SAMPLES_A_CALL = 1000
"""Samples whose ideal increments are made at a time where none are stored."""


def integrated(
    static: Static, environment: Environment, draw: Draw, numbers: Array
) -> Sensed | None:
    """What ideal sensors measure over n samples of the base that all draws share, leaves (n,).

    None where they are stored, or where the draw has a base of its own.
    """
    if environment.increments is not None or draw.motion is not None:
        return None
    assert environment.motion is not None
    motion, place, rate = environment.motion, environment.site.place, 1 / static.options.dt
    at = partial(base_motion.sensed, motion, base_motion.nodes(motion, rate), place, rate)
    k = jnp.asarray(numbers, environment.dtype)
    return (
        jax.vmap(at)(k)
        if k.size <= SAMPLES_A_CALL
        else jax.lax.map(at, k, batch_size=SAMPLES_A_CALL)
    )


def ideal(static: Static, environment: Environment, draw: Draw, n: Count) -> Sensed:
    """What ideal sensors measure over sample ``n``: stored, or of the draw's own base."""
    if draw.made.rest is not None:
        return draw.made.rest
    if draw.motion is None:
        place = draw.start + n
        stored = sensors.split(jnp.asarray(environment.increments)[place])
        if environment.axes is None:
            return Sensed(stored, None)
        row = jnp.asarray(environment.axes)[place]
        return Sensed(stored, base_motion.Axes(*(Vec3(*row[3 * i :][:3]) for i in range(3))))
    assert draw.made.nodes is not None
    place = site_of(environment, draw).place
    k = jnp.asarray(n, environment.dtype)
    return base_motion.sensed(draw.motion, draw.made.nodes, place, 1 / static.options.dt, k)


class Ahead(NamedTuple):
    """What is made ahead for n samples, before those on which they hang are known; leaves (n, ...).

    Attributes:
        numbers: of the samples; negative before the record.
        normal: see `noise`.
        exact: see `ideal`; None where it is yet to be found.
        driving: see `driving`.
    """

    numbers: Array
    normal: Increments | None
    exact: Sensed | None
    driving: Disturbances


def following(
    static: Static,
    environment: Environment,
    draw: Draw,
    before: Read,
    n: Count,
    normal: Increments | None,
    exact: Sensed | None,
    driving: Disturbances,
) -> tuple[Read, Increments]:
    """Measured increments of the sample that follows in one draw, and what is read then.

    Zeros before the record: with them nothing is compensated. Arguments as of `Ahead`, for one.
    """
    errors, dt = errors_of(environment, draw), static.options.dt
    exact = ideal(static, environment, draw, n) if exact is None else exact
    states, happened = disturbances.advance(
        disturbances_of(environment, draw), before.states, driving, dt
    )
    moved = disturbances.moved(exact, happened, site_of(environment, draw).place, dt)
    now = sensors.measure(moved, errors, normal, dt, distorted=static.distorted)
    now, left = disturbances.drifted(now, happened), before.left
    if left is not None:
        now, left = sensors.quantise(now, errors, left)
    return before._replace(states=states, left=left), recorded(static, n, now)


def in_turn(
    environment: Environment,
    draw: Draw,
    step: Callable[..., tuple[Read, Increments]],
    before: Read,
    ahead: Ahead,
) -> tuple[Increments, Read]:
    """Measured increments of n samples, one after the other only where they hang on one another.

    Args:
        environment: shared by all.
        draw: one or many.
        step: `following`, of one draw or of many.
        before: what was read before them.
        ahead: of the samples.

    Returns:
        Leaves (n, ...), and what is read then.
    """
    disturbed = jax.tree.leaves(disturbances_of(environment, draw))
    if disturbed or quantised(environment, draw):
        if ahead.numbers.size == 1:  # of many draws, which fill the vectors by themselves
            before, now = step(before, *jax.tree.map(lambda a: a[0], ahead))
            return jax.tree.map(lambda a: a[None], now), before
        before, rows = jax.lax.scan(lambda before, one: as_row(step(before, *one)), before, ahead)
        return from_rows(rows), before
    return jax.vmap(lambda *one: step(before, *one)[1])(*ahead), before


def as_row(one: tuple[Read, Increments]) -> tuple[Read, Array]:
    """The increments of a sample as one array (6, ...): several XLA copies each sample."""
    return one[0], jnp.stack(jax.tree.leaves(one[1]))


def from_rows(rows: Array) -> Increments:
    """Increments with leaves (n, ...) from rows (n, 6, ...)."""
    return sensors.split(jnp.moveaxis(rows, 1, 0))


def recorded(static: Static, n: Count, increments: Increments) -> Increments:
    """Increments of sample ``n`` of a record: zeros before it."""
    if static.rewinds or not static.repeats:
        return increments
    return passes.where(n < 0, jax.tree.map(jnp.zeros_like, increments), increments)


def read_back(static: Static, record: Increments, numbers: Array) -> Increments:
    """Increments of n samples of a kept record, leaves (samples, ...): see `recorded`."""
    return jax.vmap(lambda n: recorded(static, n, jax.tree.map(lambda a: a[n], record)))(numbers)


def driving(environment: Environment, draw: Draw, numbers: Array) -> Disturbances:
    """What drives the disturbances of n samples, leaves (n,); (n, draws) for several draws."""
    them = disturbances_of(environment, draw)
    return disturbances.driving(them, environment.seed, draw.draw_id, numbers)


def measured(
    static: Static, environment: Environment, draw: Draw, before: Read, numbers: Array
) -> tuple[Increments, Read]:
    """Measured increments of n samples of one draw, leaves (n,), and what is read then."""
    ahead = Ahead(
        numbers,
        noise(static, environment, draw, numbers),
        integrated(static, environment, draw, numbers),
        driving(environment, draw, numbers),
    )
    step = partial(following, static, environment, draw)
    return in_turn(environment, draw, step, before, ahead)


def look_back(increments: Increments, before: Increments) -> tuple[Increments, Increments]:
    """What each sample of a row is compensated with: the increments read before it.

    Args:
        increments: of the row, leaves (n, ...).
        before: read before the first of them, leaves (...).

    Returns:
        Leaves (n, ...), and the last of the row, which the next one looks back at.
    """
    shifted = jax.tree.map(lambda a, b: jnp.concatenate([b[None], a[:-1]]), increments, before)
    return shifted, jax.tree.map(lambda a: a[-1], increments)
