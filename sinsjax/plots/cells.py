"""Figures over cells that have names: ratios in classes, and values beside each other."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator
from numpy.typing import NDArray

from sinsjax.analysis import Estimate
from sinsjax.plots.style import GREY, colour, styled

_NEVER, _NEVER_EDGE, _HATCH = "#dcdcdc", "#b5b5b5", "////"
_SIDE = 2.75  # in, width of a map
_CELL = 0.2  # in, height of one of its cells
_APART = 0.16  # of the room of a name, between the marks of two lines


class Class(NamedTuple):
    """Ratios that share a colour.

    Attributes:
        most: the largest of them; those of the class before are smaller.
        name: in the legend.
        colour: of their cells.
        dark: whether the number in such a cell is white.
    """

    most: float
    name: str
    colour: str
    dark: bool = False


@styled
def ratio_maps(
    panels: Sequence[tuple[str, NDArray]],
    classes: Sequence[Class],
    title: str,
    *,
    rows: Sequence[str],
    columns: Sequence[str],
    side: str,
    across: int = 4,
) -> Figure:
    """Maps of ratios over cells with names, side by side, a colour a class.

    Args:
        panels: title and ratios (rows, columns) of each; infinite ones are *never*, in grey.
        classes: by their largest ratio, ascending, the last one without a limit.
        title: of the figure.
        rows: their names, from the top.
        columns: their names, from left to right.
        side: what the rows are.
        across: panels in a line.
    """
    across = min(across, len(panels))
    height = -(-len(panels) // across)
    tall = 1.9 + (0.45 + _CELL * len(rows)) * height + 0.9
    figure = Figure(figsize=(1.5 + _SIDE * across, tall))
    figure.suptitle(title)
    grid = figure.subplots(height, across, sharex=True, sharey=True, squeeze=False)
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_visible(False)
    for axes, (name, values) in zip(grid.flat, panels, strict=False):
        _classed(axes, values, classes)
        axes.set_title(name, fontsize=10.5)
        axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8.5)
        axes.set_yticks(range(len(rows)), rows, fontsize=8.5)
        axes.set_ylim(len(rows) - 0.5, -0.5)
    for axes in grid[:, 0]:
        axes.set_ylabel(side)
    handles = [Patch(facecolor=one.colour, label=one.name) for one in classes]
    if any(not np.isfinite(values).all() for _, values in panels):
        handles.append(
            Patch(facecolor=_NEVER, edgecolor=_NEVER_EDGE, hatch=_HATCH, label="never (median)")
        )
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _classed(axes: Axes, values: NDArray, classes: Sequence[Class]) -> None:
    limits = [one.most for one in classes[:-1]]
    found = np.searchsorted(limits, values)  # a limit belongs to the class below it
    axes.imshow(
        np.ma.masked_where(~np.isfinite(values), found),
        cmap=ListedColormap([one.colour for one in classes]),
        vmin=-0.5,
        vmax=len(classes) - 0.5,
        aspect="auto",
    )
    axes.grid(visible=False)
    axes.tick_params(length=0)
    axes.patch.set(facecolor=_NEVER, edgecolor=_NEVER_EDGE, hatch=_HATCH)  # behind masked cells
    for (row, column), value in np.ndenumerate(values):
        if np.isfinite(value):
            shade = "white" if classes[int(found[row, column])].dark else "black"
            text = f"{value:.2f}" if value < 10 else f"{value:.0f}"
            axes.text(column, row, text, ha="center", va="center", fontsize=6.5, color=shade)


@styled
def beside(
    names: Sequence[str],
    panels: Mapping[str, Mapping[str, Sequence[Estimate]]],
    spans: Mapping[str, Sequence[tuple[float, float]]],
    title: str,
    *,
    side: str,
    quantity: str,
    span: str,
) -> Figure:
    """Estimates with their intervals beside each other, a place for each name.

    Args:
        names: of the places, from left to right.
        panels: title to lines, line label to one estimate a name; infinite ones are marked at the
            upper edge as *never*.
        spans: title to the first and the last time of something at each name, NaN where there is
            none; drawn as bars below.
        title: of the figure.
        side: what the names are.
        quantity: what the estimates are, with its unit; the axis is logarithmic.
        span: what the spans are, in the legend.
    """
    figure = Figure(figsize=(11.2, 1.5 + 3.0 * len(panels)))
    figure.suptitle(title)
    grid = figure.subplots(len(panels), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    x = np.arange(len(names))
    for axes, (name, lines) in zip(grid, panels.items(), strict=True):
        axes.set_yscale("log")
        for i, estimates in enumerate(lines.values()):
            _marks(axes, x + _APART * (i - (len(lines) - 1) / 2), estimates, i)
        first, last = np.array(spans[name], dtype=float).T
        axes.vlines(x, first, last, color=GREY, linewidth=3)
        axes.plot(x, first, "_", x, last, "_", color=GREY, markersize=9)
        axes.set_title(name)
        axes.set_ylabel(quantity)
        axes.grid(visible=False, axis="x")
        for edge in x[1:] - 0.5:
            axes.axvline(edge, color="#e3e3e3", linewidth=0.6)
    ticks = [2, 5, 10, 20, 50, 100, 200, 500, 1000]
    low, high = grid[0].get_ylim()
    grid[0].set_yticks(shown := [t for t in ticks if low <= t <= high], [f"{t:g}" for t in shown])
    grid[0].yaxis.set_minor_locator(NullLocator())
    grid[0].set_xlim(-0.5, len(names) - 0.5)
    grid[-1].set_xticks(x, names, rotation=30, ha="right", fontsize=9.5)
    grid[-1].set_xlabel(side)
    handles = [
        Line2D([], [], color=colour(i), marker="o", markersize=4, linestyle="none", label=line)
        for i, line in enumerate(next(iter(panels.values())))
    ]
    handles.append(Line2D([], [], color=GREY, linewidth=3, label=span))
    estimates = [e for lines in panels.values() for line in lines.values() for e in line]
    if any(np.isinf(e.value) for e in estimates):
        handles.append(
            Line2D([], [], color=GREY, marker="x", linestyle="none", label="never (median)")
        )
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _marks(axes: Axes, x: NDArray, estimates: Sequence[Estimate], number: int) -> None:
    """Draws the estimates of a line; what never is, at the upper edge."""
    value, low, high = np.array([e[:3] for e in estimates], dtype=float).T
    never = np.isinf(value)
    value[never] = np.nan
    ends = np.nan_to_num([value - low, high - value], posinf=0.0, neginf=0.0)
    shade, ends = colour(number), np.maximum(ends, 0.0)
    axes.errorbar(x, value, ends, fmt="o", color=shade, capsize=2, markersize=4, linewidth=1.2)
    height = np.full(np.count_nonzero(never), 0.96)  # of the axes: their upper edge
    edge = axes.get_xaxis_transform()
    axes.plot(x[never], height, "x", color=shade, markersize=5, transform=edge)
