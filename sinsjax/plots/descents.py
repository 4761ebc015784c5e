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
    AND_MORE,
    COLOURS,
    GREY,
    LETTERS,
    colour,
    colour_range,
    legend_outside,
    styled,
)

_COLOURS = "viridis_r"  # light where the objective is small
_MARKERS = ("*", "D", "^", "s", "o", "P", "X")
_EDGE: Any = [withStroke(linewidth=3.0, foreground="black")]
_LETTERS = 44  # characters per line of an axis label
_MOST_PANELS = 10  # pairs of variables; more would not be legible


class Side(NamedTuple):
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


class Landscape(NamedTuple):
    """The objective at the points of a search.

    Attributes:
        sides: the p variables.
        values: (n, p) points.
        objective: (n,) objective of each point; infinite where it has none.
        shape: number of points along each variable if they form a grid, the last one fastest.
        name: name of the objective, with its unit.
    """

    sides: Sequence[Side]
    values: NDArray
    objective: NDArray
    shape: tuple[int, ...] | None
    name: str


class Way(NamedTuple):
    """A descent: (steps, p) values, and the (steps,) relaxed objectives at them."""

    values: NDArray
    objective: NDArray


class Spot(NamedTuple):
    """A marked point.

    Attributes:
        name: label in the legend.
        values: (p,) values of the variables.
        objective: its objective; None if unknown.
        look: number of its marker and colour.
    """

    name: str
    values: NDArray
    objective: float | None
    look: int


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


@styled
def descent(landscape: Landscape, ways: Sequence[Way], spots: Sequence[Spot], title: str) -> Figure:
    """Descents over a landscape: a curve of one variable, a map of two, or all pairs of more.

    Args:
        landscape: objective at points of one or more variables.
        ways: paths of the descents.
        spots: marked points, such as the best point of each search.
        title: title of the figure.
    """
    count = len(landscape.sides)
    if count == 1:
        figure = Figure(figsize=(8.4, 5.2))
        _curve(figure.subplots(), landscape, ways, spots)
    elif count == 2:
        figure = Figure(figsize=(8.4, 6.4))
        axes = figure.subplots()
        norm = _norm(landscape)
        if landscape.shape is not None:
            _map(axes, landscape, norm)
        else:
            _scatter(axes, landscape, (0, 1), norm)
        _over(axes, landscape.sides, (0, 1), ways, spots)
        _colour_bar(figure, axes, landscape)
    else:
        figure = _pairs(landscape, ways, spots)
    figure.suptitle(fill(title, int(LETTERS * figure.get_figwidth())))
    legend_outside(figure, figure.axes[0])
    return figure


def _pairs(landscape: Landscape, ways: Sequence[Way], spots: Sequence[Spot]) -> Figure:
    pairs = list(combinations(range(len(landscape.sides)), 2))[:_MOST_PANELS]
    across = min(3, len(pairs))
    down = -(-len(pairs) // across)
    figure = Figure(figsize=(1.4 + 3.3 * across, 1.5 + 3.0 * down))
    grid = figure.subplots(down, across, squeeze=False)
    norm = _norm(landscape)
    for axes, pair in zip(grid.flat, pairs, strict=False):
        _scatter(axes, landscape, pair, norm)
        _over(axes, landscape.sides, pair, ways, spots)
    for axes in list(grid.flat)[len(pairs) :]:
        axes.set_visible(False)
    _colour_bar(figure, grid, landscape, shrink=0.9)
    return figure


def _norm(landscape: Landscape) -> Normalize:
    return Normalize(*colour_range(landscape.objective[np.isfinite(landscape.objective)]))


def _colour_bar(figure: Figure, axes: Any, landscape: Landscape, **style: Any) -> None:
    norm = _norm(landscape)
    finite = landscape.objective[np.isfinite(landscape.objective)]
    above = bool(np.any(finite > norm.vmax))
    name = fill(f"{landscape.name}{AND_MORE if above else ''}", _LETTERS)
    extend = "max" if above else "neither"
    mappable = ScalarMappable(norm, _COLOURS)
    figure.colorbar(mappable, ax=axes, label=name, aspect=30, extend=extend, **style)


def _curve(axes: Axes, landscape: Landscape, ways: Sequence[Way], spots: Sequence[Spot]) -> None:
    order = np.argsort(landscape.values[:, 0])
    side = landscape.sides[0]
    axes.plot(
        landscape.values[order, 0],
        landscape.objective[order],
        color=GREY,
        marker=".",
        label="points of the search",
    )
    for number, way in enumerate(ways):
        style: Any = {"color": COLOURS[0], "linewidth": 1.1, "alpha": 0.8}
        name = "descents (relaxed)" if number == 0 else None
        axes.plot(way.values[:, 0], way.objective, marker=".", label=name, **style)
        axes.plot(way.values[0, 0], way.objective[0], marker="o", markerfacecolor="white", **style)
    for spot in spots:
        if spot.objective is None:
            style = {"color": _spot_colour(spot.look), "linestyle": ":"}
            axes.axvline(spot.values[0], label=spot.name, **style)
            continue
        axes.plot(spot.values[0], spot.objective, label=spot.name, **_spot_style(spot.look))
    _scale(axes.xaxis, side)
    axes.set_ylabel(fill(landscape.name, _LETTERS))


def _map(axes: Axes, landscape: Landscape, norm: Normalize) -> None:
    """Cells around the points of a grid; the first variable is horizontal."""
    assert landscape.shape is not None
    across, up = (
        _edges(np.unique(landscape.values[:, i]), side) for i, side in enumerate(landscape.sides)
    )
    values = np.ma.masked_invalid(landscape.objective.reshape(landscape.shape).T)
    axes.grid(visible=False)
    axes.pcolormesh(across, up, values, cmap=_COLOURS, norm=norm)


def _edges(middles: NDArray, side: Side) -> NDArray:
    """Edges of cells around their centres, of which there are at least two."""
    places = np.log(middles) if side.log else middles
    inner = (places[1:] + places[:-1]) / 2
    ends = 2 * places[[0, -1]] - inner[[0, -1]]
    edges = np.concatenate([ends[:1], inner, ends[1:]])
    return np.exp(edges) if side.log else edges


def _scatter(axes: Axes, landscape: Landscape, pair: tuple[int, int], norm: Normalize) -> None:
    """All points, with the best on top."""
    order = np.argsort(-landscape.objective)
    x, y = (landscape.values[order, i] for i in pair)
    axes.scatter(x, y, c=landscape.objective[order], cmap=_COLOURS, norm=norm, s=16)


def _over(
    axes: Axes,
    sides: Sequence[Side],
    pair: tuple[int, int],
    ways: Sequence[Way],
    spots: Sequence[Spot],
) -> None:
    """Descents and marked points over a landscape of two variables."""
    for number, way in enumerate(ways):
        x, y = way.values[:, pair[0]], way.values[:, pair[1]]
        name = "descents, from the open circles" if number == 0 else None
        axes.plot(x, y, color="white", linewidth=1.6, path_effects=_EDGE, zorder=3)
        axes.plot(x, y, ".", color="black", markersize=3, zorder=4)
        axes.plot(x[:1], y[:1], "o", mfc="white", mec="black", color="black", label=name, zorder=4)
    for number, spot in enumerate(spots):
        axes.plot(
            spot.values[pair[0]],
            spot.values[pair[1]],
            label=spot.name,
            zorder=5 + len(spots) - number,
            **_spot_style(spot.look),
        )
    for axis, number in ((axes.xaxis, pair[0]), (axes.yaxis, pair[1])):
        _scale(axis, sides[number])


def _scale(axis: Axis, side: Side) -> None:
    axis.set_label_text(side.name)
    if not side.log:
        return
    (axis.axes.set_xscale if isinstance(axis, XAxis) else axis.axes.set_yscale)("log")
    decades = np.log10(side.high / side.low)
    axis.set_major_locator(LogLocator(subs=(1.0,) if decades > 2 else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def _spot_colour(number: int) -> str:
    return COLOURS[(1, 3, 6, 4, 5, 0)[number % 6]]


def _spot_style(number: int) -> dict[str, Any]:
    marker = _MARKERS[number % len(_MARKERS)]
    return {
        "marker": marker,
        "markersize": 15 if marker == "*" else 9,
        "color": _spot_colour(number),
        "markeredgecolor": "black",
        "linestyle": "none",
    }


@styled
def best_by_cost(searches: Sequence[CostCurve], name: str, title: str) -> Figure:
    """The best objective of each search against its cost so far.

    Args:
        searches: in the order of the legend.
        name: name of the objective, with its unit.
        title: title of the figure.
    """
    figure = Figure(figsize=(8.4, 5.2))
    figure.suptitle(title)
    axes = figure.subplots()
    for number, one in enumerate(searches):
        shown: Any = {"color": colour(number), "zorder": 2 + one.relaxed}
        if not one.relaxed:
            axes.step(one.cost, one.best, where="post", label=one.name, **shown)
            axes.plot(one.cost[-1], one.best[-1], marker="o", **shown)
            continue
        axes.plot(one.cost, one.best, "--", label=f"{one.name}, relaxed", **shown)
        if one.final is not None:
            axes.plot(*one.final, "D", label=f"{one.name}, its end with hard resets", **shown)
    axes.set_xscale("log")
    axes.set_xlabel("cost (plain-run steps)")
    axes.set_ylabel(fill(name, _LETTERS))
    legend_outside(figure, axes)
    return figure
