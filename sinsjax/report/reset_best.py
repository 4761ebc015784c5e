"""The best of several reset schedules, chosen by some draws and told by others."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.report.reset_grid import Grid, median, schedule_name


class Pick(NamedTuple):
    """The best of some schedules, told by draws that did not choose it.

    Attributes:
        places: (draws,) place of the schedule that the half without the draw chose.
        settle_s: (draws,) settling times with it.
    """

    places: NDArray
    settle_s: NDArray

    @property
    def median(self) -> Estimate:
        """Median settling time, s."""
        return analysis.quantile(self.settle_s)

    @property
    def settled(self) -> Estimate:
        """Share of the draws that settle."""
        return analysis.proportion(int(np.isfinite(self.settle_s).sum()), self.settle_s.size)

    def name(self, grid: Grid) -> str:
        """What was chosen, in words; two schedules where the halves differ."""
        return " / ".join(schedule_name(grid.schedules[i]) for i in dict.fromkeys(self.places))


class Contest(NamedTuple):
    """The best single reset against the best of more than one, at a point.

    Attributes:
        at: places of its reading, level and yaw.
        one: the best with exactly one reset.
        more: the best with more.
        saved_s: median settling time of more minus that of one, on the same draws.
        by_chance: how often its interval would lie below 0, or above, where there is no difference.
    """

    at: tuple[int, int, int]
    one: Pick
    more: Pick
    saved_s: Estimate
    by_chance: float

    @property
    def better(self) -> str:
        """``more``, ``one``, ``neither`` where neither settles, or empty: no difference shown."""
        if np.isinf(self.one.median.value) and np.isinf(self.more.median.value):
            return "neither"
        return "more" if self.saved_s.high < 0 else "one" if self.saved_s.low > 0 else ""

    @property
    def only_more(self) -> bool:
        """Whether half of the draws settle with more than one reset, and not with one."""
        return bool(np.isinf(self.one.median.value) and np.isfinite(self.more.median.value))


def held_out(settle_s: NDArray, places: Sequence[int]) -> Pick:
    """The best of some schedules, chosen on every other draw and told by the rest, both ways.

    The best is where most draws settle; among those, the least median settling time; among those,
    the first.

    Args:
        settle_s: (schedules, draws), infinite where a run never settled.
        places: of the schedules to choose from.
    """

    def best(seen: NDArray) -> int:
        failed = np.isinf(seen).sum(axis=-1)
        return int(np.lexsort((median(seen), failed))[0])

    return _crossed(settle_s, places, best)


def held_out_for_all(settle_s: NDArray, places: Sequence[int], run_s: float) -> Pick:
    """One schedule for all misalignments: that with the least mean settling time over all of them.

    Args:
        settle_s: (levels, yaws, schedules, draws), infinite where a run never settled.
        places: of the schedules to choose from.
        run_s: what counts for a run that never settled.

    Returns:
        Instead of settling times, their means over the misalignments, by draw.
    """
    mean_s = np.minimum(settle_s, run_s).mean(axis=(0, 1))
    return _crossed(mean_s, places, lambda seen: int(np.argmin(seen.mean(axis=-1))))


def _crossed(values: NDArray, places: Sequence[int], best: Callable[[NDArray], int]) -> Pick:
    """Values (schedules, draws) of each half with the schedule that is best for the other."""
    chosen = np.empty(values.shape[-1], dtype=int)
    halves = slice(0, None, 2), slice(1, None, 2)
    for choosing, judging in (halves, halves[::-1]):
        chosen[judging] = places[best(values[places][:, choosing])]
    return Pick(chosen, np.take_along_axis(values, chosen[None], axis=0)[0])


def contests(grid: Grid, readings: Sequence[int]) -> list[Contest]:
    """The best single reset against the best of more, at every misalignment of some readings."""
    ones, mores = grid.with_count(1, 1), grid.with_count(2)
    found = []
    for at in np.ndindex(grid.settle_s.shape[:3]):
        if at[0] in readings:
            one, more = (held_out(grid.settle_s[at], places) for places in (ones, mores))
            pairs = more.settle_s, one.settle_s
            saved, chance = analysis.quantile_difference(*pairs), analysis.chance_apart(*pairs)
            found.append(Contest(at, one, more, saved, chance))
    return found
