"""Many runs in one compiled call.

Runs are numbered draw by draw (`run_id = draw_id * variants + variant_id`) and cut into tiles of
64 lanes. A tile is one vectorised scan whose state stays in the first-level cache; tiles follow
one another under `lax.map`, spread over the devices. Samples are made once for each distinct draw
of a tile and handed to its lanes, so that variants share their noise.
"""

from collections.abc import Iterator
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from sinsjax.metrics import Observation, Outcome
from sinsjax.simulate import Draw, Fan, Params, Static, World, simulate

LANES = 64
"""Runs a tile. Results are bit-equal for any chunk and device count only at one lane count."""


class Group(NamedTuple):
    """Runs that share one compiled program and one world.

    Attributes:
        static: program.
        world: shared by all.
        draws: `Draw` with leaves (draws,).
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


class Tiles(NamedTuple):
    """Arguments of tiles, all with a leading axis of tiles.

    Attributes:
        draws: `Draw` with leaves (tiles, distinct).
        row: (tiles, lanes) which of its tile's draws each lane takes.
        params: `Params` with leaves (tiles, lanes, ...).
    """

    draws: Draw
    row: np.ndarray
    params: Params


def distinct_draws(variants: int) -> int:
    """The most distinct draws that a tile of draw-major runs can hold."""
    if variants % LANES == 0:
        return 1
    if LANES % variants == 0:
        return LANES // variants
    return (LANES + variants - 2) // variants + 1


def run_tile(static: Static, world: World, tile: Tiles) -> tuple[Outcome, Observation | None]:
    """All runs of one tile; outcomes with leaves (lanes, ...), curves (records, lanes)."""
    distinct = tile.draws.draw_id.shape[0]

    def hand_out(tree: Any) -> Any:
        if distinct == 1:
            return jax.tree.map(lambda a: a[0], tree)
        return jax.tree.map(lambda a: jnp.moveaxis(a[tile.row], 0, 1), tree)

    fan = Fan(
        over_draws=jax.vmap,
        over_runs=lambda f, *axes: jax.vmap(f, in_axes=axes),
        hand_out=hand_out,
        shared=None if distinct == 1 else 0,
    )
    return simulate(static, world, tile.draws, tile.params, fan)


@cache
def compiled(static: Static, devices: int) -> Any:
    """The compiled function of (world, tiles), its tiles spread over the devices."""
    mesh = Mesh(np.asarray(jax.devices()[:devices]), ("tiles",))
    tiled, whole = PartitionSpec("tiles"), PartitionSpec()

    def run_tiles(world: World, tiles: Tiles) -> Any:
        return jax.lax.map(partial(run_tile, static, world), tiles)

    return jax.jit(
        jax.shard_map(
            run_tiles, mesh=mesh, in_specs=(whole, tiled), out_specs=tiled, check_vma=False
        )
    )


def tiles_of(group: Group, runs: np.ndarray) -> Tiles:
    """Arguments for the tiles that hold the given runs, whose number is whole tiles."""
    draws, variants = group.sizes
    lanes = runs.reshape(-1, LANES)
    draw, variant = lanes // variants, lanes % variants
    first = draw[:, :1]
    taken = np.minimum(first + np.arange(distinct_draws(variants)), draws - 1)
    params = jax.tree.map(lambda a: np.asarray(a)[variant], group.variants)
    q = type(group.variants.q)(*np.moveaxis(group.q[draw], -1, 0))
    return Tiles(
        draws=jax.tree.map(lambda a: np.asarray(a)[taken], group.draws),
        row=draw - first,
        params=params._replace(q=q),
    )


def chunks(group: Group, *, devices: int = 1, tiles_a_chunk: int = 32) -> Iterator[Chunk]:
    """Run a group, chunk by chunk.

    Args:
        group: what to run.
        devices: how many devices share each chunk.
        tiles_a_chunk: tiles in a compiled call, rounded up to a multiple of 2 * devices. A call is
            never given a single tile a device, whose loop the compiler would unroll to other bits.

    Yields:
        Results in the order of the runs.
    """
    draws, variants = group.sizes
    total = draws * variants
    most = -(-total // LANES)
    size = 2 * devices * -(-min(tiles_a_chunk, most) // (2 * devices))
    call = compiled(group.static, devices)
    for begin in range(0, total, size * LANES):
        # The last chunk is filled up with its last run; what is added is dropped below.
        runs = np.minimum(np.arange(begin, begin + size * LANES), total - 1)
        kept = min(total - begin, size * LANES)
        outcome, curves = call(group.world, tiles_of(group, runs))
        runs = runs[:kept]
        if curves is not None:
            curves = jax.tree.map(lambda a: np.moveaxis(np.asarray(a), 1, 2), curves)
        yield Chunk(runs // variants, runs % variants, *_first_runs((outcome, curves), kept))


def _first_runs(tree: Any, count: int) -> Any:
    """Leaves (tiles, lanes, ...) to (count, ...)."""
    return jax.tree.map(lambda a: np.asarray(a).reshape(-1, *a.shape[2:])[:count], tree)
