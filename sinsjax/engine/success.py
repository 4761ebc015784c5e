"""Success of runs: settling times about the bias floor and about the truth, and a status."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.engine.metrics import Outcome

FLOOR, TRUTH = 0, 1
"""Rows of results that are judged from the bias floor and from the truth."""


class SuccessLimits(NamedTuple):
    """The limits of successful runs.

    Attributes:
        from_truth: whether they are judged from the truth, or else from the bias floor.
        band: place, among the bands of settling times, of that in which the heading error ends.
        level_band: half-width of the band in which the level errors end, rad.
        diverged: final heading error beyond which an unsuccessful run has diverged, rad.
        dwell_s: lengths of runs, s -> time in the band before the end that they need, s.
    """

    from_truth: bool
    band: int
    level_band: float
    diverged: float
    dwell_s: Callable[[NDArray], NDArray]


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


def evaluate_success(
    limits: SuccessLimits,
    outcome: Outcome,
    floors: NDArray,
    end_s: NDArray,
    *,
    has_truth: bool = True,
    finds_heading: bool = True,
) -> RunSuccess:
    """Return the success of some runs.

    Args:
        limits: of a success.
        outcome: of the engine, leaves (runs, ...).
        floors: (runs,) whether a run has a bias floor.
        end_s: (runs,) lengths, s.
        has_truth: whether there is a truth; without one only non-finite runs are known.
        finds_heading: whether their method finds a heading; otherwise none is a success.
    """
    outside_until = np.moveaxis(np.asarray(outcome.outside_until), 0, -1)
    settled_s = np.where(outside_until >= end_s * (1 - 1e-12), np.nan, outside_until)
    settled_s[FLOOR, :, ~floors] = np.nan
    no_north = (floors & np.asarray(outcome.floor.no_north)) | (not finds_heading)
    latest_s = (end_s - limits.dwell_s(end_s)) * (1 + 1e-12)
    ok = (settled_s[:, limits.band] <= latest_s) & _is_level(limits, outcome) & ~no_north
    # Of several reasons the first one listed counts.
    last = outcome.last
    angles = (last.pitch, last.roll, last.yaw) if finds_heading else (last.pitch, last.roll)
    broken = ~np.isfinite(np.stack(angles)).all(axis=0)
    if not has_truth:
        status = ["nonfinite" if b else None for b in broken]
        return RunSuccess(floors, settled_s, ok, pa.array(status, pa.string()))
    error = np.asarray(last.phi.z) - np.where(floors, outcome.floor.phi.z, 0.0)
    kinds = {
        "nonfinite": broken,
        "no_north": no_north,
        None: ~floors & (not limits.from_truth),
        "ok": ok[TRUTH if limits.from_truth else FLOOR],
        "diverged": np.abs(error) > limits.diverged,
    }
    kind = np.select(list(kinds.values()), list(range(len(kinds))), default=len(kinds))
    status = np.array([*kinds, "not_settled"], dtype=object)[kind]
    return RunSuccess(floors, settled_s, ok, pa.array(status, pa.string()))


def _is_level(limits: SuccessLimits, outcome: Outcome) -> NDArray:
    """Return whether both level errors end in their band about floor and truth, (2, runs)."""
    floor = outcome.floor
    phi, at_floor = (np.stack([vector.x, vector.y]) for vector in (outcome.last.phi, floor.phi))
    from_floor = np.abs(phi - at_floor).max(axis=0) <= limits.level_band
    from_truth = np.abs(phi).max(axis=0) <= limits.level_band + np.asarray(floor.tilt)
    return np.stack([from_floor, from_truth])
