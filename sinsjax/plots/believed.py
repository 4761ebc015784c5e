"""The spread of true errors beside what a filter believes of them, over time."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator, StrMethodFormatter
from numpy.typing import NDArray

from sinsjax.plots.style import GREY, both_sides, colour, legend_outside, styled

_LINEAR = 10.0  # arcmin; an asinh axis is about linear up to here, and logarithmic far out
_TRUE, _OWN = colour(0), colour(1)


class Course(NamedTuple):
    """The heading error of a setting over time, arcmin.

    Attributes:
        label: title of the panel.
        time_s: (T,) record times, s.
        mean: (T,) mean error over the noise.
        sigma: (T,) its true standard deviation about that mean.
        belief: (T,) the filter's own standard deviation.
        resets_s: reset times, s.
        limit: what constant sensor biases leave of the error; None where that is not drawn.
    """

    label: str
    time_s: NDArray
    mean: NDArray
    sigma: NDArray
    belief: NDArray
    resets_s: Sequence[float] = ()
    limit: float | None = None


@styled
def believed(shown: Sequence[Course], title: str) -> Figure:
    """Mean and 2 sigma of the true heading error beside 2 sigma of P, and below how far it is off.

    A filter believes its error to be zero, give or take its sigma: so its band is about zero. Below
    stands the true rms error in units of that sigma, 1 where P is right.

    Args:
        shown: a column of panels each.
        title: title of the figure.
    """
    figure = Figure(figsize=(9.2, 6.4))
    figure.suptitle(title)
    grid = figure.subplots(
        2, len(shown), sharex="col", sharey="row", squeeze=False, height_ratios=[5, 3]
    )
    for (above, below), course in zip(grid.T, shown, strict=True):
        _bands(above, course)
        _ratio(below, course)
        for axes in (above, below):
            for reset_s in course.resets_s:
                label = "reset" if reset_s == course.resets_s[0] else None
                axes.axvline(reset_s, color=GREY, linestyle=":", linewidth=1.1, label=label)
        above.set_title(course.label)
        below.set_xlabel("time (s)")
    note = both_sides(grid[0, 0].yaxis, _LINEAR)
    grid[0, 0].set_ylabel(f"heading error (arcmin){note}")
    grid[1, 0].set_ylabel("true rms error\nover sigma of P")
    grid[1, 0].yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    grid[1, 0].yaxis.set_minor_locator(NullLocator())
    legend_outside(figure, grid[0, int(np.argmax([len(c.resets_s) for c in shown]))])
    return figure


def _bands(axes: Axes, course: Course) -> None:
    own, spread = 2 * course.belief, 2 * course.sigma
    label = "what the filter believes: 0 ± 2 sigma of P"
    axes.fill_between(course.time_s, -own, own, color=_OWN, alpha=0.25, linewidth=0, label=label)
    for side in (own, -own):
        axes.plot(course.time_s, side, "--", color=_OWN, linewidth=1.0)
    low, high = course.mean - spread, course.mean + spread
    label = "true error: mean ± 2 sigma"
    axes.fill_between(course.time_s, low, high, color=_TRUE, alpha=0.35, linewidth=0, label=label)
    axes.plot(course.time_s, course.mean, color=_TRUE, label="true error: mean")
    if course.limit is not None:
        label = "bias floor, left by the sensor biases"
        axes.axhline(course.limit, color=GREY, linewidth=0.9, zorder=1.5, label=label)
    axes.set_xlim(0, course.time_s[-1])
    axes.margins(y=0.08)


def _ratio(axes: Axes, course: Course) -> None:
    rms = np.hypot(course.mean, course.sigma)
    axes.plot(course.time_s, rms / course.belief, color=_TRUE)
    axes.axhline(1.0, color=_OWN, linestyle="--", linewidth=1.0)
    axes.set_yscale("log")
    axes.margins(y=0.1)
