"""The success of an alignment: the reference of its heading, and the criteria that it must meet.

There are two separate questions. Does the filter converge? That is judged from the bias floor, the
heading error that the constant sensor biases of the run leave. Does the vehicle know its heading?
That is judged from the truth: true north, or the reference of a record.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sinsjax import columns
from sinsjax.study.study import Study

MOST_DWELL_S = 30.0
"""Longest dwell time that a run needs if the study does not give one."""


class Success(NamedTuple):
    """The criteria of a run with status ``ok``.

    Attributes:
        judged_from: reference of the heading error, the bias floor or the truth.
        band_arcmin: half-width of the band in which the heading error ends.
        level_band_arcmin: half-width of the band in which the level errors end.
        diverged_deg: final heading error beyond which a run has diverged.
        dwell_s: time in the band before the end; None for the smaller of 30 s and a tenth of the
            run.
    """

    judged_from: Literal["truth", "floor"]
    band_arcmin: float
    level_band_arcmin: float
    diverged_deg: float
    dwell_s: float | None

    @property
    def from_truth(self) -> bool:
        """Whether it is judged from the truth."""
        return self.judged_from == "truth"

    def dwell(self, run_s: ArrayLike) -> NDArray:
        """Return the time in the band that runs of some lengths (s) need, s."""
        if self.dwell_s is not None:
            return np.full(np.shape(run_s), self.dwell_s)
        return np.minimum(MOST_DWELL_S, np.asarray(run_s) / 10)


def success_of(study: Study) -> Success:
    """Return the success criteria of a study, with defaults."""
    given = study.study
    return Success(
        judged_from=given.judged_from or "truth",
        band_arcmin=_or(given.success_band_arcmin, columns.SUCCESS_BAND_ARCMIN),
        level_band_arcmin=_or(given.level_band_arcmin, columns.SUCCESS_BAND_ARCMIN),
        diverged_deg=_or(given.diverged_deg, columns.DIVERGED_DEG),
        dwell_s=given.dwell_s,
    )


def bands(study: Study) -> tuple[float, ...]:
    """Return the bands of a study's settling times, including the success band, arcmin."""
    return columns.settling_bands(study.study.settle_bands_arcmin, study.study.success_band_arcmin)


FLOOR_COLUMNS = ("phi_u_arcmin", "floor_arcmin")
"""Columns of the final heading error of a run and its bias floor."""


class Yardstick(NamedTuple):
    """A reference of success, with its columns of the summary.

    Attributes:
        truth: whether it is the truth, or else the bias floor.
        words: description of a success: ``within 10' of true north``.
        settle: column of the time at which a run entered the band for good.
        ok: column of the successes.
        band_arcmin: half-width of the band.
    """

    truth: bool
    words: str
    settle: str
    ok: str
    band_arcmin: float

    @property
    def of_several(self) -> str:
        """The description for several runs: ``within 10' of their bias floors``."""
        return self.words.replace("its bias floor", "their bias floors")

    @property
    def rate(self) -> str:
        """The name of the share of successes in the summary."""
        return f"success_{'truth' if self.truth else 'floor'}_rate"

    def end(self, first: "Yardstick") -> str:
        """Return the suffix of a figure's name; empty for the reference of the study, the first."""
        return "" if self == first else "_truth" if self.truth else "_floor"

    def off_floor(self, column: Callable[[str], NDArray]) -> NDArray:
        """Return whether each run is ok but ends outside the band about its bias floor.

        Args:
            column: function that returns ``ok`` and `FLOOR_COLUMNS` as numbers of any shape, with
                NaN for null.
        """
        apart = np.abs(column("phi_u_arcmin") - column("floor_arcmin"))
        found: NDArray = (column(self.ok) > 0) & (apart > self.band_arcmin)
        return found


def yardsticks(study: Study, band_arcmin: float | None = None) -> tuple[Yardstick, ...]:
    """Return the reference of a study's success, then the other one; for a record its reference.

    Args:
        study: study of the runs.
        band_arcmin: half-width of the band; None for the success band.
    """
    judged = success_of(study)
    band = judged.band_arcmin if band_arcmin is None else band_arcmin
    kinds = (True,) if study.is_recorded else (judged.from_truth, not judged.from_truth)
    return tuple(_yardstick(study, band, truth) for truth in kinds)


def judged_columns(study: Study) -> list[str]:
    """Return the columns of successes and of their settling times."""
    return [name for yard in yardsticks(study) for name in (yard.ok, yard.settle)]


def _yardstick(study: Study, band: float, truth: bool) -> Yardstick:
    what = "true north" if truth else "its bias floor"
    return Yardstick(
        truth,
        f"within {band:g}' of {'the reference' if study.is_recorded else what}",
        columns.settle_column(band, truth=truth).name,
        "ok_truth" if truth else "ok_floor",
        band,
    )


def _or(value: float | None, default: float) -> float:
    return default if value is None else value
