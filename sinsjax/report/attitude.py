"""The attitude that a run ends with: the first thing that a user of a record wants."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sinsjax import analysis
from sinsjax.analysis.formats import format_heading_error
from sinsjax.errors import InputError
from sinsjax.execution.results import Results
from sinsjax.methods.filters.keys import estimates_biases
from sinsjax.methods.registry import METHODS
from sinsjax.plots.labels import describe_point
from sinsjax.records.layout import parse_axes_order
from sinsjax.records.motion import EARTH_RATE
from sinsjax.report.base import MAX_ROWS, Fact, Report, Table, build_table, caution
from sinsjax.report.verdict import (
    SweepOutcome,
    answer_facts,
    caution_facts,
    condition_table,
    fit_cautions,
    split_warnings,
    study_title,
)
from sinsjax.units import ARCMIN, DEG_PER_H, MICRO

_HEADERS = {
    "heading_deg": ("heading (deg)", 3),
    "pitch_deg": ("pitch (deg)", 3),
    "roll_deg": ("roll (deg)", 3),
    "sigma_u_arcmin": ("1 sigma (')", 1),
    "phi_u_arcmin": ("error (')", 1),
}
"""Columns of the table of final attitudes: their headers and decimals."""
_LEVEL_SIGMAS, _LEVEL_ERRORS = (tuple(f"{x}_{a}_arcmin" for a in "en") for x in ("sigma", "phi"))
_EXAMPLES = (0.01, 100.0)  # deg/h and ug, whose effect is stated if the biases are unknown


def attitude_verdict(
    source: Results, outcome: SweepOutcome | None = None, *, warnings_shown: bool = False
) -> Report:
    """Return the attitude of each start, its cautions, and the best option.

    Args:
        source: results on a record, of a study without truth, or of methods without heading.
        outcome: of the results, if some run has a truth.
        warnings_shown: whether the user has seen the study's warnings.
    """
    study = source.study
    methods = [METHODS[name] for name in study.methods]
    finds_heading = any(method.finds_heading for method in methods)
    names = ["draw_id", "variant_id", "start_s", *study.keys_shown, *_HEADERS, *_LEVEL_SIGMAS]
    rows = source.rows(names).to_pylist()
    last, table, judged = rows[-1], None, []
    if outcome and study.n_variants > 1 and finds_heading:
        last = next(row for row in reversed(rows) if row["variant_id"] == outcome.best_variant)
        judged, table = [*answer_facts(outcome), *caution_facts(outcome)], condition_table(outcome)
    elif len(rows) > 1:
        table = _final_attitude_table(source, rows)
    facts = [_attitude_fact(source, last, len(rows), finds_heading=finds_heading)]
    if not finds_heading:
        facts += _level_facts(source)
    elif any(method.has_floor for method in methods):
        facts += _bias_floor_fact(source)
    first, doubts = split_warnings(source, warnings_shown=warnings_shown)
    doubts = [*(first if finds_heading else ()), *doubts, *_caution_facts(source)]
    return Report(study_title(source), [*facts, *judged, *doubts], table)


def _attitude_fact(
    source: Results, row: Mapping[str, Any], n_runs: int, *, finds_heading: bool
) -> Fact:
    """The attitude that a run ends with, and which run it is if there are several."""
    heading, pitch, roll, sigma, error = (row[name] for name in _HEADERS)
    if pitch is None or roll is None:
        return caution("unknown, the run is not finite", "Attitude")
    text, sigmas = f"pitch {pitch:.3f}, roll {roll:.3f} deg", [row[name] for name in _LEVEL_SIGMAS]
    if not finds_heading and None not in sigmas:
        biases = max(source.study.values("level_accel_bias_ug"))
        text += f" (1 sigma {max(sigmas):.1f}', with accelerometer biases of {biases:,g} ug)"
    elif finds_heading and heading is None:
        text = f"no heading, {text}"
    elif finds_heading:
        shown = "" if sigma is None else f" (1 sigma {sigma:.1f}')"
        text = f"heading {heading:.3f} deg{_front_text(source)}{shown}, {text}"
        text += "" if error is None else f"; {error:+.1f}' from the reference"
    if n_runs > 1:
        start = f"start at {row['start_s']:g} s" if source.study.is_recorded else "last draw"
        text += f" ({start})"
    return Fact("Attitude", text)


def _front_text(source: Results) -> str:
    """What a heading is that of, if the axes of the record are a choice of the study."""
    record = source.study.record
    if record is None or record.format not in ("csv", "parquet"):
        return ""
    if record.mounting_deg is not None:
        return " of the vehicle"
    (_, front, _), (_, sign, _) = parse_axes_order(record.axes_order)
    return f" of {'-' if sign < 0 else '+'}{'xyz'[front]}"


def _level_facts(source: Results) -> Iterator[Fact]:
    """The error of pitch and roll from the truth or reference, and that there is no heading."""
    table = source.distinct_rows(["draw_id", "start_s", *_LEVEL_ERRORS])
    errors = np.concatenate([analysis.numeric_column(table, name) for name in _LEVEL_ERRORS])
    if np.isfinite(errors).any():
        recorded, draws = source.study.is_recorded, table["draw_id"].to_numpy()
        clusters = np.tile(draws * (not recorded), len(_LEVEL_ERRORS))
        found = format_heading_error(analysis.rms(errors, clusters))
        aim = "reference" if recorded else "truth"
        yield Fact("Accuracy", f"{found}' rms from the {aim} per angle")
    yield Fact("Heading", f"none: {' and '.join(source.study.methods)} finds pitch and roll alone")


def _bias_floor_fact(source: Results) -> Iterator[Fact]:
    """The heading error that biases leave on a parked vehicle, if its latitude is known."""
    latitude_deg, record = source.study.values("latitude_deg")[0], source.study.record
    if latitude_deg is None:
        latitude_deg = source.manifest.record_latitude_deg
    if latitude_deg is None:
        return
    gyro, accel = _EXAMPLES
    if record is not None:
        gyro, accel = record.gyro_bias_deg_per_h or gyro, record.accel_bias_ug or accel
    rate = EARTH_RATE * math.cos(math.radians(latitude_deg))
    east = math.atan2(gyro * DEG_PER_H, rate) / ARCMIN
    north = abs(accel * MICRO * math.tan(math.radians(latitude_deg))) / ARCMIN
    text = f"{east:.1f}' per {gyro:g} deg/h of gyro bias, {north:.1f}' per {accel:g} ug, parked"
    yield Fact("Floor", text)


def _caution_facts(source: Results) -> Iterator[Fact]:
    """Doubts about the filter's own 1 sigma, and about fits."""
    methods = [METHODS[name] for name in source.study.methods]
    filters = [method for method in methods if method.has_covariance and method.finds_heading]
    if filters and not all(map(estimates_biases, filters)):
        text = "1 sigma is the filter's own and excludes constant biases: add their floor in"
        text += " quadrature, or use gravity_fit with fit_gyro_bias_deg_per_h"
        yield caution(text)
    mean, _, high = _innovation_statistics(source) or (np.zeros(0),) * 3
    if count := int((mean > high).sum()):
        yield caution(f"the innovations of {count:,} runs contradict their 1 sigma")
    record = source.study.record
    if "gravity_fit" not in source.study.methods:
        return
    yield from fit_cautions(source)
    limit = record.gyro_bias_deg_per_h if record is not None else None
    rows = source.rows(f"fit_gyro_bias_{axis}_deg_per_h" for axis in ("right", "front", "up"))
    biases = [analysis.numeric_column(rows, name) for name in rows.column_names]
    bias = float(np.nanmax(np.abs(biases), initial=0.0))
    if limit is not None and bias > limit:  # beyond what the checks of a record accept
        text = f"the fit finds a gyro bias of {bias:.3g} deg/h, beyond {limit:.3g}"
        yield caution(f"{text} ([record] gyro_bias_deg_per_h): is a sign wrong?")


def _final_attitude_table(source: Results, rows: list[dict[str, Any]]) -> Table:
    """Final heading, pitch and roll of each start, or of each variant at the last start."""
    keys, name = source.study.keys_shown, "variant"
    if source.study.n_variants == 1:
        name, key = ("start (s)", "start_s") if source.study.is_recorded else ("draw", "draw_id")
        groups = [({name: row[key]}, row) for row in rows]
    else:
        listed = rows[-source.study.n_variants :]
        groups = [({name: describe_point({k: row[k] for k in keys})}, row) for row in listed]
    cells = [
        (header, lambda row, x=x, digits=digits: analysis.format_number(row[x], digits))
        for x, (header, digits) in _HEADERS.items()
        if any(row[x] is not None for row in rows)
    ]
    return build_table("Attitude at the end", [name], groups, cells, max_rows=len(groups))


def attitude_table(source: Results) -> Table:
    """Return the table of the final attitudes, run by run, with the filter's own 1 sigma."""
    keys = ["start_s", *source.study.keys_shown]
    digits = dict.fromkeys([f"{angle}_deg" for angle in ("pitch", "roll", "yaw")], 4)
    digits |= dict.fromkeys([f"sigma_{axis}_arcmin" for axis in "enu"], 2)
    variants = source.study.n_variants
    n_rows = MAX_ROWS // variants * variants or MAX_ROWS  # whole start times, where they fit
    rows = source.rows([*keys, *digits]).slice(0, n_rows).to_pylist()
    cells = [
        (name, lambda row, n=name: analysis.format_number(row[n], digits[n])) for name in digits
    ]
    notes = [f"{left} more runs are in `summary/`."] if (left := source.runs - len(rows)) else []
    notes += [describe_innovations(source)] if source.study.is_recorded else []
    title = "Attitude at the end, with the filter's own 1 sigma"
    return build_table(title, keys, [(row, row) for row in rows], cells, " ".join(notes))


def describe_innovations(source: Results) -> str:
    """Describe how the filters' innovations on a record agree with their covariance.

    Only values above the chi-square band contradict the covariance. Values below it mean that R is
    larger than the noise, so that innovations do not show the heading error.
    """
    statistics = _innovation_statistics(source)
    if statistics is None:
        return "Innovations: none are recorded."
    mean, low, high = statistics
    if not mean.size:
        return "No method here has innovations."
    text = (
        f"Innovations: the mean of r' S^-1 r is {mean.min():.3g} to {mean.max():.3g} in"
        f" {mean.size:,} runs with a filter, where 2 is expected if P is right ({low.min():.3g} to"
        f" {high.max():.3g} in 95 % of them, were they white)."
    )
    if above := int((mean > high).sum()):
        text += f" {above:,} lie above: their data contradict the filter's noise and model, so its"
        text += " 1 sigma is not reliable."
    if below := int((mean < low).sum()):
        text += f" {below:,} lie below: R is larger than the noise of this data. That is no"
        text += " contradiction, but such small innovations cannot reveal a wrong heading."
    return text


def _innovation_statistics(source: Results) -> tuple[NDArray, NDArray, NDArray] | None:
    """The mean of r' S^-1 r of each run with a filter, and its 95 % chi-square band."""
    try:
        rows = source.rows(["innovation_nis", "innovation_freedom"])
    except InputError:
        return None
    mean, freedom = (analysis.numeric_column(rows, name) for name in rows.column_names)
    mean, freedom = mean[freedom > 0], freedom[freedom > 0]
    tail = (1 - analysis.CONFIDENCE) / 2
    low, high = (2 * special.chdtri(freedom, p) / freedom for p in (1 - tail, tail))
    return mean, low, high
