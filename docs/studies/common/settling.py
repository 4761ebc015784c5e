"""How long the heading takes to settle, as the pages on resets draw and tell it."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.analysis.grids import median_over_draws
from sinsjax.execution.source import Source
from sinsjax.plots import GridAxis, MapQuantity
from sinsjax.report.base import Picture

from .grids import pooled_mean, shared
from .words import seconds, share


def settled(settle_s: NDArray) -> str:
    """Share of runs (..., draws) that settle."""
    return share(shared(np.isfinite(settle_s)))


def median_time(settle_s: NDArray) -> str:
    """Median settling time of runs (draws,)."""
    return seconds(analysis.quantile(settle_s))


def mean_time(settle_s: NDArray, run_s: float) -> str:
    """Mean settling time of runs (..., draws), with the whole run for one that never settles."""
    return seconds(pooled_mean(np.minimum(settle_s, run_s)))


def settling_maps(
    source: Source,
    name: str,
    panels: Mapping[str, NDArray],
    note: str,
    *,
    rows: GridAxis,
    columns: GridAxis,
    title: str,
) -> Picture:
    """Median settling times over two axes, at most four panels side by side.

    Args:
        source: of the runs.
        name: of the figure.
        panels: settling times (rows, columns, draws), s.
        note: what else the caption has to say.
        rows: upwards.
        columns: to the right.
        title: of the figure.
    """
    medians = {panel: median_over_draws(runs) for panel, runs in panels.items()}
    figure = plots.draw_heat_maps(
        list(medians.items()),
        title,
        MapQuantity("median settling time (s)", 0.0, source.study.run_s, reverse=True),
        rows=rows,
        columns=columns,
        panels_per_row=4,
    )
    never = any(not np.isfinite(cells).all() for cells in medians.values())
    hatched = ", hatched: at least half of them never settle" if never else ""
    known = how_many(source, np.stack(list(panels.values())))
    caption = f"Medians over {known}; light is good{hatched}. {note}"
    return Picture(name, caption, figure, source.sample_size_text)


def how_many(source: Source, times: NDArray) -> str:
    """The number of runs of a cell of settling times (..., draws), and how well it is known."""
    if source.study.is_recorded:
        return f"{source.draws} start times on one record, which give no interval"
    cells = times.reshape(-1, source.draws)
    known = [analysis.quantile(runs) for runs in cells[np.isfinite(median_over_draws(cells))]]
    width = np.median([(one.high - one.low) / 2 for one in known])
    return f"{source.draws} Monte Carlo runs (95 % interval: ±{width:.0f} s in half of the cells)"
