"""Success of runs: which have a bias floor, settling times about it and the truth, and a status."""

from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.engine.metrics import Outcome
from sinsjax.engine.scenario import earth_rate
from sinsjax.errors import InputError
from sinsjax.methods.filters.keys import RESET_KEYS, acting_reset_times
from sinsjax.methods.registry import METHODS
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.schema import BIAS_KEYS
from sinsjax.study.study import Study
from sinsjax.study.success import SuccessCriteria, settling_bands, success_criteria
from sinsjax.study.values import Variants, drawn_values
from sinsjax.units import ARCMIN, DEG, DEG_PER_H

FLOOR, TRUTH = 0, 1
"""Rows of results that are judged from the bias floor and from the truth."""

LEAST_PERIODS = 10
"""Sway periods since the last reset that are needed to average a bias."""

MOST_SHARED = 5 * ARCMIN
"""Largest part of one sigma of heading taken for gyro bias with which the floor holds, rad."""

_ANGLES = ("pitch", "roll", "yaw")


class RunSuccess(NamedTuple):
    """Success of some runs."""

    has_floor: NDArray  # (runs,) whether the run has a bias floor
    # (2, bands, runs) settling times about the bias floor and about the truth, s; NaN if the last
    # record is still outside, or there is no bias floor
    settled_s: NDArray
    ok: NDArray  # (2, runs) whether the run is a success, judged from either
    status: pa.Array  # (runs,) of `columns.STATUSES`, None if it cannot be judged


def evaluate_success(
    study: Study,
    outcome: Outcome,
    floor_flags: NDArray,
    end_s: NDArray,
    *,
    has_truth: bool = True,
    finds_heading: bool = True,
) -> RunSuccess:
    """Return the success of runs, leaves (runs, ...), of the lengths ``end_s``, with bias floors.

    Without a truth only non-finite runs are known; without a heading none is a success.
    """
    criteria = success_criteria(study)
    outside_until = np.moveaxis(np.asarray(outcome.outside_until), 0, -1)
    settled_s = np.where(outside_until >= end_s * (1 - 1e-12), np.nan, outside_until)
    settled_s[FLOOR, :, ~floor_flags] = np.nan
    no_north = (floor_flags & np.asarray(outcome.floor.no_north)) | (not finds_heading)
    latest_s = (end_s - criteria.dwell(end_s)) * (1 + 1e-12)
    in_band = settled_s[:, settling_bands(study).index(criteria.band_arcmin)] <= latest_s
    ok = in_band & _is_level(criteria, outcome) & ~no_north
    # Of several reasons the first one listed counts.
    last = outcome.last
    angles = (last.pitch, last.roll, last.yaw) if finds_heading else (last.pitch, last.roll)
    broken = ~np.isfinite(np.stack(angles)).all(axis=0)
    if not has_truth:
        status = ["nonfinite" if b else None for b in broken]
        return RunSuccess(floor_flags, settled_s, ok, pa.array(status, pa.string()))
    error = np.asarray(last.phi.z) - np.where(floor_flags, outcome.floor.phi.z, 0.0)
    kinds = {
        "nonfinite": broken,
        "no_north": no_north,
        None: ~floor_flags & (not criteria.from_truth),
        "ok": ok[TRUTH if criteria.from_truth else FLOOR],
        "diverged": np.abs(error) > criteria.diverged_deg * DEG,
    }
    kind = np.select(list(kinds.values()), list(range(len(kinds))), default=len(kinds))
    status = np.array([*kinds, "not_settled"], dtype=object)[kind]
    return RunSuccess(floor_flags, settled_s, ok, pa.array(status, pa.string()))


def _is_level(criteria: SuccessCriteria, outcome: Outcome) -> NDArray:
    """Return whether both level errors end in their band about floor and truth, (2, runs)."""
    floor, band = outcome.floor, criteria.level_band_arcmin * ARCMIN
    phi, at_floor = (np.stack([vector.x, vector.y]) for vector in (outcome.last.phi, floor.phi))
    from_floor = np.abs(phi - at_floor).max(axis=0) <= band
    from_truth = np.abs(phi).max(axis=0) <= band + np.asarray(floor.tilt)
    return np.stack([from_floor, from_truth])


# Bias floors


def last_scheduled_reset_s(study: Study) -> np.ndarray:
    """Return the time of the last reset of each variant's schedule, (variants,), s; 0 for none."""
    if not study.has("resets"):
        return np.zeros(study.n_variants)
    values = study.coded(*RESET_KEYS)
    return values.compute(lambda keys: max(acting_reset_times(study.rate_hz, *keys), default=0.0))


def has_floor(
    study: Study, draw_ids: np.ndarray, variant_ids: np.ndarray, last_reset_s: np.ndarray
) -> np.ndarray:
    """Return whether runs, (runs,), have the bias floor of `methods.floors`, bool.

    Biases rotated by a sway need `LEAST_PERIODS` of it since the last reset (and in the stored
    record, if passes repeat). A filter with gyro bias states distinguishes them from the heading
    once the base moves. On a still base it cannot, and has the bias floor of a filter without them
    if P0, and the P of a reset, attribute the east bias to the heading: see `MOST_SHARED`. Some
    methods have no floor, and no run has one whose base is turned. Runs of a recorded study, whose
    reference is their floor, all have one. ``last_reset_s`` is 0 for runs without a reset.
    """
    if study.is_recorded:
        return np.ones(len(variant_ids), bool)
    first, last = (int(f(draw_ids, initial=0)) for f in (np.min, np.max))
    drawn = drawn_values(study, last + 1 - first, first=first)
    keys = Variants(study, variant_ids)

    def number(key: str) -> np.ndarray:
        return drawn[key][draw_ids - first] if key in drawn else keys.column(key)

    def is_biased(key: str) -> np.ndarray:
        if key in drawn:
            return drawn[key][draw_ids - first].any(-1)
        return keys.compute(np.any, key, dtype=bool)

    codes, spans = study.lengths
    intervals = np.array([(span.records, span.pass_records) for span in spans])
    length, pass_s = (intervals[codes[variant_ids]] * study.record_every / study.rate_hz).T
    averaged_over_s = np.minimum(length - last_reset_s, pass_s) * (1 + 1e-9)
    moves = np.stack([number(f"{angle}_amplitude_deg") for angle in _ANGLES]) != 0
    periods_s = np.stack([number(f"{angle}_period_s") for angle in _ANGLES])
    slow = (moves & (LEAST_PERIODS * periods_s > averaged_over_s)).any(0)
    floors = ~(np.logical_or(*map(is_biased, BIAS_KEYS)) & slow)
    names = keys.compute(lambda name: name, "method", dtype=object)
    rate_n = keys.compute(earth_rate, "earth", "earth_rate_deg_per_h")
    rate_n = rate_n * np.cos(number("latitude_deg") * DEG)
    for name in study.methods:
        if pairs := METHODS[name].gyro_bias_keys:
            given = [pair for pair in pairs if study.has(SECTION_OF[pair[0]])]
            sigmas = [(number(bias), number(yaw)) for bias, yaw in given]
            shared = _heading_sigma_attributed_to_gyro_bias(rate_n, sigmas)
            floors = np.where(names == name, ~moves.any(0) & (shared <= MOST_SHARED), floors)
        floors &= METHODS[name].has_floor | (names != name)
    turns = "turn_times_s", "attitude_file"
    return floors & ~keys.compute(lambda *given: any(given), *turns, dtype=bool)


def _heading_sigma_attributed_to_gyro_bias(
    north_rate: np.ndarray, bias_and_heading_sigmas: list[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """Return the part of one sigma of heading that a filter takes for east gyro bias, (runs,), rad.

    Heading and east bias are observed only as their sum, omega_N phi_U + eps_E, which least squares
    splits by their variances. ``north_rate`` is omega_N, rad/s; the sigmas of gyro bias, deg/h, and
    heading, deg, are those of the start, then of a reset; where NaN, it sets P as at the start.
    """
    most = np.zeros(len(north_rate))
    for at_reset in bias_and_heading_sigmas:
        pairs = zip(at_reset, bias_and_heading_sigmas[0], strict=True)
        bias, yaw = (np.where(np.isnan(a), start, a) for a, start in pairs)
        ratio = (bias * DEG_PER_H / (north_rate * yaw * DEG)) ** 2
        most = np.maximum(most, yaw * DEG * ratio / (1 + ratio))
    return most


def require_floor(study: Study) -> None:
    """Refuse a study that is judged from a bias floor if a variant has none in its first run."""
    if success_criteria(study).from_truth:
        return
    variants = np.arange(study.n_variants)
    floors = has_floor(study, 0 * variants, variants, last_scheduled_reset_s(study))
    if not floors.all():
        variant = int(variants[~floors][0])
        method = study.values("method")[variant]
        raise InputError(
            f"{study.name}: [study] judged_from: 'floor' cannot be judged: method '{method}' has no"
            f" bias floor on this base (variant {variant}; use 'truth')"
        )
