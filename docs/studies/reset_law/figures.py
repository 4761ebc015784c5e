"""The two figures of the page: where two resets should come, and what was predicted."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter
from numpy.typing import NDArray

from sinsjax.plots.style import COLOURS, GREY, with_style


class MapPanel(NamedTuple):
    """Mean settling times at a latitude.

    Attributes:
        latitude_deg: the latitude.
        first_s: times of the first reset, (rows,).
        later_s: times from there to the second one, (columns,).
        means_s: mean settling times, (rows, columns).
        law: the law's last early reset, and the time from there to its last one, s.
    """

    latitude_deg: float
    first_s: NDArray
    later_s: NDArray
    means_s: NDArray
    law: tuple[float, float]


class PredictionPanel(NamedTuple):
    """Settling times of a policy, s; inf for never.

    Attributes:
        policy: its name.
        predicted: (starts, ...).
        measured: (starts, ...), medians.
        is_slow: whether feedback is slower than levelling, (starts, ...).
    """

    policy: str
    predicted: NDArray
    measured: NDArray
    is_slow: NDArray


@with_style
def draw_map(panels: Sequence[MapPanel]) -> Figure:
    """Settling time over the times of two resets, in a panel per latitude."""
    figure = Figure(figsize=(9.5, 4.4))
    figure.suptitle("Two resets: the law moves with latitude, 10 and 60 s stays")
    grid = figure.subplots(1, len(panels), sharey=True)
    for axes, panel in zip(grid, panels, strict=True):
        lowest = panel.means_s.min()
        levels = lowest * np.array([1, 1.1, 1.25, 1.5, 2, 3, 4])
        filled = axes.contourf(
            panel.first_s, panel.later_s, panel.means_s.T, levels, cmap="viridis_r", extend="max"
        )
        axes.contour(
            panel.first_s,
            panel.later_s,
            panel.means_s.T,
            levels[1:-1],
            colors="white",
            linewidths=0.8,
        )
        marks = {"law": ("o", panel.law), "10 and 60 s": ("X", (10.0, 50.0))}
        for name, (marker, point) in marks.items():
            axes.plot(
                *point, marker, color=COLOURS[1], markersize=11, markeredgecolor="white", label=name
            )
        axes.set(xscale="log", yscale="log", xlabel="first reset (s)")
        axes.set_title(f"latitude {panel.latitude_deg:g} deg, best {lowest:.0f} s")
        axes.grid(False)
        for axis, ticks in ((axes.xaxis, (1, 3, 10, 30, 100)), (axes.yaxis, (10, 30, 100, 300))):
            axis.set_major_locator(FixedLocator(ticks))
            axis.set_minor_locator(NullLocator())
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    grid[0].set_ylabel("from there to the second (s)")
    bar = figure.colorbar(filled, ax=list(grid), label="mean settling time, of the best")
    bar.set_ticks(levels, labels=[f"{level / lowest:g}" for level in levels])
    grid[0].legend(loc="lower left", frameon=True)
    return figure


@with_style
def draw_predictions(panels: Sequence[PredictionPanel], run_s: float) -> Figure:
    """Predicted against measured settling times, log-log; never lies at the edges."""
    figure = Figure(figsize=(9.5, 3.25))
    figure.suptitle("Predicted and measured: what settles, when, and what never does")
    low, never = 80.0, 1.25 * run_s
    for axes, panel in zip(
        figure.subplots(1, len(panels), sharex=True, sharey=True), panels, strict=True
    ):
        axes.plot([low, run_s], [low, run_s], color=GREY, linewidth=1)
        for is_slow, colour, label in (
            (False, COLOURS[0], "feedback up to 1 s"),
            (True, COLOURS[1], "every 10 s"),
        ):
            shown = panel.is_slow == is_slow
            x, y = (
                np.where(np.isfinite(times[shown]), times[shown], never).ravel()
                for times in (panel.predicted, panel.measured)
            )
            axes.plot(x, y, ".", color=colour, markersize=4, alpha=0.6, label=label)
        axes.set(xscale="log", yscale="log", xlim=(low, 1.15 * never), ylim=(low, 1.15 * never))
        axes.set_title(panel.policy)
        axes.set_aspect("equal")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(FixedLocator((100, 300, 1000, never)))
            axis.set_minor_locator(NullLocator())
            axis.set_ticklabels(["100", "300", "1000", "never"])
        axes.set_xlabel("predicted (s)")
    figure.axes[0].set_ylabel("measured (s)")
    figure.axes[0].legend(loc="upper left", handletextpad=0.1)
    return figure
