"""Figures of repeated passes over a stored record: errors by its length, settling."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter
from numpy.typing import NDArray

from sinsjax.analysis import Estimate
from sinsjax.plots.style import colour, legend_outside, styled


@styled
def by_record_length(
    lengths_s: Sequence[float],
    lines: Mapping[str, Sequence[Estimate]],
    bound: tuple[NDArray, NDArray],
    *,
    title: str,
    quantity: str,
) -> Figure:
    """Errors with their intervals by the length of the stored record, with the information bound.

    Args:
        lengths_s: lengths of the stored record, s.
        lines: line label to one estimate per length; non-finite ones are omitted.
        bound: lengths, s, and the information bound at these.
        title: title of the figure.
        quantity: label of the errors and the bound, with their unit.
    """
    figure = Figure(figsize=(9.2, 5.0))
    figure.suptitle(title)
    axes = figure.subplots()
    for i, (name, estimates) in enumerate(lines.items()):
        value, low, high = np.array([e[:3] for e in estimates], dtype=float).T
        known = np.isfinite(value)
        spread = np.nan_to_num([value - low, high - value], posinf=0.0)[:, known]
        # Offset by a percent each, so that intervals do not hide one another.
        x = np.asarray(lengths_s)[known] * 1.012 ** (i - (len(lines) - 1) / 2)
        axes.errorbar(
            x,
            value[known],
            yerr=np.maximum(spread, 0.0),
            fmt="o-",
            color=colour(i),
            label=name,
            capsize=2.5,
            markersize=4.5,
        )
    axes.plot(*bound, "--", color="black", label="information bound of the record")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_major_locator(FixedLocator(list(lengths_s)))
    axes.xaxis.set_minor_locator(NullLocator())
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.set_xlabel("length of the stored record (s)")
    axes.set_ylabel(quantity)
    legend_outside(figure, axes)
    return figure


@styled
def survival(
    panels: Mapping[str, Mapping[str, NDArray]],
    title: str,
    *,
    end_s: float,
    levels: Mapping[str, Mapping[str, float]],
) -> Figure:
    """Shares of runs that have not settled yet, against update time.

    Args:
        panels: panel title to line label to settling times, s; non-finite if never settled.
        title: title of the figure.
        end_s: end of the runs, s.
        levels: panel title to line label to a share drawn as a dashed level.
    """
    figure = Figure(figsize=(9.2, 4.6))
    figure.suptitle(title)
    grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (name, lines) in zip(grid, panels.items(), strict=True):
        for i, (line, times) in enumerate(lines.items()):
            settled = np.sort(times[np.isfinite(times)])
            left = 1 - np.arange(settled.size + 1) / times.size
            x, y = np.append(0.0, settled), left
            axes.step(
                np.append(x, end_s), np.append(y, y[-1]), where="post", color=colour(i), label=line
            )
            if line in levels.get(name, {}):
                axes.axhline(levels[name][line], color=colour(i), linestyle="--", linewidth=1.0)
        axes.set_xlim(0, end_s)
        axes.set_ylim(-0.02, 1.03)
        axes.set_title(name)
        axes.set_xlabel("update time (s)")
    grid[0].set_ylabel("share of draws not settled yet")
    legend_outside(figure, grid[0])
    return figure
