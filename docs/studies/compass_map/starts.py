"""Figures of runs from several start times of a record."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter
from numpy.typing import NDArray

from sinsjax.plots.style import GREY, add_legend_below, line_colour, with_style

_LINEAR = 1.0  # asinh axes are nearly linear up to here, and logarithmic far beyond


@with_style
def strips(
    rows: Mapping[str, NDArray], title: str, quantity: str, *, kinds: Sequence[str]
) -> Figure:
    """One dot per start time and one row per case, with a line at the median.

    Args:
        rows: case to (starts,) values, from the top.
        title: title of the figure.
        quantity: label of the values, with their unit; the axis is nearly linear near 0 and
            logarithmic far from it.
        kinds: category of each row for the legend; rows of a category share a colour.
    """
    figure = Figure(figsize=(9.2, 1.6 + 0.26 * len(rows)))
    figure.suptitle(title)
    axes = figure.subplots()
    names = list(dict.fromkeys(kinds))
    for place, (values, kind) in enumerate(zip(rows.values(), kinds, strict=True)):
        shade = line_colour(names.index(kind))
        new = kind if kind not in kinds[:place] else None
        axes.plot(
            values, np.full(values.size, place), "o", color=shade, ms=4.5, alpha=0.6, label=new
        )
        median = np.median(values)
        axes.plot([median, median], [place - 0.35, place + 0.35], color=shade, linewidth=2.2)
    axes.axvline(0.0, color=GREY, linewidth=0.9, zorder=1.5)
    axes.set_yticks(range(len(rows)), list(rows))
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlabel(f"{quantity}, logarithmic far from 0")
    axes.set_xscale("asinh", linear_width=_LINEAR)
    _tick(axes.xaxis)
    add_legend_below(figure, axes)
    return figure


def _tick(axis: Axis) -> None:
    decades = 10.0 ** np.arange(0, 5)
    axis.set_major_locator(FixedLocator([*-decades[::-1], 0.0, *decades]))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_locator(NullLocator())
