"""Maps of runs over two swept keys: `sinsjax.plot_map`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sinsjax.analysis.grids import Panel, median_over_draws, split_into_panels
from sinsjax.analysis.tables import group_rows, require_column, to_arrow_table, to_key_list
from sinsjax.errors import InputError
from sinsjax.plots.grids import CellMarks, GridAxis, MapQuantity, draw_heat_maps, find_bars
from sinsjax.plots.labels import axis_label, describe_axis_point, describe_point, format_value
from sinsjax.plots.style import colour_range

MAX_PANELS = 12
"""Panels of a figure at most."""

_YAW = "phi_u_arcmin"


class _CellStatistic(NamedTuple):
    """The statistic of a column in a cell.

    Attributes:
        name: label of the colour bar, with its unit.
        compute: function of values (draws, rows, columns) that returns (rows, columns).
        small_is_better: whether small values are better.
        is_share: whether it is a share in percent.
        is_settling_time: whether it is a settling time.
    """

    name: str
    compute: Callable[[NDArray], NDArray]
    small_is_better: bool = True
    is_share: bool = False
    is_settling_time: bool = False


def plot_map(
    runs: Any,
    rows: str,
    columns: str,
    value: str,
    *,
    by: str | Sequence[str] = (),
    pooled: Sequence[str] | None = None,
    title: str = "",
    hatched: str = "",
    hatch_name: str = "",
) -> Figure:
    """Draw a statistic of the runs over two swept keys, one panel per point of further keys.

    The statistic follows the column: the median of a settling time (``settle_10_s``, s; *never* if
    fewer than half of the runs settle), the share of a flag (``ok_truth``) or of a column that ends
    in ``_share``, in percent, and the root mean square of any other number, in its own unit. The
    cell that the title names is framed in every panel that it applies to, and thinly the best cell
    of each panel. A row or column in which the other key has no effect, such as no reset, is a bar
    next to the grid. Cells of the same runs are numbered once, and an outlier ends beyond the
    colour scale instead of flattening it. Of many panels the first 12 are drawn.

    Args:
        runs: one row per run, with the keys and the value: a pyarrow Table such as
            `Results.summary`, or a pandas data frame.
        rows: key along the vertical axis.
        columns: key along the horizontal axis.
        value: column to show.
        by: key or keys of the panels; runs that differ in other keys share a cell.
        pooled: keys of ``by`` over which the title averages to name the best cell; None for all.
        title: title of the figure; by default it names the best cell.
        hatched: flag of the runs; cells are hatched in which it is set for most runs that have it.
        hatch_name: meaning of the hatch, for the legend.

    Raises:
        InputError: no table, no runs, a missing column, or runs that form no full grid of the keys.

    Examples:
        >>> import pyarrow as pa
        >>> runs = pa.table({
        ...     "reset_count": [1, 1, 2, 2],
        ...     "reset_cycle_s": [10.0, 50.0, 10.0, 50.0],
        ...     "reset_times_s": [[10.0], [50.0], [10.0, 20.0], [50.0, 100.0]],
        ...     "settle_10_s": [240.0, 320.0, 250.0, 190.0],
        ... })
        >>> figure = sinsjax.plot_map(runs, "reset_count", "reset_cycle_s", "settle_10_s")
        >>> figure.get_suptitle()
        'Soonest: 2 resets, every 50 s (190 s)'
    """
    table = to_arrow_table(runs)
    if not table.num_rows:
        raise InputError("plot_map: there are no runs")
    by = to_key_list(by)
    axes, panels = split_into_panels(table, rows, columns, by)
    statistic = _cell_statistic(require_column(table, value), value)
    chosen = [key for key in by if pooled is not None and key not in pooled]
    best_title, best_point = _best_cell_overall(table, axes, value, statistic, chosen)
    panels = panels[:MAX_PANELS]
    cells = [statistic.compute(panel.column_values(value)) for panel in panels]
    same_runs = [_number_identical_cells(panel, value) for panel in panels]
    lines = {format_value(panel.point[by[-1]]) for panel in panels} if by else [""]
    return draw_heat_maps(
        list(zip(_panel_titles([panel.point for panel in panels]), cells, strict=True)),
        title or best_title,
        _colour_scale(statistic, cells, same_runs),
        rows=GridAxis(rows, axes[rows]),
        columns=GridAxis(columns, axes[columns]),
        panels_per_row=len(lines),
        marks=CellMarks(
            same_runs,
            [_flagged_cells(panel.column_values(hatched)) for panel in panels] if hatched else (),
            hatch_name,
            _frames(panels, axes, value, statistic, best_point),
        ),
    )


def _cell_statistic(column: pa.ChunkedArray, name: str) -> _CellStatistic:
    if name.startswith("settle_"):
        which = "expected" if name.endswith("_mean_s") else "median"
        band, *truth = name.removeprefix("settle_").split("_")
        aim = "truth" if "truth" in truth else "bias floor"
        shown = f"{which} time (s) to stay within {band}' of the {aim}"
        return _CellStatistic(
            shown, lambda times: median_over_draws(_settling_times(times)), is_settling_time=True
        )
    if pa.types.is_boolean(column.type) or name.endswith("_share"):
        share = f"{axis_label(name.removesuffix('_share'))} (%)"
        return _CellStatistic(
            share, lambda runs: 100 * runs.mean(axis=0), small_is_better=False, is_share=True
        )
    return _CellStatistic(
        f"rms of {axis_label(name)}", lambda runs: np.sqrt((runs**2).mean(axis=0))
    )


def _settling_times(settle_s: NDArray) -> NDArray:
    """Settling times (draws, ...) as (..., draws), infinite where a run never settled."""
    return np.nan_to_num(np.moveaxis(settle_s, 0, -1), nan=np.inf)


def _colour_scale(
    statistic: _CellStatistic, cells: Sequence[NDArray], same_runs: Sequence[NDArray]
) -> MapQuantity:
    """The colour scale: of distinct cells, capped where a few lie far beyond the others.

    Bars next to a grid, such as no reset, count only if the grids themselves have no numbers.
    """
    if statistic.is_share:
        return MapQuantity(statistic.name, 0.0, 100.0)
    in_grid, in_bars = [], []
    for values, kinds in zip(cells, same_runs, strict=True):
        bars = find_bars(kinds)[:, None] | find_bars(kinds.T)
        distinct = np.isin(np.arange(kinds.size), np.unique(kinds, return_index=True)[1])
        known = distinct.reshape(kinds.shape) & np.isfinite(values)
        in_grid.append(values[known & ~bars])
        in_bars.append(values[known & bars])
    low, high = colour_range(np.concatenate(in_grid if any(map(np.size, in_grid)) else in_bars))
    digits = 0 if high >= 100 or statistic.is_settling_time else 1
    return MapQuantity(statistic.name, low, high, reverse=True, digits=digits)


def _number_identical_cells(panel: Panel, column: str) -> NDArray:
    """A number per cell (rows, columns), the same for cells with the same runs in all draws.

    Runs are identified by their final heading error; without that column all cells differ.
    """
    if _YAW not in panel.rows.column_names:
        return np.arange(np.prod(panel.shape)).reshape(panel.shape)
    runs = np.stack(
        [
            np.nan_to_num(panel.column_values(name), nan=np.inf)
            for name in dict.fromkeys([column, _YAW])
        ]
    )
    flat = runs.reshape(-1, np.prod(panel.shape)).T
    kinds = np.unique(flat, axis=0, return_inverse=True)[1]
    return np.asarray(kinds).reshape(panel.shape)


def _best_cell(runs: NDArray, statistic: _CellStatistic) -> tuple[int, int] | None:
    """The best cell of runs (draws, rows, columns), or None if several or none are."""
    cells = statistic.compute(runs)
    order = cells if statistic.small_is_better else -cells
    if not np.isfinite(order).any() or np.ptp(order[np.isfinite(order)]) == 0:
        return None
    settled = np.isfinite(runs).mean(axis=0)
    rank = np.lexsort((order.ravel(), -settled.ravel()))[0]
    row, column = np.unravel_index(rank, cells.shape)
    is_tied = statistic.is_share and np.count_nonzero(order == order[row, column]) > 1
    return None if is_tied else (int(row), int(column))


def _frames(
    panels: Sequence[Panel],
    axes: Mapping[str, Sequence[Any]],
    column: str,
    statistic: _CellStatistic,
    best_point: Mapping[str, Any],
) -> dict[str, list[tuple[int, int] | None]]:
    """The frames of `CellMarks`: the best point over all panels, and the best cell of a panel."""
    word = "soonest" if statistic.is_settling_time else "best"
    by_median = statistic.name.startswith("median")
    place = [list(values).index(best_point[key]) for key, values in axes.items() if best_point]
    overall: list[tuple[int, int] | None] = [
        (place[0], place[1])
        if best_point and all(best_point.get(key, at) == at for key, at in panel.point.items())
        else None
        for panel in panels
    ]
    if len(panels) == 1:
        return {word: overall}
    own = [_best_cell(panel.column_values(column), statistic) for panel in panels]
    others = [None if a == b else a for a, b in zip(own, overall, strict=True)]
    return {
        f"{word} over all panels{' (mean)' * by_median}": overall,
        f"{word} in its panel{' (median)' * by_median}": others,
    }


def _flagged_cells(flags: NDArray) -> NDArray:
    """Cells (rows, columns) in which a flag (draws, rows, columns) is set for most known runs."""
    return np.asarray(2 * np.nansum(flags, axis=0) > np.isfinite(flags).sum(axis=0))


def _panel_titles(points: Sequence[Mapping[str, Any]]) -> list[str]:
    """The title of each panel; a single key is named in the first one, with its value in all."""
    names = [describe_point(point) if point else "" for point in points]
    if len(points) > 1 and len(points[0]) == 1:
        (key,) = points[0]
        unit = axis_label(key).partition("(")[2].rstrip(")")
        texts = [format_value(point[key]) for point in points]
        names[1:] = [
            f"{text} {unit}".rstrip() if text[-1:].isdigit() else text for text in texts[1:]
        ]
    return names


def _best_cell_overall(
    table: pa.Table,
    axes: Mapping[str, Sequence[Any]],
    column: str,
    statistic: _CellStatistic,
    choice_keys: Sequence[str],
) -> tuple[str, dict[str, Any]]:
    """Return a title that names the best cell and the best point of the choice keys, and both.

    If no cell is the best, the title names the statistic, and there is no point.
    """
    found = []
    for point, rows in group_rows(table, choice_keys):
        _, (panel,) = split_into_panels(rows, *axes)
        runs = panel.column_values(column)
        if _best_cell(runs, statistic) is None:
            continue
        settled = np.isfinite(runs).mean(axis=0)
        shown = np.nansum(runs, axis=0) / np.maximum(settled * len(runs), 1)  # mean of the settled
        shown = shown if statistic.is_settling_time else statistic.compute(runs)
        order = np.nan_to_num(shown, nan=np.inf) * (1 if statistic.small_is_better else -1)
        best = np.lexsort((order.ravel(), -settled.ravel()))[0]
        best_point = dict(point)
        for name in (*axes, *{"reset_times_s"}.intersection(rows.column_names)):
            best_point[name] = panel.rows[name][int(best)].as_py()
        found.append((-settled.flat[best], order.flat[best], best_point, shown.flat[best]))
    if not found:
        return f"{statistic.name[:1].upper()}{statistic.name[1:]}", {}
    missing, _, point, shown = min(found, key=lambda candidate: candidate[:2])
    words = describe_axis_point(point)
    if not statistic.is_settling_time:
        unit = statistic.name.rpartition("(")[2].rstrip(")")
        title = f"Best: {words} ({shown:.3g} {unit})"
    elif missing > -1:
        title = f"Most often: {words} ({-100 * missing:.3g} % of the runs settle)"
    else:
        title = f"Soonest: {words} ({shown:.0f} s{' on average' * (runs.shape[0] > 1)})"
    return title, point
