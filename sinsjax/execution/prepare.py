"""Preparation of a study before it runs: every check, forecast and warning, once.

The command line and the Python functions prepare a `Job` here and pass it to `run.run_job`, which
checks nothing again. Nothing is created or changed.
"""

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sinsjax.engine.scenario import Scenario, read_site, start_samples
from sinsjax.errors import InputError, StudyWarning
from sinsjax.execution import forecast
from sinsjax.execution.directory import refuse_existing_results
from sinsjax.execution.forecast import Forecast
from sinsjax.execution.store import continue_job
from sinsjax.execution.tasks import Job
from sinsjax.messages import format_seconds
from sinsjax.methods.registry import METHODS, PACKAGES, check_plugin
from sinsjax.platform import runtime
from sinsjax.records import Record, read_record, read_reference, require_samples
from sinsjax.records.checks import StationaryValues, check_stationary, report_anomalies
from sinsjax.records.layout import Finding
from sinsjax.records.reference import StoredRecord
from sinsjax.study.files import source_name
from sinsjax.study.keys import COARSE_KEYS
from sinsjax.study.load import load_study, with_rate
from sinsjax.study.motion import data_end_s, read_attitude_file, turn_ignoring_method_warnings
from sinsjax.study.reset_schedules import NOISE_KEYS, noise_heading_sigma
from sinsjax.study.rules import describe_idle_keys
from sinsjax.study.study import Study
from sinsjax.study.success import success_criteria
from sinsjax.study.values import Variants
from sinsjax.units import ARCMIN, DEG, micro_g

_TRUST_HINT = "[record] trust = true aligns it anyway"
_START_KEYS = ("p0_yaw_deg", "phi_u0_deg")  # of filters; of other methods that need a start
_BANDS_ARCMIN = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200)  # to set in place of narrower

MOST_CURVE_RUNS = 1024
"""Largest number of runs whose curves are all kept without being asked for."""


def prepare_job(
    study: Path | str | Study,
    overrides: Mapping[str, Any] | None = None,
    record: StoredRecord | Path | str | None = None,
    reference: Path | str | None = None,
    **options: Any,
) -> Job:
    """Check a study with its record and options, and forecast its cost.

    Args:
        study: study file, name of a shipped study, or study.
        overrides: values by ``section.key``, see `Study.replace`.
        record: inertial record of a recorded study, or its file.
        reference: file of the reference attitude of a record that is a file.
        options: further arguments of `load_job`.

    Raises:
        InputError: the study is invalid or does not fit its record; the record is certainly
            wrong; the directory cannot be used or contains results of another study; disk or memory
            are too small; or double precision cannot be enabled.
    """
    job = load_job(study, overrides, record, reference, **options)
    if job.directory is not None:
        refuse_existing_results(job.directory, overwrite=job.overwrite, resume=job.resume)
        job = continue_job(job) if job.resume else job
    if job.study.tune:
        note = "[tune] is ignored: the study runs as it is (`sinsjax tune` searches)."
        job = job._replace(notes=(note, *job.notes))
    return check_and_annotate_job(job, forecast.forecast_sweep(job.study, job.curves))


# --- steps of preparing a sweep or a tuning run, in order ---------------------------------------


def load_job(
    study: Path | str | Study,
    overrides: Mapping[str, Any] | None,
    record: StoredRecord | Path | str | None,
    reference: Path | str | None,
    *,
    directory: str | Path | None = None,
    keeps_few_curves: bool = False,
    **options: Any,
) -> Job:
    """Load a study with its record, and check that they fit.

    The arguments are those of `prepare_job`; the results directory; whether to keep the curves of
    up to `MOST_CURVE_RUNS` runs in any case; and further fields of `Job`.
    """
    runtime.ensure_configured()
    path = None if directory is None else Path(directory)
    file = None if isinstance(study, Study) else Path(study)
    name = study.name if isinstance(study, Study) else source_name(study)
    study = load_study(study, overrides)
    notes, doubts = describe_idle_keys(study), list[str]()
    refuse_external(study.study.external, name)
    given = reference if record is None else record
    if given is not None and not study.is_recorded:
        text = given if isinstance(given, Path | str) else "a record"
        raise InputError(f"{name}: has no [record] section to read {text} with")
    if study.is_recorded and record is None:
        hint = "`sinsjax align RECORD`, `sinsjax tune --record`, in Python `sinsjax.align`"
        raise InputError(f"{name}: [record]: the study needs a record ({hint})")
    if isinstance(record, Path | str):
        record = load_increments(study, record, reference)
    if record is not None:
        if not isinstance(record, StoredRecord):
            text = f"must be a file or what `load_increments` returns, not {type(record).__name__}"
            raise InputError(f"{name}: record: {text} (see sinsjax.record_from_arrays)")
        study = with_rate(study, record.record.rate_hz)
        doubts = list_record_doubts(study, record)
    runs = study.n_draws * study.n_variants
    if keeps_few_curves and runs <= MOST_CURVE_RUNS:
        options["curves"] = True
    elif keeps_few_curves and not study.study.curves:
        notes.append(f"{runs:,} runs: curves are kept only if [study] curves = true.")
    if file is not None:  # an absolute path means nothing on another machine
        options.setdefault("source", file.name if file.is_absolute() else file.as_posix())
    if path is not None and options.get("resume") and not path.exists():
        notes.append(f"{path}: no results to resume, all runs are new.")
    options |= {"directory": path, "warnings": tuple(doubts), "notes": tuple(notes)}
    return Job(study, record, **options)


def check_and_annotate_job(job: Job, cost: Forecast) -> Job:
    """Check what a job needs apart from its record, and collect its warnings and notes."""
    study, notes, doubts = job.study, job.notes, job.warnings
    read_attitude_file(study)
    is_new = not (job.overwrite or job.resume or study.stop_when)
    forecast.check_resources(study.name, cost, job.directory if is_new else None)
    check_plugins(study, job.stored)
    if not study.is_recorded:
        doubts = (*turn_ignoring_method_warnings(study), *iter_warnings_of_bands_below_noise(study))
    if study.dropped_s:
        notes += (f"The last {study.dropped_s:g} s do not fill a record interval and are not run.",)
    return job._replace(warnings=doubts, notes=notes, forecast=cost)


def issue_warnings(job: Job) -> Job:
    """Issue the warnings and notes of a prepared job as a `StudyWarning` each, and return it."""
    for line in (*job.warnings, *job.notes):
        warnings.warn(line, StudyWarning, stacklevel=3)
    return job


def make_subjob(job: Job, study: Study, name: str) -> Job:
    """Return a job for a study derived from that of a job, in a folder of its directory."""
    assert job.directory is not None
    subdirectory = job.directory / name
    refuse_existing_results(subdirectory, overwrite=job.overwrite, resume=job.resume)
    job = job._replace(study=study, curves=False, directory=subdirectory)
    return continue_job(job) if job.resume else job


def load_increments(
    study: Study | str | Path, record: str | Path, reference: str | Path | None = None
) -> StoredRecord:
    """Read the record of a recorded study, and the reference attitude if given.

    Args:
        study: study with [record], its file, or the name of a shipped study.
        record: file of the inertial record.
        reference: file of the reference attitude.

    Raises:
        InputError: a file cannot be used, or the study has no [record].

    Examples:
        >>> import numpy as np
        >>> layout = sinsjax.load_study("csv_log").record
        >>> names = [layout.time_column, *layout.gyro_columns, *layout.accel_columns]
        >>> samples = np.c_[10.0 * np.arange(1, 1001), np.zeros((1000, 5)), -np.ones(1000)]
        >>> np.savetxt("drive.csv", samples, delimiter=",", header=",".join(names), comments="")
        >>> stored = sinsjax.load_increments("csv_log", "drive.csv")
        >>> stored.record.rate_hz, stored.reference is None
        (100.0, True)
    """
    study = load_study(study)
    if study.record is None:
        raise InputError(f"{study.name}: has no [record] section")
    if study.record.format == "arrays":
        text = f"[record] format: 'arrays' are passed to sinsjax.run, not read from {record}"
        raise InputError(f"{study.name}: {text} (see sinsjax.record_from_arrays)")
    layout = study.record.layout(study.study.rate_hz)
    inertial = read_record(record, layout)
    return StoredRecord.from_record(
        inertial, None if reference is None else read_reference(reference, layout)
    )


# --- checks ---------------------------------------------------------------------------------------


def refuse_external(programs: Sequence[str] | None, source: Path | str) -> None:
    """Refuse to run a study, by its file or directory, with results of programs elsewhere."""
    if programs:
        raise InputError(
            f"{source}: its runs of {', '.join(programs)} were made elsewhere and cannot be run"
            " here (`sinsjax score` compares the program again)"
        )


def check_plugins(study: Study, stored: StoredRecord | None = None) -> None:
    """Refuse a plug-in method that cannot be run, by its package, see `registry.check_plugin`."""
    if not PACKAGES.keys() & study.methods:
        return
    scenario = Scenario(study, stored, curves=False)
    for program, spec in enumerate(scenario.specs):
        if spec.method in PACKAGES:
            name = f"method {spec.method!r} of {' '.join(PACKAGES[spec.method])}"
            batch = scenario.batch(program, range(1), blank=stored is None)
            params, site = batch.params.method, batch.environment.site
            check_plugin(name, spec.program, params, batch.n_variants, site)


def list_record_doubts(study: Study, stored: StoredRecord) -> list[str]:
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
    spans = _merged_used_spans(study, record)
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


def _merged_used_spans(study: Study, record: Record) -> list[tuple[int, int]]:
    """Return the spans of samples that a study reads, overlapping ones merged."""
    section, rate_hz = study.record, record.rate_hz
    assert section is not None
    points = study.combinations(*COARSE_KEYS)
    coarse = max(study.samples_before(rate_hz, **point) for point in points)
    fine = max(span.records_read for span in study.distinct_spans) * study.record_every
    merged: list[tuple[int, int]] = []
    for start in sorted(start_samples(study, rate_hz).tolist()):
        end = start + coarse + fine
        require_samples(record, start / rate_hz, (coarse + fine) / rate_hz)
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


def iter_warnings_of_bands_below_noise(study: Study) -> Iterator[str]:
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
