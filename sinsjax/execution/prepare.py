"""Preparation of a study before it runs: every check, forecast and warning, once.

The command line and the Python functions prepare a `Job` here and pass it to `run.run_job`, which
checks nothing again. Nothing is created or changed.
"""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sinsjax.errors import InputError, StudyWarning
from sinsjax.execution import checks, directory, forecast, resume
from sinsjax.execution.forecast import Forecast
from sinsjax.execution.tasks import Job
from sinsjax.platform import runtime
from sinsjax.records import read_record, read_reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.attitude_file import read_attitude
from sinsjax.study.files import find_study_file, source_name
from sinsjax.study.load import load_study, with_rate
from sinsjax.study.study import Study
from sinsjax.study.unused_keys import list_idle_keys


class RunOptions(NamedTuple):
    """Options of a run.

    Attributes:
        directory: results directory; None for tables in memory.
        curves: whether to keep curves; None follows the study.
        max_curve_runs: number of runs up to which curves of all runs are kept; None for no limit.
        chunk_runs: runs per chunk; None for the default.
        overwrite: whether to replace existing results.
        resume: whether to continue existing results.
        source: label of the study in the manifest; None for its file, if it has one.
    """

    directory: str | Path | None = None
    curves: bool | None = None
    max_curve_runs: int | None = None
    chunk_runs: int | None = None
    overwrite: bool = False
    resume: bool = False
    source: Path | str | None = None


_DEFAULTS = RunOptions()
_TUNE_IGNORED = "[tune] is ignored: the study runs as it is (`sinsjax tune` searches)."


def prepare_job(
    source: Path | str | Study,
    overrides: Mapping[str, Any] | None = None,
    record: StoredRecord | Path | str | None = None,
    reference: Path | str | None = None,
    options: RunOptions = _DEFAULTS,
) -> Job:
    """Check a study with its record and options, and forecast its cost.

    Args:
        source: study file, name of a shipped study, or study.
        overrides: values by ``section.key``, see `Study.replace`.
        record: inertial record of a recorded study, or its file.
        reference: file of the reference attitude of a record that is a file.
        options: options of the run.

    Returns:
        The job, at the rate of its record, with warnings, notes and forecast.

    Raises:
        InputError: the study is invalid or does not fit its record; the record is certainly
            wrong; the directory cannot be used or contains results of another study; disk or memory
            are too small; or double precision cannot be enabled.
    """
    job = load_job(source, overrides, record, reference, options)
    if job.directory is not None:
        resume.check_available(job.directory, overwrite=job.overwrite, resume=job.resume)
    job = _choose_curves(job, _name_of(source), options.max_curve_runs)
    job = add_record(job, record, reference, checks.level_only)
    if job.directory is not None and job.resume:
        job = resume.continue_job(job)
    if job.study.tune:
        job = job._replace(notes=(_TUNE_IGNORED, *job.notes))
    return finish_job(job, forecast.forecast_sweep(job.study, job.curves))


# --- steps of preparing a sweep or a tuning run, in order ---------------------------------------


def load_job(
    source: Path | str | Study,
    overrides: Mapping[str, Any] | None,
    record: StoredRecord | Path | str | None,
    reference: Path | str | None,
    options: RunOptions,
) -> Job:
    """Load a study, and check that it can run, with a record or without, into its directory.

    The arguments are those of `prepare_job`. The record is read by `add_record`.
    """
    runtime.ensure_configured()
    path = None if options.directory is None else directory.results_path(options.directory)
    name, notes = _name_of(source), list[str]()
    study = load_study(source, overrides)
    if not isinstance(source, Study):
        notes += list_idle_keys(study)
    checks.refuse_external(study.study.external, name)
    given = reference if record is None else record
    if given is not None and not study.is_recorded:
        text = given if isinstance(given, Path | str) else "a record"
        raise InputError(f"{name}: has no [record] section to read {text} with")
    if study.is_recorded and record is None:
        hint = "`sinsjax align RECORD`, `sinsjax tune --record`, in Python `sinsjax.align`"
        raise InputError(f"{name}: [record]: the study needs a record ({hint})")
    if path is not None:
        directory.check_unlocked(path)
        if options.resume and not path.exists():
            notes.append(f"{path}: no results to resume, all runs are new.")
    return Job(
        study,
        curves=options.curves,
        chunk_runs=options.chunk_runs,
        directory=path,
        overwrite=options.overwrite,
        resume=options.resume,
        source=_source_label(source, options.source),
        notes=tuple(notes),
    )


def add_record(
    job: Job,
    record: StoredRecord | Path | str | None,
    reference: Path | str | None,
    adapt: Callable[[Study, checks.RecordCheck], tuple[Study, list[str]]],
) -> Job:
    """Read the record of a job, if it has one, and check it at its own rate.

    Args:
        job: job of `load_job`.
        record: inertial record of a recorded study, or its file.
        reference: file of the reference attitude of a record that is a file.
        adapt: `checks.level_only` or `checks.require_north`, for gyros that hide north.
    """
    study = job.study
    if record is None:
        return job
    if isinstance(record, Path | str):
        record = _read_stored_record(study, record, reference)
    if not isinstance(record, StoredRecord):
        raise InputError(
            f"{study.name}: record: must be what sinsjax.load_increments or"
            f" sinsjax.record_from_arrays returns, not a {type(record).__name__}"
        )
    study = with_rate(study, record.record.rate_hz)
    found = checks.check_record(study, record)
    study, doubts = adapt(study, found)
    return job._replace(study=study, stored=record, warnings=(*found.warnings, *doubts))


def finish_job(job: Job, expected_cost: Forecast) -> Job:
    """Check what a job needs apart from its record, and collect its warnings and notes."""
    study, notes = job.study, list(job.notes)
    read_attitude(study)
    forecast.check_resources(
        study.name, expected_cost, job.directory, overwrite=job.overwrite, resume=job.resume
    )
    checks.check_plugins(study, job.stored)
    doubts = job.warnings if study.is_recorded else tuple(checks.study_warnings(study))
    if dropped_s := study.dropped_s:
        notes.append(f"The last {dropped_s:g} s do not fill a record interval and are not run.")
    if study.run_s <= study.study.window_s[0]:
        notes.append(f"Runs that end by {study.study.window_s[0]:g} s have no window statistics.")
    return job._replace(warnings=doubts, notes=tuple(notes), forecast=expected_cost)


def _name_of(source: Path | str | Study) -> str:
    return source.name if isinstance(source, Study) else source_name(source)


def _choose_curves(job: Job, name: str, max_runs: int | None) -> Job:
    """Return a job that keeps all curves if its runs are few enough."""
    study, runs = job.study, job.study.n_draws * job.study.n_variants
    if max_runs is None:
        return job
    if runs <= max_runs:
        return job._replace(curves=True)
    if study.is_recorded:
        note = f"{runs} runs: curves are kept only if [study] curves = true."
        return job._replace(curves=None, notes=(*job.notes, note))
    raise InputError(
        f"{name}: {runs} runs are too many to keep every curve (at most {max_runs}; use"
        " `sinsjax sweep`)"
    )


def _source_label(source: Path | str | Study, label: Path | str | None) -> str | None:
    """Return the label of the study in the manifest; None for a study without a file."""
    if label is None and not isinstance(source, Study):
        label = find_study_file(source)
    if isinstance(label, Path):  # an absolute path means nothing on another machine
        return label.name if label.is_absolute() else label.as_posix()
    return label


def issue_warnings(job: Job) -> Job:
    """Issue the warnings of a prepared job as Python warnings, and return the job.

    Warns:
        StudyWarning: one per doubt, one for keys without effect, and one for an ignored [tune].
    """
    ignored = [note for note in job.notes if note == _TUNE_IGNORED]
    for line in (*job.warnings, *list_idle_keys(job.study), *ignored):
        warnings.warn(line, StudyWarning, stacklevel=3)
    return job


def make_subjob(job: Job, study: Study, name: str) -> Job:
    """Return a job for a study derived from that of a prepared job, in a folder of its directory.

    Only the folder is checked: the study has been.

    Args:
        job: prepared job with a directory.
        study: study of the new job, on the same record.
        name: name of the folder.

    Raises:
        InputError: the folder cannot be used, or contains results of another study.
    """
    assert job.directory is not None
    subdirectory = job.directory / name
    directory.check_unlocked(subdirectory)
    resume.check_available(subdirectory, overwrite=job.overwrite, resume=job.resume)
    job = job._replace(study=study, curves=False, directory=subdirectory)
    return resume.continue_job(job) if job.resume else job


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
    return _read_stored_record(load_study(study), record, reference)


def _read_stored_record(
    study: Study, record: str | Path, reference: str | Path | None
) -> StoredRecord:
    if study.record is None:
        raise InputError(f"{study.name}: has no [record] section")
    if study.record.format == "arrays":
        text = f"[record] format: 'arrays' are passed to sinsjax.run, not read from {record}"
        raise InputError(f"{study.name}: {text} (see sinsjax.record_from_arrays)")
    layout = checks.record_layout(study)
    read_data = read_record(record, layout)
    return StoredRecord.from_record(
        read_data, None if reference is None else read_reference(reference, layout)
    )
