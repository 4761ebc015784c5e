"""The runs of a sweep of reset schedules, laid out by reading, misalignment and schedule."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate, format_difference
from sinsjax.errors import InputError
from sinsjax.report.base import Block, Source, percent, value_text
from sinsjax.study.study import Study

Schedule = tuple[float, ...]
"""Times of the resets, s."""

NONE: Schedule = ()
PAPER_SCHEDULE: Schedule = (50.0, 100.0, 150.0)
"""Paper 1, section 3.3.2."""

PAPER_LEVEL_DEG, PAPER_YAW_DEG = 5.0, 30.0
"""Paper 1's condition 5, the large misalignment."""

BAND_ARCMIN = 10
"""A run that stays this near to its limit has settled; one that never does has failed."""

_SETTLED = f"settle_{BAND_ARCMIN}_s"
_YAW = "phi_u_mean_arcmin"


FORCES = ("measured", "gravity")
"""The specific force in A(t), and that of the ablation."""


class Reading(NamedTuple):
    """What paper 1 does not print, and the force of the ablation.

    Attributes:
        force: the specific force in A(t), ``measured`` or ``gravity``.
        q: how Q is read.
        feedback_s: between two feedbacks, s.
    """

    force: str
    q: str
    feedback_s: float

    @property
    def name(self) -> str:
        """In words."""
        text = f"Q `{self.q}`, feedback {self.feedback_s:g} s"
        return text if self.force == "measured" else f"{text}, f = gravity"

    @property
    def cells(self) -> list[str]:
        """As the first cells of a row, see `READING_CELLS`."""
        return [self.force, self.q, value_text(self.feedback_s)]


LEVEL, YAW = "initial level error_deg", "initial yaw error_deg"
"""The sides of a map over the misalignments, as `plots.label` writes them."""

READING_CELLS = ("force in A(t)", "Q reading", "feedback (s)")

PAPER_READING = Reading("measured", "per_step", 1.0)
"""The reading under which most of paper 1's statements hold, see ``docs/paper1.md``."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Every run of a study, by reading, level, yaw, schedule and draw.

    Attributes:
        study: whose runs.
        readings: by force, by Q in the study's order, by feedback interval.
        levels: initial level errors, east and north alike, ascending, deg.
        yaws: initial yaw errors, ascending, deg.
        schedules: by the number of resets, by their times.
        settle_s: (readings, levels, yaws, schedules, draws), infinite where a run never settled.
        yaw_mean: the same shape, window mean of phi_u, arcmin; NaN where it is unknown.
    """

    study: Study
    readings: tuple[Reading, ...]
    levels: tuple[float, ...]
    yaws: tuple[float, ...]
    schedules: tuple[Schedule, ...]
    settle_s: NDArray
    yaw_mean: NDArray

    @classmethod
    def of(cls, source: Source) -> "Grid":
        """Lays out the runs of a study.

        Raises:
            InputError: runs are missing, or the study is no such grid.
        """
        study = source.study
        keys = ("specific_force", "q_reading", "feedback_interval_s")
        east, north, up = (study.values(f"phi_{axis}0_deg") for axis in "enu")
        if east != north:
            raise _unfit(study, "level errors about east and north that are the same")
        each = [Reading(*point) for point in zip(*map(study.values, keys), strict=True)]
        times = study.reset_times()
        qs = list(dict.fromkeys(reading.q for reading in each))
        readings = tuple(
            sorted(set(each), key=lambda r: (FORCES.index(r.force), qs.index(r.q), r.feedback_s))
        )
        schedules = tuple(sorted(set(times), key=lambda times: (len(times), times)))
        levels, yaws = tuple(sorted(set(east))), tuple(sorted(set(up)))
        _require(study, readings, levels, yaws, schedules)
        points = ((readings, each), (levels, east), (yaws, up), (schedules, times))
        shape = tuple(len(order) for order, _ in points)
        at = [[order.index(value) for value in values] for order, values in points]
        place = np.ravel_multi_index(at, shape)
        if not np.array_equal(np.sort(place), np.arange(np.prod(shape))):
            raise _unfit(study, "every schedule once at every misalignment and reading")
        draws, rows = source.draws, source.rows((_SETTLED, _YAW))
        settle, yaw = (
            analysis.numbers(rows, name).reshape(draws, -1)[:, np.argsort(place)].T
            for name in (_SETTLED, _YAW)
        )
        shape = (*shape, draws)
        settle = np.nan_to_num(settle, nan=np.inf).reshape(shape)
        return cls(study, readings, levels, yaws, schedules, settle, yaw.reshape(shape))

    @property
    def measured(self) -> list[int]:
        """Places of the readings with the measured force."""
        return [i for i, reading in enumerate(self.readings) if reading.force == "measured"]

    @property
    def gravity(self) -> list[int]:
        """Places of the readings with gravity for the force."""
        return [i for i, reading in enumerate(self.readings) if reading.force == "gravity"]

    @property
    def draws(self) -> int:
        """Draws of every variant."""
        return self.settle_s.shape[-1]

    @property
    def n_points(self) -> int:
        """Misalignments of a reading."""
        return len(self.levels) * len(self.yaws)

    def reading(self, force: str, q: str, feedback_s: float) -> int:
        """Place of a reading; the study is known to have it."""
        return self.readings.index(Reading(force, q, feedback_s))

    def schedule(self, schedule: Schedule) -> int:
        """Place of a schedule; the study is known to have it."""
        return self.schedules.index(schedule)

    def with_count(self, least: int, most: int | None = None) -> list[int]:
        """Places of the schedules with ``least`` to ``most`` resets, or any more."""
        return [
            i
            for i, times in enumerate(self.schedules)
            if least <= len(times) and (most is None or len(times) <= most)
        ]

    @property
    def paper_point(self) -> tuple[int, int]:
        """Places of the level and the yaw of paper 1's condition 5."""
        return self.levels.index(PAPER_LEVEL_DEG), self.yaws.index(PAPER_YAW_DEG)

    @property
    def paper_reading(self) -> int:
        """Place of `PAPER_READING`."""
        return self.readings.index(PAPER_READING)


class Answer(NamedTuple):
    """What a page says to one question.

    Attributes:
        headline: the finding.
        heading: the question.
        blocks: what it rests on.
    """

    headline: str
    heading: str
    blocks: Sequence[Block]


def schedule_name(times: Schedule) -> str:
    """A schedule in words: ``none``, ``1 at 50 s``, ``3 from 50 s, 25 s apart``."""
    if not times:
        return "none"
    if len(times) == 1:
        return f"1 at {times[0]:g} s"
    return f"{len(times)} from {times[0]:g} s, {times[1] - times[0]:g} s apart"


def point_name(grid: Grid, at: tuple[int, int, int]) -> str:
    """The misalignment of a point by the places of its reading, level and yaw."""
    level, yaw = grid.levels[at[1]], grid.yaws[at[2]]
    return f"({level:g}, {level:g}, {yaw:g}) deg"


def median(settle_s: NDArray) -> NDArray:
    """Median over the draws, the last axis; infinite where fewer than half of them settled."""
    return np.quantile(settle_s, 0.5, axis=-1, method="inverted_cdf")


def draws_of(runs: NDArray) -> NDArray:
    """The draw of each of some runs (..., draws) laid out in a row, which is what is counted."""
    return np.broadcast_to(np.arange(runs.shape[-1]), runs.shape).ravel()


def shared(runs: NDArray) -> Estimate:
    """Share of runs (..., draws) that have a property; its interval is that of the draws."""
    return analysis.share(runs.ravel(), draws_of(runs))


def against(later_s: Estimate, other: str) -> str:
    """A difference of settling times in words, such as ``settles 12 s [3, 20] later than ...``."""
    if np.isnan(later_s.value):
        return f"does not settle, nor does {other}"
    if np.isinf(later_s.value):
        return f"settles where {other} does not" if later_s.value < 0 else "does not settle"
    if later_s.value >= 0:
        return f"settles {format_difference(later_s, 's', 0)} later than {other}"
    sooner = Estimate(-later_s.value, -later_s.high, -later_s.low, later_s.n)
    return f"settles {format_difference(sooner, 's', 0)} sooner than {other}"


def percent_mean(share: Estimate) -> str:
    """A mean of shares by draw in percent; Student's t may reach beyond what a share can be."""
    return percent(share._replace(low=max(share.low, 0.0), high=min(share.high, 1.0)))


def _unfit(study: Study, needs: str) -> InputError:
    return InputError(f"{study.name}: its layout needs {needs}")


def _require(
    study: Study,
    readings: Sequence[Reading],
    levels: Sequence[float],
    yaws: Sequence[float],
    schedules: Sequence[Schedule],
) -> None:
    """Refuses a study without the points that the page speaks of."""
    if PAPER_READING not in readings:
        raise _unfit(study, f"the reading {PAPER_READING.name}, with the measured force")
    forces = [{(r.q, r.feedback_s) for r in readings if r.force == f} for f in FORCES]
    if forces[0] != forces[1]:
        raise _unfit(study, "every reading with both specific forces, measured and gravity")
    if PAPER_LEVEL_DEG not in levels or PAPER_YAW_DEG not in yaws:
        raise _unfit(study, f"a level error of {PAPER_LEVEL_DEG:g} and a yaw of 30 deg")
    if min(len(levels), len(yaws)) < 2:
        raise _unfit(study, "two levels and two yaws or more")
    for wanted in (NONE, PAPER_SCHEDULE):
        if wanted not in schedules:
            raise _unfit(study, f"the schedule of resets at {value_text(list(wanted))} s")
    if not any(len(times) == 1 for times in schedules):
        raise _unfit(study, "a schedule of one reset")
    if study.n_draws < 2:
        raise _unfit(study, "two draws or more, of which one half judges what the other chooses")
