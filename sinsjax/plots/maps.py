"""Maps of runs over two swept keys: `sinsjax.plot_map`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sinsjax.analysis.grids import median_over_draws, split_into_panels
from sinsjax.analysis.tables import group_rows, require_column, to_arrow_table, to_key_list
from sinsjax.errors import InputError
from sinsjax.plots.grids import CellMarks, GridAxis, MapQuantity, draw_heat_maps
from sinsjax.plots.labels import axis_label, describe_axis_point, describe_point, format_value
from sinsjax.plots.style import colour_range

MAX_PANELS = 12
"""Panels of a figure at most."""


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
    cell that the title names is framed in every panel that it applies to. An outlier ends beyond
    the colour scale instead of flattening it. Of many panels the first 12 are drawn.

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
    lines = {format_value(panel.point[by[-1]]) for panel in panels} if by else [""]
    return draw_heat_maps(
        list(zip(_panel_titles([panel.point for panel in panels]), cells, strict=True)),
        title or best_title,
        _colour_scale(statistic, cells),
        rows=GridAxis(rows, axes[rows]),
        columns=GridAxis(columns, axes[columns]),
        panels_per_row=len(lines),
        marks=CellMarks(
            [_flagged_cells(panel.column_values(hatched)) for panel in panels] if hatched else (),
            hatch_name,
            [_named_cell(panel.point, axes, best_point) for panel in panels],
            "soonest" if statistic.is_settling_time else "best",
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


def _colour_scale(statistic: _CellStatistic, cells: Sequence[NDArray]) -> MapQuantity:
    """The colour scale: of the distinct values of each panel, capped where a few lie far beyond."""
    if statistic.is_share:
        return MapQuantity(statistic.name, 0.0, 100.0)
    # Equal cells, such as those of no reset, count once.
    low, high = colour_range(np.concatenate([np.unique(c[np.isfinite(c)]) for c in cells]))
    digits = 0 if high >= 100 or statistic.is_settling_time else 1
    return MapQuantity(statistic.name, low, high, reverse=True, digits=digits)


def _has_best_cell(runs: NDArray, statistic: _CellStatistic) -> bool:
    """Whether one cell of runs (draws, rows, columns) is the best."""
    cells = statistic.compute(runs)
    known = cells[np.isfinite(cells)]
    if not known.size or np.ptp(known) == 0:
        return False
    return not statistic.is_share or int(np.sum(known == known.max())) == 1


def _named_cell(
    panel_point: Mapping[str, Any],
    axes: Mapping[str, Sequence[Any]],
    best_point: Mapping[str, Any],
) -> tuple[int, int] | None:
    """The cell (row, column) of a panel that the title names, or None if it is in another one."""
    if not best_point or any(best_point.get(key, at) != at for key, at in panel_point.items()):
        return None
    row, column = (list(values).index(best_point[key]) for key, values in axes.items())
    return row, column


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
        if not _has_best_cell(runs, statistic):
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
