"""The figure of the page: heading error over time, parked and turned, for three grades of gyros."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter
from numpy.typing import NDArray

from sinsjax.analysis import Estimate
from sinsjax.plots.style import COLOURS, with_style

TIME_TICKS_S = (30, 60, 120, 300, 600)
ERROR_TICKS_ARCMIN = (1, 3, 10, 30, 100, 300)


class Curve(NamedTuple):
    """Heading error over time with one motion of the base.

    Attributes:
        name: of the motion.
        bound: bound of the heading error, (times,), arcmin.
        measured: rms error by time, s.
    """

    name: str
    bound: NDArray
    measured: dict[float, Estimate]


@with_style
def draw_errors(times_s: NDArray, panels: Mapping[str, Sequence[Curve]]) -> Figure:
    """Draw bounds as lines and measured errors as points, in a panel per grade."""
    figure = Figure(figsize=(9.5, 4.0))
    figure.suptitle("One half turn breaks the bias floor, a carousel never meets it")
    grid = figure.subplots(1, len(panels), sharex=True, sharey=True)
    for axes, (title, curves) in zip(grid, panels.items(), strict=True):
        for number, curve in enumerate(curves):
            _draw_curve(axes, times_s, curve, COLOURS[number])
        axes.set(xscale="log", yscale="log", xlabel="time (s)", title=title)
        for axis, ticks in ((axes.xaxis, TIME_TICKS_S), (axes.yaxis, ERROR_TICKS_ARCMIN)):
            axis.set_major_locator(FixedLocator(ticks))
            axis.set_minor_locator(NullLocator())
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    grid[0].set_ylabel("heading error, 1 sigma (arcmin)")
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


def _draw_curve(axes: Axes, times_s: NDArray, curve: Curve, colour: str) -> None:
    """Draw the bound as a line and the measured errors as points with their intervals."""
    axes.plot(times_s, curve.bound, color=colour, label=curve.name)
    for time, rms in curve.measured.items():
        reach = [[rms.value - rms.low], [rms.high - rms.value]]
        axes.errorbar(time, rms.value, reach, fmt="o", color=colour, markersize=4, linewidth=1.2)
