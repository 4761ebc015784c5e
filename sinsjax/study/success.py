"""When an alignment is a success: what its heading is judged from, and how well it has to do.

Two questions, never mixed. Does the filter converge? That is judged from the bias floor, the
heading error that the run's own constant sensor biases leave. Does the vehicle know its heading?
That is judged from the truth: true north, or the reference of a record.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sinsjax import columns
from sinsjax.study.study import Study

MOST_DWELL_S = 30.0
"""The longest that a run has to have stayed in its band where the study does not say it."""


class Success(NamedTuple):
    """What a run has to do to end with status ``ok``.

    Attributes:
        judged_from: the bias floor or the truth, from which its heading error counts.
        band_arcmin: half-width of the band that its heading error ends in.
        level_band_arcmin: half-width of that of its level errors.
        diverged_deg: a heading error beyond this at the end has diverged.
        dwell_s: how long before the end it has stayed in the band; None: the smaller of 30 s and
            a tenth of the run.
    """

    judged_from: Literal["truth", "floor"]
    band_arcmin: float
    level_band_arcmin: float
    diverged_deg: float
    dwell_s: float | None

    @property
    def from_truth(self) -> bool:
        """Whether the truth is what it is judged from."""
        return self.judged_from == "truth"

    def dwell(self, run_s: ArrayLike) -> NDArray:
        """How long runs of some lengths (s) have to have stayed in the band, s."""
        if self.dwell_s is not None:
            return np.full(np.shape(run_s), self.dwell_s)
        return np.minimum(MOST_DWELL_S, np.asarray(run_s) / 10)


def success_of(study: Study) -> Success:
    """What the runs of a study have to do, defaults filled in."""
    given = study.study
    return Success(
        judged_from=given.judged_from or "truth",
        band_arcmin=_or(given.success_band_arcmin, columns.SUCCESS_BAND_ARCMIN),
        level_band_arcmin=_or(given.level_band_arcmin, columns.SUCCESS_BAND_ARCMIN),
        diverged_deg=_or(given.diverged_deg, columns.DIVERGED_DEG),
        dwell_s=given.dwell_s,
    )


def bands(study: Study) -> tuple[float, ...]:
    """The bands of a study's settling times, that of success among them, arcmin."""
    return columns.bands(study.study.settle_bands_arcmin, study.study.success_band_arcmin)


FLOOR_COLUMNS = ("phi_u_arcmin", "floor_arcmin")
"""Columns that tell how far from its bias floor a run ends."""


class Yardstick(NamedTuple):
    """What a success is counted from, with its columns of the summary.

    Attributes:
        truth: whether that is the truth, or else the bias floor.
        words: what a success is: ``within 10' of true north``.
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
        """What successes of several runs are: ``within 10' of their bias floors``."""
        return self.words.replace("its bias floor", "their bias floors")

    @property
    def rate(self) -> str:
        """The share of successes, as a statistic of the summary."""
        return f"success_{'truth' if self.truth else 'floor'}_rate"

    def end(self, first: "Yardstick") -> str:
        """The end of a figure's name: none of what a study is judged from, which is the first."""
        return "" if self == first else "_truth" if self.truth else "_floor"

    def off_floor(self, column: Callable[[str], NDArray]) -> NDArray:
        """Which runs are ok and yet end outside the band about their bias floor: not converged.

        Args:
            column: gives ``ok`` and `FLOOR_COLUMNS` as numbers, of any shape; null is NaN.
        """
        apart = np.abs(column("phi_u_arcmin") - column("floor_arcmin"))
        found: NDArray = (column(self.ok) > 0) & (apart > self.band_arcmin)
        return found


def yardsticks(study: Study, band_arcmin: float | None = None) -> tuple[Yardstick, ...]:
    """What a study's success is judged from, then the other; of a record the reference alone.

    Args:
        study: whose runs.
        band_arcmin: half-width of the band; None: that of success.
    """
    judged = success_of(study)
    band = judged.band_arcmin if band_arcmin is None else band_arcmin
    kinds = (True,) if study.is_recorded else (judged.from_truth, not judged.from_truth)
    return tuple(_yardstick(study, band, truth) for truth in kinds)


def judged_columns(study: Study) -> list[str]:
    """The columns that tell successes and when they settled."""
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
