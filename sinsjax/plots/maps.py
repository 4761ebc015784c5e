"""Maps: of runs over two swept keys, `sinsjax.plot_map`, and of a tuning's points."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import combinations, product
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from sinsjax.analysis.labels import axis_label, describe_point, format_value
from sinsjax.analysis.tables import Grid, require_column, to_arrow_table, to_key_list
from sinsjax.errors import InputError
from sinsjax.plots.style import (
    COLOURS,
    GREY,
    add_colour_bar,
    add_legend_below,
    add_title,
    colour_range,
    line_colour,
    set_log_scale,
    with_style,
)

MAX_PANELS = 12  # of a map
_NEVER: Any = {"facecolor": "#dcdcdc", "edgecolor": "#b5b5b5", "hatch": "////"}
_FRAME: Any = {"edgecolor": COLOURS[1], "linewidth": 3.5, "fill": False}
_FLAGS = {
    "ok_floor": "successful runs, from the bias floor (%)",
    "ok_truth": "successful runs, from the truth (%)",
}
_LEGIBLE = 10  # most cells side by side with numbers
_LETTERS = 9  # characters per inch in a panel's title
_MARKERS = "*D^soPXv"
_EDGE: Any = [withStroke(linewidth=3.0, foreground="black")]
_MOST_PAIRS = 10  # of a tuning's variables; more panels would not be legible
_SMALL, _LARGE = 4.0, 320.0  # pt: the side of a point, and that of all points of a grid together


@with_style
def plot_map(
    runs: Any,
    rows: str,
    columns: str,
    value: str,
    *,
    by: str | Sequence[str] = (),
    best: Mapping[str, Any] | None = None,
    title: str = "",
) -> Figure:
    """Draw a statistic of the runs over two swept keys, one panel per point of further keys.

    The statistic follows the column: the median of a settling time (``settle_10_s``, s; *never* if
    fewer than half of the runs settle), the share of a flag (``ok_truth``) in percent, and the root
    mean square of any other number, in its own unit. An outlier ends beyond the colour scale
    instead of flattening it. Of many panels the first 12 are drawn.

    Args:
        runs: one row per run, with the keys and the value: a pyarrow Table such as
            `Results.summary`, or a pandas data frame.
        rows: key along the vertical axis.
        columns: key along the horizontal axis.
        value: column to show.
        by: key or keys of the panels; runs that differ in other keys share a cell.
        best: values by key of a cell to frame, in every panel that it is in.
        title: title of the figure; by default the statistic.

    Raises:
        InputError: no table, no runs, a missing column, or runs that form no full grid of the keys.

    Examples:
        >>> import pyarrow as pa
        >>> runs = pa.table({
        ...     "reset_count": [1, 1, 2, 2],
        ...     "reset_cycle_s": [10.0, 50.0, 10.0, 50.0],
        ...     "settle_10_s": [240.0, 320.0, 250.0, 190.0],
        ... })
        >>> figure = sinsjax.plot_map(runs, "reset_count", "reset_cycle_s", "settle_10_s")
        >>> figure.get_suptitle()
        "median time (s) to stay within 10' of the bias floor"
    """
    table, keys = to_arrow_table(runs), to_key_list(by)
    if not table.num_rows:
        raise InputError("plot_map: there are no runs")
    if len({rows, columns, *keys}) < len(keys) + 2:
        raise InputError("plot_map: rows, columns and by must be different keys")
    name, compute, colours = _cell_label_statistic_and_colours(require_column(table, value), value)
    grid = Grid.from_table(table, keys, (rows,), (columns,))
    points = [dict(zip(keys, point, strict=True)) for point in grid.axes[tuple(keys)]]
    points, up, across = points[:MAX_PANELS], grid.axes[rows,], grid.axes[columns,]
    cells = compute(grid.column(value))[:MAX_PANELS]
    width = min(4, len({format_value(point[keys[-1]]) for point in points}) if keys else 1)
    height = -(-len(points) // width)
    side = max(2.3, 7.2 / width)  # width of a panel, in; together as wide as the title
    figure = Figure(figsize=(side * width + 2.0, 3.0 * height + 1.3))
    add_title(figure, title or name)
    panels = figure.subplots(height, width, sharex=True, sharey=True, squeeze=False)
    words = [format_value(place) for (place,) in across]
    turned = 90 if 0.085 * sum(map(len, words)) > 0.8 * side else 0
    panels[0, 0].set_xticks(range(len(across)), words, rotation=turned)
    panels[0, 0].set_yticks(range(len(up)), [format_value(place) for (place,) in up])
    # Equal cells, such as those of no reset, count once.
    norm = colour_range(np.concatenate([np.unique(panel) for panel in cells]))
    norm = Normalize(0.0, 100.0) if name.endswith("(%)") else norm
    legend = {} if np.isfinite(cells).all() else {"never (median)": _NEVER}
    for axes, point, panel in zip(panels.flat, points, cells, strict=False):
        image = _draw_cells(axes, panel, norm, colours)
        axes.set_title(fill(describe_point(point), int(_LETTERS * side)) if point else "")
        for (row, y), (column, x) in product(enumerate(up), enumerate(across)):
            cell = point | {rows: y[0], columns: x[0]}
            same = (
                format_value(cell.get(k, v)) == format_value(v) for k, v in (best or {}).items()
            )
            if best and all(same):
                place = (column - 0.5, row - 0.5)
                axes.add_patch(Rectangle(place, 1, 1, **_FRAME, clip_on=False, zorder=3))
                legend["best"] = _FRAME
    for axes in panels.flat[len(points) :]:
        axes.set_visible(False)
    for axes in panels[:, 0]:
        axes.set_ylabel(axis_label(rows))
    for axes in panels.flat[max(len(points) - width, 0) : len(points)]:
        axes.set_xlabel(axis_label(columns))
        axes.tick_params(axis="x", labelbottom=True)
    add_colour_bar(figure, panels, image, name, cells)
    if legend:
        handles = [Patch(**patch, label=label) for label, patch in legend.items()]
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _cell_label_statistic_and_colours(
    column: pa.ChunkedArray, name: str
) -> tuple[str, Callable[[NDArray], NDArray], str]:
    """The name of the statistic of a column, its function of (..., draws), and its colours."""
    if name.startswith("settle_"):
        band, *truth = name.removeprefix("settle_").split("_")
        aim = "truth" if "truth" in truth else "bias floor"
        words = f"median time (s) to stay within {band}' of the {aim}"
        median = partial(np.quantile, q=0.5, axis=-1, method="inverted_cdf")
        return words, lambda runs: median(np.nan_to_num(runs, nan=np.inf)), "viridis_r"
    if pa.types.is_boolean(column.type):
        words = _FLAGS.get(name, f"{axis_label(name)} (%)")
        return words, lambda runs: 100 * runs.mean(axis=-1), "viridis"
    if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
        raise InputError(f"plot_map: column {name} has no numbers (give one that has)")
    words = f"rms of {axis_label(name)}"
    return words, lambda runs: np.sqrt((runs**2).mean(axis=-1)), "viridis_r"


def _draw_cells(axes: Axes, cells: NDArray, norm: Normalize, colours: str) -> AxesImage:
    """Draw the cells of a panel; a non-finite one means *never*."""
    axes.grid(visible=False)
    axes.patch.set(**_NEVER)  # behind masked cells
    style: Any = {"cmap": colours, "norm": norm, "aspect": "auto", "origin": "lower"}
    image = axes.imshow(np.ma.masked_invalid(cells), **style)
    digits = 0 if float(norm.vmax or 0.0) >= 100 else 1
    is_light = image.to_rgba(cells)[..., :3].mean(axis=-1) > 0.5
    for row, column in np.argwhere(np.isfinite(cells)) if cells.shape[1] <= _LEGIBLE else ():
        number = f"{cells[row, column]:.{digits}f}"
        font: Any = {"size": 9, "color": "black" if is_light[row, column] else "white"}
        axes.text(column, row, number, ha="center", va="center", **font).set_in_layout(False)
    return image


class Points(NamedTuple):
    """Points of a search, of a descent in its order, or a single one that is marked.

    Values are (points, variables); the objective is infinite if a point has none, NaN if unknown.
    """

    name: str
    values: NDArray
    objective: NDArray

    def places(self, pair: Sequence[int]) -> tuple[NDArray, NDArray]:
        """Their places in a panel: two variables, or one and the objective."""
        along = [*self.values.T[list(pair)], self.objective]
        return along[0], along[1]


@with_style
def draw_landscape(
    variables: Mapping[str, bool],
    points: Points,
    descents: Sequence[Points],
    marked: Sequence[Points],
    title: str,
) -> Figure:
    """Draw descents over sampled points: a curve of one variable, or a panel per pair of more.

    Variables are given by their labels, and whether the axis is logarithmic. The name of the points
    is that of the objective, with its unit. The best of each search, for example, is marked.
    """
    names, logs = list(variables), list(variables.values())
    pairs = list(combinations(range(len(names)), min(2, len(names))))[:_MOST_PAIRS]
    across = min(3, len(pairs))
    down = -(-len(pairs) // across)
    size = (8.4, 6.2) if len(pairs) == 1 else (1.4 + 3.3 * across, 1.5 + 3.0 * down)
    figure = Figure(figsize=size)
    add_title(figure, title)
    grid = figure.subplots(down, across, squeeze=False)
    for axes in grid.flat[len(pairs) :]:
        axes.set_visible(False)
    for axes, pair in zip(grid.flat, pairs, strict=False):
        x, y = points.places(pair)
        if len(pair) == 1:
            order = np.argsort(x)
            axes.plot(x[order], y[order], ".-", color=GREY, label="points of the search")
        else:
            order = np.argsort(-points.objective)  # the best on top
            side = max(_SMALL, _LARGE / len(np.unique(x)))
            colours: Any = {"cmap": "viridis_r", "norm": colour_range(points.objective)}
            colours |= {"c": points.objective[order], "plotnonfinite": False}
            image = axes.scatter(x[order], y[order], side**2, marker="s", **colours)
        _draw_descents_and_marks(axes, pair, descents, marked)
        labels = [*(names[i] for i in pair), fill(points.name, 44)]
        axes.set(xlabel=labels[0], ylabel=labels[1])
        for axis, i in zip((axes.xaxis, axes.yaxis), pair, strict=False):
            if logs[i]:
                set_log_scale(axis, points.values[:, i].min(), points.values[:, i].max())
    if len(names) > 1:
        add_colour_bar(figure, grid, image, points.name, points.objective)
    add_legend_below(figure, grid[0, 0])
    return figure


def _draw_descents_and_marks(
    axes: Axes, pair: Sequence[int], descents: Sequence[Points], marked: Sequence[Points]
) -> None:
    for number, descent in enumerate(descents):
        x, y = descent.places(pair)
        name = descent.name if number == 0 else None
        axes.plot(x, y, color="white", linewidth=1.6, path_effects=_EDGE, zorder=3)
        axes.plot(x, y, ".", color="black", markersize=3, zorder=4)
        axes.plot(x[:1], y[:1], "o", mfc="white", mec="black", color="black", label=name, zorder=4)
    for number, point in enumerate(marked):
        (x,), (y,) = point.places(pair)
        colour, marker = line_colour(number + 1), _MARKERS[number % len(_MARKERS)]
        if np.isnan(y):  # its objective is unknown
            axes.axvline(x, color=colour, linestyle=":", label=point.name)
            continue
        style: Any = {"marker": marker, "markersize": 15 if marker == "*" else 9, "color": colour}
        style |= {"markeredgecolor": "black", "linestyle": "none", "label": point.name}
        axes.plot(x, y, zorder=5 + len(marked) - number, **style)
