"""Running a prepared study, into tables in memory or into a directory."""

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from sinsjax import columns
from sinsjax.errors import StudyInterrupted
from sinsjax.execution import resume, schemas, stopping
from sinsjax.execution import tasks as study_tasks
from sinsjax.execution.prepare import RunOptions, issue_warnings, prepare_job
from sinsjax.execution.store import DirectoryStore, MemoryStore, ResultSink
from sinsjax.execution.study_results import Results
from sinsjax.execution.tasks import Executor, Job, Task, TaskRunner
from sinsjax.platform import runtime
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import load_study
from sinsjax.study.study import Study


class RunProgress(NamedTuple):
    """Progress of a study.

    Attributes:
        done: completed runs.
        total: number of runs; with [stop_when], at most.
        failures: runs of this session that diverged or became non-finite; None if there are none
            to count.
        done_before: runs completed before this session.
        unit: what is counted, in words.
        compiled: programs of the running stage that are compiled.
        programs: number of them; 0 if it is not known.
    """

    done: int
    total: int
    failures: int | None
    done_before: int
    unit: str = "runs"
    compiled: int = 0
    programs: int = 0


MAX_CURVE_RUNS = 1024
"""Largest number of runs whose curves are all stored by default."""

ProgressCallback = Callable[[RunProgress], None]
"""Progress callback, called before the first chunk and after every one.

Also when a program has been compiled, then from another thread, though never at the same time.
"""


def run(
    study: Study | str | Path,
    record: StoredRecord | None = None,
    *,
    curves: bool | None = None,
    chunk_runs: int | None = None,
    on_progress: ProgressCallback | None = None,
) -> Results:
    """Run a study in memory.

    Args:
        study: study, its file, or the name of a shipped study.
        record: the record of a recorded study.
        curves: whether to keep curves; None follows the study.
        chunk_runs: runs per chunk; does not affect the rows.
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
    return _run_to_results(
        issue_warnings(prepare_job(study, None, record, None, options)), on_progress
    )


def align(
    record: StoredRecord | str | Path,
    study: Study | str | Path,
    reference: str | Path | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    curves: bool | None = None,
    on_progress: ProgressCallback | None = None,
) -> Results:
    """Align recorded data in memory, from every start time of the study.

    Args:
        record: inertial record: a file, or the result of `record_from_arrays` or `load_increments`.
        study: study with [record], its file, or the name of a shipped study.
        reference: file of a reference attitude to compare with, if the record is a file.
        overrides: values of the study by ``section.key`` to change, see `Study.replace`.
        curves: whether to keep curves; None keeps them for up to 1,024 runs.
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
    return _run_to_results(
        issue_warnings(prepare_job(study, None, record, reference, options)), on_progress
    )


def run_into(
    study: Study | str | Path,
    directory: str | Path,
    record: StoredRecord | None = None,
    *,
    curves: bool | None = None,
    chunk_runs: int | None = None,
    overwrite: bool = False,
    resume: bool = False,
    executor: Executor | None = None,
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
    run_job(job, executor=executor, on_progress=on_progress, stop=stop)
    return Results(job.study, time.monotonic() - began, directory=job.directory)


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
    executor = executor or study_tasks.local_executor()
    session = runtime.describe_environment() | executor.facts
    if job.resume:
        resume.check_instruction_set(job.directory, session["instructions"])
    runner = TaskRunner(job)
    store = DirectoryStore(runner, session)
    try:
        _run_tasks(runner, store, executor, on_progress, stop or threading.Event())
    finally:
        store.unlock()


def run_in_memory(job: Job, on_progress: ProgressCallback | None = None) -> dict[str, pa.Table]:
    """Run a job in memory.

    Args:
        job: prepared job.
        on_progress: called with the progress before the first chunk and after every one.

    Returns:
        The rows of all tasks by dataset, in any order.
    """
    store = MemoryStore()
    _run_tasks(
        TaskRunner(job), store, study_tasks.memory_executor(), on_progress, threading.Event()
    )
    return store.tables()


def _run_to_results(job: Job, on_progress: ProgressCallback | None) -> Results:
    began = time.monotonic()
    tables = run_in_memory(job, on_progress)
    order = [("run_id", "ascending"), ("time_s", "ascending")]
    curves = tables.get(
        "curves", columns.arrow_schema(schemas.curve_columns(job.study)).empty_table()
    )
    tables |= {"summary": tables["summary"].sort_by("run_id"), "curves": curves.sort_by(order)}
    return Results(job.study, time.monotonic() - began, tables=tables)


def _run_tasks(
    runner: TaskRunner,
    sink: ResultSink,
    executor: Executor,
    on_progress: ProgressCallback | None,
    stop: threading.Event,
) -> None:
    """Run the tasks that a sink lacks, stage by stage."""
    study, tasks_by_stage = runner.job.study, runner.plan_tasks()
    missing = set(sink.missing_tasks(task for tasks in tasks_by_stage for task in tasks))
    counter = _ProgressCounter(study, on_progress)
    counter.start(task for tasks in tasks_by_stage for task in tasks if task not in missing)
    with closing(runner):
        for draws, tasks in zip(runner.stages, tasks_by_stage, strict=True):
            pending = [task for task in tasks if task in missing]
            ready = (
                runner.compile_ahead(pending, counter.set_programs) if executor.local else pending
            )
            for result in executor.run_tasks(runner, takewhile(lambda _: not stop.is_set(), ready)):
                sink.add_result(result)
                missing.remove(result.task)
                counter.add_task(result.task, result.failures)
            if not missing.isdisjoint(pending):
                sink.finish("interrupted")
                now = counter.progress
                text = f"{now.done:,} of {now.total:,} runs are in {sink.place}"
                raise StudyInterrupted(text)
            if _may_stop(study, sink, draws):
                break
    sink.finish("complete", draws=draws.stop, runs=draws.stop * study.n_variants)


def _may_stop(study: Study, sink: ResultSink, draws: range) -> bool:
    if study.stop_when is None or draws.stop not in stopping.interim_draws(study):
        return False
    rows = sink.read_summary(stopping.required_columns(study))
    return stopping.analyse_interim(study, rows, draws.stop).is_sufficient


class _ProgressCounter:
    """Track progress; calls from several threads follow one another."""

    def __init__(self, study: Study, on_progress: ProgressCallback | None) -> None:
        self.progress = RunProgress(0, study.n_draws * study.n_variants, 0, 0)
        self._on_progress = on_progress or (lambda progress: None)
        self._lock = threading.Lock()

    def start(self, stored: Iterable[Task]) -> None:
        before = sum(task.runs for task in stored)
        self._change(lambda now: now._replace(done=before, done_before=before))

    def set_programs(self, compiled: int, programs: int) -> None:
        self._change(lambda now: now._replace(compiled=compiled, programs=programs))

    def add_task(self, task: Task, failures: int) -> None:
        self._change(
            lambda now: now._replace(
                done=now.done + task.runs, failures=(now.failures or 0) + failures
            )
        )

    def _change(self, change: Callable[[RunProgress], RunProgress]) -> None:
        with self._lock:
            self.progress = change(self.progress)
            self._on_progress(self.progress)
