"""The lanes of tiles: pairs of a draw and a variant, draw by draw."""

from typing import NamedTuple

import jax
import numpy as np

from sinsjax.engine.environment import Draw, Environment, RunParams, Static

LANES = 64
"""Runs per tile. Results are bit-equal for any chunk and device count only at one lane count."""

STACKED_TILES = 8
"""Tiles that share one covariance; like `LANES`, it decides the last bits."""

MOST_IDLE = 1 / 8
"""Largest share of idle lanes in a draw's last tile; beyond it another draw is put there."""

VECTOR = 16
"""Single-precision numbers in the widest vector of a CPU."""


class Group(NamedTuple):
    """Runs that share one compiled program and one environment.

    Attributes:
        static: program.
        environment: shared by all runs.
        draws: `Draw` with leaves (draws,), or () for what all share.
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

    def select(self, draws: np.ndarray, variants: np.ndarray) -> "Group":
        """Return the group with some draws and variants only, by their places."""
        return self._replace(
            draws=jax.tree.map(lambda a: a[draws] if np.ndim(a) else a, self.draws),
            q=self.q[draws],
            variants=jax.tree.map(lambda a: np.asarray(a)[variants], self.variants),
        )


class Lanes(NamedTuple):
    """Draw and variant of each lane of a call; leaves (tiles, sets, lanes).

    Attributes:
        draw: place of the draw in the group; beyond its end for idle lanes.
        variant: place of the variant, the same for all sets; beyond its end for idle lanes.
    """

    draw: np.ndarray
    variant: np.ndarray


class Tiles(NamedTuple):
    """Arguments of tiles, with a leading axis of tiles, and of sets if tiles are stacked.

    Attributes:
        draws: `Draw` with leaves (tiles, [sets,] distinct).
        row: (tiles, lanes) draw of each lane among those of its tile.
        params: `RunParams` with leaves (tiles, lanes, ...), ``q`` (tiles, [sets,] lanes).
    """

    draws: Draw
    row: np.ndarray
    params: RunParams


def layout(static: Static, variants: int, lanes: int = LANES) -> tuple[int, int]:
    """Return the number of tiles that share a covariance, and of the lanes that a draw takes.

    Stacked tiles need the same variants in the same lanes: a draw is widened there, with idle
    lanes, to whole tiles or to a divisor of a tile. Otherwise it is widened to whole tiles if few
    lanes stay idle, since a tile of two draws makes the samples of `VECTOR`.
    """
    whole = lanes * -(-variants // lanes)
    if not static.shares_covariance:
        few = variants > lanes and whole - variants <= MOST_IDLE * variants
        return 1, whole if few else variants
    if variants > lanes:
        return STACKED_TILES, whole
    return STACKED_TILES, next(n for n in range(variants, lanes + 1) if lanes % n == 0)


def distinct_draws(width: int, lanes: int = LANES) -> int:
    """Return the number of draws that a tile has room for if each takes ``width`` lanes in a row.

    That is at least the most that it can hold, in whole vectors, since a part of a vector takes as
    long as a whole one; it is as many as there are lanes only if a draw takes one lane.
    """
    if width % lanes == 0:
        return 1
    if lanes % width == 0:
        return lanes // width
    most = (lanes + width - 2) // width + 1
    whole = -(-most // VECTOR) * VECTOR
    return whole if whole < lanes else most


def tiles_of(group: Group, places: Lanes) -> Tiles:
    """Return the arguments of the tiles of a call; idle lanes repeat the last draw or variant."""
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


def curve_lanes(group: Group) -> int | None:
    """Return the lanes of a tile whose curves are returned, the first ones; None for all.

    A few runs are in the first lanes, and the curves of idle lanes would fill the memory.
    """
    draws, variants = group.sizes
    used = draws * layout(group.static, variants)[1]
    return used if group.static.curves and used < LANES else None
