"""The runs of the study of reset schedules as an array, and the words for its axes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.report.base import Source
from sinsjax.report.grids import Choice, Grid, held_out, median, soonest

Schedule = tuple[float, ...]

NONE: Schedule = ()
TWO: Schedule = (10.0, 60.0)
THREE: Schedule = (25.0, 125.0, 225.0)
PAPER: Schedule = (50.0, 100.0, 150.0)  # paper 1, section 3.3.2
LEVEL, YAW = 5.0, 30.0  # its condition 5, deg
MEASURED, GRAVITY = "measured", "gravity"
PRINTED = "per_step"  # Q as printed: the reading of most of paper 1's statements
FEEDBACK_S = 1.0
QS = {"per_step": "Q as printed", "psd": "Q as a density", "per_sample": "Q of a sample"}
BAND_ARCMIN = 10
SETTLE, HEADING = "settle_10_s", "phi_u_mean_arcmin"
CONVERGES = 0.95
"""Share of the draws from which a setting is said to settle."""


class Contest(NamedTuple):
    """The best single reset against the best of more, at one misalignment and reading.

    Attributes:
        one: the best with one reset, on unused draws.
        more: the best with more.
        saved_s: median settling time of more minus that of one, on the same draws.
        by_chance: how often that shows a difference, one way, where there is none.
    """

    one: Choice
    more: Choice
    saved_s: Estimate
    by_chance: float

    @property
    def only_more(self) -> bool:
        """Whether half of the draws settle with more than one reset, and not with one."""
        return bool(np.isinf(median(self.one.values)) and np.isfinite(median(self.more.values)))


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


def contests(grid: Grid) -> dict[tuple[str, float, float, float], Contest]:
    """One reset against more, with the measured force, by reading, feedback, level and yaw."""
    found = {}
    sides = schedules(grid, 1, 1), schedules(grid, 2)
    for at in np.ndindex(*(len(grid.axes[name]) for name in ("q", "feedback", "level", "yaw"))):
        key = dict(zip(("q", "feedback", "level", "yaw"), at, strict=True))
        point = {name: grid.axes[name][place] for name, place in key.items()}
        one, more = (
            held_out(grid.at(SETTLE, force=MEASURED, schedule=side, **point), soonest)
            for side in sides
        )
        pair = more.values, one.values
        saved, chance = analysis.quantile_difference(*pair), analysis.chance_apart(*pair)
        found[point["q"], point["feedback"], point["level"], point["yaw"]] = Contest(
            one, more, saved, chance
        )
    return found


def failed_by_level_and_yaw(failed: NDArray) -> tuple[Estimate, Estimate, Estimate]:
    """What failure (levels, yaws, draws) varies with: level, yaw, both together; shares of 1.

    Sums of squares of a two-way layout with one value a cell, draw by draw.
    """
    values = failed - failed.mean(axis=(0, 1))
    level, yaw = values.mean(axis=1, keepdims=True), values.mean(axis=0, keepdims=True)
    whole = (values**2).mean(axis=(0, 1))
    with np.errstate(invalid="ignore"):  # nothing varies: unknown
        parts = [(p**2).mean(axis=(0, 1)) / whole for p in (level, yaw, values - level - yaw)]
    level_part, yaw_part, both = (analysis.mean(part) for part in parts)
    return level_part, yaw_part, both
