"""Runs laid out over axes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.analysis.tables import group_numbers, numeric_column
from sinsjax.errors import InputError


class Grid(NamedTuple):
    """Runs by the points of some axes, and by draw.

    Attributes:
        axes: the points of each axis, as values of its keys, by these keys.
        table: one row per run.
        rows: row of each run, shape (*axes, draws).
    """

    axes: dict[tuple[str, ...], list[tuple[Any, ...]]]
    table: pa.Table
    rows: NDArray

    @classmethod
    def from_table(cls, table: pa.Table, *axes: Sequence[str]) -> "Grid":
        """Lay the runs of a table out over axes.

        Args:
            table: one row per run, ordered by draw within each variant.
            axes: keys of each axis; runs that differ in other keys alone share a point.

        Returns:
            The grid; the points of each axis by first appearance.

        Raises:
            InputError: a key is missing, or the points do not have as many runs each.
        """
        numbers = [group_numbers(table, keys) for keys in axes]
        points = {
            tuple(keys): [
                tuple(table[key][row].as_py() for key in keys)
                for row in np.unique(number, return_index=True)[1].tolist()
            ]
            for keys, number in zip(axes, numbers, strict=True)
        }
        shape = tuple(map(len, points.values()))
        place = np.ravel_multi_index(numbers, shape)
        if np.ptp(np.bincount(place, minlength=np.prod(shape))):
            raise InputError(
                f"{', '.join(key for keys in axes for key in keys)}: the runs form no full grid of"
                " these keys with equally many runs per cell (name the other varying keys in `by`)"
            )
        return cls(points, table, np.argsort(place, kind="stable").reshape(*shape, -1))

    def column(self, name: str) -> NDArray:
        """A column as numbers, shape (*axes, draws); null is NaN."""
        return numeric_column(self.table, name)[self.rows]


def median_over_draws(settle_s: NDArray) -> NDArray:
    """Return the median over the draws, the last axis; infinite if fewer than half settled."""
    return np.asarray(np.quantile(settle_s, 0.5, axis=-1, method="inverted_cdf"))
