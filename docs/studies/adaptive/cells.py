"""Figures of ratios over named cells, coloured by class."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sinsjax.plots.style import with_style

_NEVER, _NEVER_EDGE, _HATCH = "#dcdcdc", "#b5b5b5", "////"
_SIDE = 3.0  # in, width of a map
_CELL = 0.2  # in, height of one of its cells


class Class(NamedTuple):
    """A range of ratios that share a colour.

    Attributes:
        most: largest ratio; smaller ones may belong to the previous class.
        name: label in the legend.
        colour: colour of the cells.
        dark: whether the colour is dark, so that the number is white.
    """

    most: float
    name: str
    colour: str
    dark: bool = False


@with_style
def ratio_maps(
    panels: Sequence[tuple[str, NDArray]],
    classes: Sequence[Class],
    title: str,
    *,
    rows: Sequence[str],
    columns: Sequence[str],
    side: str,
    only: str = "",
    across: int = 4,
) -> Figure:
    """Maps of ratios over named cells, side by side, coloured by class.

    Args:
        panels: title and ratios (rows, columns) of each; infinite ones are *never*, in grey.
        classes: by their largest ratio, ascending, the last one without a limit.
        title: title of the figure.
        rows: names of the rows, from the top.
        columns: names of the columns, from left to right.
        side: label of the rows.
        only: meaning of a ratio of 0, for the legend; its cells are marked with a star.
        across: panels per row.
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
    if only and any((values == 0).any() for _, values in panels):
        handles.append(Patch(facecolor=classes[0].colour, label=f"*  {only}"))
    if any(not np.isfinite(values).all() for _, values in panels):
        handles.append(
            Patch(facecolor=_NEVER, edgecolor=_NEVER_EDGE, hatch=_HATCH, label="never (median)")
        )
    fit = max(1, int(figure.get_figwidth() / 1.9))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(fit, len(handles)))
    return figure


def _classed(axes: Axes, values: NDArray, classes: Sequence[Class]) -> None:
    limits = [one.most for one in classes[:-1]]
    found = np.searchsorted(limits, values)  # a limit belongs to the class below
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
            text = "*" if value == 0 else f"{value:.2f}" if value < 10 else f"{value:.0f}"
            axes.text(column, row, text, ha="center", va="center", fontsize=7, color=shade)
