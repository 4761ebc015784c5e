"""Figures of the page on paper 1: heading errors over time, and which statement holds."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sinsjax.plots import COLOURS, Ensemble, Line, draw_mean_and_band, line_colour
from sinsjax.plots.curves import use_asinh_if_wide
from sinsjax.plots.style import add_legend_below, with_style


@with_style
def yaw_errors(panels: Mapping[str, Sequence[Ensemble]], title: str) -> Figure:
    """Yaw error over time, one panel per setting.

    Args:
        panels: panel title to lines with the ``phi_u_arcmin`` column.
        title: title of the figure.
    """
    width = min(2, len(panels))
    height = -(-len(panels) // width)
    figure = Figure(figsize=(9.2, 1.6 + 2.6 * height))
    figure.suptitle(title)
    grid = figure.subplots(height, width, sharex=True, squeeze=False)
    far = ""
    for axes, (name, shown) in zip(grid.flat, panels.items(), strict=False):
        extents = [
            draw_mean_and_band(
                axes, Line(e.label, e.time_s, e.columns["phi_u_arcmin"], line_colour(i))
            )
            for i, e in enumerate(shown)
        ]
        far = use_asinh_if_wide(axes, extents) or far
        axes.set_title(name)
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel(f"heading error (arcmin){far}")
    for axes in grid[-1]:
        axes.set_xlabel("time (s)")
    add_legend_below(figure, grid[0, 0])
    return figure


class Verdicts(NamedTuple):
    """Statements tested under several readings of a paper.

    Attributes:
        readings: names of the rows.
        statements: names of the columns.
        holds: (readings, statements) bool.
        straddles: (readings, statements) bool, whether the interval includes the threshold.
        best: row to highlight.
    """

    readings: Sequence[str]
    statements: Sequence[str]
    holds: NDArray
    straddles: NDArray
    best: int


@with_style
def verdict_matrix(verdicts: Verdicts, title: str) -> Figure:
    """Matrix of which statement holds under which reading.

    Args:
        verdicts: rows in drawing order, from the top.
        title: title of the figure.
    """
    rows, columns = verdicts.holds.shape
    figure = Figure(figsize=(9.2, 3.2 + 0.17 * rows))
    figure.suptitle(title)
    axes = figure.subplots()
    no, yes = COLOURS[1], COLOURS[0]
    axes.imshow(verdicts.holds, cmap=ListedColormap([no, yes]), vmin=0, vmax=1, aspect="auto")
    axes.set_xticks(range(columns), verdicts.statements, fontsize=9, rotation=60, ha="right")
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
    axes.set_ylabel("interpretation of Q, of R, feedback; how many hold")
    handles = [
        Patch(color=yes, label="holds"),
        Patch(color=no, label="does not hold"),
        Patch(facecolor="none", label="~  the interval reaches across"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure
