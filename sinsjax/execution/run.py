"""Running all tasks of a study, into tables in memory or into a directory."""

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
from sinsjax.execution import forecast, layouts, stopping, store
from sinsjax.execution import resume as resuming
from sinsjax.execution import tasks as study_tasks
from sinsjax.execution.preflight import check_methods, layout_of, warnings_of
from sinsjax.execution.tasks import Executor, Job, Task, TaskRunner
from sinsjax.platform import runtime
from sinsjax.records import read_record, read_reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import with_rate
from sinsjax.study.study import Study


class Results(NamedTuple):
    """Results of a study.

    Attributes:
        summary: one row per run, ordered by run_id.
        curves: one row per run and record time; empty if curves were not kept.
    """

    summary: pa.Table
    curves: pa.Table


class RunProgress(NamedTuple):
    """Progress of a study, or of one of its stages.

    Attributes:
        done: completed runs.
        total: number of runs; with [stop_when], at most.
        failures: runs of this session that diverged or became non-finite.
        before: runs completed before this session.
        counted: what is counted, if not runs; another word than before begins another stage.
    """

    done: int
    total: int
    failures: int
    before: int
    counted: str = "runs"


_ESTIMATES = "estimates"

Tell = Callable[[RunProgress], None]
"""Progress callback, called before the first chunk and after every one."""


def load_tape(
    study: Study, record: str | Path, reference: str | Path | None = None
) -> StoredRecord:
    """Read the record of a recorded study, and the reference attitude if given.

    Raises:
        InputError: a file cannot be used, or the study has no [record].
    """
    if study.record is None:
        raise InputError(f"{study.name}: has no [record] section")
    if study.record.format == "arrays":
        text = f"[record] format: 'arrays' are given to sinsjax.run, not read from {record}"
        raise InputError(f"{study.name}: {text} (see sinsjax.record_from_arrays)")
    layout = layout_of(study)
    read = read_record(record, layout)
    return StoredRecord.of(read, None if reference is None else read_reference(reference, layout))


def at_rate(study: Study, tape: StoredRecord | None) -> Study:
    """The study at the rate of its record.

    Raises:
        InputError: the study is invalid at this rate, or the tape is something else.
    """
    if tape is not None and not isinstance(tape, StoredRecord):
        raise InputError(
            f"{study.name}: tape: must be what sinsjax.load_tape or sinsjax.record_from_arrays"
            f" gives, not a {type(tape).__name__}"
        )
    if tape is not None and study.is_recorded:
        return with_rate(study, tape.record.rate_hz)
    return study


def made_ready(study: Study, tape: StoredRecord | None) -> tuple[Study, list[str]]:
    """The study at the rate of its record, and warnings about it, one line each.

    Raises:
        InputError: the record does not fit the study, or is certainly wrong.
    """
    study = at_rate(study, tape)
    if study.is_recorded != (tape is not None):  # rejected when it is run
        return study, []
    return study, [*check_methods(study, tape), *warnings_of(study, tape)]


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
        curves: whether to keep curves; None follows the study.
        chunk_runs: runs per chunk; does not affect the rows.
        tell: called with the progress after every chunk.

    Returns:
        Tables of all runs.

    Raises:
        InputError: the record does not fit the study, or that has no runs but estimates.
    """
    runtime.ensure_configured()
    if study.is_estimated:
        text = "covariance estimates have no runs (use sinsjax.estimate)"
        raise InputError(f"{study.name}: [study] estimate: {text}")
    study, _ = made_ready(study, tape)
    made = _tables(Job(study, tape, curves, chunk_runs), tell)
    order = [("run_id", "ascending"), ("time_s", "ascending")]
    kept = made.get("curves", columns.schema(layouts.curves(study)).empty_table())
    return Results(made["summary"].sort_by("run_id"), kept.sort_by(order))


def estimate(study: Study, *, chunk_runs: int | None = None, tell: Tell | None = None) -> pa.Table:
    """Estimate the errors of a study's variants in memory, without draws or with few.

    Args:
        study: checked study with ``estimate = "covariance"`` or ``"controlled"``.
        chunk_runs: variants per chunk; does not affect the rows.
        tell: called with the progress after every chunk.

    Returns:
        One row per variant, ordered by variant_id; the schema has units and meanings.

    Raises:
        InputError: the study asks for draws, or covariance analysis does not hold for it.
    """
    runtime.ensure_configured()
    if study.study.estimate == "draws":
        raise InputError(f"{study.name}: [study] estimate: is 'draws' (use sinsjax.run)")
    study, _ = made_ready(study, None)
    return _tables(Job(study, chunk_runs=chunk_runs), tell)["estimates"].sort_by("variant_id")


def _tables(job: Job, tell: Tell | None) -> dict[str, pa.Table]:
    """The rows of all tasks of a job, by dataset, in any order."""
    study, runner = job.study, TaskRunner(job)
    count = _ProgressCounter(study, tell)
    count.begin([])
    made: dict[str, list[pa.Table]] = {}
    for draws, tasks in zip(runner.stages, runner.tasks(), strict=True):
        for piece in in_threads(runner.do, tasks, len(jax.devices())):
            for name, table in piece.tables.items():
                made.setdefault(name, []).append(table)
            count.add(piece.task, runner.failures(piece.task, piece.tables))
        if _enough(study, lambda names: pa.concat_tables(made["summary"]).select(names), draws):
            break
    if concluding := runner.concluding_tasks():
        from sinsjax.execution.conclusion import Conclusion  # late, for scipy

        end = Conclusion(runner, lambda n: pa.concat_tables(made["summary"]).select(n))
        count.conclude([])
        for piece in in_threads(runner.do, map(end.asked, concluding), len(jax.devices())):
            made.setdefault("estimates", []).append(end.of(piece).tables["estimates"])
            count.add(piece.task, runner.failures(piece.task, piece.tables))
    return {name: pa.concat_tables(tables) for name, tables in made.items()}


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
    source: Path | str | None = None,
) -> None:
    """Run a study into a directory, one Parquet part per chunk.

    Args:
        study: checked study.
        directory: results directory; must hold no results unless ``overwrite`` or ``resume``.
        tape: the record of a recorded study.
        curves: whether to keep curves; None follows the study.
        chunk_runs: runs per chunk; does not affect the rows. Fixed when a directory is begun.
        overwrite: whether to remove existing results.
        resume: whether to keep complete parts of the same study and compute only the others.
        executor: runs the tasks; None for all devices of this process.
        tell: called with the progress before the first chunk and after every one.
        stop: event that ends the study after the running chunks.
        source: the study's file, or words for it, named in the manifest; an absolute path is
            shortened to the file name, since it means nothing on another machine.

    Raises:
        InputError: the record does not fit, or the directory cannot be used; both are checked
            before anything is written or removed. Also if the directory can no longer be written;
            complete parts are kept.
        StudyInterrupted: ``stop`` was set; the running chunks have been stored.
    """
    runtime.ensure_configured()
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
        "config": _told(source) if isinstance(source, Path) else source,
        "record": None if tape is None else Path(tape.record.source).name,
        "warnings": warnings,
        "session": session,
    }
    held = store.Store(directory, runner, resume=resume, overwrite=overwrite, facts=facts)
    try:
        _carry_out(runner, held, executor, _ProgressCounter(study, tell), stop or threading.Event())
    finally:
        held.release()


def _told(file: Path) -> str:
    return file.name if file.is_absolute() else file.as_posix()


def _carry_out(
    runner: TaskRunner,
    held: store.Store,
    executor: Executor,
    count: "_ProgressCounter",
    stop: threading.Event,
) -> None:
    study, staged, concluding = runner.job.study, runner.tasks(), runner.concluding_tasks()
    missing = set(held.missing([*(task for tasks in staged for task in tasks), *concluding]))
    count.begin(task for tasks in staged for task in tasks if task not in missing)
    for draws, tasks in zip(runner.stages, staged, strict=True):
        todo = [task for task in tasks if task in missing]
        for encoded in executor.do(runner, takewhile(lambda _: not stop.is_set(), todo)):
            held.write(encoded)
            missing.remove(encoded.task)
            count.add(encoded.task, encoded.failures)
        if not missing.isdisjoint(todo):
            raise _interrupted(held, count)
        if _enough(study, held.summary, draws):
            break
    if todo := [task for task in concluding if task in missing]:
        from sinsjax.execution.conclusion import Conclusion  # late, for scipy

        end = Conclusion(runner, held.summary)
        going = takewhile(lambda _: not stop.is_set(), todo)
        count.conclude(task for task in concluding if task not in missing)
        for encoded in executor.do(runner, map(end.asked, going)):
            held.write(runner.encoded(end.of(runner.decoded(encoded))))
            count.add(encoded.task, encoded.failures)
        if count.progress.done < count.progress.total:
            raise _interrupted(held, count)
    held.finish("complete", draws=draws.stop, runs=draws.stop * study.n_variants)


def _interrupted(held: store.Store, count: "_ProgressCounter") -> StudyInterrupted:
    held.finish("interrupted")
    now = count.progress
    text = f"{now.done:,} of {now.total:,} {now.counted} are in {held.directory}"
    return StudyInterrupted(text)


def _enough(study: Study, select: Callable[[list[str]], pa.Table], draws: range) -> bool:
    if study.stop_when is None or draws.stop not in stopping.interim_draws(study):
        return False
    return stopping.analyse_interim(study, select(stopping.columns(study)), draws.stop).enough


class _ProgressCounter:
    """Track progress."""

    def __init__(self, study: Study, tell: Tell | None) -> None:
        counted = _ESTIMATES if study.is_estimated else "runs"
        self.progress = RunProgress(0, study.n_draws * study.n_variants, 0, 0, counted)
        self._variants = study.n_variants
        self._tell = tell or (lambda progress: None)

    def begin(self, there: Iterable[Task]) -> None:
        before = sum(map(_size, there))
        self.progress = self.progress._replace(done=before, before=before)
        self._tell(self.progress)

    def conclude(self, there: Iterable[Task]) -> None:
        """Begin the stage of concluding tasks."""
        self.progress = RunProgress(0, self._variants, 0, 0, _ESTIMATES)
        self.begin(there)

    def add(self, task: Task, failures: int) -> None:
        done, failed = self.progress.done + _size(task), self.progress.failures + failures
        self.progress = self.progress._replace(done=done, failures=failed)
        self._tell(self.progress)


def _size(task: Task) -> int:
    """Runs of a task, or the estimates of one that concludes."""
    return task.runs or dict(task.rows)[_ESTIMATES]
