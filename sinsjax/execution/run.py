"""Running a prepared study, into tables in memory or into a directory."""

import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import closing
from itertools import chain, takewhile
from pathlib import Path
from typing import Any

import pyarrow as pa

from sinsjax import columns
from sinsjax.errors import StudyInterrupted
from sinsjax.execution import stopping
from sinsjax.execution.directory import Manifest
from sinsjax.execution.prepare import RunOptions, issue_warnings, prepare_job
from sinsjax.execution.progress import ProgressCallback, RunProgress, python_progress
from sinsjax.execution.results import Results
from sinsjax.execution.store import DirectoryStore, open_store
from sinsjax.execution.tables import curve_columns
from sinsjax.execution.tasks import Executor, Job, Task, TaskResult, TaskRunner, local_executor
from sinsjax.platform import runtime
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import load_study
from sinsjax.study.study import Study

MAX_CURVE_RUNS = 1024
"""Largest number of runs whose curves are all stored by default."""


class MemorySink:
    """The tables of a job in memory, with the methods of `DirectoryStore` that a job needs."""

    def __init__(self) -> None:
        self._tables: dict[str, list[pa.Table]] = {}

    def missing_tasks(self, tasks: Iterable[Task]) -> list[Task]:
        """Return all tasks."""
        return list(tasks)

    def add_result(self, result: TaskResult) -> None:
        """Keep the tables of one task."""
        for name, table in result.content.items():
            self._tables.setdefault(name, []).append(table)

    def read_summary(self, names: list[str]) -> pa.Table:
        """Return some columns of all rows of the summary."""
        return self.tables()["summary"].select(names)

    def finish(self, state: str, **facts: Any) -> None:
        """Do nothing."""

    def tables(self) -> dict[str, pa.Table]:
        """Return the rows of all tasks by dataset, in any order."""
        return {name: pa.concat_tables(tables) for name, tables in self._tables.items()}


def run(
    study: Study | str | Path,
    record: StoredRecord | None = None,
    *,
    curves: bool | None = None,
    chunk_runs: int | None = None,
    progress: bool | None = None,
    on_progress: ProgressCallback | None = None,
) -> Results:
    """Run a study in memory.

    Args:
        study: study, its file, or the name of a shipped study.
        record: the record of a recorded study.
        curves: whether to keep curves; None follows the study.
        chunk_runs: runs per chunk; does not affect the rows.
        progress: whether to show the progress; None shows it on a terminal or in a notebook, after
            two seconds.
        on_progress: called with the progress after every chunk.

    Returns:
        Tables of all runs.

    Raises:
        InputError: the study is not valid, or the record does not fit it.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> results = sinsjax.run(study)
        >>> results.summary.select(["case", "reset_count"]).slice(2, 1).to_pylist()
        [{'case': 'condition 5 with resets', 'reset_count': 3}]
    """
    study = load_study(study)
    options = RunOptions(curves=curves, chunk_runs=chunk_runs)
    job = issue_warnings(prepare_job(study, None, record, None, options))
    return _run_to_results(job, progress, on_progress)


def align(
    record: StoredRecord | str | Path,
    study: Study | str | Path,
    reference: str | Path | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    curves: bool | None = None,
    progress: bool | None = None,
    on_progress: ProgressCallback | None = None,
) -> Results:
    """Align recorded data in memory, from every start time of the study.

    Args:
        record: inertial record: a file, or the result of `record_from_arrays` or `load_increments`.
        study: study with [record], its file, or the name of a shipped study.
        reference: file of a reference attitude to compare with, if the record is a file.
        overrides: values of the study by ``section.key`` to change, see `Study.replace`.
        curves: whether to keep curves; None keeps them for up to 1,024 runs.
        progress: whether to show the progress; None shows it on a terminal or in a notebook, after
            two seconds.
        on_progress: called with the progress after every chunk.

    Returns:
        Tables with one row per start time and variant, and per record time: attitude, 1 sigma, and
        errors if there is a reference.

    Raises:
        InputError: the study has no [record], a file cannot be read, the record is certainly wrong,
            or does not cover the span that the study reads.

    Examples:
        >>> made = sinsjax.simulated_record("paper1_resets")
        >>> record = sinsjax.record_from_arrays(
        ...     None, made.dtheta, made.dv, gyro_unit="rad", accel_unit="m_per_s", rate_hz=100.0
        ... )
        >>> study = sinsjax.study_from_dict(
        ...     {
        ...         "study": {"duration_s": 60.0},
        ...         "earth": {"latitude_deg": 32.0},
        ...         "record": {"format": "arrays"},
        ...         "coarse": {"coarse_method": "inertial", "coarse_duration_s": 30.0},
        ...         "alignment": {"method": "inertial"},
        ...     }
        ... )
        >>> results = sinsjax.align(record, study)
        >>> [round(heading) for heading in results.summary["heading_deg"].to_pylist()]
        [359]
    """
    max_curve_runs = MAX_CURVE_RUNS if curves is None else None
    options = RunOptions(curves=curves, max_curve_runs=max_curve_runs)
    study = load_study(study, overrides)  # here, to warn about keys that a change drops
    job = issue_warnings(prepare_job(study, None, record, reference, options))
    return _run_to_results(job, progress, on_progress)


def run_into(  # noqa: PLR0913
    study: Study | str | Path,
    directory: str | Path,
    record: StoredRecord | None = None,
    *,
    curves: bool | None = None,
    chunk_runs: int | None = None,
    overwrite: bool = False,
    resume: bool = False,
    executor: Executor | None = None,
    progress: bool | None = None,
    on_progress: ProgressCallback | None = None,
    stop: threading.Event | None = None,
    source: Path | str | None = None,
) -> Results:
    """Run a study into a directory, one Parquet part per chunk.

    Args:
        study: study, its file, or the name of a shipped study.
        directory: results directory; must hold no results unless ``overwrite`` or ``resume``.
        record: the record of a recorded study.
        curves: whether to keep curves; None follows the study.
        chunk_runs: runs per chunk; does not affect the rows. Fixed when a directory is begun.
        overwrite: whether to remove existing results.
        resume: whether to keep complete parts of the same study and compute only the others.
        executor: runs the tasks; None for all devices of this process.
        progress: whether to show the progress; None shows it on a terminal or in a notebook, after
            two seconds.
        on_progress: called with the progress before the first chunk and after every one.
        stop: event that ends the study after the running chunks.
        source: label of the study in the manifest; None for its file.

    Returns:
        The results, read from the directory when needed.

    Raises:
        InputError: the record does not fit, or the directory cannot be used; both are checked
            before anything is written or removed. Also if the directory can no longer be written;
            complete parts are kept.
        StudyInterrupted: ``stop`` was set; the running chunks have been stored.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> sinsjax.run_into(study, "out").summary.num_rows
        6
        >>> sinsjax.read_summary("out").num_rows
        6
    """
    options = RunOptions(
        directory, curves, None, chunk_runs, overwrite=overwrite, resume=resume, source=source
    )
    began = time.monotonic()
    job = issue_warnings(prepare_job(study, None, record, None, options))
    with python_progress(job.study.name, progress, on_progress) as show:
        run_job(job, executor=executor, on_progress=show, stop=stop)
    assert job.directory is not None
    manifest = Manifest.read(job.directory)
    return Results(job.study, time.monotonic() - began, directory=job.directory, manifest=manifest)


def run_job(
    job: Job,
    *,
    executor: Executor | None = None,
    on_progress: ProgressCallback | None = None,
    stop: threading.Event | None = None,
) -> None:
    """Run a prepared job into its directory.

    Args:
        job: prepared job with a directory.
        executor: runs the tasks; None for all devices of this process.
        on_progress: called with the progress before the first chunk and after every one.
        stop: event that ends the job after the running chunks.

    Raises:
        InputError: the directory cannot be written, or results there were computed with another
            instruction set.
        StudyInterrupted: ``stop`` was set; the running chunks have been stored.
    """
    assert job.directory is not None
    executor = executor or local_executor()
    session = runtime.describe_environment() | executor.facts
    runner = TaskRunner(job)
    with open_store(job, session) as store:
        _run_tasks(runner, store, executor, on_progress, stop or threading.Event())


def _run_to_results(
    job: Job, progress: bool | None, on_progress: ProgressCallback | None
) -> Results:
    """Run a job in memory."""
    began, sink = time.monotonic(), MemorySink()
    with python_progress(job.study.name, progress, on_progress) as show:
        _run_tasks(TaskRunner(job), sink, local_executor(), show, threading.Event())
    tables, order = sink.tables(), [("run_id", "ascending"), ("time_s", "ascending")]
    curves = tables.get("curves", columns.arrow_schema(curve_columns(job.study)).empty_table())
    tables |= {"summary": tables["summary"].sort_by("run_id"), "curves": curves.sort_by(order)}
    return Results(job.study, time.monotonic() - began, tables=tables)


def _run_tasks(
    runner: TaskRunner,
    sink: DirectoryStore | MemorySink,
    executor: Executor,
    on_progress: ProgressCallback | None,
    stop: threading.Event,
) -> None:
    """Run the tasks that a sink lacks, stage by stage."""
    study, tasks_by_stage = runner.job.study, runner.plan_tasks()
    missing = set(sink.missing_tasks(chain.from_iterable(tasks_by_stage)))
    done = sum(task.runs for task in chain.from_iterable(tasks_by_stage) if task not in missing)
    progress = _ProgressReport(
        RunProgress(done, study.n_draws * study.n_variants, 0, done), on_progress
    )
    with closing(runner):
        for draws, tasks in zip(runner.stages, tasks_by_stage, strict=True):
            pending = [task for task in tasks if task in missing]
            if executor.local:
                runner.compile(pending, progress.set_programs)
            ready = takewhile(lambda _: not stop.is_set(), pending)
            for result in executor.run_tasks(runner, ready):
                sink.add_result(result)
                missing.remove(result.task)
                progress.add_result(result)
            if not missing.isdisjoint(pending):
                sink.finish("interrupted")
                now = progress.now
                where = runner.job.directory
                raise StudyInterrupted(f"{now.done:,} of {now.total:,} runs are in {where}")
            if _may_stop(study, sink, draws):
                break
    sink.finish("complete", draws=draws.stop, runs=draws.stop * study.n_variants)


def _may_stop(study: Study, sink: DirectoryStore | MemorySink, draws: range) -> bool:
    if study.stop_when is None or draws.stop not in stopping.interim_draws(study):
        return False
    rows = sink.read_summary(stopping.required_columns(study))
    return stopping.widest_half_width(study, rows, draws.stop) <= study.stop_when.half_width


class _ProgressReport:
    """The progress of a job; reports from several threads follow one another."""

    def __init__(self, now: RunProgress, on_progress: ProgressCallback | None) -> None:
        self.now, self._on_progress = now, on_progress or (lambda progress: None)
        self._lock = threading.Lock()
        self._on_progress(now)

    def set_programs(self, compiled: int, programs: int) -> None:
        self._report(compiled=compiled, programs=programs)

    def add_result(self, result: TaskResult) -> None:
        failures = (self.now.failures or 0) + result.failures
        self._report(done=self.now.done + result.task.runs, failures=failures)

    def _report(self, **changes: Any) -> None:
        with self._lock:
            self.now = self.now._replace(**changes)
            self._on_progress(self.now)
