"""Figures of a grid of settings: heat maps over two axes, verdicts of readings."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sinsjax.plots.style import COLOURS, label, styled

_NEVER, _NEVER_EDGE = "#dcdcdc", "#b5b5b5"
_HATCH = "////"
_LEGIBLE = 10  # cells side by side in a panel that still have room for their numbers
_LIGHT = 0.5  # of the colour map; cells beyond it are light and carry dark numbers


class Scale(NamedTuple):
    """A swept key along one side of a heat map.

    Attributes:
        key: leaf key, unit in its name.
        values: in the order of the grid.
    """

    key: str
    values: Sequence[float]


class Shown(NamedTuple):
    """The quantity that a heat map shows.

    Attributes:
        name: axis label of the colour bar, with its unit.
        low: value at the dark end of the colours.
        high: value at the light end.
        reverse: whether low values are the light ones.
        digits: decimals of the number in a cell.
    """

    name: str
    low: float
    high: float
    reverse: bool = False
    digits: int = 0


@styled
def heat_maps(
    panels: Sequence[tuple[str, NDArray]],
    title: str,
    shown: Shown,
    *,
    rows: Scale,
    columns: Scale,
) -> Figure:
    """Heat maps of one quantity over two swept keys, side by side.

    Args:
        panels: title and values (rows, columns) of each; a value that is not finite is *never*,
            drawn hatched in grey.
        title: of the figure.
        shown: the quantity.
        rows: the key from bottom to top.
        columns: the key from left to right.
    """
    width = min(4, len(panels))
    height = -(-len(panels) // width)
    figure = Figure(figsize=(1.2 + max(2.5 * width, 5.0), 1.4 + 2.5 * height))
    figure.suptitle(title)
    grid = figure.subplots(height, width, sharex=True, sharey=True, squeeze=False)
    for axes, (name, values) in zip(grid.flat, panels, strict=False):
        image = _heat_map(axes, values, shown)
        axes.set_title(name)
        axes.set_xticks(range(len(columns.values)), [f"{v:g}" for v in columns.values])
        axes.set_yticks(range(len(rows.values)), [f"{v:g}" for v in rows.values])
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel(label(rows.key))
    for axes in grid[-1]:
        axes.set_xlabel(label(columns.key))
    figure.colorbar(image, ax=grid, label=shown.name, shrink=0.8, aspect=30)
    if any(not np.isfinite(values).all() for _, values in panels):
        never = Patch(facecolor=_NEVER, edgecolor=_NEVER_EDGE, hatch=_HATCH, label="never (median)")
        figure.legend(handles=[never], loc="outside lower center")
    return figure


def _heat_map(axes: Axes, values: NDArray, shown: Shown) -> AxesImage:
    image = axes.imshow(
        np.ma.masked_invalid(values),
        cmap="viridis_r" if shown.reverse else "viridis",
        vmin=shown.low,
        vmax=shown.high,
        aspect="auto",
        origin="lower",
    )
    axes.grid(visible=False)
    axes.patch.set(facecolor=_NEVER, edgecolor=_NEVER_EDGE, hatch=_HATCH)  # behind masked cells
    if values.shape[1] <= _LEGIBLE:
        for (row, column), value in np.ndenumerate(values):
            if np.isfinite(value):
                _write(axes, (column, row), value, shown)
    return image


def _write(axes: Axes, cell: tuple[int, int], value: float, shown: Shown) -> None:
    level = (value - shown.low) / (shown.high - shown.low or 1.0)
    light = (level > _LIGHT) != shown.reverse
    text = f"{value:.{shown.digits}f}"
    shade = "black" if light else "white"
    axes.text(*cell, text, ha="center", va="center", fontsize=6.5, color=shade)


class Verdicts(NamedTuple):
    """Statements judged under several readings.

    Attributes:
        readings: a name for each row.
        statements: a name for each column.
        holds: (readings, statements) bool.
        straddles: (readings, statements) bool, whether the interval reaches across the threshold.
        best: the row that is pointed out.
    """

    readings: Sequence[str]
    statements: Sequence[str]
    holds: NDArray
    straddles: NDArray
    best: int


@styled
def verdict_matrix(verdicts: Verdicts, title: str) -> Figure:
    """Which statement holds under which reading, a cell each.

    Args:
        verdicts: rows in the order in which they are drawn, from the top.
        title: of the figure.
    """
    rows, columns = verdicts.holds.shape
    figure = Figure(figsize=(9.2, 1.6 + 0.17 * rows))
    figure.suptitle(title)
    axes = figure.subplots()
    no, yes = COLOURS[1], COLOURS[0]
    axes.imshow(verdicts.holds, cmap=ListedColormap([no, yes]), vmin=0, vmax=1, aspect="auto")
    axes.set_xticks(range(columns), verdicts.statements, fontsize=8)
    held = verdicts.holds.sum(axis=1)
    names = [f"{name}   {n:2d}" for name, n in zip(verdicts.readings, held, strict=True)]
    axes.set_yticks(range(rows), names, fontsize=7.5)
    axes.get_yticklabels()[verdicts.best].set_fontweight("bold")
    axes.set_xticks(np.arange(columns + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(rows + 1) - 0.5, minor=True)
    axes.grid(visible=False, which="major")
    axes.grid(which="minor", color="white", linewidth=1)
    axes.tick_params(which="both", length=0)
    for row, column in np.argwhere(verdicts.straddles):
        axes.text(column, row, "~", ha="center", va="center", color="white", fontsize=9)
    axes.set_xlabel("statement")
    axes.set_ylabel("reading (Q, R, feedback), and statements that hold")
    handles = [
        Patch(color=yes, label="holds"),
        Patch(color=no, label="does not hold"),
        Patch(facecolor="none", label="~  the interval straddles the threshold"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure
