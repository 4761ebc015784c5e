"""Figures of categories over two swept keys."""

from collections.abc import Sequence
from textwrap import fill
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sinsjax.plots.grids import Scale, label_rim
from sinsjax.plots.style import styled

_LETTERS = 24  # characters per line of a panel's title


class Kind(NamedTuple):
    """Category of a cell.

    Attributes:
        mark: letter or sign in the cell, so that colours are not essential.
        name: label in the legend.
        colour: colour of the cell.
        dark: whether the colour is dark, so that the mark is white.
    """

    mark: str
    name: str
    colour: str
    dark: bool = False


@styled
def kind_maps(
    panels: Sequence[tuple[str, NDArray]],
    kinds: Sequence[Kind],
    title: str,
    *,
    rows: Scale,
    columns: Scale,
    across: int,
) -> Figure:
    """Maps of categories over two swept keys, side by side.

    Args:
        panels: title and values (rows, columns) of each, indices into ``kinds``.
        kinds: categories, all of which appear in the legend.
        title: title of the figure.
        rows: key from bottom to top.
        columns: key from left to right.
        across: panels per row.
    """
    height = -(-len(panels) // across)
    line = 0.2 * max(fill(name, _LETTERS).count("\n") for name, _ in panels)
    figure = Figure(figsize=(max(2.6 * across, 7.5), 1.9 + (2.3 + line) * height))
    figure.suptitle(title)
    grid = figure.subplots(height, across, sharex=True, sharey=True, squeeze=False)
    colours = ListedColormap([kind.colour for kind in kinds])
    for axes, (name, values) in zip(grid.flat, panels, strict=False):
        axes.imshow(
            values, cmap=colours, vmin=-0.5, vmax=len(kinds) - 0.5, aspect="auto", origin="lower"
        )
        _mark(axes, values, kinds)
        axes.set_title(fill(name, _LETTERS))
        axes.set_xticks(range(len(columns.values)), [f"{v:g}" for v in columns.values])
        axes.set_yticks(range(len(rows.values)), [f"{v:g}" for v in rows.values])
    label_rim(grid, len(panels), rows=rows, columns=columns)
    handles = [Patch(facecolor=kind.colour, label=f"{kind.mark}  {kind.name}") for kind in kinds]
    widest = max(len(kind.name) for kind in kinds)
    fit = max(1, int(figure.get_figwidth() * 11 / (widest + 8)))
    figure.legend(handles=handles, loc="outside lower center", ncols=fit)
    return figure


def _mark(axes: Axes, values: NDArray, kinds: Sequence[Kind]) -> None:
    """Write the marks into the cells and draw lines between the cells."""
    for (row, column), value in np.ndenumerate(values):
        kind = kinds[value]
        shade = "white" if kind.dark else "black"
        axes.text(column, row, kind.mark, ha="center", va="center", color=shade)
    down, right = values.shape
    axes.set_xticks(np.arange(right + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(down + 1) - 0.5, minor=True)
    axes.grid(visible=False, which="major")
    axes.grid(which="minor", color="white", linewidth=1.2)
    axes.tick_params(which="both", length=0)
