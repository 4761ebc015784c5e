"""Warnings about a study before it runs, from its record or its sample rate."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sinsjax.engine.scenario import Scenario, read_site, start_samples
from sinsjax.errors import InputError
from sinsjax.execution.hidden_north import hidden_north
from sinsjax.messages import format_seconds
from sinsjax.methods.level import LEVEL
from sinsjax.methods.plugins import check_plugin
from sinsjax.methods.registry import METHODS, PACKAGES
from sinsjax.records import Record, RecordLayout, require_span
from sinsjax.records.checks import StationaryValues, check_stationary, report_anomalies
from sinsjax.records.layout import Finding
from sinsjax.records.reference import StoredRecord
from sinsjax.study import sampling
from sinsjax.study.keys import COARSE_KEYS
from sinsjax.study.reset_schedules import NOISE_KEYS, noise_heading_sigma
from sinsjax.study.study import Study
from sinsjax.study.success import success_criteria
from sinsjax.study.turns import data_end_s, useless_methods
from sinsjax.study.variants import Variants
from sinsjax.units import ARCMIN, DEG

_TRUST_HINT = "[record] trust = true aligns it anyway"
_CHECKED_DRAWS = 1024  # draws in which a drawn period is checked
_START_KEYS = ("p0_yaw_deg", "phi_u0_deg")  # of filters; of other methods that need a start
_BANDS_ARCMIN = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200)  # to set in place of narrower


def refuse_external(programs: Sequence[str] | None, source: Path | str) -> None:
    """Refuse to run a study with results of programs outside sinsjax.

    Args:
        programs: their names, [study] external.
        source: file or directory of the study.

    Raises:
        InputError: names the programs.
    """
    if programs:
        raise InputError(
            f"{source}: its runs of {', '.join(programs)} were made elsewhere and cannot be run"
            " here (`sinsjax score` compares the program again)"
        )


def study_warnings(study: Study) -> list[str]:
    """Return warnings for the user before a simulated study runs, one line each."""
    hidden = hidden_north(study)
    lines = [*_sway_warnings(study), *_surge_warnings(study)]
    lines += [*useless_methods(study), *band_warnings(study)]
    return [*lines, *([hidden] if hidden else [])]


def check_plugins(study: Study, stored: StoredRecord | None = None) -> None:
    """Check each plug-in method of a study, see `plugins.check_plugin`.

    Args:
        study: checked study, at the rate of its record.
        stored: the record of a recorded study.

    Raises:
        InputError: one of them cannot be run; names its package.
    """
    plugins = PACKAGES.keys() & study.methods
    if not plugins:
        return
    scenario = Scenario(study, stored, curves=False)
    for number, spec in enumerate(scenario.specs):
        if spec.method not in plugins:
            continue
        batch = scenario.batch(number, range(1), blank=stored is None)
        check_plugin(
            f"method {spec.method!r} of {' '.join(PACKAGES[spec.method])}",
            spec.program,
            batch.params.method,
            batch.n_variants,
            batch.environment.site,
        )


def record_layout(study: Study) -> RecordLayout:
    """Return the layout of a study's record."""
    assert study.record is not None
    return study.record.layout(study.study.rate_hz)


class RecordCheck(NamedTuple):
    """What a check of a record finds.

    Attributes:
        warnings: for the user, one line each.
        hides_north: the line that says why its gyros cannot find north; "" if they may.
    """

    warnings: list[str]
    hides_north: str


def check_record(study: Study, stored: StoredRecord) -> RecordCheck:
    """Check the record of a study in the spans that the study reads.

    Args:
        study: checked study, at the rate of its record.
        stored: its record.

    Raises:
        InputError: the record is certainly wrong and the study does not trust it, or it does not
            cover the span that the study reads.
    """
    section, record = study.record, stored.record
    assert section is not None
    layout = record.layout or record_layout(study)
    lines = [f"{record.source}: {remark}" for remark in record.remarks]
    if record.filled:
        key = "max_gap_s" if record.layout else "[record] max_gap_s"
        lines.append(
            f"{record.source}: {record.filled} missing samples are interpolated (gaps up to"
            f" {key} = {layout.max_gap_s:g} s)"
        )
    site, _ = read_site(study, Variants(study, np.zeros(1, int)), stored)
    expected = StationaryValues(
        earth_rate=float(site.earth.rate),
        latitude=float(site.latitude),
        gravity=float(site.place.gravity),
        gyro_bias_deg_per_h=section.gyro_bias_deg_per_h,
        accel_bias_ug=section.accel_bias_ug,
    )
    used, whole, hides_north = _used_spans(study, record), (0, len(record.dv)), ""
    found: list[tuple[str, Finding]] = [
        (record.source, anomaly) for anomaly in report_anomalies(record.anomalies, used)
    ]
    for span in used:
        begin_s, end_s = (format_seconds(sample / record.rate_hz) for sample in span)
        where = f"{record.source}: {begin_s} to {end_s} s"
        found += [(where, finding) for finding in check_stationary(record, span, layout, expected)]
    for where, finding in found:
        if finding.hides_north:
            hides_north = hides_north or f"{where}: {finding.text}"
        elif finding.is_certain and not section.trust:
            # A constant channel may be the cause, and only this error is shown.
            constant = (a.text for a in record.anomalies if (a.begin, a.end) == whole)
            text = "; ".join(dict.fromkeys([finding.text, *constant]))
            raise InputError(f"{where}: {text} ({_TRUST_HINT})")
        else:
            lines.append(f"{where}: {finding.text}")
    return RecordCheck(lines, hides_north)


def level_only(study: Study, check: RecordCheck) -> tuple[Study, list[str]]:
    """Return a study that finds pitch and roll alone if the gyros of its record hide north.

    Args:
        study: checked study with a record.
        check: check of the record.

    Returns:
        The study, and the warning that says so; the same study if its methods may find north.
    """
    if not check.hides_north or not any(METHODS[name].finds_heading for name in study.methods):
        return study, [check.hides_north] if check.hides_north else []
    changes: dict[str, Any] = {"alignment.method": LEVEL.name}
    if study.passes:
        changes["passes"] = {}
    accel_bias_ug = study.record.accel_bias_ug if study.record else None
    if accel_bias_ug is not None:
        changes["level.level_accel_bias_ug"] = accel_bias_ug
    replaced = " and ".join(study.methods)
    try:
        level_study = study.replace(changes)
    except InputError as error:  # such as sweeps that have no meaning without these methods
        text = f"method {LEVEL.name} finds pitch and roll, but not in this study: {error.lines[0]}"
        raise InputError(f"{check.hides_north}; {text}") from None
    text = (
        f"pitch and roll are those of the mean specific force (method {LEVEL.name}, not {replaced})"
    )
    return level_study, [f"{check.hides_north}; {text}"]


def require_north(study: Study, check: RecordCheck) -> tuple[Study, list[str]]:
    """Refuse a record whose gyros hide north, unless the study trusts it; as `level_only`."""
    if not check.hides_north:
        return study, []
    if study.record and study.record.trust:
        return study, [check.hides_north]
    raise InputError(f"{check.hides_north}, so nothing can be tuned ({_TRUST_HINT})")


def _used_spans(study: Study, record: Record) -> list[tuple[int, int]]:
    """Return the spans of samples that a study reads, overlapping ones merged."""
    starts = start_samples(study, record.rate_hz)
    samples_before = [
        study.samples_before(record.rate_hz, **point) for point in study.combinations(*COARSE_KEYS)
    ]
    fine_samples = max(span.records_read for span in study.distinct_spans) * study.record_every
    needed, coarse = max(samples_before) + fine_samples, ""
    if max(samples_before):
        lengths = [
            f"{format_seconds(count / record.rate_hz)} s"
            for count in (max(samples_before), fine_samples)
        ]
        coarse = f" ({lengths[0]} of coarse alignment + {lengths[1]})"
    merged: list[tuple[int, int]] = []
    for start in sorted(starts.tolist()):
        require_span(record, start / record.rate_hz, needed / record.rate_hz, coarse)
        if merged and start <= merged[-1][1]:
            merged[-1] = merged[-1][0], start + needed
        else:
            merged.append((start, start + needed))
    assert study.record is not None
    end = study.record.to_s
    if end is not None and merged[-1][1] / record.rate_hz > end * (1 + 1e-9):
        raise InputError(
            f"{record.source}: the study needs data up to"
            f" {format_seconds(merged[-1][1] / record.rate_hz)} s, but [record] to_s is"
            f" {format_seconds(end)}"
        )
    return merged


def band_warnings(study: Study) -> Iterator[str]:
    """Warn of a heading band that the sensors' white noise exceeds, 1 sigma, in every variant.

    At most two thirds of the runs can end in such a band. The best variant counts, with all data of
    the longest run. Bands are that of success and, if the file gives them, those of settling times.
    """
    settings, success_arcmin = study.study, success_criteria(study).band_arcmin
    is_given = "settle_bands_arcmin" in settings.model_fields_set
    given = settings.settle_bands_arcmin if is_given else ()
    length_s = data_end_s(study)
    keys = [key for key in ("method", *NOISE_KEYS, *_START_KEYS) if study.is_readable(key)]
    points = study.combinations(*keys)
    sigma = min(_heading_sigma(study.rate_hz, length_s, point) for point in points) / ARCMIN
    narrowest = min((success_arcmin, *given))
    if narrowest >= sigma:
        return
    wide = next((band for band in _BANDS_ARCMIN if band >= 4 * sigma), _BANDS_ARCMIN[-1])
    hints = [f"settle_bands_arcmin, e.g. [{wide}]"] if min(given, default=sigma) < sigma else []
    hints += [f"success_band_arcmin, e.g. {wide}"] if success_arcmin < sigma else []
    yield (
        f"{narrowest:g}' cannot be reached reliably with these sensors in {length_s:g} s"
        f" ({float(f'{2 * sigma:.2g}'):,g}', 2 sigma of their noise): set {' and '.join(hints)}"
    )


def _heading_sigma(rate_hz: float, length_s: float, point: Mapping[str, Any]) -> float:
    """Return the sigma of heading that noise leaves to a method at the end of its data, rad.

    What its start knows counts. The quietest axis decides; drawn noise and a drawn start count as
    zero, a drawn latitude as the equator.
    """
    method = METHODS[point["method"]]
    quietest = {key: min(v) if isinstance(v, tuple) else v for key, v in point.items()}
    quietest["latitude_deg"] = quietest["latitude_deg"] or 0.0
    sigma = noise_heading_sigma(rate_hz, length_s, quietest)
    if not method.needs_start:
        return sigma
    start = abs(point["p0_yaw_deg" if "filter" in method.sections else "phi_u0_deg"] or 0.0) * DEG
    return sigma * start / math.hypot(sigma, start) if start else 0.0


def _surge_warnings(study: Study) -> Iterator[str]:
    """Warn that the acceleration of first-order surges depends on the sample rate."""
    keys = ("surge_model", "surge_m_per_s", "surge_time_s")
    worst = 0.0
    for model, surge, time in (tuple(p[key] for key in keys) for p in study.combinations(*keys)):
        if model == "gauss_markov" and surge is not None and time is not None:
            changes = np.sqrt(-2 * np.expm1(-1 / (time * study.rate_hz)))
            worst = max(worst, float(np.max(surge)) * changes * study.rate_hz)
    if worst:
        yield (
            f"[motion] surge_model: the acceleration of a 'gauss_markov' surge grows with the rate,"
            f" {worst:.3g} m/s^2 rms at {study.rate_hz:g} Hz"
        )


def _sway_warnings(study: Study) -> Iterator[str]:
    """Warn about sways above the Nyquist frequency."""
    half = study.rate_hz / 2
    for angle in ("pitch", "roll", "yaw"):
        amplitude, period = f"{angle}_amplitude_deg", f"{angle}_period_s"
        points = list(study.combinations(amplitude, period))
        periods = [p[period] for p in points if p[amplitude] or amplitude in study.drawn_keys]
        if periods and period in study.drawn_keys:
            periods = sampling.drawn_values(study, min(study.n_draws, _CHECKED_DRAWS))[
                period
            ].tolist()
        if periods and 1 / min(periods) > half:
            yield (
                f"[motion] {period}: a sway of {1 / min(periods):.4g} Hz is above half of rate_hz ="
                f" {study.rate_hz:g}, so it is aliased to a slower one"
            )
