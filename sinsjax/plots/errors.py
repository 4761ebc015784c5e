"""Figures of attitude errors in the units and layout of paper 2, and of lines over time."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sinsjax.plots.curves import Extent, Line, draw
from sinsjax.plots.style import GREY, legend_outside, styled


class Mark(NamedTuple):
    """A horizontal level for attitude errors, such as their limit.

    Attributes:
        label: label in the legend, the same in all panels.
        values: by angle, deg; angles without a level are missing.
        style: matplotlib line style.
        colour: colour of the line.
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
    """Errors of pitch, roll and heading: the whole run, and a time span enlarged.

    Args:
        lines: by angle, deg.
        title: title of the figure.
        marks: levels, drawn only in the enlargement.
        zoom_s: time span to enlarge, s.
        reach: an enlargement is fitted to the marks and to the lines whose mean within it is at
            most this far from a mark, deg.
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
    """Show a time span, with the vertical axis fitted to the levels and the lines near them."""
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
        panels: panel title to lines, all in the same unit.
        title: title of the figure.
        quantity: label of the vertical axis, with its unit.
        floor: lower end of a logarithmic axis; None for a linear one.
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
