"""Many runs in one compiled call.

Runs are numbered draw by draw (`run_id = draw_id * variants + variant_id`) and cut into tiles of
64 lanes. A tile is one vectorised scan whose state stays in the first-level cache; in a call tiles
follow one another under `lax.map`, and each device has a thread that makes calls. Samples are made
once for each distinct draw of a tile and handed to its lanes, so that variants share their noise.

Where the covariance is the same for all runs of a variant (`Method.common_covariance`), tiles of
the same variants and different draws are stacked into sets, which share it: JAX finds by itself
that it does not depend on what the sets are mapped over.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from itertools import chain
from typing import Any, NamedTuple

import jax
import numpy as np

from sinsjax.metrics import Observation, Outcome
from sinsjax.simulate import Draw, Fan, Params, Static, World, method_of, simulate

LANES = 64
"""Runs a tile. Results are bit-equal for any chunk and device count only at one lane count."""

SETS = 8
"""Tiles that share one covariance; as `LANES`, it decides the last bits."""

MOST_IDLE = 1 / 8
"""Share of idle lanes that a draw's last tile may have before another draw is put into it."""

VECTOR = 16
"""Single-precision numbers in the widest vector of a CPU."""


class Group(NamedTuple):
    """Runs that share one compiled program and one world.

    Attributes:
        static: program.
        world: shared by all.
        draws: `Draw` with leaves (draws,), or () for what is the same for all.
        q: (draws, 4) attitude of each draw before the misalignment.
        variants: `Params` with leaves (variants, ...); its ``q`` is ignored.
    """

    static: Static
    world: World
    draws: Draw
    q: np.ndarray
    variants: Params

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of draws and of variants."""
        return len(self.draws.draw_id), len(self.variants.ve)


class Chunk(NamedTuple):
    """Results of consecutive runs of a group.

    Attributes:
        draw: (runs,) place of each run's draw in the group.
        variant: (runs,) place of each run's variant in the group.
        outcome: `Outcome` with leaves (runs, ...).
        curves: `Observation` with leaves (runs, records), or None.
    """

    draw: np.ndarray
    variant: np.ndarray
    outcome: Outcome
    curves: Observation | None


class Lanes(NamedTuple):
    """Which runs the lanes of a call take; leaves (tiles, sets, lanes).

    Attributes:
        draw: place of the draw in the group; beyond its end for idle lanes.
        variant: place of the variant, the same for all sets; beyond its end for idle lanes.
    """

    draw: np.ndarray
    variant: np.ndarray


class Tiles(NamedTuple):
    """Arguments of tiles, with a leading axis of tiles, and of sets where tiles are stacked.

    Attributes:
        draws: `Draw` with leaves (tiles, [sets,] distinct).
        row: (tiles, lanes) which of its tile's draws each lane takes.
        params: `Params` with leaves (tiles, lanes, ...), ``q`` (tiles, [sets,] lanes).
    """

    draws: Draw
    row: np.ndarray
    params: Params


def layout(group: Group, lanes: int = LANES) -> tuple[int, int]:
    """How many tiles share a covariance, and how many lanes a draw takes.

    Stacked tiles need the same variants in the same lanes: there a draw is widened, with idle
    lanes, to whole tiles or to a part of one that leaves no rest. Others are widened to whole
    tiles where few lanes stay idle: a tile of two draws makes the samples of `VECTOR`.
    """
    _, variants = group.sizes
    whole = lanes * -(-variants // lanes)
    if not method_of(group.static).common_covariance:
        few = variants > lanes and whole - variants <= MOST_IDLE * variants
        return 1, whole if few else variants
    if variants > lanes:
        return SETS, whole
    return SETS, next(n for n in range(variants, lanes + 1) if lanes % n == 0)


def distinct_draws(width: int, lanes: int = LANES) -> int:
    """Draws a tile has room for, where each takes ``width`` lanes in a row.

    At least the most that it can hold, in whole vectors: a rest would take as long as another.
    """
    if width % lanes == 0:
        return 1
    if lanes % width == 0:
        return lanes // width
    most = (lanes + width - 2) // width + 1
    return min(lanes, -(-most // VECTOR) * VECTOR)


def plan(
    group: Group, *, devices: int = 1, tiles_a_chunk: int = 32, lanes: int = LANES
) -> Iterator[Lanes]:
    """Lay the runs of a group, in their order, into the lanes of calls of one size.

    What is missing at the end is filled up with idle lanes.

    Args:
        group: what to run.
        devices: that share the calls.
        tiles_a_chunk: the most tiles a call, stacked ones counted singly, if that is more than two
            blocks. A call is never given a single one, whose loop the compiler would unroll to
            other bits.
        lanes: runs a tile.
    """
    draws, _ = group.sizes
    sets, width = layout(group, lanes)
    # What cannot be cut: a tile, or the stacked tiles of a few draws and all variants.
    block = lanes if sets == 1 else sets * max(lanes, width)
    blocks = -(-draws * width // block)
    most = max(2, tiles_a_chunk * lanes // block)
    rounds = -(-blocks // (most * devices))
    size = max(2, -(-blocks // (rounds * devices)))
    for begin in range(0, draws * width, size * block):
        blocks_of_tiles = begin + np.arange(size * block).reshape(size, sets, -1, lanes)
        places = blocks_of_tiles.swapaxes(1, 2).reshape(-1, sets, lanes)
        yield Lanes(places // width, places % width)


def tiles_of(group: Group, places: Lanes) -> Tiles:
    """Arguments for the tiles of one call; idle lanes repeat the last draw or variant."""
    draws, variants = group.sizes
    _, sets, lanes = places.draw.shape
    _, width = layout(group, lanes)
    first = places.draw[..., :1]
    taken = np.minimum(first + np.arange(distinct_draws(width, lanes)), draws - 1)
    variant = np.minimum(places.variant[:, 0], variants - 1)
    q = np.moveaxis(group.q[np.minimum(places.draw, draws - 1)], -1, 0)
    if sets == 1:
        taken, q = taken[:, 0], q[:, :, 0]
    params = jax.tree.map(lambda a: np.asarray(a)[variant], group.variants)
    return Tiles(
        draws=Draw(*(a[taken] if np.ndim(a) else np.full(len(taken), a) for a in group.draws)),
        row=(places.draw - first)[:, 0].astype(np.int32),
        params=params._replace(q=type(group.variants.q)(*q)),
    )


def run_tile(static: Static, world: World, tile: Tiles) -> tuple[Outcome, Observation | None]:
    """All runs of one tile; outcomes with leaves (lanes, ...), curves (records, lanes)."""
    distinct = tile.draws.draw_id.shape[0]

    def hand_out(tree: Any) -> Any:
        if distinct == 1:
            return jax.tree.map(lambda a: a[0], tree)
        if distinct == tile.row.size:
            return tree
        # Without the check of bounds, which would cost as much as the look-up.
        return jax.tree.map(lambda a: a.at[tile.row].get(mode="promise_in_bounds"), tree)

    def over(f: Callable, *axes: Any) -> Callable:
        return jax.vmap(f, in_axes=axes)

    fan = Fan(
        over_draws=over,
        over_runs=over,
        hand_out=hand_out,
        shared=None if distinct == 1 else 0,
    )
    return simulate(static, world, tile.draws, tile.params, fan)


def compiled(static: Static, world: World, tiles: Tiles) -> jax.stages.Compiled:
    """The program for arguments of these shapes: the same bits, whatever thread calls it."""
    leaves, structure = jax.tree.flatten((world, tiles))
    shapes = tuple(jax.ShapeDtypeStruct(np.shape(a), np.asarray(a).dtype) for a in leaves)
    return _compile(static, structure, shapes)


@cache
def _compile(static: Static, structure: Any, shapes: tuple) -> jax.stages.Compiled:
    def run_tiles(world: World, tiles: Tiles) -> Any:
        one = partial(run_tile, static, world)
        if method_of(static).common_covariance:
            # Only what belongs to draws differs between the sets.
            axes: Any = jax.tree.map(lambda a: None, tiles)
            draws = jax.tree.map(lambda a: 0 if a.ndim > 1 else None, tiles.draws)
            q = jax.tree.map(lambda a: 0, tiles.params.q)
            axes = axes._replace(draws=draws, params=axes.params._replace(q=q))
            one = jax.vmap(one, in_axes=(axes,))
        return jax.lax.map(one, tiles)

    return jax.jit(run_tiles).lower(*jax.tree.unflatten(structure, shapes)).compile()


def spread(call: Callable[[Any], Any], arguments: Iterable, devices: int) -> Iterator[Any]:
    """Results of calls in their order, with ``devices`` of them under way."""
    with ThreadPoolExecutor(devices) as pool:
        ahead: deque[Future] = deque()
        for argument in arguments:
            ahead.append(pool.submit(call, argument))
            if len(ahead) > devices:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()


def chunks(group: Group, *, devices: int = 1, tiles_a_chunk: int = 32) -> Iterator[Chunk]:
    """Run a group, chunk by chunk.

    Args:
        group: what to run.
        devices: how many chunks are under way at a time.
        tiles_a_chunk: tiles in a compiled call, see `plan`.

    Yields:
        Results in the order of the runs.
    """
    draws, variants = group.sizes
    calls = plan(group, devices=devices, tiles_a_chunk=tiles_a_chunk)
    first = next(calls)
    # Before there are threads, which would each compile it.
    program = compiled(group.static, group.world, tiles_of(group, first))

    def call(places: Lanes) -> Chunk:
        outcome, curves = jax.device_get(program(group.world, tiles_of(group, places)))
        if curves is not None:
            curves = jax.tree.map(lambda a: np.moveaxis(a, -2, -1), curves)
        draw, variant = places.draw.ravel(), places.variant.ravel()
        busy = np.flatnonzero((draw < draws) & (variant < variants))
        runs = busy[np.argsort(draw[busy] * variants + variant[busy])]
        return Chunk(draw[runs], variant[runs], *_lanes((outcome, curves), places.draw.shape, runs))

    yield from spread(call, chain([first], calls), devices)


def _lanes(tree: Any, shape: tuple[int, ...], lanes: np.ndarray) -> Any:
    """Some lanes of a call's results: leaves (tiles, [sets,] lanes, ...) to (runs, ...)."""
    axes = 2 + (shape[1] > 1)
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[axes:])[lanes], tree)
