"""The success of an alignment: the reference of its heading, and the criteria that it must meet.

Whether a filter converges is judged from the bias floor, whether the vehicle knows its heading from
the truth: true north, or the reference of a record.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sinsjax import columns
from sinsjax.study.study import Study
from sinsjax.value_types import otherwise

FLOOR_COLUMNS = ("phi_u_arcmin", "floor_arcmin")
"""Columns of the final heading error of a run and its bias floor."""


class SuccessCriteria(NamedTuple):
    """The criteria of a run with status ``ok``; a band is the half-width within which it ends."""

    from_truth: bool  # whether the heading error is judged from the truth, not from the bias floor
    band_arcmin: float
    level_band_arcmin: float
    diverged_deg: float  # final heading error beyond which a run has diverged
    dwell_s: float | None  # time in the band; None for the smaller of 30 s and a tenth of the run

    def dwell(self, run_s: ArrayLike) -> NDArray:
        """Return the time in the band that runs of some lengths (s) need, s."""
        if self.dwell_s is not None:
            return np.full(np.shape(run_s), self.dwell_s)
        return np.minimum(30.0, np.asarray(run_s) / 10)


def success_criteria(study: Study) -> SuccessCriteria:
    """Return the success criteria of a study, with defaults."""
    settings = study.study
    band, level_band, diverged = (
        otherwise(type(settings), key) if (given := getattr(settings, key)) is None else given
        for key in ("success_band_arcmin", "level_band_arcmin", "diverged_deg")
    )
    from_truth = settings.judged_from != "floor"
    return SuccessCriteria(from_truth, band, level_band, diverged, settings.dwell_s)


def settling_bands(study: Study) -> tuple[float, ...]:
    """Return the bands of a study's settling times, including the success band, arcmin."""
    bands = (*study.study.settle_bands_arcmin, success_criteria(study).band_arcmin)
    return tuple({f"{band:g}": band for band in bands}.values())  # one of each column name


class SuccessMeasure(NamedTuple):
    """A reference of success, the truth or the bias floor, with its columns of the summary."""

    truth: bool
    description: str  # a success in words: within 10' of true north
    settle_column: str  # of the time at which a run entered the band for good
    ok_column: str
    band_arcmin: float

    @property
    def plural_description(self) -> str:
        """The description for several runs: ``within 10' of their bias floors``."""
        return self.description.replace("its bias floor", "their bias floors")

    @property
    def rate_column(self) -> str:
        """The name of the share of successes in the summary."""
        return f"success_{'truth' if self.truth else 'floor'}_rate"

    def figure_suffix(self, first: "SuccessMeasure") -> str:
        """Return the suffix of a figure's name; empty for the reference of the study, the first."""
        return "" if self == first else "_truth" if self.truth else "_floor"

    def outside_floor_band(self, get_column: Callable[[str], NDArray]) -> NDArray:
        """Return whether each run is ok but ends outside the band about its bias floor.

        ``get_column`` returns ``ok`` and `FLOOR_COLUMNS` as numbers of any shape, NaN for null.
        """
        distance = np.abs(get_column("phi_u_arcmin") - get_column("floor_arcmin"))
        off: NDArray = (get_column(self.ok_column) > 0) & (distance > self.band_arcmin)
        return off


def success_measures(study: Study, band_arcmin: float | None = None) -> tuple[SuccessMeasure, ...]:
    """Return the reference of a study's success, then the other one; for a record its reference.

    The half-width of the band is that of success unless it is given.
    """
    criteria = success_criteria(study)
    band = criteria.band_arcmin if band_arcmin is None else band_arcmin
    north = "the reference" if study.is_recorded else "true north"
    kinds = (True,) if study.is_recorded else (criteria.from_truth, not criteria.from_truth)
    return tuple(
        SuccessMeasure(
            truth=truth,
            description=f"within {band:g}' of {north if truth else 'its bias floor'}",
            settle_column=columns.settle_column(band, truth=truth).name,
            ok_column="ok_truth" if truth else "ok_floor",
            band_arcmin=band,
        )
        for truth in kinds
    )


def success_columns(study: Study) -> list[str]:
    """Return the columns of successes and of their settling times."""
    return [name for y in success_measures(study) for name in (y.ok_column, y.settle_column)]
