"""Heading errors of all arms over starts, bases, grades and times, and the best arm of a cell."""

import re
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.analysis import Estimate
from sinsjax.analysis.estimates import bootstrap_interval, quantile, quantile_index
from sinsjax.analysis.formats import format_estimate
from sinsjax.execution.source import Source

from ..common.grids import grid_of

TIMES_S = (30, 60, 120, 300, 600)
STORED_S = 100
"""Of the stored record that the prose tells of."""

MOST = 0.9
"""What share of the runs an error is told for: half of the draws bound no larger one."""

USELESS = 600.0
"""Heading error that is no alignment, arcmin."""

Start = tuple[float, float, float]
"""Initial misalignment about east, north and up, deg."""


class Base(NamedTuple):
    """Vehicle motion: amplitude of sway (deg), lever arm (m), surge (m/s) and vibration (ug)."""

    sway: float
    lever: float
    surge: float
    vibration: float

    @property
    def words(self) -> str:
        """Vehicle motion in words."""
        if self.lever and self.surge and self.vibration:
            return "all of these"
        names = (
            (self.surge, "sway and surge"),
            (self.vibration, "vibration"),
            (self.lever, "sway with a lever arm"),
            (self.sway, "sway"),
        )
        return next((name for value, name in names if value), "still")


@dataclass(frozen=True)
class Cell:
    """Prior knowledge, vehicle motion, sensor grade and available time.

    Attributes:
        starts: initial misalignments that it has to do for.
        base: vehicle motion.
        grade: gyro bias, deg/h.
        time_s: from the first sample of data.
    """

    starts: tuple[Start, ...]
    base: Base
    grade: float
    time_s: int


class Choice(NamedTuple):
    """The best arm of a cell, and the next if it is not told apart, with their errors, arcmin."""

    arms: tuple[str, ...]
    errors: tuple[Estimate, ...]

    @property
    def text(self) -> str:
        """Both with their intervals; none where even the best is no alignment."""
        if self.errors[0].value > USELESS:
            return f"none ({angle(self.errors[0])})"
        pairs = zip(self.arms, self.errors, strict=True)
        return "; or ".join(f"{arm}: {angle(error)}" for arm, error in pairs)


class Field:
    """All arms of one or more studies over the same conditions, on the same draws."""

    def __init__(self, *sources: Source) -> None:
        columns = [f"phi_u_at_{t}_arcmin" for t in (*TIMES_S, STORED_S)]
        columns += [f"nees_at_{t}" for t in TIMES_S] + ["floor_arcmin", "settle_10_s"]
        self.grids = [grid_of(one, columns, **_axes(one)) for one in sources]
        first = self.grids[0].axes
        self.starts: tuple[Start, ...] = first["start"]
        self.bases: dict[str, Base] = {base.words: base for base in first["base"]}
        self.grades: tuple[float, ...] = first["grade"]
        self.draws = self.grids[0].draws
        self._of = {case: grid for grid in self.grids for case in grid.axes["case"]}
        self.arms = tuple(self._of)
        self.methods: dict[str, str] = {
            case: method
            for source in sources
            for case, method in zip(
                source.study.values("case"), source.study.values("method"), strict=True
            )
        }

    def at(self, grade: float) -> tuple[str, ...]:
        """The arms that were run with sensors of a grade."""
        return tuple(arm for arm in self.arms if grade in self._of[arm].axes["grade"])

    def column(self, name: str, arm: str, cell: Cell) -> NDArray:
        """(starts, draws) of a column whose name may have the time in it, as ``{t}``."""
        points = {"case": arm, "base": cell.base, "grade": cell.grade, "start": list(cell.starts)}
        return self._of[arm].at(name.format(t=cell.time_s), **points)

    def errors(self, arm: str, cell: Cell, *, from_floor: bool = False) -> NDArray:
        """(starts, draws) heading error from truth or the bias floor, arcmin; infinite for none."""
        error = self.column("phi_u_at_{t}_arcmin", arm, cell)
        if from_floor:
            error = error - self.column("floor_arcmin", arm, cell)
        return np.nan_to_num(np.abs(error), nan=np.inf)

    def best(self, cell: Cell) -> Choice:
        """The arm that every other draw chose, its error on the rest; two if not told apart."""
        arms = self.at(cell.grade)
        chosen = [_most(self.errors(arm, cell)[:, ::2]) for arm in arms]
        one, two = np.argsort(chosen, kind="stable")[:2]
        judged = [self.errors(arms[place], cell)[:, 1::2] for place in (one, two)]
        low, high = _apart(*judged)
        stand = (one, two) if low <= 0 <= high else (one,)
        return Choice(
            tuple(arms[number] for number in stand),
            tuple(reach(errors) for errors, _ in zip(judged, stand, strict=False)),
        )


def reach(errors: NDArray, share: float = MOST) -> Estimate:
    """What a share of the runs (starts, draws) stays below, arcmin; its interval is by draw."""
    cluster = np.broadcast_to(np.arange(errors.shape[-1]), errors.shape)
    return quantile(errors.ravel(), share, cluster.ravel())


def worst_start(errors: NDArray, share: float = MOST) -> Estimate:
    """Error that a share of the draws stays below from the worst start, arcmin.

    Args:
        errors: shape (starts, draws), arcmin; the starts are a list and no distribution.
        share: share of the draws.

    Returns:
        The largest value, and the largest ends, of the starts.
    """
    of_starts = [quantile(row, share) for row in errors]
    value, low, high = np.max([one[:3] for one in of_starts], axis=0)
    return Estimate(float(value), float(low), float(high), errors.shape[-1])


def angle(error: Estimate) -> str:
    """An angle, arcmin, in degrees where it is large."""
    if error.value < 100:
        return f"{format_estimate(error, digits=1 if error.value < 10 else 0)}'"
    degrees = Estimate(error.value / 60, error.low / 60, error.high / 60, error.n)
    return f"{format_estimate(degrees, digits=0 if degrees.value > 10 else 1)} deg"


def brief(error: Estimate) -> str:
    """Return an angle without its interval, which the tables have."""
    return re.sub(r" \[.*\]", "", angle(error))


def start_samples(source: Source) -> list[Start]:
    """Initial misalignment of each variant."""
    east, north, up = (source.study.values(f"phi_{axis}0_deg") for axis in "enu")
    return [(float(e), float(n), float(u)) for e, n, u in zip(east, north, up, strict=True)]


def bases_of(source: Source) -> list[Base]:
    """Return the vehicle motion of each variant; keys that the study leaves out are 0."""
    study = source.study
    values = [
        study.values(key)
        for key in ("pitch_amplitude_deg", "lever_arm_m", "surge_m_per_s", "vibration_ug_rms")
    ]
    return [Base(*(float(np.max(x)) for x in one)) for one in zip(*values, strict=True)]


def _axes(source: Source) -> dict[str, str | list[Any]]:
    """What the axes of a study are called here, a value for each variant."""
    return {
        "case": "case",
        "start": start_samples(source),
        "base": bases_of(source),
        "grade": [float(np.max(bias)) for bias in source.study.values("gyro_bias_deg_per_h")],
    }


def _most(errors: NDArray) -> float:
    """What most of the runs stay below, arcmin."""
    return float(np.partition(errors.ravel(), at := quantile_index(errors.size, MOST))[at])


def _apart(one: NDArray, other: NDArray) -> tuple[float, float]:
    """95 % interval of the difference of what most runs (starts, draws) stay below, by draw."""
    at = quantile_index(one.size, MOST)

    def statistic(picks: NDArray) -> NDArray:
        left, right = (
            np.partition(np.moveaxis(errors[:, picks], 0, 1).reshape(len(picks), -1), at, axis=-1)[
                :, at
            ]
            for errors in (one, other)
        )
        same = left == right
        return np.where(same, 0.0, left - np.where(same, 0.0, right))

    return bootstrap_interval(statistic, np.arange(one.shape[-1]))
