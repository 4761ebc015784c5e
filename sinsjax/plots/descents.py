"""Figures of a tuning run: descents over the sampled objective, and best objective by cost."""

from collections.abc import Sequence
from itertools import combinations
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from sinsjax.plots.style import (
    ABOVE_SCALE,
    COLOURS,
    GREY,
    LETTERS,
    add_legend_below,
    colour_range,
    line_colour,
    with_style,
)

_COLOURS = "viridis_r"  # light where the objective is small
_MARKERS = ("*", "D", "^", "s", "o", "P", "X", "v")
_EDGE: Any = [withStroke(linewidth=3.0, foreground="black")]
_LETTERS = 44  # characters per line of an axis label
_MOST_PANELS = 10  # pairs of variables; more would not be legible


class VariableAxis(NamedTuple):
    """A variable along one axis of a figure.

    Attributes:
        name: axis label, with its unit.
        low: lowest value.
        high: highest value.
        log: whether the axis is logarithmic.
    """

    name: str
    low: float
    high: float
    log: bool


class ObjectiveLandscape(NamedTuple):
    """The objective at the points of a search.

    Attributes:
        axes: the p variables.
        values: (n, p) points.
        objective: (n,) objective of each point; infinite where it has none.
        shape: number of points along each variable if they form a grid, the last one fastest.
        name: name of the objective, with its unit.
    """

    axes: Sequence[VariableAxis]
    values: NDArray
    objective: NDArray
    shape: tuple[int, ...] | None
    name: str


class DescentPath(NamedTuple):
    """A descent: (steps, p) values, and the (steps,) relaxed objectives at them."""

    values: NDArray
    objective: NDArray


class MarkedPoint(NamedTuple):
    """A marked point.

    Attributes:
        name: label in the legend.
        values: (p,) values of the variables.
        objective: its objective; None if unknown.
        style_index: number of its marker and colour.
    """

    name: str
    values: NDArray
    objective: float | None
    style_index: int


class CostCurve(NamedTuple):
    """Progress of a search.

    Attributes:
        name: name of the search.
        cost: (n,) cost so far, ascending.
        best: (n,) best objective at that cost.
        relaxed: whether the objective is relaxed.
        final: final cost and unrelaxed objective of a relaxed search, else None.
    """

    name: str
    cost: NDArray
    best: NDArray
    relaxed: bool
    final: tuple[float, float] | None


@with_style
def draw_descents(
    landscape: ObjectiveLandscape,
    paths: Sequence[DescentPath],
    points: Sequence[MarkedPoint],
    title: str,
) -> Figure:
    """Descents over a landscape: a curve of one variable, a map of two, or all pairs of more.

    Args:
        landscape: objective at points of one or more variables.
        paths: paths of the descents.
        points: marked points, such as the best point of each search.
        title: title of the figure.
    """
    count = len(landscape.axes)
    if count == 1:
        figure = Figure(figsize=(8.4, 5.2))
        _draw_curve(figure.subplots(), landscape, paths, points)
    elif count == 2:
        figure = Figure(figsize=(8.4, 6.4))
        axes = figure.subplots()
        norm = _colour_norm(landscape)
        if landscape.shape is not None:
            _draw_map(axes, landscape, norm)
        else:
            _draw_scatter(axes, landscape, (0, 1), norm)
        _draw_paths_and_points(axes, landscape.axes, (0, 1), paths, points)
        _add_colour_bar(figure, axes, landscape)
    else:
        figure = _draw_pairs(landscape, paths, points)
    figure.suptitle(fill(title, int(LETTERS * figure.get_figwidth())))
    add_legend_below(figure, figure.axes[0])
    return figure


def _draw_pairs(
    landscape: ObjectiveLandscape, paths: Sequence[DescentPath], points: Sequence[MarkedPoint]
) -> Figure:
    pairs = list(combinations(range(len(landscape.axes)), 2))[:_MOST_PANELS]
    across = min(3, len(pairs))
    down = -(-len(pairs) // across)
    figure = Figure(figsize=(1.4 + 3.3 * across, 1.5 + 3.0 * down))
    grid = figure.subplots(down, across, squeeze=False)
    norm = _colour_norm(landscape)
    for axes, pair in zip(grid.flat, pairs, strict=False):
        _draw_scatter(axes, landscape, pair, norm)
        _draw_paths_and_points(axes, landscape.axes, pair, paths, points)
    for axes in list(grid.flat)[len(pairs) :]:
        axes.set_visible(False)
    _add_colour_bar(figure, grid, landscape, shrink=0.9)
    return figure


def _colour_norm(landscape: ObjectiveLandscape) -> Normalize:
    return Normalize(*colour_range(landscape.objective[np.isfinite(landscape.objective)]))


def _add_colour_bar(figure: Figure, axes: Any, landscape: ObjectiveLandscape, **style: Any) -> None:
    norm = _colour_norm(landscape)
    finite = landscape.objective[np.isfinite(landscape.objective)]
    above = bool(np.any(finite > norm.vmax))
    name = fill(f"{landscape.name}{ABOVE_SCALE if above else ''}", _LETTERS)
    extend = "max" if above else "neither"
    mappable = ScalarMappable(norm, _COLOURS)
    figure.colorbar(mappable, ax=axes, label=name, aspect=30, extend=extend, **style)


def _draw_curve(
    axes: Axes,
    landscape: ObjectiveLandscape,
    paths: Sequence[DescentPath],
    points: Sequence[MarkedPoint],
) -> None:
    order = np.argsort(landscape.values[:, 0])
    axis = landscape.axes[0]
    axes.plot(
        landscape.values[order, 0],
        landscape.objective[order],
        color=GREY,
        marker=".",
        label="points of the search",
    )
    for number, path in enumerate(paths):
        style: Any = {"color": COLOURS[0], "linewidth": 1.1, "alpha": 0.8}
        name = "descents (relaxed)" if number == 0 else None
        axes.plot(path.values[:, 0], path.objective, marker=".", label=name, **style)
        axes.plot(
            path.values[0, 0], path.objective[0], marker="o", markerfacecolor="white", **style
        )
    for point in points:
        if point.objective is None:
            style = {"color": _point_colour(point.style_index), "linestyle": ":"}
            axes.axvline(point.values[0], label=point.name, **style)
            continue
        axes.plot(
            point.values[0], point.objective, label=point.name, **_point_style(point.style_index)
        )
    _set_axis_scale(axes.xaxis, axis)
    axes.set_ylabel(fill(landscape.name, _LETTERS))


def _draw_map(axes: Axes, landscape: ObjectiveLandscape, norm: Normalize) -> None:
    """Cells around the points of a grid; the first variable is horizontal."""
    assert landscape.shape is not None
    across, up = (
        _cell_edges(np.unique(landscape.values[:, i]), axis)
        for i, axis in enumerate(landscape.axes)
    )
    values = np.ma.masked_invalid(landscape.objective.reshape(landscape.shape).T)
    axes.grid(visible=False)
    axes.pcolormesh(across, up, values, cmap=_COLOURS, norm=norm)


def _cell_edges(centres: NDArray, axis: VariableAxis) -> NDArray:
    """Edges of cells around their centres, of which there are at least two."""
    places = np.log(centres) if axis.log else centres
    inner = (places[1:] + places[:-1]) / 2
    ends = 2 * places[[0, -1]] - inner[[0, -1]]
    edges = np.concatenate([ends[:1], inner, ends[1:]])
    return np.exp(edges) if axis.log else edges


def _draw_scatter(
    axes: Axes, landscape: ObjectiveLandscape, pair: tuple[int, int], norm: Normalize
) -> None:
    """All points, with the best on top."""
    order = np.argsort(-landscape.objective)
    x, y = (landscape.values[order, i] for i in pair)
    axes.scatter(x, y, c=landscape.objective[order], cmap=_COLOURS, norm=norm, s=16)


def _draw_paths_and_points(
    axes: Axes,
    variables: Sequence[VariableAxis],
    pair: tuple[int, int],
    paths: Sequence[DescentPath],
    points: Sequence[MarkedPoint],
) -> None:
    """Descents and marked points over a landscape of two variables."""
    for number, path in enumerate(paths):
        x, y = path.values[:, pair[0]], path.values[:, pair[1]]
        name = "descents, from the open circles" if number == 0 else None
        axes.plot(x, y, color="white", linewidth=1.6, path_effects=_EDGE, zorder=3)
        axes.plot(x, y, ".", color="black", markersize=3, zorder=4)
        axes.plot(x[:1], y[:1], "o", mfc="white", mec="black", color="black", label=name, zorder=4)
    for number, point in enumerate(points):
        axes.plot(
            point.values[pair[0]],
            point.values[pair[1]],
            label=point.name,
            zorder=5 + len(points) - number,
            **_point_style(point.style_index),
        )
    for axis, number in ((axes.xaxis, pair[0]), (axes.yaxis, pair[1])):
        _set_axis_scale(axis, variables[number])


def _set_axis_scale(axis: Axis, variable: VariableAxis) -> None:
    axis.set_label_text(variable.name)
    if not variable.log:
        return
    (axis.axes.set_xscale if isinstance(axis, XAxis) else axis.axes.set_yscale)("log")
    decades = np.log10(variable.high / variable.low)
    axis.set_major_locator(LogLocator(subs=(1.0,) if decades > 2 else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def _point_colour(style_index: int) -> str:
    return COLOURS[(1, 3, 6, 4, 5, 0, 1, 2)[style_index % len(_MARKERS)]]


def _point_style(style_index: int) -> dict[str, Any]:
    marker = _MARKERS[style_index % len(_MARKERS)]
    return {
        "marker": marker,
        "markersize": 15 if marker == "*" else 9,
        "color": _point_colour(style_index),
        "markeredgecolor": "black",
        "linestyle": "none",
    }


@with_style
def draw_best_by_cost(searches: Sequence[CostCurve], objective_name: str, title: str) -> Figure:
    """The best objective of each search against its cost so far.

    Args:
        searches: in the order of the legend.
        objective_name: name of the objective, with its unit.
        title: title of the figure.
    """
    figure = Figure(figsize=(8.4, 5.2))
    figure.suptitle(title)
    axes = figure.subplots()
    for number, search in enumerate(searches):
        style: Any = {"color": line_colour(number), "zorder": 2 + search.relaxed}
        if not search.relaxed:
            axes.step(search.cost, search.best, where="post", label=search.name, **style)
            axes.plot(search.cost[-1], search.best[-1], marker="o", **style)
            continue
        axes.plot(search.cost, search.best, "--", label=f"{search.name}, relaxed", **style)
        if search.final is not None:
            axes.plot(*search.final, "D", label=f"{search.name}, its end with hard resets", **style)
    axes.set_xscale("log")
    axes.set_xlabel("cost (plain-run steps)")
    axes.set_ylabel(fill(objective_name, _LETTERS))
    add_legend_below(figure, axes)
    return figure
