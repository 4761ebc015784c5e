"""Figures of statistics over the draws: along one swept key, and whole distributions."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from sinsjax.analysis import Estimate
from sinsjax.plots.style import GREY, colour, legend_outside, styled
from sinsjax.plots.words import label, value_text

_MARKS = "os^Dv*P"
_DODGE = 0.008  # share of the axis by which the marks of two lines are offset to remain visible
_MOST_STEPS = 1000
_APART = 0.06  # share of the axis needed between marks
_WIDE = 12  # letters of a word that has no room beside others
_LONG = 4.0  # times the median bar of a panel; beyond it a bar leaves the panel


class Expected(NamedTuple):
    """Expected value of a quantity.

    Attributes:
        name: label in the legend.
        value: value, drawn as a line.
        band: lower and upper end of a shaded band around it.
    """

    name: str
    value: float
    band: tuple[float, float]


@styled
def along_axis(
    key: str,
    values: Sequence[Any],
    panels: Mapping[str, Mapping[str, Sequence[Estimate]]],
    *,
    title: str,
    expected: Expected | None = None,
    log: bool = False,
) -> Figure:
    """Estimates with their 95 % intervals along one swept key.

    Args:
        key: leaf key, with the unit in its name.
        values: values of the key; lists stand side by side, as words.
        panels: quantity, with its unit, to line label to one estimate per value; infinite ones are
            marked at the upper edge as *never*; a bar far longer than the others ends outside.
        title: title of the figure.
        expected: expected value, drawn in every panel.
        log: whether the vertical axes are logarithmic.
    """
    figure = Figure(figsize=(9.2, 1.2 + 2.5 * len(panels)))
    figure.suptitle(title)
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    words = [value_text(value) for value in values if isinstance(value, list | tuple)]
    x = np.arange(len(values)) if words else np.asarray(values, dtype=float)
    for axes, (name, lines) in zip(grid, panels.items(), strict=True):
        if expected:
            axes.axhspan(*expected.band, color=GREY, alpha=0.25, linewidth=0)
            axes.axhline(expected.value, color=GREY, linestyle="--", label=expected.name)
        if log:
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        for i, (line, estimates) in enumerate(lines.items()):
            value, spread = _bars(estimates)
            style = {"color": colour(i), "label": line, "capsize": 2.5, "markersize": 5}
            beside = x + _DODGE * np.ptp(x) * (i - (len(lines) - 1) / 2)
            mark = _MARKS[i % len(_MARKS)] + ("" if words else "-")  # lists have no distance
            axes.errorbar(beside, value, yerr=spread, fmt=mark, **style)
            never = beside[np.isposinf([e.value for e in estimates])]
            if never.size:
                height = np.full(never.size, 0.97)  # of the axes: their upper edge
                edge = axes.get_xaxis_transform()
                axes.plot(never, height, "x", color=colour(i), transform=edge)
        if not log:
            _follow(axes, [e for estimates in lines.values() for e in estimates], expected)
        axes.set_title(name, loc="left", size="medium")
        if not any(np.isfinite(e.value) for estimates in lines.values() for e in estimates):
            axes.set_yticks([])
    if words:
        turned = {"rotation": 20, "ha": "right"} if max(map(len, words)) > _WIDE else {}
        grid[-1].set_xticks(x, words, **turned)
    elif np.diff(np.sort(x)).min(initial=np.inf) > _APART * np.ptp(x):
        grid[-1].set_xticks(x, [f"{value:g}" for value in x])
    grid[-1].set_xlabel(label(key))
    if any(np.isposinf(e.value) for p in panels.values() for line in p.values() for e in line):
        grid[0].plot([], [], "x", color=GREY, label="never (median)")
    legend_outside(figure, grid[0])
    return figure


def _bars(estimates: Sequence[Estimate]) -> tuple[NDArray, NDArray]:
    """(n,) finite values, others NaN, and the lengths (2, n) of their bars down and up."""
    value, low, high = np.array([e[:3] for e in estimates], dtype=float).T
    value[~np.isfinite(value)] = np.nan
    spread = np.nan_to_num([value - low, high - value], posinf=0.0, neginf=0.0)
    return value, np.maximum(spread, 0.0)


def _follow(axes: Axes, estimates: Sequence[Estimate], expected: Expected | None) -> None:
    """Let a bar that is far longer than the others leave the panel, instead of squashing it."""
    value, bars = _bars(estimates)
    known = np.isfinite(value)
    value, bars = value[known], bars[:, known]
    if not bars.any():
        return
    room = max(_LONG * np.median(bars[bars > 0]), np.ptp(value) / 2)
    if (bars > room).any():
        down, up = np.minimum(bars, room)
        ends = [*(value - down), *(value + up), *(expected.band if expected else ())]
        margin = 0.05 * np.ptp(ends)
        axes.set_ylim(min(ends) - margin, max(ends) + margin)


def tells(panel: Mapping[str, Sequence[Estimate]]) -> bool:
    """Whether a panel of `along_axis` has anything but *never*, unknown and zeros."""
    return any(e.value and np.isfinite(e.value) for line in panel.values() for e in line)


def steps(values: NDArray) -> tuple[NDArray, NDArray]:
    """The cumulative distribution of some values as points of a step function.

    Args:
        values: (n,) values; non-finite ones count but have no position.

    Returns:
        Ascending positions and the share of the values up to each, thinned out for many values
        without a visible change.
    """
    known = np.sort(values[np.isfinite(values)])
    if known.size == 0:
        return known, known
    ranks = np.arange(known.size + 1)
    if known.size > _MOST_STEPS:
        ranks = np.unique(np.linspace(0, known.size, _MOST_STEPS).round().astype(int))
    return known[np.maximum(ranks - 1, 0)], ranks / values.size
