"""The figure of a tuning run: descents over the sampled objective."""

from collections.abc import Sequence
from itertools import combinations
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from sinsjax.plots.style import (
    GREY,
    add_colour_bar,
    add_legend_below,
    add_title,
    colour_range,
    line_colour,
    set_log_scale,
    with_style,
)

_MARKERS = "*D^soPXv"
_EDGE: Any = [withStroke(linewidth=3.0, foreground="black")]
_LETTERS = 44  # characters per line of an axis label
_MOST_PANELS = 10  # pairs of variables; more would not be legible
_SMALL, _LARGE = 4.0, 320.0  # pt: the side of a point, and that of all points of a grid together


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
) -> Figure:
    """Draw descents over sampled points: a curve of one variable, or a panel per pair of more.

    Args:
        variables: the variables.
        points: the points of a search; its name is that of the objective, with its unit.
        descents: the descents.
        marked: marked points, such as the best point of each search.
        title: title of the figure.
    """
    pairs = list(combinations(range(len(variables)), min(2, len(variables))))[:_MOST_PANELS]
    across = min(3, len(pairs))
    down = -(-len(pairs) // across)
    size = (8.4, 6.2) if len(pairs) == 1 else (1.4 + 3.3 * across, 1.5 + 3.0 * down)
    figure = Figure(figsize=size)
    add_title(figure, title)
    grid = figure.subplots(down, across, squeeze=False)
    for axes in grid.flat[len(pairs) :]:
        axes.set_visible(False)
    for axes, pair in zip(grid.flat, pairs, strict=False):
        x, y = _coordinates(points, pair)
        if len(pair) == 1:
            order = np.argsort(x)
            axes.plot(x[order], y[order], ".-", color=GREY, label="points of the search")
            axes.set_ylabel(fill(points.name, _LETTERS))
        else:
            order = np.argsort(-points.objective)  # the best on top
            side = max(_SMALL, _LARGE / len(np.unique(x)))
            colours: Any = {"cmap": "viridis_r", "norm": colour_range(points.objective)}
            colours |= {"c": points.objective[order], "plotnonfinite": False}
            image = axes.scatter(x[order], y[order], side**2, marker="s", **colours)
            axes.set_ylabel(variables[pair[1]].name)
        _draw_descents_and_marks(axes, pair, descents, marked)
        axes.set_xlabel(variables[pair[0]].name)
        for axis, i in zip((axes.xaxis, axes.yaxis), pair, strict=False):
            if variables[i].log:
                set_log_scale(axis, points.values[:, i].min(), points.values[:, i].max())
    if len(variables) > 1:
        add_colour_bar(figure, grid, image, points.name, points.objective)
    add_legend_below(figure, grid[0, 0])
    return figure


def _coordinates(points: Points, pair: Sequence[int]) -> tuple[NDArray, NDArray]:
    """Places of points in a panel: two variables, or one and the objective."""
    along = [*points.values.T[list(pair)], points.objective]
    return along[0], along[1]


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
        (x,), (y,) = _coordinates(point, pair)
        colour, marker = line_colour(number + 1), _MARKERS[number % len(_MARKERS)]
        if np.isnan(y):  # its objective is unknown
            axes.axvline(x, color=colour, linestyle=":", label=point.name)
            continue
        style: Any = {"marker": marker, "markersize": 15 if marker == "*" else 9, "color": colour}
        style |= {"markeredgecolor": "black", "linestyle": "none", "label": point.name}
        axes.plot(x, y, zorder=5 + len(marked) - number, **style)
