"""The runs of a table laid out over two of its keys."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.analysis.tables import encode_values, group_rows, numeric_column, require_column
from sinsjax.errors import InputError

_PLACE = "place in the grid"


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
    """One point of the keys that are no axis of a map, and its rows.

    Attributes:
        point: the keys' values.
        rows: the draws are outermost, and among the runs of a draw the first axis.
        shape: of the map.
    """

    point: dict[str, Any]
    rows: pa.Table
    shape: tuple[int, ...]

    def column_values(self, column: str) -> NDArray:
        """A column, (draws, rows, columns); null is NaN."""
        return numeric_column(self.rows, column).reshape(-1, *self.shape)

    def cell_outcomes(self, ok: str, settle: str, off_floor: NDArray) -> "CellOutcomes":
        """Successes and settling times of each cell; off_floor as in `CellOutcomes`."""
        return CellOutcomes(
            self.column_values(ok) > 0,
            off_floor,
            np.nan_to_num(self.column_values(settle), nan=np.inf),
        )


def split_into_panels(
    table: pa.Table, row_key: str, column_key: str, panel_keys: Sequence[str] = ()
) -> tuple[dict[str, tuple[Any, ...]], list[Panel]]:
    """Lay the runs of a table out over two keys, a panel for each point of further keys.

    Args:
        table: one row per run, ordered by draw within each variant.
        row_key: key of the rows of each panel.
        column_key: key of its columns.
        panel_keys: keys of the panels; runs that differ in other keys share a cell.

    Returns:
        The values of the two keys by first appearance, and the panels likewise.

    Raises:
        InputError: a key is missing, or the cells of a panel do not have as many runs each.
    """
    axes, places = {}, []
    for key in (row_key, column_key):
        places.append(encode_values(require_column(table, key)))
        first = np.unique(places[-1], return_index=True)[1]
        axes[key] = tuple(table[key].take(first).to_pylist())
    shape = tuple(map(len, axes.values()))
    place = np.ravel_multi_index(places, shape)
    panels = []
    for point, group in group_rows(table.append_column(_PLACE, pa.array(place)), panel_keys):
        cell = numeric_column(group, _PLACE).astype(np.int64)
        if np.ptp(np.bincount(cell, minlength=np.prod(shape))):
            raise InputError(
                f"{row_key}, {column_key}: the runs form no full grid of these keys with equally"
                " many runs per cell (name the other varying keys in `by`)"
            )
        order = np.argsort(cell, kind="stable").reshape(np.prod(shape), -1)
        panels.append(Panel(point, group.take(order.T.ravel()), shape))
    return axes, panels


class CellOutcomes(NamedTuple):
    """The runs of each cell of a map.

    Attributes:
        ok: (draws, rows, columns) the successes.
        off_floor: (draws, rows, columns) successes that end outside the band about the floor.
        settle_s: (draws, rows, columns) settling times, infinite where a run never settled, s.
    """

    ok: NDArray
    off_floor: NDArray
    settle_s: NDArray

    @property
    def median_s(self) -> NDArray:
        """Median settling time of each cell, (rows, columns), s; see `median_over_draws`."""
        return median_over_draws(np.moveaxis(self.settle_s, 0, -1))

    @property
    def success_share(self) -> NDArray:
        """Share of the runs of each cell that are ok, (rows, columns)."""
        return np.asarray(self.ok.mean(axis=0))

    @property
    def not_converged(self) -> NDArray:
        """Cells in which most of the runs that are ok are off their bias floor, (rows, columns)."""
        return np.asarray(2 * self.off_floor.sum(axis=0) > self.ok.sum(axis=0))
