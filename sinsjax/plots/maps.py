"""Maps of runs over two swept keys: `sinsjax.plot_map`."""

from collections.abc import Callable, Mapping, Sequence
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
from sinsjax.plots.labels import (
    axis_label,
    describe_axis_point,
    describe_point,
    format_value,
    name_and_unit,
)
from sinsjax.plots.style import COLOURS, LETTERS, add_colour_bar, colour_range, with_style

MAX_PANELS = 12
"""Panels of a figure at most."""

_NEVER: Any = {"facecolor": "#dcdcdc", "edgecolor": "#b5b5b5", "hatch": "////"}
_FLAGS = {
    "ok_floor": "successful runs, from the bias floor (%)",
    "ok_truth": "successful runs, from the truth (%)",
}
_ROOMY = 6  # most cells side by side in a panel with full-size numbers
_LEGIBLE = 10  # most cells side by side with small numbers
_LETTERS = 9  # characters per inch in a panel's title
_MARKED = "xx"
_FRAME: Any = {"edgecolor": COLOURS[1], "linewidth": 3.5, "fill": False}


class CellStatistic(NamedTuple):
    """The statistic of a column in a cell of a map.

    Attributes:
        kind: "time" of settling, "share" in percent, or "rms".
        name: label of the colour bar, with its unit.
        compute: function of values (draws, rows, columns) that returns (rows, columns).
    """

    kind: str
    name: str
    compute: Callable[[NDArray], NDArray]


class CellStyle(NamedTuple):
    """Colours of the cells of a map, and decimals of their numbers."""

    norm: Normalize
    colours: str
    digits: int


@with_style
def plot_map(  # noqa: PLR0913
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
    cells = [statistic.compute(grid.column_values(value)) for grid in grids]
    flags = [grid.column_values(hatched) for grid in grids] if hatched else []
    marked = [2 * np.nansum(runs, axis=0) > np.isfinite(runs).sum(axis=0) for runs in flags]
    width = min(4, len({format_value(grid.point[by[-1]]) for grid in grids}) if by else 1)
    height = -(-len(grids) // width)
    side = max(2.3, 7.2 / width)  # width of a panel, in; together as wide as the title
    wide, tall = side * width + 2.0, 3.0 * height + 1.3
    up, across = ([_tick_label(key, v) for v in values] for key, values in axes.items())
    # Set before the axes are created: later, every tick would be created twice.
    tick = 10.5 if len(across) <= _ROOMY else 9
    mpl.rcParams.update({"axes.grid": False, "xtick.labelsize": tick})
    figure = Figure(figsize=(wide, tall))
    figure.suptitle(fill(title or best_title, int(LETTERS * wide)))
    places = figure.subplots(height, width, sharex=True, sharey=True, squeeze=False)
    places[0, 0].set_xticks(range(len(across)), across)
    places[0, 0].set_yticks(range(len(up)), up)
    # Equal cells, such as those of no reset, count once.
    known = np.concatenate([np.unique(values[np.isfinite(values)]) for values in cells])
    low, high = (0.0, 100.0) if statistic.kind == "share" else colour_range(known)
    style = CellStyle(
        Normalize(low, high, clip=True),
        "viridis" if statistic.kind == "share" else "viridis_r",  # light is good
        1 if statistic.kind == "rms" and high < 100 else 0,
    )
    titles, legend = _panel_titles([grid.point for grid in grids]), {}
    for number, (place, grid) in enumerate(zip(places.flat, grids, strict=False)):
        hatch = marked[number] if marked else np.zeros(grid.shape, bool)
        image = _draw_cells(place, cells[number], hatch, style)
        place.set_title(fill(titles[number], int(_LETTERS * side)))
        # In every panel that the named cell is in.
        if best_point and all(best_point.get(key, at) == at for key, at in grid.point.items()):
            row, column = (list(values).index(best_point[key]) for key, values in axes.items())
            frame: Any = _FRAME | {"clip_on": False, "zorder": 3}
            place.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, **frame))
            legend["soonest" if statistic.kind == "time" else "best"] = _FRAME
    for place in list(places.flat)[len(grids) :]:
        place.set_visible(False)
    for place in places[:, 0]:
        place.set_ylabel(axis_label(rows))
    turned = 0.085 * sum(map(len, across)) > 0.8 * side
    for place in list(places.flat)[max(len(grids) - width, 0) : len(grids)]:
        place.set_xlabel(axis_label(columns))
        place.tick_params(axis="x", labelbottom=True, labelrotation=90 if turned else 0)
    add_colour_bar(figure, places, image, statistic.name, known, int(8 * tall))
    if any(hatch.any() for hatch in marked):
        hatch_style = {"facecolor": "none", "edgecolor": "black", "hatch": _MARKED}
        legend = {hatch_name: hatch_style} | legend
    if not all(np.isfinite(values).all() for values in cells):
        legend = {"never (median)": _NEVER} | legend
    if legend:
        handles = [Patch(**patch, label=label) for label, patch in legend.items()]
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _cell_statistic(column: pa.ChunkedArray, name: str) -> CellStatistic:
    if name.startswith("settle_"):
        band, *truth = name.removeprefix("settle_").split("_")
        aim = "truth" if "truth" in truth else "bias floor"
        shown = f"median time (s) to stay within {band}' of the {aim}"
        return CellStatistic("time", shown, _median_settling_time)
    if pa.types.is_boolean(column.type) or name.endswith("_share"):
        share = _FLAGS.get(name, f"{axis_label(name.removesuffix('_share'))} (%)")
        return CellStatistic("share", share, lambda runs: 100 * runs.mean(axis=0))
    name = f"rms of {axis_label(name)}"
    return CellStatistic("rms", name, lambda runs: np.sqrt((runs**2).mean(axis=0)))


def _median_settling_time(settle_s: NDArray) -> NDArray:
    """The median over the draws of (draws, ...), infinite where most runs never settle."""
    return median_over_draws(np.nan_to_num(np.moveaxis(settle_s, 0, -1), nan=np.inf))


def _panel_titles(points: Sequence[Mapping[str, Any]]) -> list[str]:
    """The title of each panel; a single key is named in the first one, with its value in all."""
    names = [describe_point(point) if point else "" for point in points]
    if len(points[0]) == 1:
        key_name = name_and_unit(*points[0])[0]
        names[1:] = [name.removeprefix(f"{key_name} ") for name in names[1:]]
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
        if statistic.kind == "share" and np.sum(known == known.max()) > 1:
            continue
        settled = np.isfinite(runs).mean(axis=0)
        if statistic.kind == "time":  # mean of those that settle
            cells = np.nansum(runs, axis=0) / np.maximum(settled * len(runs), 1)
        order = np.nan_to_num(cells, nan=np.inf) * (-1 if statistic.kind == "share" else 1)
        best = int(np.lexsort((order.ravel(), -settled.ravel()))[0])
        best_point = dict(point)
        for name in (*axes, *{"reset_times_s"}.intersection(rows.column_names)):
            best_point[name] = panel.rows[name][best].as_py()
        found.append((-settled.flat[best], order.flat[best], best_point, cells.flat[best]))
    if not found:
        return f"{statistic.name[:1].upper()}{statistic.name[1:]}", {}
    missing, _, point, shown = min(found, key=lambda candidate: candidate[:2])
    words = describe_axis_point(point)
    if statistic.kind != "time":
        unit = statistic.name.rpartition("(")[2].rstrip(")")
        return f"Best: {words} ({shown:.3g} {unit})", point
    if missing > -1:
        return f"Most often: {words} ({-100 * missing:.3g} % of the runs settle)", point
    return f"Soonest: {words} ({shown:.0f} s{' on average' * (runs.shape[0] > 1)})", point


def _tick_label(key: str, value: Any) -> str:
    return "none" if key == "reset_count" and value == 0 else format_value(value)


def _draw_cells(axes: Axes, cells: NDArray, hatched: NDArray, style: CellStyle) -> AxesImage:
    """Draw the cells of a panel; a non-finite one means *never*."""
    values = np.ma.masked_invalid(cells)
    options: Any = {"cmap": style.colours, "norm": style.norm, "aspect": "auto", "origin": "lower"}
    image = axes.imshow(values, **options)
    axes.patch.set(**_NEVER)  # behind masked cells
    light = np.ma.filled(style.norm(values), 0.0) > 0.5
    shades = np.where(light != style.colours.endswith("_r"), "black", "white")
    for row, column in np.argwhere(np.isfinite(cells)):
        shade, is_hatched = shades[row, column], hatched[row, column]
        if is_hatched:
            patch: Any = {"fill": False, "edgecolor": shade, "hatch": _MARKED, "linewidth": 0}
            axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, **patch))
        if cells.shape[1] <= _LEGIBLE:
            number = f"{cells[row, column]:.{style.digits}f}"
            font: Any = {"size": 9.0 if cells.shape[1] <= _ROOMY else 7.5, "color": shade}
            text = axes.text(column, row, number, ha="center", va="center", **font)
            text.set_in_layout(False)
            if is_hatched:  # a hatch leaves room for the number
                colour = image.to_rgba(cells[row, column])
                text.set_bbox({"facecolor": colour, "linewidth": 0, "pad": 1.0})
    return image
