"""The runs of the study of reset schedules as an array, and the words for its axes."""

import numpy as np
from numpy.typing import NDArray

from sinsjax.report.base import Source
from sinsjax.report.grids import Grid

Schedule = tuple[float, ...]

NONE: Schedule = ()
TWO: Schedule = (10.0, 60.0)
THREE: Schedule = (25.0, 125.0, 225.0)
PAPER: Schedule = (50.0, 100.0, 150.0)  # paper 1, section 3.3.2
MEASURED, GRAVITY = "measured", "gravity"
PRINTED = {"force": MEASURED, "q": "per_step"}  # Q as printed: most of paper 1's statements
HERE = PRINTED | {"feedback": 1.0}
POINT = HERE | {"level": 5.0, "yaw": 30.0}  # its condition 5
SMALL = {"force": MEASURED, "schedule": NONE, "level": 0.0, "yaw": 5.0}
SETTLE, HEADING = "settle_10_s", "phi_u_mean_arcmin"
CONVERGES = 0.95
"""Share of the draws from which a setting is said to settle."""


def layout(source: Source) -> Grid:
    """Every run by force in A(t), reading of Q, feedback interval, level, yaw, schedule, draw."""
    study = source.study
    return Grid.of(
        source,
        (SETTLE, HEADING),
        force=study.values("specific_force"),
        q=study.values("q_reading"),
        feedback=study.values("feedback_interval_s"),
        level=study.values("phi_e0_deg"),
        yaw=study.values("phi_u0_deg"),
        schedule=[tuple(times) for times in study.reset_times()],
    )


def schedules(grid: Grid, least: int, most: int = 99) -> list[Schedule]:
    """The schedules with some number of resets."""
    return [times for times in grid.axes["schedule"] if least <= len(times) <= most]


def named(times: Schedule) -> str:
    """A schedule in words: ``none``, ``one at 50 s``, ``two at 10 and 60 s``."""
    words = ("none", "one", "two", "three", "four", "five")
    if len(times) < 2:
        return f"one at {times[0]:g} s" if times else "none"
    *first, last = (f"{time:g}" for time in times)
    return f"{words[len(times)]} at {', '.join(first)} and {last} s"


def converges(settle_s: NDArray) -> NDArray:
    """Whether enough of the draws (..., draws) settle."""
    return np.isfinite(settle_s).mean(axis=-1) >= CONVERGES
