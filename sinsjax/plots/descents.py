"""The figure of a tuning run: descents over the sampled objective."""

from collections.abc import Sequence
from itertools import combinations
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from sinsjax.plots.style import (
    COLOURS,
    GREY,
    LETTERS,
    add_colour_bar,
    add_legend_below,
    colour_range,
    set_log_scale,
    with_style,
)

_COLOURS = "viridis_r"  # light where the objective is small
_MARKERS = ("*", "D", "^", "s", "o", "P", "X", "v")
_MARKER_COLOURS = (1, 3, 6, 4, 5, 0, 1, 2)
_EDGE: Any = [withStroke(linewidth=3.0, foreground="black")]
_LETTERS = 44  # characters per line of an axis label
_MOST_PANELS = 10  # pairs of variables; more would not be legible


class VariableAxis(NamedTuple):
    """A variable along an axis: its label with the unit, and whether the axis is logarithmic."""

    name: str
    log: bool


class Points(NamedTuple):
    """Points of a search, of a descent in its order, or a single one that is marked.

    Attributes:
        name: label in the legend.
        values: (points, variables).
        objective: (points,) of a descent relaxed; infinite if a point has none, NaN if unknown.
    """

    name: str
    values: NDArray
    objective: NDArray


@with_style
def draw_descents(
    variables: Sequence[VariableAxis],
    points: Points,
    descents: Sequence[Points],
    marked: Sequence[Points],
    title: str,
    *,
    grid_points: int | None = None,
) -> Figure:
    """Descents over sampled points: a curve of one variable, or a panel for each pair of more.

    Args:
        variables: the variables.
        points: the points of a search; its name is that of the objective, with its unit.
        descents: the descents.
        marked: marked points, such as the best point of each search.
        title: title of the figure.
        grid_points: points along each variable if they form a grid, the last one fastest.
    """
    number = min(2, len(variables))  # of variables of a panel
    pairs = list(combinations(range(len(variables)), number))[:_MOST_PANELS]
    across = min(3, len(pairs))
    down = -(-len(pairs) // across)
    size = (8.4, 6.2) if len(pairs) == 1 else (1.4 + 3.3 * across, 1.5 + 3.0 * down)
    figure = Figure(figsize=size)
    figure.suptitle(fill(title, int(LETTERS * size[0])))
    grid = figure.subplots(down, across, squeeze=False)
    objective = points.objective[np.isfinite(points.objective)]
    norm, name = Normalize(*colour_range(objective)), points.name
    for axes, pair in zip(grid.flat, pairs, strict=False):
        x, *y = _coordinates(points, pair)
        if len(variables) == 1:
            order = np.argsort(x)
            style: Any = {"color": GREY, "marker": ".", "label": "points of the search"}
            axes.plot(x[order], y[0][order], **style)
            axes.set_ylabel(fill(name, _LETTERS))
        else:
            if grid_points and len(variables) == 2:
                edges = (_cell_edges(points.values[:, i], variables[i].log) for i in pair)
                cells = points.objective.reshape(grid_points, grid_points).T
                axes.grid(visible=False)
                axes.pcolormesh(*edges, np.ma.masked_invalid(cells), cmap=_COLOURS, norm=norm)
            else:
                order = np.argsort(-points.objective)  # the best on top
                style = {"c": points.objective[order], "cmap": _COLOURS, "norm": norm, "s": 16}
                axes.scatter(x[order], y[0][order], **style)
            axes.set_ylabel(variables[pair[1]].name)
        _draw_descents_and_marks(axes, pair, descents, marked)
        axes.set_xlabel(variables[pair[0]].name)
        for axis, i in zip((axes.xaxis, axes.yaxis), pair, strict=False):
            if variables[i].log:
                set_log_scale(axis, points.values[:, i].min(), points.values[:, i].max())
    for axes in list(grid.flat)[len(pairs) :]:
        axes.set_visible(False)
    if len(variables) > 1:
        image = ScalarMappable(norm, _COLOURS)
        add_colour_bar(figure, grid, image, name, objective, _LETTERS)
    add_legend_below(figure, grid[0, 0])
    return figure


def _coordinates(points: Points, pair: Sequence[int]) -> list[NDArray]:
    """Places of points in a panel: two variables, or one and the objective."""
    along = [points.values[:, number] for number in pair]
    return along if len(pair) == 2 else [*along, points.objective]


def _cell_edges(values: NDArray, log: bool) -> NDArray:
    """Edges of cells around the evenly spaced values of a variable, of which there are several."""
    places = np.unique(np.log(values) if log else values)
    half = (places[1] - places[0]) / 2
    edges = np.append(places - half, places[-1] + half)
    return np.exp(edges) if log else edges


def _draw_descents_and_marks(
    axes: Axes, pair: Sequence[int], descents: Sequence[Points], marked: Sequence[Points]
) -> None:
    for number, descent in enumerate(descents):
        x, y = _coordinates(descent, pair)
        name = descent.name if number == 0 else None
        axes.plot(x, y, color="white", linewidth=1.6, path_effects=_EDGE, zorder=3)
        axes.plot(x, y, ".", color="black", markersize=3, zorder=4)
        axes.plot(x[:1], y[:1], "o", mfc="white", mec="black", color="black", label=name, zorder=4)
    for number, point in enumerate(marked):
        kind = number % len(_MARKERS)
        colour, marker = COLOURS[_MARKER_COLOURS[kind]], _MARKERS[kind]
        (x,), (y,) = _coordinates(point, pair)
        if np.isnan(y):  # its objective is unknown
            axes.axvline(x, color=colour, linestyle=":", label=point.name)
            continue
        style: Any = {"marker": marker, "markersize": 15 if marker == "*" else 9, "color": colour}
        style |= {"markeredgecolor": "black", "linestyle": "none", "label": point.name}
        axes.plot(x, y, zorder=5 + len(marked) - number, **style)
