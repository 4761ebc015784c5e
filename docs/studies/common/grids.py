"""The runs of a study as arrays over its axes, and the best of several settings on unused draws."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.analysis import Estimate, mean, numeric_column, share
from sinsjax.analysis.grids import held_out_choices, median_over_draws
from sinsjax.errors import InputError
from sinsjax.execution.source import Source


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
            runs = numeric_column(rows, name).reshape(draws, -1)[:, np.argsort(place)].T
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


def grid_of(source: Source, columns: Sequence[str], **axes: str | Sequence[Any]) -> Grid:
    """Every run of a study as arrays over the axes that a page names.

    Args:
        source: the results.
        columns: of the summary, numbers.
        axes: a key of the study, or a value for each variant, by the name of the axis.

    Raises:
        InputError: runs are missing, or a point of the axes is there not once.
    """
    study = source.study
    values = {n: study.values(v) if isinstance(v, str) else v for n, v in axes.items()}
    rows, draws = source.rows(columns), source.draws
    try:
        return Grid.of(rows, draws, values)
    except InputError as error:
        raise InputError(f"{study.name}: {error}") from error


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

    Args:
        values: (..., settings, draws); each of the leading places chooses for itself.
        best: the place of the best setting of values (settings, some draws).
    """
    chosen = np.empty((*values.shape[:-2], values.shape[-1]), dtype=int)
    for point in np.ndindex(values.shape[:-2]):
        chosen[point] = held_out_choices(values[point], best)
    judged = np.take_along_axis(values, chosen[..., None, :], axis=-2)
    return Choice(chosen, judged[..., 0, :])


def soonest(settle_s: NDArray) -> int:
    """The setting (settings, draws) with which most draws settle; among those, the soonest."""
    failed = np.isinf(settle_s).sum(axis=-1)
    return int(np.lexsort((median_over_draws(settle_s), failed))[0])


def least_mean(values: NDArray) -> int:
    """The setting (settings, draws) with the least mean."""
    return int(np.argmin(values.mean(axis=-1)))
