"""Figures of the page on how many resets to make, and when."""

from itertools import product

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sinsjax import plots
from sinsjax.plots import COLOURS, Scale, Shown
from sinsjax.plots.kinds import Kind, kind_maps
from sinsjax.report.base import Picture
from sinsjax.report.grids import Grid, median

from .grid import GRAVITY, HERE, MEASURED, NONE, PRINTED, SETTLE, TWO, named, schedules

_LEVELS, _YAWS = "initial level error_deg", "initial heading error_deg"

_SETTLING = (
    Kind("o", "every draw settles", "#f2f2f2"),
    Kind("~", "some draws settle", COLOURS[4]),
    Kind("x", "no draw settles", COLOURS[1], dark=True),
)


def _settling(
    grid: Grid, run_s: float, panels: dict[str, NDArray], title: str, columns: Scale
) -> Figure:
    """Median settling times (s), shape (level, ...), a panel each."""
    return plots.heat_maps(
        list(panels.items()),
        title,
        Shown("median settling time (s)", 0.0, run_s, reverse=True),
        rows=Scale(_LEVELS, grid.axes["level"]),
        columns=columns,
        across=4,
    )


def answer(grid: Grid, run_s: float) -> Picture:
    """Settling times over the misalignments, with the settings that the page is about."""
    shown = {
        "no reset": (MEASURED, NONE),
        named((50.0,)): (MEASURED, (50.0,)),
        named(TWO): (MEASURED, TWO),
        "no reset, gravity in A(t)": (GRAVITY, NONE),
    }
    panels = {
        name: median(grid.at(SETTLE, schedule=times, **HERE | {"force": force}))
        for name, (force, times) in shown.items()
    }
    title = "How long until the heading stays within 10' of its limit?"
    figure = _settling(grid, run_s, panels, title, Scale(_YAWS, grid.axes["yaw"]))
    caption = (
        f"Median over {grid.draws} draws, feedback every second, Q as printed; light is good,"
        " hatched: at least half of the draws never settle."
    )
    return Picture("answer", caption, figure)


def single(grid: Grid, run_s: float) -> Picture:
    """Settling time against the time of the only reset."""
    times = schedules(grid, 1, 1)
    runs = median(grid.at(SETTLE, schedule=times, **HERE))
    panels = {f"heading error {yaw:g} deg": runs[:, y] for y, yaw in enumerate(grid.axes["yaw"])}
    title = "When must a single reset come? Heading within 10' of its limit"
    columns = Scale("time of the reset_s", [time for (time,) in times])
    figure = _settling(grid, run_s, panels, title, columns)
    return Picture("single_reset", "As above, against the time of the only reset.", figure)


def failure(grid: Grid) -> Picture:
    """Which misalignments settle without reset, with both forces in A(t)."""
    panels = []
    for force, feedback in product((MEASURED, GRAVITY), grid.axes["feedback"]):
        at = PRINTED | {"force": force, "feedback": feedback}
        runs = grid.at(SETTLE, schedule=NONE, **at)
        settled = np.isfinite(runs).mean(axis=-1)
        words = "measured force" if force == MEASURED else force
        kinds = np.select([settled == 1, settled > 0], [0, 1], 2)
        panels.append((f"{words}, {feedback:g} s", kinds))
    figure = kind_maps(
        panels,
        _SETTLING,
        "Which settle without reset? Heading within 10' of its limit",
        rows=Scale(_LEVELS, grid.axes["level"]),
        columns=Scale(_YAWS, grid.axes["yaw"]),
        across=len(grid.axes["feedback"]),
    )
    caption = f"Force in A(t) and feedback interval; over {grid.draws} draws, Q as printed."
    return Picture("failure", caption, figure)
