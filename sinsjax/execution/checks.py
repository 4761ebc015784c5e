"""Checks of a study before it runs: its record, its plug-in methods and its heading bands."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sinsjax.engine.scenario import Scenario, read_site, start_samples
from sinsjax.errors import InputError
from sinsjax.messages import format_seconds
from sinsjax.methods.plugins import check_plugin
from sinsjax.methods.registry import METHODS, PACKAGES
from sinsjax.records import Record, require_span
from sinsjax.records.checks import StationaryValues, check_stationary, report_anomalies
from sinsjax.records.layout import Finding
from sinsjax.records.reference import StoredRecord
from sinsjax.study.keys import COARSE_KEYS
from sinsjax.study.motion import data_end_s
from sinsjax.study.reset_schedules import NOISE_KEYS, noise_heading_sigma
from sinsjax.study.study import Study
from sinsjax.study.success import success_criteria
from sinsjax.study.values import Variants
from sinsjax.units import ARCMIN, DEG, micro_g

_TRUST_HINT = "[record] trust = true aligns it anyway"
_START_KEYS = ("p0_yaw_deg", "phi_u0_deg")  # of filters; of other methods that need a start
_BANDS_ARCMIN = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200)  # to set in place of narrower


def refuse_external(programs: Sequence[str] | None, source: Path | str) -> None:
    """Refuse to run a study, by its file or directory, with results of programs elsewhere."""
    if programs:
        raise InputError(
            f"{source}: its runs of {', '.join(programs)} were made elsewhere and cannot be run"
            " here (`sinsjax score` compares the program again)"
        )


def check_plugins(study: Study, stored: StoredRecord | None = None) -> None:
    """Refuse a plug-in method that cannot be run, by its package, see `plugins.check_plugin`."""
    if not PACKAGES.keys() & study.methods:
        return
    scenario = Scenario(study, stored, curves=False)
    for program, spec in enumerate(scenario.specs):
        if spec.method in PACKAGES:
            name = f"method {spec.method!r} of {' '.join(PACKAGES[spec.method])}"
            batch = scenario.batch(program, range(1), blank=stored is None)
            params, site = batch.params.method, batch.environment.site
            check_plugin(name, spec.program, params, batch.n_variants, site)


def check_record(study: Study, stored: StoredRecord) -> list[str]:
    """Return doubts about the record of a study, one line each, in the spans that it reads.

    Raises:
        InputError: the record does not cover these spans; or the study does not trust it and it is
            certainly wrong, or its gyros cannot find the north that a method is to find.
    """
    section, record = study.record, stored.record
    assert section is not None
    doubts = [f"{record.source}: {remark}" for remark in record.remarks]
    site, _ = read_site(study, Variants(study, np.zeros(1, int)), stored)
    expected = StationaryValues(
        earth_rate=float(site.earth.rate),
        latitude=float(site.latitude),
        gravity=float(site.place.gravity),
        gyro_bias_deg_per_h=section.gyro_bias_deg_per_h,
    )
    if section.accel_bias_ug is not None:
        expected = expected._replace(accel_bias=section.accel_bias_ug * micro_g())
    spans = _used_spans(study, record)
    found: list[tuple[str, Finding]] = [
        (record.source, anomaly) for anomaly in report_anomalies(record.anomalies, spans)
    ]
    for span in spans:
        begin_s, end_s = (format_seconds(sample / record.rate_hz) for sample in span)
        where = f"{record.source}: {begin_s} to {end_s} s"
        found += [(where, finding) for finding in check_stationary(record, span, expected)]
    needs_north = any(METHODS[name].finds_heading for name in study.methods)
    for where, finding in found:
        text, hint = finding.text, _TRUST_HINT
        if finding.is_certain and not section.trust:
            # A constant channel may be the cause, and only this error is shown.
            whole = (a.text for a in record.anomalies if (a.begin, a.end) == (0, len(record.dv)))
            text = "; ".join(dict.fromkeys([text, *whole]))
            raise InputError(f"{where}: {text} ({hint})")
        if finding.hides_north and needs_north and not section.trust:
            hint = f"[alignment] method = 'level' finds pitch and roll, {hint}"
            raise InputError(f"{where}: {text} ({hint})")
        doubts.append(f"{where}: {text}")
    return doubts


def _used_spans(study: Study, record: Record) -> list[tuple[int, int]]:
    """Return the spans of samples that a study reads, overlapping ones merged."""
    section, rate_hz = study.record, record.rate_hz
    assert section is not None
    points = study.combinations(*COARSE_KEYS)
    coarse = max(study.samples_before(rate_hz, **point) for point in points)
    fine = max(span.records_read for span in study.distinct_spans) * study.record_every
    merged: list[tuple[int, int]] = []
    for start in sorted(start_samples(study, rate_hz).tolist()):
        end = start + coarse + fine
        require_span(record, start / rate_hz, (coarse + fine) / rate_hz)
        if merged and start <= merged[-1][1]:
            start = merged.pop()[0]
        merged.append((start, end))
    end_s = merged[-1][1] / rate_hz
    if section.to_s is not None and end_s > section.to_s * (1 + 1e-9):
        raise InputError(
            f"{record.source}: the study needs data up to {format_seconds(end_s)} s, but [record]"
            f" to_s is {format_seconds(section.to_s)}"
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
