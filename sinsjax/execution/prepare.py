"""Preparation of a study before it runs: every check, forecast and warning, once.

The command line and the Python functions prepare a `Job` here and pass it to `run.run_job`, which
checks nothing again. Nothing is created or changed.
"""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sinsjax.errors import InputError, StudyWarning
from sinsjax.execution import checks, forecast
from sinsjax.execution.directory import check_available
from sinsjax.execution.forecast import Forecast
from sinsjax.execution.store import continue_job
from sinsjax.execution.tasks import Job
from sinsjax.platform import runtime
from sinsjax.records import read_record, read_reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.files import source_name
from sinsjax.study.load import load_study, with_rate
from sinsjax.study.motion import read_attitude, useless_methods
from sinsjax.study.rules import list_idle_keys
from sinsjax.study.study import Study

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
        check_available(job.directory, overwrite=job.overwrite, resume=job.resume)
        job = continue_job(job) if job.resume else job
    if job.study.tune:
        note = "[tune] is ignored: the study runs as it is (`sinsjax tune` searches)."
        job = job._replace(notes=(note, *job.notes))
    return finish_job(job, forecast.forecast_sweep(job.study, job.curves))


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
    notes, doubts = list_idle_keys(study), list[str]()
    checks.refuse_external(study.study.external, name)
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
        doubts = checks.check_record(study, record)
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


def finish_job(job: Job, cost: Forecast) -> Job:
    """Check what a job needs apart from its record, and collect its warnings and notes."""
    study, notes, doubts = job.study, job.notes, job.warnings
    read_attitude(study)
    is_new = not (job.overwrite or job.resume or study.stop_when)
    forecast.check_resources(study.name, cost, job.directory if is_new else None)
    checks.check_plugins(study, job.stored)
    if not study.is_recorded:
        doubts = (*useless_methods(study), *checks.band_warnings(study))
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
    check_available(subdirectory, overwrite=job.overwrite, resume=job.resume)
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
