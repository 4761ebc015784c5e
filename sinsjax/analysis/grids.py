"""Runs laid out over axes."""

from collections.abc import Callable, Sequence
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


def held_out_choices(values: NDArray, choose_best: Callable[[NDArray], int]) -> NDArray:
    """Return the setting that judges each draw, shape (draws,), chosen without that draw.

    Every other draw chooses for the rest, and the rest for it. A choice judged by the draws that
    made it would favour the longer list of settings.

    Args:
        values: shape (settings, ..., draws).
        choose_best: returns the place of the best setting of the values of some draws.
    """
    chosen = np.empty(values.shape[-1], dtype=int)
    halves = slice(0, None, 2), slice(1, None, 2)
    for choosing, judging in (halves, halves[::-1]):
        chosen[judging] = choose_best(values[..., choosing])
    return chosen


class Panel(NamedTuple):
    """One point of the keys that are no axis of a map, with the grid of its runs."""

    point: dict[str, Any]
    grid: Grid
    shape: tuple[int, ...]
    rows: pa.Table

    def column_values(self, column: str) -> NDArray:
        """A column, (draws, rows, columns); null is NaN."""
        return np.moveaxis(self.grid.column(column), -1, 0)


def split_into_panels(
    table: pa.Table, row_key: str, column_key: str, panel_keys: Sequence[str] = ()
) -> tuple[dict[str, tuple[Any, ...]], list[Panel]]:
    """The axes of a grid over two keys, and its panels for each point of further keys."""
    grid = Grid.from_table(table, panel_keys, (row_key,), (column_key,))
    axes = {key: tuple(value for (value,) in grid.axes[key,]) for key in (row_key, column_key)}
    panels = [
        Panel(
            dict(zip(panel_keys, point, strict=True)),
            grid._replace(rows=rows),
            rows.shape[:-1],
            table.take(np.moveaxis(rows, -1, 0).ravel()),
        )
        for point, rows in zip(grid.axes[tuple(panel_keys)], grid.rows, strict=True)
    ]
    return axes, panels
