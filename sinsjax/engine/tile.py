"""Runs side by side in the lanes of a tile, and what they share there."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.engine.metrics import Observation, Outcome
from sinsjax.engine.realisations import Draw, Environment, Static
from sinsjax.engine.simulate import BatchMap, RunParams, method_of, simulate

LANES = 64
"""Runs a tile. Results are bit-equal for any chunk and device count only at one lane count."""


STACKED_TILES = 8
"""Tiles that share one covariance; as `LANES`, it decides the last bits."""


MOST_IDLE = 1 / 8
"""Share of idle lanes that a draw's last tile may have before another draw is put into it."""


VECTOR = 16
"""Single-precision numbers in the widest vector of a CPU."""


class Group(NamedTuple):
    """Runs that share one compiled program and one environment.

    Attributes:
        static: program.
        environment: shared by all.
        draws: `Draw` with leaves (draws,), or () for what is the same for all.
        q: (draws, 4) attitude of each draw before the misalignment.
        variants: `RunParams` with leaves (variants, ...); its ``q`` is ignored.
    """

    static: Static
    environment: Environment
    draws: Draw
    q: np.ndarray
    variants: RunParams

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of draws and of variants."""
        return len(self.draws.draw_id), len(self.variants.ve)


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
        params: `RunParams` with leaves (tiles, lanes, ...), ``q`` (tiles, [sets,] lanes).
    """

    draws: Draw
    row: np.ndarray
    params: RunParams


def layout(static: Static, variants: int, lanes: int = LANES) -> tuple[int, int]:
    """How many tiles share a covariance, and how many lanes a draw takes.

    Stacked tiles need the same variants in the same lanes: there a draw is widened, with idle
    lanes, to whole tiles or to a part of one that leaves no rest. Others are widened to whole
    tiles where few lanes stay idle: a tile of two draws makes the samples of `VECTOR`.
    """
    whole = lanes * -(-variants // lanes)
    if not method_of(static).common_covariance:
        few = variants > lanes and whole - variants <= MOST_IDLE * variants
        return 1, whole if few else variants
    if variants > lanes:
        return STACKED_TILES, whole
    return STACKED_TILES, next(n for n in range(variants, lanes + 1) if lanes % n == 0)


def distinct_draws(width: int, lanes: int = LANES) -> int:
    """Draws a tile has room for, where each takes ``width`` lanes in a row.

    At least the most that it can hold, in whole vectors: a rest would take as long as another. As
    many as there are lanes, of which there are three or more, only where a draw takes one.
    """
    if width % lanes == 0:
        return 1
    if lanes % width == 0:
        return lanes // width
    most = (lanes + width - 2) // width + 1
    whole = -(-most // VECTOR) * VECTOR
    return whole if whole < lanes else most


def tiles_of(group: Group, places: Lanes) -> Tiles:
    """Arguments for the tiles of one call; idle lanes repeat the last draw or variant."""
    draws, variants = group.sizes
    _, sets, lanes = places.draw.shape
    _, width = layout(group.static, variants, lanes)
    first = places.draw[..., :1]
    taken = np.minimum(first + np.arange(distinct_draws(width, lanes)), draws - 1)
    variant = np.minimum(places.variant[:, 0], variants - 1)
    q = np.moveaxis(group.q[np.minimum(places.draw, draws - 1)], -1, 0)
    if sets == 1:
        taken, q = taken[:, 0], q[:, :, 0]
    params = jax.tree.map(lambda a: np.asarray(a)[variant], group.variants)
    return Tiles(
        draws=jax.tree.map(
            lambda a: a[taken] if np.ndim(a) else np.full(len(taken), a), group.draws
        ),
        row=(places.draw - first)[:, 0].astype(np.int32),
        params=params._replace(q=type(group.variants.q)(*q)),
    )


def run_tile(
    static: Static, environment: Environment, tile: Tiles
) -> tuple[Outcome, Observation | None]:
    """All runs of one tile; outcomes with leaves (lanes, ...), curves (records, lanes)."""
    distinct = tile.draws.draw_id.shape[0]

    def broadcast_to_runs(tree: Any) -> Any:
        if distinct == 1:
            return jax.tree.map(lambda a: a[0], tree)
        if distinct == tile.row.size:
            return tree
        # Without the check of bounds, which would cost as much as the look-up.
        return jax.tree.map(lambda a: a.at[tile.row].get(mode="promise_in_bounds"), tree)

    def over(f: Callable, *axes: Any) -> Callable:
        return jax.vmap(f, in_axes=axes)

    batch_map = BatchMap(
        over_draws=over,
        over_runs=over,
        broadcast_to_runs=broadcast_to_runs,
        shared=None if distinct == 1 else 0,
        earliest=jnp.min,
    )
    return simulate(static, environment, tile.draws, tile.params, batch_map)


def over_stacked_tiles(
    static: Static, one: Callable[[Tiles], Any], tiles: Tiles
) -> Callable[[Tiles], Any]:
    """A function of one tile, mapped over the sets of stacked ones where the method has such.

    Args:
        static: program.
        one: of a tile.
        tiles: that it will be applied to, one after the other.
    """
    if not method_of(static).common_covariance:
        return one
    # Only what belongs to draws differs between the sets.
    axes: Any = jax.tree.map(lambda a: None, tiles)
    draws = jax.tree.map(lambda a: 0 if a.ndim > 1 else None, tiles.draws)
    q = jax.tree.map(lambda a: 0, tiles.params.q)
    return jax.vmap(one, in_axes=(axes._replace(draws=draws, params=axes.params._replace(q=q)),))


def shown(group: Group) -> int | None:
    """Lanes of a tile whose curves are asked for, see `Static.shown`.

    A few runs are in the first lanes, and the curves of idle ones would fill the memory.
    """
    draws, variants = group.sizes
    taken = draws * layout(group.static, variants)[1]
    return taken if group.static.curves and taken < LANES else None
