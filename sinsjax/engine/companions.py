"""The linear error of given draws beside the noise-free run of each variant.

What a draw's sensors measure beyond noise-free ones drives the error d of the corrected solution in
closed loop (`alignment.error_growth`). The run itself and its transition, gains and attitude are
those of the variant, common to its draws: a companion costs a part of a run. Its misalignment is
close to that of the run with the same noise, and its expectation is known: a control variate.
"""

from collections.abc import Iterator
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.alignment import passes
from sinsjax.alignment.error_growth import driven
from sinsjax.alignment.schedules import mix
from sinsjax.engine import simulate, tile
from sinsjax.engine.batch import MOST_PROGRAMS, Program
from sinsjax.engine.covariance import over_bands, record_times
from sinsjax.engine.lanes import Group, Tiles
from sinsjax.engine.measurements import Read, look_back
from sinsjax.engine.pieces import measurer, piece
from sinsjax.engine.realisations import Draw, Environment, Static, method_of
from sinsjax.engine.sensitivity import limits_beyond, sensitivity, starts_beyond
from sinsjax.engine.simulate import Run
from sinsjax.engine.stepping import event_by_event, sample_by_sample
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.types import Array, Count, Increments, Sample, Scalar


class Companions(NamedTuple):
    """Of the variants in the lanes of a tile and of its draws.

    Attributes:
        phi: (3, records, lanes, draws) misalignment, noise-free run and linear error, rad.
        outside_until: (2, B, lanes, draws) as `Metrics.outside_until`.
    """

    phi: Array
    outside_until: Array


class Accompanied(NamedTuple):
    """A noise-free run, and the errors of its draws.

    Attributes:
        inner: state of the method.
        errors: d, n arrays (draws,).
    """

    inner: Any
    errors: tuple[Array, ...]


class Block(NamedTuple):
    """How many variants and draws a call of companions has: the rest is idle.

    Their errors, of some states each, stay in the first-level cache.
    """

    variants: int
    draws: int


FEW_VARIANTS = Block(8, 64)
"""For many draws, which share the noise-free run of their variant."""

FEW_DRAWS = Block(64, 8)


def of_group(group: Group) -> Iterator[tuple[np.ndarray, np.ndarray, Companions]]:
    """The companions of all runs of a group, call by call.

    Yields:
        Places of some variants and of some draws, and the companions, leaves (..., variants,
        draws).
    """
    draws, variants = group.sizes
    width, height = FEW_VARIANTS
    for first in range(0, variants, width):
        some = np.arange(first, min(first + width, variants))
        for begin in range(0, draws, height):
            taken = np.arange(begin, min(begin + height, draws))
            yield some, taken, of_block(group, some, taken)


def of_block(
    group: Group,
    variants: np.ndarray,
    draws: np.ndarray,
    records: np.ndarray | None = None,
    size: Block = FEW_VARIANTS,
) -> Companions:
    """The companions of some variants and draws of a group, in one call.

    Args:
        group: whose.
        variants: places in the group.
        draws: places in the group.
        records: numbers, from 0, of the records whose misalignment is told; None for all.
        size: the most variants and draws of a call.
    """
    call = program(group, records, size).compiled()
    made = jax.device_get(call(*_arguments(group, variants, draws, records, size)))
    # Idle lanes and draws are at the end.
    phi, outside = (a[..., : len(variants), : len(draws)] for a in made)
    return Companions(phi, outside)


def program(group: Group, records: np.ndarray | None = None, size: Block = FEW_VARIANTS) -> Program:
    """The program of `of_block`, whichever the block."""
    none = np.zeros(1, int)
    leaves, structure = jax.tree.flatten(_arguments(group, none, none, records, size))
    shapes = tuple(jax.ShapeDtypeStruct(np.shape(a), np.asarray(a).dtype) for a in leaves)
    return _trace(group.static, structure, shapes)


@lru_cache(maxsize=MOST_PROGRAMS)
def _trace(static: Static, structure: Any, shapes: tuple) -> Program:
    def call(
        environment: Environment, tile_: Tiles, draws: Draw, records: Array | None
    ) -> Companions:
        phi, outside = companions(static, environment, tile_, draws)
        return Companions(phi if records is None else phi[:, records], outside)

    return Program(jax.jit(call).lower(*jax.tree.unflatten(structure, shapes)))


def _arguments(
    group: Group,
    variants: np.ndarray,
    draws: np.ndarray,
    records: np.ndarray | None,
    size: Block,
) -> tuple[Environment, Tiles, Draw, np.ndarray | None]:
    """Of a call, filled up with the last variant and the last draw."""
    lanes = np.pad(variants, (0, size.variants - len(variants)), mode="edge")
    taken = np.pad(draws, (0, size.draws - len(draws)), mode="edge")
    return group.environment, _tile(group, lanes), _some(group.draws, taken), records


def _some(draws: Draw, places: np.ndarray) -> Draw:
    taken: Draw = jax.tree.map(lambda a: a[places] if np.ndim(a) else a, draws)
    return taken


def _tile(group: Group, variants: np.ndarray) -> Tiles:
    """Some variants in the lanes of a tile of one draw, the group's first."""
    drawn = group.environment.drawn
    first = group.draws if drawn is None else drawn.mean(group.draws)
    first = jax.tree.map(lambda a: a[:1] if np.ndim(a) else np.full(1, a), first)
    params = jax.tree.map(lambda a: np.asarray(a)[variants], group.variants)
    q = np.broadcast_to(group.q[0], (len(variants), 4)).T
    row = np.zeros(len(variants), np.int32)
    return Tiles(first, row, params._replace(q=type(group.variants.q)(*q)))


def companions(
    static: Static, environment: Environment, variants: Tiles, draws: Draw
) -> Companions:
    """The companions of some draws for each variant of a tile.

    Args:
        static: program of the runs.
        environment: shared by all.
        variants: a single tile, of one draw.
        draws: leaves (draws,), or () for what is the same for all.
    """
    quiet = static._replace(noisy=False)
    setup = tile.set_up(quiet, environment, variants)
    runs = jax.vmap(partial(simulate.begin, quiet, environment), in_axes=(setup.site_axis, 0))(
        setup.site, setup.params
    )
    method, count = method_of(quiet), draws.draw_id.size
    assert method.error_angles is not None
    none = jnp.zeros((setup.row.size, count))
    errors = (none,) * len(jax.vmap(method.error_angles)(runs.state)[0])
    floor = setup.limit.phi.z[:, None]
    drawn = sensitivity(quiet, environment, variants.params, setup.site, setup.site_axis)
    if drawn is not None and environment.drawn is not None:
        errors = tuple(jnp.moveaxis(drawn.start @ starts_beyond(environment.drawn, draws), 1, 0))
        floor = floor + limits_beyond(drawn, environment.drawn, draws)
    reads = (
        tile.nothing_read(quiet, _undisturbed(environment), setup.draws),
        tile.nothing_read(static, environment, draws),
    )
    over = partial(_over_record, (quiet, static), environment, setup, draws)
    begun = runs._replace(state=Accompanied(runs.state, errors)), reads
    _, phi = jax.lax.scan(over, begun, jnp.arange(static.records))
    return _judged(static, environment, phi, floor)


def _over_record(
    programs: tuple[Static, Static],
    environment: Environment,
    setup: tile.TileSetup,
    draws: Draw,
    under_way: tuple[Run, tuple[Read, Read]],
    number: Count,
) -> tuple[tuple[Run, tuple[Read, Read]], Array]:
    """One record interval, and the misalignments at its end, (3, lanes, draws)."""
    quiet, noisy = programs
    (runs, before), method = under_way, method_of(quiet)
    done = number * quiet.record_every
    samples = done + jnp.arange(quiet.record_every)
    size = piece(quiet, draws)
    make = _maker(
        measurer(quiet, _undisturbed(environment), setup.draws, samples),
        measurer(noisy, environment, draws, samples),
        size,
    )
    over_lanes = jax.vmap(partial(_step, quiet), in_axes=(0, setup.site_axis, 0, None, None))
    close_loop = jax.vmap(partial(simulate.close_loop, quiet), in_axes=(0, 0, None))

    def n(place: Count) -> Scalar:
        return (done + place).astype(environment.dtype)

    def take(state: Accompanied, place: Count, made: tuple[Sample, Increments]) -> Accompanied:
        return over_lanes(setup.params, setup.site, state, made, n(place + 1))

    def close(state: Accompanied, place: Count) -> Accompanied:
        return state._replace(inner=close_loop(setup.params, state.inner, n(place)))

    def due(state: Accompanied, place: Count) -> Scalar | None:
        if method.next_event is None:
            return None
        ahead = jax.vmap(method.next_event, in_axes=(0, 0, None))
        first = ahead(setup.params.method, state.inner, n(place))
        return None if first is None else jnp.min(first) - done.astype(environment.dtype)

    going = runs.state, before, quiet.record_every, take, close, make, size
    if due(runs.state, jnp.asarray(0)) is None:
        state, before = sample_by_sample(*going)
    else:
        state, before = event_by_event(*going, next_event=due)
    inner = tile.observe(
        quiet, environment, setup, Run(state.inner, runs.metrics), number, q_true=None
    )
    assert method.error_angles is not None
    angles = jax.vmap(method.error_angles)(inner.state)
    phi = jnp.stack(
        [
            mean[:, None] + sum(a[:, None] * d for a, d in zip(row, state.errors, strict=True))
            for mean, row in zip(inner.metrics.last.phi, angles, strict=True)
        ]
    )
    return (inner._replace(state=state._replace(inner=inner.state)), before), phi


def _step(
    static: Static,
    params: simulate.RunParams,
    site: Any,
    state: Accompanied,
    made: tuple[Sample, Increments],
    n: Scalar,
) -> Accompanied:
    """The run of one lane and the errors of all draws after the ``n``-th sample."""
    method, (sample, excess) = method_of(static), made
    assert method.error_step is not None
    given = params.method, site, state.inner, sample, n
    moved = partial(driven, method.error_step(*given), state.inner.nav.q)
    errors = jax.vmap(moved)(excess, state.errors)
    return Accompanied(method.step(*given), errors)


def _maker(quiet: Any, noisy: Any, size: int) -> Any:
    """See `stepping.Make`: the sample without noise, and what each draw measures beyond it."""
    compensate = jax.vmap(partial(passes.compensate, backward=None))

    def make(before: tuple[Read, Read], number: Count) -> Any:
        places = number * size + jnp.arange(size)
        without, later = quiet(before[0], places)
        with_, own_later = noisy(before[1], places)
        excess = jax.tree.map(jnp.subtract, with_, without)
        now = jax.tree.map(lambda a: a[:, 0], without)
        earlier, last = look_back(now, jax.tree.map(lambda a: a[0], before[0].last))
        last = jax.tree.map(lambda a: a[None], last)
        return (compensate(now, earlier), excess), (later._replace(last=last), own_later)

    return make


def _undisturbed(environment: Environment) -> Environment:
    """What runs share on a base and with sensors that nothing disturbs."""
    errors = environment.errors._replace(gyro_quantum=None, accel_quantum=None)
    return environment._replace(errors=errors, disturbances=Disturbances())


def _judged(static: Static, environment: Environment, phi: Array, floor: Array) -> Companions:
    """Settling of misalignments (records, 3, lanes, draws) from limits (lanes, draws or 1)."""
    criteria = environment.criteria

    def over(outside: Array, record: tuple[Scalar, Array]) -> tuple[Array, None]:
        time, error = record
        now = [over_bands(criteria, error - floor), over_bands(criteria, error)]
        return mix(jnp.stack(now), time, outside), None

    outside = jnp.zeros((2, len(criteria.bands), *phi.shape[2:]))
    outside, _ = jax.lax.scan(over, outside, (record_times(static), phi[:, 2]))
    return Companions(jnp.moveaxis(phi, 0, 1), outside)
