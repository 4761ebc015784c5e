"""A study carried out: every task of it, into tables in memory or into a directory."""

import threading
from collections.abc import Callable, Iterable
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

import jax
import pyarrow as pa

from sinsjax import columns
from sinsjax.engine.batch import in_threads
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution import forecast, stopping, store
from sinsjax.execution import resume as resuming
from sinsjax.execution import tasks as study_tasks
from sinsjax.execution.preflight import layout_of, warnings_of
from sinsjax.execution.tasks import Executor, Job, Task, TaskRunner
from sinsjax.platform import runtime
from sinsjax.records import read_record, read_reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import with_rate
from sinsjax.study.study import Study


class Results(NamedTuple):
    """What a study gave.

    Attributes:
        summary: one row a run, by run_id.
        curves: one row a run and record time; empty if curves were not kept.
    """

    summary: pa.Table
    curves: pa.Table


class RunProgress(NamedTuple):
    """How far a study has come.

    Attributes:
        done: runs that are there.
        total: runs in all; with [stop_when], the most there can be.
        failures: of the runs of this session, those that diverged or broke.
        before: runs that were there when the session began.
    """

    done: int
    total: int
    failures: int
    before: int


Tell = Callable[[RunProgress], None]
"""Called before the first chunk and after every one."""


def load_tape(
    study: Study, record: str | Path, reference: str | Path | None = None
) -> StoredRecord:
    """Read the record of a recorded study, and a reference attitude if there is one.

    Raises:
        InputError: a file that cannot be used, or a study without [record].
    """
    if study.record is None:
        raise InputError(f"{study.name}: has no [record] section")
    layout = layout_of(study)
    read = read_record(record, layout)
    if reference is None:
        return StoredRecord(read, None)
    judge = read_reference(reference, layout)
    return StoredRecord(read, judge._replace(time_s=judge.time_s - read.t0_s))


def at_rate(study: Study, tape: StoredRecord | None) -> Study:
    """A study at the rate of its record.

    Raises:
        InputError: at this rate it is none.
    """
    if tape is not None and study.is_recorded:
        return with_rate(study, tape.record.rate_hz)
    return study


def made_ready(study: Study, tape: StoredRecord | None) -> tuple[Study, list[str]]:
    """A study as it runs, at the rate of its record, and one line for everything doubtful about it.

    Raises:
        InputError: a record that does not fit, or cannot be what it is taken for.
    """
    study = at_rate(study, tape)
    if study.is_recorded != (tape is not None):  # refused where it is run
        return study, []
    return study, warnings_of(study, tape)


def run(
    study: Study,
    tape: StoredRecord | None = None,
    *,
    curves: bool | None = None,
    chunk_runs: int | None = None,
    tell: Tell | None = None,
) -> Results:
    """Run a study in memory.

    Args:
        study: checked study.
        tape: the record of a recorded study.
        curves: whether curves are kept; None takes the study's word.
        chunk_runs: runs a chunk; no row depends on it.
        tell: told how far it is, after every chunk.

    Returns:
        Tables of all runs.

    Raises:
        InputError: a record that does not fit.
        RuntimeError: double precision is off (`runtime.configure` turns it on).
    """
    study, _ = made_ready(study, tape)
    runner = TaskRunner(Job(study, tape, curves, chunk_runs))
    count = _ProgressCounter(study, tell)
    count.begin([])
    summaries: list[pa.Table] = []
    kept = [columns.schema(columns.curves(passes=study.passes is not None)).empty_table()]
    for draws, tasks in zip(runner.stages, runner.tasks(), strict=True):
        for piece in in_threads(runner.do, tasks, len(jax.devices())):
            summaries.append(piece.summary)
            kept += [] if piece.curves is None else [piece.curves]
            count.add(piece.task, study_tasks.failures(piece.summary))
        if _enough(study, pa.concat_tables(summaries).select, draws):
            break
    order = [("run_id", "ascending"), ("time_s", "ascending")]
    summary = pa.concat_tables(summaries).sort_by("run_id")
    return Results(summary, pa.concat_tables(kept).sort_by(order))


def run_into(
    study: Study,
    directory: str | Path,
    tape: StoredRecord | None = None,
    *,
    curves: bool | None = None,
    chunk_runs: int | None = None,
    overwrite: bool = False,
    resume: bool = False,
    executor: Executor | None = None,
    tell: Tell | None = None,
    stop: threading.Event | None = None,
    source: Path | None = None,
) -> None:
    """Run a study into a directory, a Parquet part a chunk.

    Args:
        study: checked study.
        directory: where; must hold no results unless ``overwrite`` or ``resume``.
        tape: the record of a recorded study.
        curves: whether curves are kept; None takes the study's word.
        chunk_runs: runs a chunk; no row depends on it. A directory keeps the one it began with.
        overwrite: whether earlier results are removed.
        resume: whether whole parts of the same study are kept, and only the others made.
        executor: who does the tasks; None: all devices of this process.
        tell: told how far it is, before the first chunk and after every one.
        stop: set from elsewhere, it ends the study after the chunks under way.
        source: the study's file, named in the manifest; without its folders if they begin at
            the root, which mean nothing on another machine.

    Raises:
        InputError: a record that does not fit, or a directory that cannot be used. Nothing is
            written or removed before both are known to be good. Also a directory that can no
            longer be written: what is complete stays.
        StudyInterrupted: ``stop`` was set; all that was under way is stored.
        RuntimeError: double precision is off.
    """
    directory = resuming.named(directory)
    resuming.check_free(directory, overwrite=overwrite or resume)
    study = at_rate(study, tape)
    if study.study.rate_hz:
        expected = forecast.of(study, curves=curves)
        forecast.require_room(study, expected, directory, overwrite=overwrite, resume=resume)
    study, warnings = made_ready(study, tape)
    job = Job(study, tape, curves, chunk_runs)
    executor = executor or study_tasks.on_this_machine()
    session = runtime.session() | executor.facts
    if resume:
        job = resuming.resumed(directory, job, session["instructions"])
    runner = TaskRunner(job)
    facts = {
        "config": source and (source.name if source.is_absolute() else source.as_posix()),
        "record": None if tape is None else Path(tape.record.source).name,
        "warnings": warnings,
        "session": session,
    }
    held = store.Store(directory, runner, resume=resume, overwrite=overwrite, facts=facts)
    try:
        _carry_out(runner, held, executor, _ProgressCounter(study, tell), stop or threading.Event())
    finally:
        held.release()


def _carry_out(
    runner: TaskRunner,
    held: store.Store,
    executor: Executor,
    count: "_ProgressCounter",
    stop: threading.Event,
) -> None:
    study, staged = runner.job.study, runner.tasks()
    missing = set(held.missing(task for tasks in staged for task in tasks))
    count.begin(task for tasks in staged for task in tasks if task not in missing)
    for draws, tasks in zip(runner.stages, staged, strict=True):
        todo = [task for task in tasks if task in missing]
        for encoded in executor.do(runner, takewhile(lambda _: not stop.is_set(), todo)):
            held.write(encoded)
            missing.remove(encoded.task)
            count.add(encoded.task, encoded.failures)
        if not missing.isdisjoint(todo):
            held.finish("interrupted")
            done, total = count.progress.done, count.progress.total
            raise StudyInterrupted(f"{done:,} of {total:,} runs are in {held.directory}")
        if _enough(study, held.summary, draws):
            break
    held.finish("complete", draws=draws.stop, runs=draws.stop * study.n_variants)


def _enough(study: Study, select: Callable[[list[str]], pa.Table], draws: range) -> bool:
    if study.stop_when is None:
        return False
    return stopping.analyse_interim(study, select(stopping.columns(study)), draws.stop).enough


class _ProgressCounter:
    """Track progress."""

    def __init__(self, study: Study, tell: Tell | None) -> None:
        self.progress = RunProgress(0, study.n_draws * study.n_variants, 0, 0)
        self._tell = tell or (lambda progress: None)

    def begin(self, there: Iterable[Task]) -> None:
        before = sum(task.runs for task in there)
        self.progress = self.progress._replace(done=before, before=before)
        self._tell(self.progress)

    def add(self, task: Task, failures: int) -> None:
        done, failed = self.progress.done + task.runs, self.progress.failures + failures
        self.progress = self.progress._replace(done=done, failures=failed)
        self._tell(self.progress)
