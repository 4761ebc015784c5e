"""Running a prepared study, in memory or into a directory, and repeating one of its runs."""

import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import closing
from itertools import chain, count, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from rich.console import Console

from sinsjax.engine.batch import Chunks
from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution.directory import Manifest
from sinsjax.execution.prepare import issue_warnings, load_increments, prepare_job, refuse_external
from sinsjax.execution.progress import ProgressCallback, RunProgress, callback_or_progress_bar
from sinsjax.execution.results import Results, read_summary
from sinsjax.execution.store import DirectoryStore, locked_store
from sinsjax.execution.tables import TableBuilder
from sinsjax.execution.tasks import (
    Executor,
    Job,
    Task,
    TaskResult,
    TaskRunner,
    interim_analysis_columns,
    interim_draws,
    local_executor,
    widest_half_width,
)
from sinsjax.messages import print_line
from sinsjax.platform import runtime
from sinsjax.platform.files import atomic_write, make_folder, write_file
from sinsjax.records.reference import StoredRecord
from sinsjax.study.study import Study


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
        on_progress: called with the progress after every chunk, instead of showing it.

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
    job = issue_warnings(prepare_job(study, None, record, curves=curves, chunk_runs=chunk_runs))
    return _run_in_memory(job, progress, on_progress)


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
        on_progress: called with the progress after every chunk, instead of showing it.

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
    options = {"curves": curves, "keeps_few_curves": curves is None}
    job = issue_warnings(prepare_job(study, overrides, record, reference, **options))
    return _run_in_memory(job, progress, on_progress)


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
        on_progress: called with the progress before the first chunk and after every one, instead of
            showing it.
        stop: event that ends the study after the running chunks.

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
    began, path = time.monotonic(), Path(directory)
    options: dict[str, Any] = {"curves": curves, "chunk_runs": chunk_runs}
    options |= {"directory": path, "overwrite": overwrite, "resume": resume}
    job = issue_warnings(prepare_job(study, None, record, **options))
    with callback_or_progress_bar(job.study.name, progress, on_progress) as show:
        run_job(job, executor=executor, on_progress=show, stop=stop)
    took_s = time.monotonic() - began
    return Results(job.study, took_s, directory=path, manifest=Manifest.read(path))


def run_job(
    job: Job,
    *,
    executor: Executor | None = None,
    on_progress: ProgressCallback | None = None,
    stop: threading.Event | None = None,
) -> None:
    """Run a prepared job into its directory, with the arguments and errors of `run_into`."""
    executor = executor or local_executor()
    session = runtime.describe_environment() | executor.facts
    runner = TaskRunner(job)
    with locked_store(job, session) as store:
        _run_tasks(runner, store, executor, on_progress, stop or threading.Event())


class _MemorySink:
    """The tables of a job in memory, in place of a `DirectoryStore`."""

    def __init__(self) -> None:
        self._contents: list[dict[str, pa.Table]] = []

    def missing_tasks(self, tasks: Iterable[Task]) -> list[Task]:
        return list(tasks)

    def add_result(self, result: TaskResult) -> None:
        self._contents.append(result.content)

    def read_summary(self, names: list[str]) -> pa.Table:
        return self.table("summary").select(names)

    def finish(self, state: str, **facts: Any) -> None:
        pass

    def table(self, name: str) -> pa.Table:
        """Return the rows of a dataset, in any order."""
        return pa.concat_tables(content[name] for content in self._contents)


def _run_in_memory(
    job: Job, progress: bool | None, on_progress: ProgressCallback | None
) -> Results:
    """Run a job in memory."""
    began, sink, runner = time.monotonic(), _MemorySink(), TaskRunner(job)
    with callback_or_progress_bar(job.study.name, progress, on_progress) as show:
        _run_tasks(runner, sink, local_executor(), show, threading.Event())
    tables = {"summary": sink.table("summary").sort_by("run_id")}
    if "curves" in runner.schemas:
        order = [("run_id", "ascending"), ("time_s", "ascending")]
        tables["curves"] = sink.table("curves").sort_by(order)
    return Results(job.study, time.monotonic() - began, tables=tables)


def _run_tasks(
    runner: TaskRunner,
    sink: DirectoryStore | _MemorySink,
    executor: Executor,
    on_progress: ProgressCallback | None,
    stop: threading.Event,
) -> None:
    """Run the tasks that a sink lacks, stage by stage."""
    study, stages = runner.job.study, runner.all_tasks_by_stage()
    missing, total = set(sink.missing_tasks(chain(*stages))), study.n_draws * study.n_variants
    done_before = done = total - sum(task.runs for task in missing)
    programs = len({task.part for task in missing}) if executor.local else 0
    failures, compiled = 0, count()

    def show(now_compiled: int) -> None:
        if on_progress is not None:
            counts = done, total, failures, done_before
            on_progress(RunProgress(*counts, compiled=now_compiled, programs=programs))

    show(next(compiled))
    with closing(runner):
        for draws, tasks in zip(runner.stages, stages, strict=True):
            pending = [task for task in tasks if task in missing]
            if executor.local:
                runner.compile(pending, lambda _: show(next(compiled)))
            ready = takewhile(lambda _: not stop.is_set(), pending)
            for result in executor.run_tasks(runner, ready):
                sink.add_result(result)
                missing.remove(result.task)
                done, failures = done + result.task.runs, failures + result.failures
                show(programs)
            if not missing.isdisjoint(pending):
                sink.finish("interrupted")
                where = runner.job.directory
                raise StudyInterrupted(f"{done:,} of {total:,} runs are in {where}")
            if _may_stop(study, sink, draws):
                break
    sink.finish("complete", draws=draws.stop, runs=draws.stop * study.n_variants)


def _may_stop(study: Study, sink: DirectoryStore | _MemorySink, draws: range) -> bool:
    if study.stop_when is None or draws.stop not in interim_draws(study):
        return False
    rows = sink.read_summary(interim_analysis_columns(study))
    return widest_half_width(study, rows, draws.stop) <= study.stop_when.half_width


def repeat_run(
    study: Study, run_id: int, record: StoredRecord | None = None
) -> dict[str, pa.Table]:
    """Return the summary and curves of one run of a study, equal to those of a sweep to the bit."""
    draw, variant = divmod(run_id, study.n_variants)
    scenario = Scenario(study, record, curves=True)
    number, place = scenario.find(variant)
    batch = scenario.batch(number, range(draw, draw + 1))
    # The smallest possible chunk: a run's bits do not depend on its lane or chunk.
    chunks = Chunks(batch, tiles_per_chunk=1)
    first = int(np.flatnonzero(batch.draws.draw_id == draw)[0])
    chunk = chunks.compute(chunks.layout.chunk_of(first, place))
    builder = TableBuilder(study, has_truth=scenario.has_truth, curves=True)
    tables = builder.make_tables(chunk, batch.variant_ids)
    return {name: table.filter(pc.field("run_id") == run_id) for name, table in tables.items()}


def rerun_stored_run(
    directory: Path,
    run_id: int,
    console: Console,
    *,
    out: Path | None = None,
    files: tuple[Path | None, Path | None] = (None, None),
) -> bool:
    """Repeat one run of stored results, and write its row, curve and figure.

    They go to ``reruns/RUN_ID`` or to another directory. A recorded study needs the files of its
    record and reference. Return whether the row is identical to the stored one.
    """
    from sinsjax import plots  # which import Matplotlib

    results = Results.read(directory)
    study, manifest, target = results.study, results.manifest, out or directory / f"reruns/{run_id}"
    refuse_external(study.study.external, directory)
    if files[0] is None and (study.is_recorded or files[1] is not None):
        raise InputError(f"{directory}: its study needs a record (give it with --record)")
    record = None if files[0] is None else load_increments(study, files[0], files[1])
    if manifest.identity != Job(study, record, extended_at=manifest.extended_at).input_hash:
        raise InputError(f"{directory}: the results are of another record or reference")
    stored = read_summary(directory, run_ids=[run_id])
    if stored.num_rows != 1:
        raise InputError(f"{directory}: has no run {run_id} (`--resume` computes missing ones)")
    tables = repeat_run(study, run_id, record)
    row, curve, title = tables["summary"], tables["curves"], f"{study.name}, run {run_id}"
    make_folder(target)
    for name, table in (("summary", row), ("curve", curve)):
        with atomic_write(target / f"{name}.parquet") as file:
            pq.write_table(table, file, compression="zstd")
    figure = plots.plot_curves(curve, row, title=title)
    write_file(target / "curve.png", plots.render_png(figure))
    (before,), (now,) = stored.to_pylist(), row.to_pylist()
    for name, value in now.items():
        print_line(console, f"{name:>30}  {value}")
    differing = [name for name in before | now if before.get(name) != now.get(name)]
    verdict = f"The row is identical to the stored one in all {len(before)} columns."
    if differing:
        verdict = (
            f"{len(differing)} of {len(before)} columns differ from the stored row:"
            f" {', '.join(differing)}. Last bits depend on the versions, flags and processor that"
            " `manifest.json` lists."
        )
    print_line(console, verdict)
    print_line(console, f"Row, curve and figure: {target}")
    return not differing
