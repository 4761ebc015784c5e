"""Where paper 1's claim holds: resets cure a large misalignment, as precisely as a small one."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.report.grids import Grid, held_out, soonest

from .grid import CONVERGES, HEADING, MEASURED, NONE, PAPER, SETTLE, schedules

AS_PRECISE_ARCMIN = 1.0
SMALLEST = (0.0, 0.0, 5.0)
NOT_NEEDED, ONE_TOO, SEVERAL, COARSE, NOT_CURED = range(5)
CURED = (ONE_TOO, SEVERAL)


class Claim(NamedTuple):
    """The claim at one misalignment and reading.

    Attributes:
        q: how Q is read.
        feedback: interval, s.
        level: initial level error, deg.
        yaw: initial heading error, deg.
        none: share of the draws that settle without reset.
        three: share with the paper's three.
        one: share with the best single reset, on unused draws.
        off: mean heading with the three less that of the smallest misalignment, arcmin.
        later_s: the same of the median settling times.
        kind: what it comes to.
    """

    q: str
    feedback: float
    level: float
    yaw: float
    none: Estimate
    three: Estimate
    one: Estimate
    off: Estimate
    later_s: Estimate
    kind: int


def judge(grid: Grid) -> list[Claim]:
    """The claim at every misalignment and reading with the measured force."""
    return [
        _judge(grid, q, feedback, level, yaw)
        for q in grid.axes["q"]
        for feedback in grid.axes["feedback"]
        for level in grid.axes["level"]
        for yaw in grid.axes["yaw"]
    ]


def _judge(grid: Grid, q: str, feedback: float, level: float, yaw: float) -> Claim:
    reading = {"force": MEASURED, "q": q, "feedback": feedback}
    at = {**reading, "level": level, "yaw": yaw}
    small = {**reading, "level": SMALLEST[0], "yaw": SMALLEST[2], "schedule": NONE}
    none, three = (grid.at(SETTLE, schedule=schedule, **at) for schedule in (NONE, PAPER))
    best = held_out(grid.at(SETTLE, schedule=schedules(grid, 1, 1), **at), soonest)
    shares = _settled(none), _settled(three), _settled(best.values)
    off = analysis.difference(grid.at(HEADING, schedule=PAPER, **at), grid.at(HEADING, **small))
    later = analysis.quantile_difference(three, grid.at(SETTLE, **small))
    return Claim(q, feedback, level, yaw, *shares, off, later, _kind(shares, off, grid.draws))


def _settled(settle_s: NDArray) -> Estimate:
    return analysis.proportion(int(np.isfinite(settle_s).sum()), settle_s.size)


def _kind(shares: tuple[Estimate, ...], off: Estimate, draws: int) -> int:
    none, three, one = (share.value >= CONVERGES for share in shares)
    if none:
        return NOT_NEEDED
    if not three:
        return NOT_CURED
    if not (-AS_PRECISE_ARCMIN < off.low and off.high < AS_PRECISE_ARCMIN and off.n == draws):
        return COARSE
    return ONE_TOO if one else SEVERAL
