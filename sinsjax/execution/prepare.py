"""Preparation of a study before it runs: every check, forecast and warning, once.

The command line and the Python functions prepare a `Job` here and pass it to `run.run_job`, which
checks nothing again. Nothing is created or changed.
"""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sinsjax.errors import InputError, StudyWarning
from sinsjax.execution import checks, directory, forecast, store
from sinsjax.execution.forecast import Forecast
from sinsjax.execution.tasks import Job
from sinsjax.platform import runtime
from sinsjax.records import read_record, read_reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.attitude_file import read_attitude
from sinsjax.study.files import source_name
from sinsjax.study.load import load_study, with_rate
from sinsjax.study.study import Study
from sinsjax.study.turns import useless_methods
from sinsjax.study.unused_keys import list_idle_keys

MOST_CURVE_RUNS = 1024
"""Largest number of runs whose curves are all kept without being asked for."""


class RunOptions(NamedTuple):
    """Options of a run.

    Attributes:
        directory: results directory; None for tables in memory.
        curves: whether to keep curves; None follows the study.
        keeps_few_curves: whether to keep the curves of up to `MOST_CURVE_RUNS` runs in any case.
        chunk_runs: runs per chunk; None for the default.
        overwrite: whether to replace existing results.
        resume: whether to continue existing results.
        source: label of the study in the manifest; None for its file, if it has one.
    """

    directory: str | Path | None = None
    curves: bool | None = None
    keeps_few_curves: bool = False
    chunk_runs: int | None = None
    overwrite: bool = False
    resume: bool = False
    source: str | None = None


_DEFAULTS = RunOptions()


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
        directory.check_available(job.directory, overwrite=job.overwrite, resume=job.resume)
        job = store.continue_job(job) if job.resume else job
    if job.study.tune:
        note = "[tune] is ignored: the study runs as it is (`sinsjax tune` searches)."
        job = job._replace(notes=(note, *job.notes))
    return finish_job(job, forecast.forecast_sweep(job.study, job.curves))


# --- steps of preparing a sweep or a tuning run, in order ---------------------------------------


def load_job(
    source: Path | str | Study,
    overrides: Mapping[str, Any] | None,
    record: StoredRecord | Path | str | None,
    reference: Path | str | None,
    options: RunOptions,
) -> Job:
    """Load a study with its record, and check that they fit, see `prepare_job`."""
    runtime.ensure_configured()
    path = None if options.directory is None else Path(options.directory)
    study = load_study(source, overrides)
    name = study.name if isinstance(source, Study) else source_name(source)
    notes, doubts, stored = list_idle_keys(study), list[str](), None
    checks.refuse_external(study.study.external, name)
    given = reference if record is None else record
    if given is not None and not study.is_recorded:
        text = given if isinstance(given, Path | str) else "a record"
        raise InputError(f"{name}: has no [record] section to read {text} with")
    if study.is_recorded and record is None:
        hint = "`sinsjax align RECORD`, `sinsjax tune --record`, in Python `sinsjax.align`"
        raise InputError(f"{name}: [record]: the study needs a record ({hint})")
    if record is not None:
        stored = _read_record(study, record, reference)
        study = with_rate(study, stored.record.rate_hz)
        doubts = checks.check_record(study, stored)
    if path is not None and options.resume and not path.exists():
        notes.append(f"{path}: no results to resume, all runs are new.")
    curves, runs = options.curves, study.n_draws * study.n_variants
    if options.keeps_few_curves and runs <= MOST_CURVE_RUNS:
        curves = True
    elif options.keeps_few_curves and not study.study.curves:
        notes.append(f"{runs:,} runs: curves are kept only if [study] curves = true.")
    label = options.source
    if label is None and not isinstance(source, Study):
        # An absolute path means nothing on another machine.
        label = Path(source).name if Path(source).is_absolute() else Path(source).as_posix()
    return Job(
        study,
        stored,
        curves=curves,
        chunk_runs=options.chunk_runs,
        directory=path,
        overwrite=options.overwrite,
        resume=options.resume,
        source=label,
        warnings=tuple(doubts),
        notes=tuple(notes),
    )


def finish_job(job: Job, cost: Forecast) -> Job:
    """Check what a job needs apart from its record, and collect its warnings and notes."""
    study, notes, doubts = job.study, job.notes, job.warnings
    read_attitude(study)
    forecast.check_memory(study.name, cost)
    if job.directory is not None and not (job.overwrite or job.resume or study.stop_when):
        forecast.check_disk(job.directory, cost)
    checks.check_plugins(study, job.stored)
    if not study.is_recorded:
        doubts = (*useless_methods(study), *checks.band_warnings(study))
    if study.dropped_s:
        notes += (f"The last {study.dropped_s:g} s do not fill a record interval and are not run.",)
    return job._replace(warnings=doubts, notes=notes, forecast=cost)


def _read_record(
    study: Study, record: StoredRecord | Path | str, reference: Path | str | None
) -> StoredRecord:
    """Return the record of a study, which is that or its file."""
    if isinstance(record, Path | str):
        return load_increments(study, record, reference)
    if not isinstance(record, StoredRecord):
        raise InputError(
            f"{study.name}: record: must be what sinsjax.load_increments or"
            f" sinsjax.record_from_arrays returns, not a {type(record).__name__}"
        )
    return record


def issue_warnings(job: Job) -> Job:
    """Issue the warnings and notes of a prepared job as Python warnings, and return the job.

    Warns:
        StudyWarning: one per line.
    """
    for line in (*job.warnings, *job.notes):
        warnings.warn(line, StudyWarning, stacklevel=3)
    return job


def make_subjob(job: Job, study: Study, name: str) -> Job:
    """Return a job for a study derived from that of a prepared job, in a folder of its directory.

    Raises:
        InputError: the folder cannot be used, or contains results of another study.
    """
    assert job.directory is not None
    subdirectory = job.directory / name
    directory.check_available(subdirectory, overwrite=job.overwrite, resume=job.resume)
    job = job._replace(study=study, curves=False, directory=subdirectory)
    return store.continue_job(job) if job.resume else job


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
        >>> from sinsjax.records import write_psins
        >>> write_psins(sinsjax.simulated_record("paper1_resets"), "car.imu")
        >>> stored = sinsjax.load_increments("car_test", "car.imu")
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
