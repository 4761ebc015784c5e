"""Figures of the page on paper 1: heading errors over time, and how often a statement holds."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

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
    """Statements tested under several interpretations of a paper.

    Attributes:
        statements: names of the columns.
        holds: (interpretations, statements) bool.
        straddles: (interpretations, statements) bool, whether the interval includes the threshold.
        best: row of the interpretation under which most statements hold.
    """

    statements: Sequence[str]
    holds: NDArray
    straddles: NDArray
    best: int


@with_style
def verdict_bars(verdicts: Verdicts, title: str) -> Figure:
    """Draw one bar per statement: the number of interpretations under which it holds.

    Args:
        verdicts: statements in drawing order, from the top.
        title: title of the figure.
    """
    count, statements = verdicts.holds.shape
    figure = Figure(figsize=(9.2, 1.5 + 0.26 * statements))
    figure.suptitle(title)
    axes = figure.subplots()
    places = range(statements)
    held = verdicts.holds.sum(axis=0)
    undecided = (~verdicts.holds & verdicts.straddles).sum(axis=0)
    holds_under_best = verdicts.holds[verdicts.best]
    yes, no, open_ = COLOURS[0], COLOURS[1], "#cfcfcf"
    shades = [yes if holds else no for holds in holds_under_best]
    axes.barh(places, held, height=0.7, color=shades)
    axes.barh(places, undecided, height=0.7, left=held, color=open_)
    for place, number in zip(places, held, strict=True):
        inside = number > 0.1 * count
        axes.text(
            number - 0.4 if inside else number + 0.4,
            place,
            f"{number}",
            ha="right" if inside else "left",
            va="center",
            size=10.5,
            color="white" if inside else "black",
        )
    axes.set_yticks(places, verdicts.statements)
    axes.set_ylim(statements - 0.4, -0.6)
    axes.set_xlim(0, count)
    axes.set_xlabel(f"interpretations under which it holds, of {count}")
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    handles = [
        Patch(color=yes, label="holds under the best one too"),
        Patch(color=no, label="not under the best one"),
        Patch(color=open_, label="fails, interval includes the bound"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure
