"""How runs are laid into the lanes of tiles: pairs of a draw and a variant, draw by draw."""

from typing import NamedTuple

import jax
import numpy as np

from sinsjax.engine.realisations import Draw, Environment, Static, method_of
from sinsjax.engine.simulate import RunParams

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

    def some(self, draws: np.ndarray, variants: np.ndarray) -> "Group":
        """The group with some draws and some variants only, by their places."""
        return self._replace(
            draws=jax.tree.map(lambda a: a[draws] if np.ndim(a) else a, self.draws),
            q=self.q[draws],
            variants=jax.tree.map(lambda a: np.asarray(a)[variants], self.variants),
        )


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
    if not method_of(static).shares_covariance:
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


def shown(group: Group) -> int | None:
    """Lanes of a tile whose curves are asked for, None for all.

    A few runs are in the first lanes, and the curves of idle ones would fill the memory.
    """
    draws, variants = group.sizes
    taken = draws * layout(group.static, variants)[1]
    static = group.static
    return taken if static.curves and not static.sampled_errors and taken < LANES else None
