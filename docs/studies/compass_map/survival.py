"""Figures of repeated passes over a stored record."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sinsjax.plots.style import add_legend_below, line_colour, with_style


@with_style
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
                np.append(x, end_s),
                np.append(y, y[-1]),
                where="post",
                color=line_colour(i),
                label=line,
            )
            if line in levels.get(name, {}):
                axes.axhline(
                    levels[name][line], color=line_colour(i), linestyle="--", linewidth=1.0
                )
        axes.set_xlim(0, end_s)
        axes.set_ylim(-0.02, 1.03)
        axes.set_title(name)
        axes.set_xlabel("update time (s)")
    grid[0].set_ylabel("share of runs not settled yet")
    add_legend_below(figure, grid[0])
    return figure
