"""Figures of attitude errors in the units and columns of paper 2, and of any lines over time."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sinsjax.plots.curves import Extent, Line, draw
from sinsjax.plots.style import GREY, legend_outside, styled


class Mark(NamedTuple):
    """A level along an attitude error, such as its limit.

    Attributes:
        label: what the legend calls it; the same one in all panels.
        values: by angle, deg; an angle without it has none.
        style: matplotlib's line style.
        colour: of the line.
    """

    label: str
    values: Mapping[str, float]
    style: str = "-"
    colour: str = GREY


@styled
def attitude_errors(
    lines: Mapping[str, Sequence[Line]],
    title: str,
    *,
    marks: Sequence[Mark] = (),
    zoom_s: tuple[float, float],
    reach: float = np.inf,
) -> Figure:
    """Errors of pitch, roll and heading: the whole run, and a time span of it enlarged.

    Args:
        lines: by angle, deg.
        title: of the figure.
        marks: levels, in the enlargement only.
        zoom_s: time span of the enlargement, s.
        reach: an enlargement is fitted to the marks and to those lines whose mean in it is no
            further than this from one of them, deg.
    """
    figure = Figure(figsize=(9.2, 7.8))
    figure.suptitle(title)
    grid = figure.subplots(len(lines), 2, sharex="col", squeeze=False)
    for (whole, part), (angle, here) in zip(grid, lines.items(), strict=True):
        extents = [draw(whole, line) for line in here]
        for line in here:
            draw(part, line)
        levels = [_level(part, mark, angle) for mark in marks if angle in mark.values]
        whole.set_xlim(0, max(extent.time_s[-1] for extent in extents))
        whole.set_ylabel(f"{angle} error (deg)")
        _enlarge(part, zoom_s, extents, levels=levels, reach=reach)
    grid[0, 0].set_title("Whole run")
    grid[0, 1].set_title(f"Enlarged: {zoom_s[0]:g} to {zoom_s[1]:g} s")
    for axes in grid[-1]:
        axes.set_xlabel("update time (s)")
    legend_outside(figure, grid[-1, 1])
    return figure


def _level(axes: Axes, mark: Mark, angle: str) -> float:
    value = mark.values[angle]
    axes.axhline(value, color=mark.colour, linestyle=mark.style, linewidth=1.1, label=mark.label)
    return value


def _enlarge(
    axes: Axes,
    span: tuple[float, float],
    extents: Sequence[Extent],
    *,
    levels: Sequence[float],
    reach: float,
) -> None:
    """Shows a time span, with the vertical axis fitted to the levels and the lines near them."""
    axes.set_xlim(*span)
    shown = [np.asarray(levels, dtype=float)]
    for time, low, high in extents:
        inside = (time >= span[0]) & (time <= span[1])
        centre = (low[inside] + high[inside]).mean() / 2 if inside.any() else np.nan
        if not levels or np.abs(centre - np.asarray(levels)).min() <= reach:
            shown += [low[inside], high[inside]]
    covered = np.concatenate(shown)
    if covered.size:
        margin = 0.06 * max(float(np.ptp(covered)), 1e-6)
        axes.set_ylim(covered.min() - margin, covered.max() + margin)


@styled
def over_time(
    panels: Mapping[str, Sequence[Line]],
    title: str,
    *,
    quantity: str,
    floor: float | None = None,
) -> Figure:
    """Lines over update time, panels side by side.

    Args:
        panels: lines by panel title, all in one unit.
        title: of the figure.
        quantity: label of the vertical axis, with its unit.
        floor: lower end of a logarithmic axis; linear without it.
    """
    figure = Figure(figsize=(9.2, 4.6))
    figure.suptitle(title)
    grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (name, lines) in zip(grid, panels.items(), strict=True):
        extents = [draw(axes, line) for line in lines]
        axes.set_xlim(0, max(extent.time_s[-1] for extent in extents))
        if floor is not None:
            axes.set_yscale("log")
            axes.set_ylim(bottom=floor)
        axes.set_title(name)
        axes.set_xlabel("update time (s)")
    grid[0].set_ylabel(quantity)
    legend_outside(figure, grid[0])
    return figure
