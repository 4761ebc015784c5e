"""Figure of the ratios of settling times: median and worst cell of each policy."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

from sinsjax.plots.style import COLOURS, GREY, with_style

MEDIAN, WORST = COLOURS[0], COLOURS[1]
_TICKS = (0.2, 0.5, 1, 2, 5, 10, 20, 50)
_LEFT = 1.6  # least finite value over the left end of the axis
_NEVER, _END = 1.6, 2.6  # of "never" and of the right end, over the largest finite value


class PolicyRatios(NamedTuple):
    """Settling time over that of the best single reset, of one policy.

    Attributes:
        name: of the policy.
        median: over the cells; infinite if half of them never settle.
        worst: largest; infinite if a cell never settles.
    """

    name: str
    median: float
    worst: float


@with_style
def draw_ratios(policies: Sequence[PolicyRatios], title: str, within: float) -> Figure:
    """Draw the median and the worst ratio of each policy, a row each, infinite ones as *never*.

    Args:
        policies: from the top.
        title: of the figure.
        within: largest ratio that counts as as fast.
    """
    finite = [r for one in policies for r in one[1:] if 0 < r < math.inf] or [1.0]
    low, high = min(*finite, 1 / within) / _LEFT, max(*finite, within)
    never = high * _NEVER
    figure = Figure(figsize=(7.4, 1.5 + 0.34 * len(policies)))
    figure.suptitle(title, x=0.01, ha="left")
    axes = figure.subplots()
    axes.axvspan(low, within, color=COLOURS[2], alpha=0.12, linewidth=0)
    for row, one in enumerate(policies):
        median, worst = (r if math.isfinite(r) else never for r in one[1:])
        axes.plot([median, worst], [row, row], color=GREY, linewidth=1.2, zorder=1.5)
        _dot(axes, median, row, one.median, MEDIAN, "median cell" if row == 0 else None)
        _dot(axes, worst, row, one.worst, WORST, "worst cell" if row == 0 else None)
    axes.set_xscale("log")
    axes.set_xlim(low, high * _END)
    ticks = [tick for tick in _TICKS if low < tick <= high]
    axes.xaxis.set_major_locator(FixedLocator([*ticks, never]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.set_xticks([*ticks, never], [*(f"{tick:g}" for tick in ticks), "never"])
    axes.set_yticks(range(len(policies)), [one.name for one in policies])
    axes.set_ylim(len(policies) - 0.4, -0.7)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel(f"settling time over that of the best single reset; green: up to {within:g}")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _dot(axes: Axes, x: float, row: int, ratio: float, colour: str, label: str | None) -> None:
    """Draw a ratio as a dot with its number, *never* without."""
    axes.plot(x, row, "o", color=colour, markersize=7, label=label)
    if math.isfinite(ratio):
        axes.annotate(
            f"{ratio:.2f}",
            (x, row),
            (7, 0) if colour == WORST else (-7, 0),
            textcoords="offset points",
            ha="left" if colour == WORST else "right",
            va="center",
            fontsize=10.5,
            color=colour,
        )
