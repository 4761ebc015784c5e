"""Figures of the page on how many resets to make, and when."""

import numpy as np

from sinsjax import plots
from sinsjax.plots import COLOURS, Scale, Shown
from sinsjax.plots.kinds import Kind, kind_maps
from sinsjax.report.base import Picture
from sinsjax.report.grids import Grid, median

from .claim import Claim
from .grid import (
    FEEDBACK_S,
    GRAVITY,
    MEASURED,
    NONE,
    PRINTED,
    QS,
    SETTLE,
    TWO,
    named,
    schedules,
)

_GOOD, _SOME, _BAD = "#f2f2f2", COLOURS[4], COLOURS[1]
_SIDES = "initial level error_deg", "initial heading error_deg"

KINDS = (
    Kind("o", "settles without reset", _GOOD),
    Kind("+", "the three cure, one does too", COLOURS[5]),
    Kind("3", "the three cure, one does not", COLOURS[0], dark=True),
    Kind("~", "settles, precision not shown", _SOME),
    Kind("x", "the three do not cure", _BAD, dark=True),
)
"""By the numbers of `claim.Claim.kind`."""

_SETTLING = (
    Kind("o", "every draw settles", _GOOD),
    Kind("~", "some draws settle", _SOME),
    Kind("x", "no draw settles", _BAD, dark=True),
)


def _time(run_s: float) -> Shown:
    return Shown("median settling time (s)", 0.0, run_s, reverse=True)


def _scales(grid: Grid) -> tuple[Scale, Scale]:
    return Scale(_SIDES[0], grid.axes["level"]), Scale(_SIDES[1], grid.axes["yaw"])


def answer(grid: Grid, run_s: float) -> Picture:
    """Settling times over the misalignments, with the settings that the page is about."""
    here = {"q": PRINTED, "feedback": FEEDBACK_S}
    panels = [
        ("no reset", grid.at(SETTLE, force=MEASURED, schedule=NONE, **here)),
        (named((50.0,)), grid.at(SETTLE, force=MEASURED, schedule=(50.0,), **here)),
        (named(TWO), grid.at(SETTLE, force=MEASURED, schedule=TWO, **here)),
        ("no reset, gravity in A(t)", grid.at(SETTLE, force=GRAVITY, schedule=NONE, **here)),
    ]
    rows, columns = _scales(grid)
    figure = plots.heat_maps(
        [(name, median(runs)) for name, runs in panels],
        "How long until the heading stays within 10' of its limit?",
        _time(run_s),
        rows=rows,
        columns=columns,
        across=4,
    )
    caption = (
        f"Median over {grid.draws} draws, feedback every {FEEDBACK_S:g} s, Q as printed; light is"
        " good, hatched: at least half of the draws never settle."
    )
    return Picture("answer", caption, figure)


def single(grid: Grid, run_s: float) -> Picture:
    """Settling time against the time of the only reset."""
    times = schedules(grid, 1, 1)
    panels = [
        (
            f"heading error {yaw:g} deg, feedback {feedback:g} s",
            median(
                grid.at(
                    SETTLE, force=MEASURED, q=PRINTED, feedback=feedback, yaw=yaw, schedule=times
                )
            ),
        )
        for feedback in grid.axes["feedback"]
        for yaw in grid.axes["yaw"]
    ]
    figure = plots.heat_maps(
        panels,
        "When must a single reset come? Heading within 10' of its limit",
        _time(run_s),
        rows=_scales(grid)[0],
        columns=Scale("time of the reset_s", [time for (time,) in times]),
        across=len(grid.axes["yaw"]),
    )
    caption = f"Median over {grid.draws} draws, Q as printed; light is good, hatched: never."
    return Picture("single_reset", caption, figure)


def failure(grid: Grid) -> Picture:
    """Which misalignments settle without reset, with both forces in A(t)."""
    panels = []
    for force, words in ((MEASURED, "measured force"), (GRAVITY, "gravity")):
        for feedback in grid.axes["feedback"]:
            runs = grid.at(SETTLE, force=force, q=PRINTED, feedback=feedback, schedule=NONE)
            settled = np.isfinite(runs).mean(axis=-1)
            kinds = np.where(settled == 1, 0, np.where(settled == 0, 2, 1))
            panels.append((f"{words}, feedback {feedback:g} s", kinds))
    rows, columns = _scales(grid)
    figure = kind_maps(
        panels,
        _SETTLING,
        "Which settle without reset? Heading within 10' of its limit",
        rows=rows,
        columns=columns,
        across=len(grid.axes["feedback"]),
    )
    caption = f"Over {grid.draws} draws, Q as printed; the specific force is that in A(t)."
    return Picture("failure", caption, figure)


def claim(grid: Grid, judged: list[Claim]) -> Picture:
    """What the paper's three resets do at each misalignment and reading."""
    shape = len(grid.axes["level"]), len(grid.axes["yaw"])
    panels = [
        (
            f"{QS[q]}, feedback {feedback:g} s",
            np.array(
                [c.kind for c in judged if (c.q, c.feedback) == (q, feedback)], dtype=int
            ).reshape(shape),
        )
        for q in grid.axes["q"]
        for feedback in grid.axes["feedback"]
    ]
    rows, columns = _scales(grid)
    figure = kind_maps(
        panels,
        KINDS,
        "Where do the paper's three resets help?",
        rows=rows,
        columns=columns,
        across=len(grid.axes["feedback"]),
    )
    caption = (
        f"Over {grid.draws} draws, from the limit, measured force. *One*: the best single reset."
    )
    return Picture("claim", caption, figure)
