"""Success of runs: settling times about the bias floor and about the truth, and a status."""

from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.engine.metrics import Outcome
from sinsjax.study.study import Study
from sinsjax.study.success import settling_bands, success_criteria
from sinsjax.units import ARCMIN, DEG

FLOOR, TRUTH = 0, 1
"""Rows of results that are judged from the bias floor and from the truth."""


class RunSuccess(NamedTuple):
    """Success of some runs.

    Attributes:
        has_floor: (runs,) whether the run has a bias floor.
        settled_s: (2, bands, runs) settling times about the bias floor and about the truth, s; NaN
            if the last record is still outside, or there is no bias floor.
        ok: (2, runs) whether the run is a success, judged from either.
        status: (runs,) of `columns.STATUSES`, None if it cannot be judged.
    """

    has_floor: NDArray
    settled_s: NDArray
    ok: NDArray
    status: pa.Array


class SuccessEvaluator:
    """Evaluates the success of a study's runs."""

    def __init__(self, study: Study, *, has_truth: bool) -> None:
        """Read the criteria of a study; without a truth only non-finite runs are known."""
        self._success = success_criteria(study)
        self._band = settling_bands(study).index(self._success.band_arcmin)
        self._has_truth = has_truth

    def __call__(
        self,
        outcome: Outcome,
        has_floor: NDArray,
        end_s: NDArray,
        *,
        finds_heading: bool = True,
    ) -> RunSuccess:
        """Return the success of some runs.

        Args:
            outcome: of the engine, leaves (runs, ...).
            has_floor: (runs,) whether a run has a bias floor.
            end_s: (runs,) lengths, s.
            finds_heading: whether their method finds a heading; otherwise none is a success.
        """
        outside_until = np.moveaxis(np.asarray(outcome.outside_until), 0, -1)
        settled_s = np.where(outside_until >= end_s * (1 - 1e-12), np.nan, outside_until)
        settled_s[FLOOR, :, ~has_floor] = np.nan
        no_north = (has_floor & np.asarray(outcome.floor.no_north)) | (not finds_heading)
        latest_s = (end_s - self._success.dwell(end_s)) * (1 + 1e-12)
        long_enough = settled_s[:, self._band] <= latest_s
        ok = long_enough & self._is_level(outcome) & ~no_north
        status = self._status(outcome, has_floor, no_north, ok, finds_heading=finds_heading)
        return RunSuccess(has_floor, settled_s, ok, status)

    def _is_level(self, outcome: Outcome) -> NDArray:
        """Return whether both level errors end in their band about floor and truth, (2, runs)."""
        band, floor = self._success.level_band_arcmin * ARCMIN, outcome.floor
        phi, at_floor = (np.stack([vector.x, vector.y]) for vector in (outcome.last.phi, floor.phi))
        from_floor = np.abs(phi - at_floor).max(axis=0) <= band
        from_truth = np.abs(phi).max(axis=0) <= band + np.asarray(floor.tilt)
        return np.stack([from_floor, from_truth])

    def _status(
        self,
        outcome: Outcome,
        has_floor: NDArray,
        no_north: NDArray,
        ok: NDArray,
        *,
        finds_heading: bool,
    ) -> pa.Array:
        """Return why each run is ok or not; of several reasons the first one listed counts."""
        last = outcome.last
        angles = (last.pitch, last.roll, last.yaw) if finds_heading else (last.pitch, last.roll)
        broken = ~np.isfinite(np.stack(angles)).all(axis=0)
        if not self._has_truth:
            return pa.array(["nonfinite" if b else None for b in broken], pa.string())
        from_truth = self._success.from_truth
        error = np.asarray(last.phi.z) - np.where(has_floor, outcome.floor.phi.z, 0.0)
        kinds = {
            "nonfinite": broken,
            "no_north": no_north,
            None: ~has_floor & (not from_truth),
            "ok": ok[TRUTH if from_truth else FLOOR],
            "diverged": np.abs(error) > self._success.diverged_deg * DEG,
        }
        kind = np.select(list(kinds.values()), list(range(len(kinds))), default=len(kinds))
        return pa.array(np.array([*kinds, "not_settled"], dtype=object)[kind], pa.string())
