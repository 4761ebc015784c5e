"""Maps of runs over two swept keys: `sinsjax.plot_map`."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from sinsjax.analysis.grids import median_over_draws, split_into_panels
from sinsjax.analysis.tables import group_rows, require_column, to_arrow_table, to_key_list
from sinsjax.errors import InputError
from sinsjax.plots.labels import axis_label, describe_axis_point, describe_point, format_value
from sinsjax.plots.style import ABOVE_SCALE, COLOURS, LETTERS, colour_range, with_style

MAX_PANELS = 12
"""Panels of a figure at most."""

_NEVER: Any = {"facecolor": "#dcdcdc", "edgecolor": "#b5b5b5", "hatch": "////"}
_FLAGS = {
    "ok_floor": "successful runs, from the bias floor (%)",
    "ok_truth": "successful runs, from the truth (%)",
}
_MARKED = "xx"
_ROOMY = 6  # most cells side by side in a panel with full-size numbers
_LEGIBLE = 10  # most cells side by side with small numbers
_LETTERS = 9  # characters per inch in a panel's title
_FRAME: Any = {"edgecolor": COLOURS[1], "linewidth": 3.5, "fill": False}


class CellStatistic(NamedTuple):
    """The statistic of a column in a cell of a map.

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


class MapPanel(NamedTuple):
    """A panel of a map.

    Attributes:
        title: text above it.
        values: (rows, columns) of the cells; a non-finite one means *never*.
        hatched: (rows, columns) cells to hatch; None for none.
        framed: the cell (row, column) to frame; None for none.
    """

    title: str
    values: NDArray
    hatched: NDArray | None = None
    framed: tuple[int, int] | None = None


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
    axes, grids = split_into_panels(table, rows, columns, by)
    statistic = _cell_statistic(require_column(table, value), value)
    chosen = [key for key in by if pooled is not None and key not in pooled]
    best_title, best_point = _best_cell_overall(table, axes, value, statistic, chosen)
    grids = grids[:MAX_PANELS]
    panels = [
        MapPanel(
            name,
            statistic.compute(grid.column_values(value)),
            _flagged_cells(grid.column_values(hatched)) if hatched else None,
            _named_cell(grid.point, axes, best_point),
        )
        for name, grid in zip(_panel_titles([grid.point for grid in grids]), grids, strict=True)
    ]
    across = {format_value(grid.point[by[-1]]) for grid in grids} if by else [""]
    title = title or best_title
    return draw_heat_maps(panels, title, statistic, axes, len(across), hatch_name)


def _cell_statistic(column: pa.ChunkedArray, name: str) -> CellStatistic:
    if name.startswith("settle_"):
        which = "expected" if name.endswith("_mean_s") else "median"
        band, *truth = name.removeprefix("settle_").split("_")
        aim = "truth" if "truth" in truth else "bias floor"
        shown = f"{which} time (s) to stay within {band}' of the {aim}"
        return CellStatistic(shown, _median_settling_time, is_settling_time=True)
    if pa.types.is_boolean(column.type) or name.endswith("_share"):
        share = _FLAGS.get(name, f"{axis_label(name.removesuffix('_share'))} (%)")
        return CellStatistic(
            share, lambda runs: 100 * runs.mean(axis=0), small_is_better=False, is_share=True
        )
    return CellStatistic(f"rms of {axis_label(name)}", lambda runs: np.sqrt((runs**2).mean(axis=0)))


def _median_settling_time(settle_s: NDArray) -> NDArray:
    """The median over the draws of (draws, ...), infinite where most runs never settle."""
    return median_over_draws(np.nan_to_num(np.moveaxis(settle_s, 0, -1), nan=np.inf))


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
    statistic: CellStatistic,
    choice_keys: Sequence[str],
) -> tuple[str, dict[str, Any]]:
    """Return a title that names the best cell and the best point of the choice keys, and both.

    The best has the fewest runs that never settle, then the shortest mean. If no cell is the best,
    the title names the statistic, and there is no point.
    """
    found = []
    for point, rows in group_rows(table, choice_keys):
        _, (panel,) = split_into_panels(rows, *axes)
        runs = panel.column_values(column)
        cells = statistic.compute(runs)
        known = cells[np.isfinite(cells)]
        if not known.size or np.ptp(known) == 0:
            continue
        if statistic.is_share and np.sum(known == known.max()) > 1:
            continue
        settled = np.isfinite(runs).mean(axis=0)
        if statistic.is_settling_time:  # mean of those that settle
            cells = np.nansum(runs, axis=0) / np.maximum(settled * len(runs), 1)
        order = np.nan_to_num(cells, nan=np.inf) * (1 if statistic.small_is_better else -1)
        best = int(np.lexsort((order.ravel(), -settled.ravel()))[0])
        best_point = dict(point)
        for name in (*axes, *{"reset_times_s"}.intersection(rows.column_names)):
            best_point[name] = panel.rows[name][best].as_py()
        found.append((-settled.flat[best], order.flat[best], best_point, cells.flat[best]))
    if not found:
        return f"{statistic.name[:1].upper()}{statistic.name[1:]}", {}
    missing, _, point, shown = min(found, key=lambda candidate: candidate[:2])
    words = describe_axis_point(point)
    if not statistic.is_settling_time:
        unit = statistic.name.rpartition("(")[2].rstrip(")")
        return f"Best: {words} ({shown:.3g} {unit})", point
    if missing > -1:
        return f"Most often: {words} ({-100 * missing:.3g} % of the runs settle)", point
    return f"Soonest: {words} ({shown:.0f} s{' on average' * (runs.shape[0] > 1)})", point


@with_style
def draw_heat_maps(
    panels: Sequence[MapPanel],
    title: str,
    statistic: CellStatistic,
    axes: Mapping[str, Sequence[Any]],
    panels_per_row: int = 4,
    hatch_name: str = "",
) -> Figure:
    """Draw heat maps of one quantity over two swept keys, side by side.

    Args:
        panels: the panels.
        title: title of the figure.
        statistic: quantity to show.
        axes: values of the key from bottom to top, and of that from left to right.
        panels_per_row: panels per row, such as the values of a third key; at most 4.
        hatch_name: meaning of the hatch, for the legend.
    """
    (row_key, row_values), (column_key, column_values) = axes.items()
    width = min(4, panels_per_row, len(panels))
    height = -(-len(panels) // width)
    side = max(2.3, 7.2 / width)  # width of a panel, in; together as wide as the title
    wide, tall = side * width + 2.0, 3.0 * height + 1.3
    # Set before the axes are created: later, every tick would be created twice.
    tick = 10.5 if len(column_values) <= _ROOMY else 9
    mpl.rcParams.update({"axes.grid": False, "xtick.labelsize": tick})
    figure = Figure(figsize=(wide, tall))
    figure.suptitle(fill(title, int(LETTERS * wide)))
    grid = figure.subplots(height, width, sharex=True, sharey=True, squeeze=False)
    across = [_tick_label(column_key, value) for value in column_values]
    grid[0, 0].set_xticks(range(len(across)), across)
    grid[0, 0].set_yticks(range(len(row_values)), [_tick_label(row_key, v) for v in row_values])
    norm, digits = _colour_scale(statistic, panels)
    for place, panel in zip(grid.flat, panels, strict=False):
        image = _draw_heat_map(place, panel, norm, digits, reverse=statistic.small_is_better)
        place.set_title(fill(panel.title, int(_LETTERS * side)))
    for place in list(grid.flat)[len(panels) :]:
        place.set_visible(False)
    for place in grid[:, 0]:
        place.set_ylabel(axis_label(row_key))
    turned = 0.085 * sum(map(len, across)) > 0.8 * side
    for place in list(grid.flat)[max(len(panels) - width, 0) : len(panels)]:
        place.set_xlabel(axis_label(column_key))
        place.tick_params(axis="x", labelbottom=True, labelrotation=90 if turned else 0)
    above = any((p.values[np.isfinite(p.values)] > norm.vmax).any() for p in panels)
    bar = fill(f"{statistic.name}{ABOVE_SCALE if above else ''}", int(8 * tall))
    figure.colorbar(image, ax=grid, label=bar, aspect=30, extend="max" if above else "neither")
    if handles := [*_legend_handles(panels, statistic, hatch_name)]:
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _tick_label(key: str, value: Any) -> str:
    return "none" if key == "reset_count" and value == 0 else format_value(value)


def _colour_scale(statistic: CellStatistic, panels: Sequence[MapPanel]) -> tuple[Normalize, int]:
    """The colours and the decimals: of distinct values, capped where a few lie far beyond."""
    if statistic.is_share:
        return Normalize(0.0, 100.0, clip=True), 0
    # Equal cells, such as those of no reset, count once.
    distinct = [np.unique(panel.values[np.isfinite(panel.values)]) for panel in panels]
    low, high = colour_range(np.concatenate(distinct))
    return Normalize(low, high, clip=True), 0 if high >= 100 or statistic.is_settling_time else 1


def _legend_handles(
    panels: Sequence[MapPanel], statistic: CellStatistic, hatch_name: str
) -> Iterator[Patch]:
    if any(not np.isfinite(panel.values).all() for panel in panels):
        yield Patch(**_NEVER, label="never (median)")
    if any(panel.hatched is not None and panel.hatched.any() for panel in panels):
        yield Patch(facecolor="none", edgecolor="black", hatch=_MARKED, label=hatch_name)
    if any(panel.framed is not None for panel in panels):
        yield Patch(**_FRAME, label="soonest" if statistic.is_settling_time else "best")


def _draw_heat_map(
    axes: Axes, panel: MapPanel, norm: Normalize, digits: int, *, reverse: bool
) -> AxesImage:
    values = np.ma.masked_invalid(panel.values)
    colours = "viridis_r" if reverse else "viridis"
    image = axes.imshow(values, cmap=colours, norm=norm, aspect="auto", origin="lower")
    axes.patch.set(**_NEVER)  # behind masked cells
    light = np.ma.filled(norm(values), 0.0) > 0.5
    shades = np.where(light != reverse, "black", "white")
    for row, column in np.argwhere(np.isfinite(panel.values)):
        shade, corner = shades[row, column], (column - 0.5, row - 0.5)
        is_hatched = panel.hatched is not None and panel.hatched[row, column]
        if is_hatched:
            style: Any = {"fill": False, "edgecolor": shade, "hatch": _MARKED, "linewidth": 0}
            axes.add_patch(Rectangle(corner, 1, 1, **style))
        if values.shape[1] > _LEGIBLE:
            continue
        number = f"{values[row, column]:.{digits}f}"
        size = 9.0 if values.shape[1] <= _ROOMY else 7.5
        text = axes.text(column, row, number, ha="center", va="center", size=size, color=shade)
        text.set_in_layout(False)
        if is_hatched:  # a hatch leaves room for the number
            colour = image.to_rgba(values[row, column])
            text.set_bbox({"facecolor": colour, "linewidth": 0, "pad": 1.0})
    if panel.framed is not None:
        row, column = panel.framed
        style = _FRAME | {"clip_on": False, "zorder": 3}
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, **style))
    return image
