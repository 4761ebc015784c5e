"""The runs of a study as arrays over its axes, and the best of several settings on unused draws."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.analysis.estimates import Estimate, mean, share
from sinsjax.analysis.tables import codes, groups, numbers, require
from sinsjax.errors import InputError

_PLACE = "place in the grid"


@dataclass(frozen=True, eq=False)
class Grid:
    """Every run of a full grid, by the axes that a page names and by draw.

    Attributes:
        axes: the points of each axis, in the study's order.
        columns: arrays by column, shape (points of the first axis, ..., draws).
        draws: of every variant.
    """

    axes: dict[str, tuple[Any, ...]]
    columns: dict[str, NDArray]
    draws: int

    @classmethod
    def of(cls, rows: pa.Table, draws: int, axes: Mapping[str, Sequence[Any]]) -> "Grid":
        """Lays out the runs of a study.

        Args:
            rows: of the summary, by run_id, numbers; a time to settle is infinite where it is null.
            draws: of every variant.
            axes: a value for each variant, by the name of the axis.

        Raises:
            InputError: a point of the axes is there not once.
        """
        points = {name: tuple(dict.fromkeys(values)) for name, values in axes.items()}
        shape = tuple(map(len, points.values()))
        at = [[points[name].index(value) for value in values] for name, values in axes.items()]
        place = np.ravel_multi_index(at, shape)
        if not np.array_equal(np.sort(place), np.arange(np.prod(shape))):
            raise InputError(f"is no full grid of {', '.join(axes)}")
        found = {}
        for name in rows.column_names:
            runs = numbers(rows, name).reshape(draws, -1)[:, np.argsort(place)].T
            missing = np.inf if name.startswith("settle_") else np.nan
            found[name] = np.nan_to_num(runs, nan=missing, posinf=np.inf).reshape(*shape, draws)
        return cls(points, found, draws)

    def at(self, column: str, **points: Any) -> NDArray:
        """A column at points of some axes; the other axes stay, in their order, and the draws.

        Args:
            column: its name.
            points: the point of an axis by its name; a list of points keeps the axis.
        """
        runs = self.columns[column]
        for number, (name, values) in reversed(list(enumerate(self.axes.items()))):
            if name in points:
                wanted = points[name]
                several = isinstance(wanted, list)
                places = [values.index(one) for one in (wanted if several else [wanted])]
                runs = np.take(runs, places if several else places[0], axis=number)
        return runs


def median(settle_s: NDArray) -> NDArray:
    """Median over the draws, the last axis; infinite where fewer than half of them settled."""
    return np.asarray(np.quantile(settle_s, 0.5, axis=-1, method="inverted_cdf"))


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

    def of(self, column: str) -> NDArray:
        """A column, (draws, rows, columns); null is NaN."""
        return numbers(self.rows, column).reshape(-1, *self.shape)

    def cells(self, ok: str, settle: str, off_floor: NDArray) -> "Cells":
        """Its runs by the columns of successes and settling times; off_floor as in `Cells`."""
        return Cells(self.of(ok) > 0, off_floor, np.nan_to_num(self.of(settle), nan=np.inf))


def panels_of(
    table: pa.Table, rows: str, columns: str, by: Sequence[str] = ()
) -> tuple[dict[str, tuple[Any, ...]], list[Panel]]:
    """Lay the runs of a table out over two keys, a panel for each point of further keys.

    Args:
        table: one row per run, ordered by draw within each variant.
        rows: key of the rows of each panel.
        columns: key of its columns.
        by: keys of the panels; runs that differ in other keys share a cell.

    Returns:
        The values of the two keys by first appearance, and the panels likewise.

    Raises:
        InputError: a key is missing, or the cells of a panel do not have as many runs each.
    """
    axes, places = {}, []
    for key in (rows, columns):
        places.append(codes(require(table, key)))
        first = np.unique(places[-1], return_index=True)[1]
        axes[key] = tuple(table[key].take(first).to_pylist())
    shape = tuple(map(len, axes.values()))
    place = np.ravel_multi_index(places, shape)
    found = []
    for point, own in groups(table.append_column(_PLACE, pa.array(place)), by):
        cell = numbers(own, _PLACE).astype(np.int64)
        if np.ptp(np.bincount(cell, minlength=np.prod(shape))):
            raise InputError(
                f"{rows}, {columns}: the runs are no full grid of these keys, with as many runs in"
                " each cell (name the other keys that differ in `by`)"
            )
        order = np.argsort(cell, kind="stable").reshape(np.prod(shape), -1)
        found.append(Panel(point, own.take(order.T.ravel()), shape))
    return axes, found


class Cells(NamedTuple):
    """The runs of each cell of a map.

    Attributes:
        ok: (draws, rows, columns) the successes.
        off_floor: (draws, rows, columns) those of them that end outside the band about their floor.
        settle_s: (draws, rows, columns) settling times, infinite where a run never settled, s.
    """

    ok: NDArray
    off_floor: NDArray
    settle_s: NDArray

    @property
    def median_s(self) -> NDArray:
        """Median settling time of each cell, (rows, columns), s; see `median`."""
        return median(np.moveaxis(self.settle_s, 0, -1))

    @property
    def share(self) -> NDArray:
        """Share of the runs of each cell that are ok, (rows, columns)."""
        return np.asarray(self.ok.mean(axis=0))

    @property
    def not_converged(self) -> NDArray:
        """Cells in which most of the runs that are ok are off their bias floor, (rows, columns)."""
        return np.asarray(2 * self.off_floor.sum(axis=0) > self.ok.sum(axis=0))

    @property
    def best(self) -> tuple[int, int] | None:
        """The cell in which most runs are ok, of equals the soonest; None if no run is ok."""
        if not self.ok.any():
            return None
        order = np.lexsort((self.median_s.ravel(), -self.share.ravel()))
        row, column = np.unravel_index(order[0], self.share.shape)
        return int(row), int(column)


def shared(flags: NDArray) -> Estimate:
    """Share of runs (..., draws) that have a property; its interval is that of the draws."""
    draws = np.broadcast_to(np.arange(flags.shape[-1]), flags.shape)
    return share(flags.ravel(), draws.ravel())


def pooled_mean(values: NDArray) -> Estimate:
    """Mean of values (..., draws); its interval is that of the draws."""
    draws = np.broadcast_to(np.arange(values.shape[-1]), values.shape)
    return mean(values.ravel(), draws.ravel())


class Choice(NamedTuple):
    """The best of several settings, judged by draws that did not choose it.

    Attributes:
        places: (..., draws) place of the setting that the half without the draw chose.
        values: (..., draws) the value with it.
    """

    places: NDArray
    values: NDArray

    def named(self, names: Sequence[str]) -> str:
        """What was chosen; two names where the halves differ."""
        return " / ".join(names[i] for i in dict.fromkeys(self.places))


def held_out(values: NDArray, best: Callable[[NDArray], int]) -> Choice:
    """Chooses a setting on every other draw and judges it by the rest, both ways.

    A choice judged by the draws that made it would flatter the longer list of settings.

    Args:
        values: (..., settings, draws); each of the leading places chooses for itself.
        best: the place of the best setting of values (settings, some draws).
    """
    chosen = np.empty((*values.shape[:-2], values.shape[-1]), dtype=int)
    halves = slice(0, None, 2), slice(1, None, 2)
    for choosing, judging in (halves, halves[::-1]):
        for point in np.ndindex(values.shape[:-2]):
            chosen[point][judging] = best(values[point][:, choosing])
    told = np.take_along_axis(values, chosen[..., None, :], axis=-2)
    return Choice(chosen, told[..., 0, :])


def soonest(settle_s: NDArray) -> int:
    """The setting (settings, draws) with which most draws settle; among those, the soonest."""
    failed = np.isinf(settle_s).sum(axis=-1)
    return int(np.lexsort((median(settle_s), failed))[0])


def least_mean(values: NDArray) -> int:
    """The setting (settings, draws) with the least mean."""
    return int(np.argmin(values.mean(axis=-1)))
