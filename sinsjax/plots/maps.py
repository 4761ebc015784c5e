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
from sinsjax.plots.grids import Marks, Scale, Shown, heat_maps
from sinsjax.plots.style import colour_range
from sinsjax.plots.words import label, name_of, point_text, value_text

MOST_PANELS = 12
"""Panels of a figure at most."""

_YAW = "phi_u_arcmin"


class _Quantity(NamedTuple):
    """The statistic of a column in a cell.

    Attributes:
        name: label of the colour bar, with its unit.
        of: function of values (draws, rows, columns) that gives (rows, columns).
        reverse: whether small values are better.
        is_share: whether it is a share in percent.
        settles: whether it is a settling time.
    """

    name: str
    of: Callable[[NDArray], NDArray]
    reverse: bool = True
    is_share: bool = False
    settles: bool = False


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
    best cell of each panel is framed, cells of the same runs are numbered once, and an outlier ends
    beyond the colour scale instead of flattening it. Of many panels the first 12 are drawn.

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
        InputError: no table, no runs, a missing column, or runs that are no full grid of the keys.

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
    quantity = _quantity(require_column(table, value), value)
    if not title:
        chosen = [key for key in by if pooled is not None and key not in pooled]
        title = _finding(table, axes, value, quantity, chosen)
    panels = panels[:MOST_PANELS]
    cells = [quantity.of(panel.column_values(value)) for panel in panels]
    alike = [_alike(panel, value) for panel in panels]
    best = [_best(panel.column_values(value), quantity) for panel in panels]
    lines = {value_text(panel.point[by[-1]]) for panel in panels} if by else [""]
    return heat_maps(
        list(zip(_panel_names([panel.point for panel in panels]), cells, strict=True)),
        title,
        _shown(quantity, cells, alike),
        rows=Scale(rows, axes[rows]),
        columns=Scale(columns, axes[columns]),
        across=len(lines),
        marks=Marks(
            alike,
            [_most(panel.column_values(hatched)) for panel in panels] if hatched else (),
            hatch_name,
            best,
            "soonest" if quantity.settles else "best",
        ),
    )


def _quantity(column: pa.ChunkedArray, name: str) -> _Quantity:
    if name.startswith("settle_"):
        which = "expected" if name.endswith("_mean_s") else "median"
        band, *truth = name.removeprefix("settle_").split("_")
        aim = "truth" if "truth" in truth else "bias floor"
        shown = f"{which} time (s) to stay within {band}' of the {aim}"
        return _Quantity(shown, lambda times: median_over_draws(_never(times)), settles=True)
    if pa.types.is_boolean(column.type) or name.endswith("_share"):
        share = f"{label(name.removesuffix('_share'))} (%)"
        return _Quantity(share, lambda runs: 100 * runs.mean(axis=0), reverse=False, is_share=True)
    return _Quantity(f"rms of {label(name)}", lambda runs: np.sqrt((runs**2).mean(axis=0)))


def _never(settle_s: NDArray) -> NDArray:
    """Settling times (draws, ...) as (..., draws), infinite where a run never settled."""
    return np.nan_to_num(np.moveaxis(settle_s, 0, -1), nan=np.inf)


def _shown(quantity: _Quantity, cells: Sequence[NDArray], alike: Sequence[NDArray]) -> Shown:
    """The colour scale: of distinct cells, capped where a few lie far beyond the others."""
    if quantity.is_share:
        return Shown(quantity.name, 0.0, 100.0)
    distinct = [
        values.ravel()[np.unique(kinds, return_index=True)[1]]
        for values, kinds in zip(cells, alike, strict=True)
    ]
    known = np.concatenate(distinct)
    low, high = colour_range(known[np.isfinite(known)])
    digits = 0 if high >= 100 or quantity.settles else 1
    return Shown(quantity.name, low, high, reverse=True, digits=digits)


def _alike(panel: Panel, value: str) -> NDArray:
    """A number per cell (rows, columns), the same for cells with the same runs in all draws.

    Runs are told apart by their final heading error; without that column each cell is its own kind.
    """
    if _YAW not in panel.rows.column_names:
        return np.arange(np.prod(panel.shape)).reshape(panel.shape)
    runs = np.stack(
        [
            np.nan_to_num(panel.column_values(name), nan=np.inf)
            for name in dict.fromkeys([value, _YAW])
        ]
    )
    flat = runs.reshape(-1, np.prod(panel.shape)).T
    kinds = np.unique(flat, axis=0, return_inverse=True)[1]
    return np.asarray(kinds).reshape(panel.shape)


def _best(runs: NDArray, quantity: _Quantity) -> tuple[int, int] | None:
    """The best cell of runs (draws, rows, columns), or None if several or none are."""
    cells = quantity.of(runs)
    order = cells if quantity.reverse else -cells
    if not np.isfinite(order).any() or np.ptp(order[np.isfinite(order)]) == 0:
        return None
    settled = np.isfinite(runs).mean(axis=0)
    rank = np.lexsort((order.ravel(), -settled.ravel()))[0]
    row, column = np.unravel_index(rank, cells.shape)
    is_tied = quantity.is_share and np.count_nonzero(order == order[row, column]) > 1
    return None if is_tied else (int(row), int(column))


def _most(flags: NDArray) -> NDArray:
    """Cells (rows, columns) in which a flag (draws, rows, columns) is set for most known runs."""
    return np.asarray(2 * np.nansum(flags, axis=0) > np.isfinite(flags).sum(axis=0))


def _panel_names(points: Sequence[Mapping[str, Any]]) -> list[str]:
    """The title of each panel; a single key is named in the first one, with its value in all."""
    names = [name_of(point) if point else "" for point in points]
    if len(points) > 1 and len(points[0]) == 1:
        (key,) = points[0]
        unit = label(key).partition("(")[2].rstrip(")")
        texts = [value_text(point[key]) for point in points]
        names[1:] = [
            f"{text} {unit}".rstrip() if text[-1:].isdigit() else text for text in texts[1:]
        ]
    return names


def _finding(
    table: pa.Table,
    axes: Mapping[str, Sequence[Any]],
    value: str,
    quantity: _Quantity,
    chosen: Sequence[str],
) -> str:
    """What is best, in words: a cell, and a point of the chosen keys, over all other runs."""
    found = []
    for point, rows in group_rows(table, chosen):
        _, (panel,) = split_into_panels(rows, *axes)
        runs = panel.column_values(value)
        if _best(runs, quantity) is None:
            continue
        settled = np.isfinite(runs).mean(axis=0)
        shown = np.nansum(runs, axis=0) / np.maximum(settled * len(runs), 1)  # mean of the settled
        shown = shown if quantity.settles else quantity.of(runs)
        order = np.nan_to_num(shown, nan=np.inf) * (1 if quantity.reverse else -1)
        best = np.lexsort((order.ravel(), -settled.ravel()))[0]
        here = dict(point)
        for name in (*axes, *{"reset_times_s"}.intersection(rows.column_names)):
            here[name] = panel.rows[name][int(best)].as_py()
        found.append((-settled.flat[best], order.flat[best], here, shown.flat[best]))
    if not found:
        return f"{quantity.name[:1].upper()}{quantity.name[1:]}"
    missing, _, point, shown = min(found, key=lambda one: one[:2])
    words = point_text(point)
    if not quantity.settles:
        unit = quantity.name.rpartition("(")[2].rstrip(")")
        return f"Best: {words} ({shown:.3g} {unit})"
    if missing > -1:
        return f"Most often: {words} ({-100 * missing:.3g} % of the runs settle)"
    return f"Soonest: {words} ({shown:.0f} s{' on average' * (runs.shape[0] > 1)})"
