"""Figures of statistics over the draws: along one swept key, and whole distributions."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from sinsjax.analysis import Estimate
from sinsjax.plots.style import GREY, colour, label, legend_outside, styled


@styled
def along_axis(
    key: str,
    values: Sequence[float],
    panels: Mapping[str, Mapping[str, Sequence[Estimate]]],
    *,
    title: str,
) -> Figure:
    """Estimates with their 95 % intervals along one swept key.

    Args:
        key: leaf key, unit in its name.
        values: of the key.
        panels: axis label to lines, line label to one estimate a value; infinite ones are marked
            at the upper edge as *never*.
        title: of the figure.
    """
    figure = Figure(figsize=(9.2, 1.2 + 2.5 * len(panels)))
    figure.suptitle(title)
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    x = np.asarray(values, dtype=float)
    for axes, (name, lines) in zip(grid, panels.items(), strict=True):
        for i, (line, estimates) in enumerate(lines.items()):
            value, low, high = np.array([e[:3] for e in estimates], dtype=float).T
            value[~np.isfinite(value)] = np.nan
            spread = np.nan_to_num([value - low, high - value], posinf=0.0, neginf=0.0)
            style = {"color": colour(i), "label": line, "capsize": 2.5, "markersize": 4}
            axes.errorbar(x, value, yerr=np.maximum(spread, 0.0), fmt="o-", **style)
            never = x[np.isposinf([e.value for e in estimates])]
            if never.size:
                height = np.full(never.size, 0.97)  # of the axes: their upper edge
                edge = axes.get_xaxis_transform()
                axes.plot(never, height, "x", color=colour(i), transform=edge)
        axes.set_ylabel(name)
    grid[-1].set_xlabel(label(key))
    if any(np.isposinf(e.value) for p in panels.values() for line in p.values() for e in line):
        grid[0].plot([], [], "x", color=GREY, label="never (median)")
    legend_outside(figure, grid[0])
    return figure


@styled
def distributions(panels: Mapping[str, Mapping[str, ArrayLike]], title: str) -> Figure:
    """Cumulative distributions over the runs: the share of runs at or below a value.

    Args:
        panels: axis label to lines, line label to one value a run. A value that is not finite
            counts as never reached, so such a line ends below 1.
        title: of the figure.
    """
    figure = Figure(figsize=(9.2, 4.4))
    figure.suptitle(title)
    grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (name, lines) in zip(grid, panels.items(), strict=True):
        for i, (line, values) in enumerate(lines.items()):
            data = np.asarray(values, dtype=float)
            known = np.sort(data[np.isfinite(data)])
            share = np.arange(known.size + 1) / max(data.size, 1)
            steps = np.concatenate([known[:1], known])
            axes.plot(
                steps, share[: steps.size], drawstyle="steps-post", color=colour(i), label=line
            )
        axes.set_xlabel(name)
        axes.set_ylim(0, 1.02)
    grid[0].set_ylabel("share of runs")
    legend_outside(figure, grid[0])
    return figure
