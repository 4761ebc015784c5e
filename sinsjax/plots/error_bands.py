"""The spread of true heading errors compared with the filter's own sigma, over time."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator, StrMethodFormatter
from numpy.typing import NDArray

from sinsjax.plots.style import GREY, add_legend_below, line_colour, set_asinh_scale, with_style

_LINEAR = 10.0  # arcmin; an asinh axis is about linear up to here, and logarithmic far out
_TRUE, _OWN = line_colour(0), line_colour(1)


class HeadingErrorCourse(NamedTuple):
    """The heading error of a setting over time, arcmin.

    Attributes:
        label: title of the panel.
        time_s: (T,) record times, s.
        mean: (T,) mean error over the noise.
        sigma: (T,) its true standard deviation about that mean.
        filter_sigma: (T,) the filter's own standard deviation.
        resets_s: reset times, s.
        floor: bias floor, left by constant sensor biases; None to omit it.
    """

    label: str
    time_s: NDArray
    mean: NDArray
    sigma: NDArray
    filter_sigma: NDArray
    resets_s: Sequence[float] = ()
    floor: float | None = None


@with_style
def draw_error_bands(courses: Sequence[HeadingErrorCourse], title: str) -> Figure:
    """Draw mean and 2 sigma of the true heading error with 2 sigma of P, and their ratio below.

    A filter estimates its error as zero within its sigma, so its band is about zero. The lower
    panel has the true rms error in units of that sigma; it is 1 if P is right.

    Args:
        courses: a column of panels each.
        title: title of the figure.
    """
    figure = Figure(figsize=(9.2, 6.4))
    figure.suptitle(title)
    grid = figure.subplots(
        2, len(courses), sharex="col", sharey="row", squeeze=False, height_ratios=[5, 3]
    )
    for (above, below), course in zip(grid.T, courses, strict=True):
        _draw_bands(above, course)
        _draw_sigma_ratio(below, course)
        for axes in (above, below):
            for reset_s in course.resets_s:
                label = "reset" if reset_s == course.resets_s[0] else None
                axes.axvline(reset_s, color=GREY, linestyle=":", linewidth=1.1, label=label)
        above.set_title(course.label)
        below.set_xlabel("time (s)")
    note = set_asinh_scale(grid[0, 0].yaxis, _LINEAR)
    grid[0, 0].set_ylabel(f"heading error (arcmin){note}")
    grid[1, 0].set_ylabel("true rms error\nover sigma of P")
    grid[1, 0].yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    grid[1, 0].yaxis.set_minor_locator(NullLocator())
    add_legend_below(figure, grid[0, int(np.argmax([len(c.resets_s) for c in courses]))])
    return figure


def _draw_bands(axes: Axes, course: HeadingErrorCourse) -> None:
    filter_band, spread = 2 * course.filter_sigma, 2 * course.sigma
    label = "what the filter believes: 0 ± 2 sigma of P"
    axes.fill_between(
        course.time_s, -filter_band, filter_band, color=_OWN, alpha=0.25, linewidth=0, label=label
    )
    for side in (filter_band, -filter_band):
        axes.plot(course.time_s, side, "--", color=_OWN, linewidth=1.0)
    low, high = course.mean - spread, course.mean + spread
    label = "true error: mean ± 2 sigma"
    axes.fill_between(course.time_s, low, high, color=_TRUE, alpha=0.35, linewidth=0, label=label)
    axes.plot(course.time_s, course.mean, color=_TRUE, label="true error: mean")
    if course.floor is not None:
        label = "bias floor, left by the sensor biases"
        axes.axhline(course.floor, color=GREY, linewidth=0.9, zorder=1.5, label=label)
    axes.set_xlim(0, course.time_s[-1])
    axes.margins(y=0.08)


def _draw_sigma_ratio(axes: Axes, course: HeadingErrorCourse) -> None:
    rms = np.hypot(course.mean, course.sigma)
    axes.plot(course.time_s, rms / course.filter_sigma, color=_TRUE)
    axes.axhline(1.0, color=_OWN, linestyle="--", linewidth=1.0)
    axes.set_yscale("log")
    axes.margins(y=0.1)
