"""The attitude that a run ends with: the first thing that a user of a record wants."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy import special

from sinsjax import analysis
from sinsjax.errors import InputError
from sinsjax.execution.results import Results
from sinsjax.methods.filters.keys import estimates_biases
from sinsjax.methods.registry import METHODS
from sinsjax.plots.labels import describe_point
from sinsjax.records.layout import parse_axes_order
from sinsjax.records.motion import EARTH_RATE
from sinsjax.report.base import MAX_ROWS, Fact, Report, Table, build_table
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

_ANGLES = ("heading", "pitch", "roll")
_COLUMNS = (*(f"{angle}_deg" for angle in _ANGLES), "sigma_u_arcmin", "phi_u_arcmin")
_EXAMPLES = (0.01, 100.0)  # deg/h and ug, whose effect is stated if the biases are unknown


def attitude_verdict(source: Results, *, warnings_shown: bool = False) -> Report:
    """Return the attitude of each start, its cautions, and the best option.

    Args:
        source: results on a record, or of a study without truth.
        warnings_shown: whether the user has seen the study's warnings.
    """
    study = source.study
    names = ["draw_id", "variant_id", "start_s", *study.keys_shown, *_COLUMNS]
    rows = source.rows(names).to_pylist()
    last, judged, table = rows[-1], [], None
    if any(row["phi_u_arcmin"] is not None for row in rows) and study.n_variants > 1:
        outcome = SweepOutcome.from_source(source)
        last = next(row for row in reversed(rows) if row["variant_id"] == outcome.best_variant)
        judged, table = [*answer_facts(outcome), *caution_facts(outcome)], condition_table(outcome)
    elif len(rows) > 1:
        table = _final_attitude_table(source, rows)
    facts = [_attitude_fact(source, last, len(rows)), *_bias_floor_fact(source), *judged]
    first, doubts = split_warnings(source, warnings_shown=warnings_shown)
    doubts = [*first, *doubts, *_caution_facts(source)]
    return Report(study_title(source), facts + doubts, table)


def _attitude_fact(source: Results, row: Mapping[str, Any], n_runs: int) -> Fact:
    """The attitude that a run ends with, and which run it is if there are several."""
    heading, pitch, roll, sigma, error = (row[name] for name in _COLUMNS)
    if heading is None and pitch is not None:
        return Fact("Attitude", f"no heading, pitch {pitch:.3f}, roll {roll:.3f} deg")
    if heading is None:
        return Fact("Attitude", "unknown, the run is not finite", True)
    text = f"heading {heading:.3f} deg{_front_text(source)}"
    text += "" if sigma is None else f" (1 sigma {sigma:.1f}')"
    text += f", pitch {pitch:.3f}, roll {roll:.3f} deg"
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


def _bias_floor_fact(source: Results) -> Iterator[Fact]:
    """The heading error that biases leave on a parked vehicle, if its latitude is known."""
    if not any(METHODS[name].has_floor for name in source.study.methods):
        return
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
    filters = [METHODS[name] for name in source.study.methods if METHODS[name].has_covariance]
    if filters and not all(map(estimates_biases, filters)):
        text = "1 sigma is the filter's own and excludes constant biases: add their floor in"
        text += " quadrature, or use gravity_fit with fit_gyro_bias_deg_per_h"
        yield Fact("Caution", text, True)
    count = _count_runs_above_band(source)
    if count:
        yield Fact("Caution", f"the innovations of {count:,} runs contradict their 1 sigma", True)
    if "gravity_fit" in source.study.methods:
        yield from _fit_cautions(source)


def _fit_cautions(source: Results) -> Iterator[Fact]:
    """Doubts about fits, and a gyro bias beyond what the checks of a record accept."""
    yield from fit_cautions(source)
    record = source.study.record
    limit = record.gyro_bias_deg_per_h if record is not None else None
    rows = source.rows(f"fit_gyro_bias_{axis}_deg_per_h" for axis in ("right", "front", "up"))
    biases = [analysis.numeric_column(rows, name) for name in rows.column_names]
    bias = float(np.nanmax(np.abs(biases), initial=0.0))
    if limit is not None and bias > limit:
        text = f"the fit finds a gyro bias of {bias:.3g} deg/h, beyond {limit:.3g}"
        yield Fact("Caution", f"{text} ([record] gyro_bias_deg_per_h): is a sign wrong?", True)


def _final_attitude_table(source: Results, rows: list[dict[str, Any]]) -> Table:
    """Final heading, pitch and roll of each start, or of each variant at the last start."""
    one_variant = source.study.n_variants == 1
    keys = source.study.keys_shown
    words = {"sigma_u_arcmin": "1 sigma (')", "phi_u_arcmin": "error (')"}
    words |= {f"{angle}_deg": f"{angle} (deg)" for angle in _ANGLES}
    digits = dict(zip(_COLUMNS, (3, 3, 3, 1, 1), strict=True))
    columns = [name for name in digits if any(row[name] is not None for row in rows)]
    listed = rows if one_variant else rows[-source.study.n_variants :]
    if one_variant:
        first, key = ("start (s)", "start_s") if source.study.is_recorded else ("draw", "draw_id")
        names = [f"{row[key]:g}" for row in rows]
    else:
        first, names = (
            "variant",
            [describe_point({key: row[key] for key in keys}) for row in listed],
        )
    cells = [
        [name, *(analysis.format_number(row[column], digits[column]) for column in columns)]
        for name, row in zip(names, listed, strict=True)
    ]
    return Table("Attitude at the end", [first, *(words[name] for name in columns)], cells)


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
    return build_table(title, keys, rows, cells, " ".join(notes))


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


def _count_runs_above_band(source: Results) -> int:
    """Return the number of runs with innovations above the chi-square band."""
    statistics = _innovation_statistics(source)
    return 0 if statistics is None else int((statistics[0] > statistics[2]).sum())


def _innovation_statistics(source: Results) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
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
