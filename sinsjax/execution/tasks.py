"""Division of a study into tasks, whose results do not depend on machine or order.

A task is one chunk of runs, computed by one call of the compiled program. The division depends only
on the study, so a task can be repeated anywhere. Interim analyses for ``[stop_when]`` occur at
fixed numbers of draws and use all rows of those draws, so they do not depend on chunks either.
"""

import hashlib
import json
import math
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from itertools import count, groupby
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sinsjax import columns
from sinsjax.engine.batch import LANES, Batch, Chunks, Layout, duplicates_to_skip, map_in_threads
from sinsjax.engine.scenario import Scenario
from sinsjax.execution.directory import to_sealed_parquet
from sinsjax.execution.forecast import Forecast
from sinsjax.execution.results import CHUNK_METADATA, STUDY_METADATA
from sinsjax.execution.success import require_floor
from sinsjax.execution.tables import TableBuilder
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import fingerprint, with_draws
from sinsjax.study.study import Study
from sinsjax.study.success import settling_bands, success_criteria

_DRAWS_PER_BLOCK = 2**16  # about 30 MB if everything is drawn
_CACHED_CHUNKS = 3  # each has its own increments; threads may work on two programs
_MOST_COMPILERS = 4  # programs that are compiled side by side, each in memory of its own


class Job(NamedTuple):
    """A study that is ready to run, see `prepare.prepare_job`."""

    study: Study  # at the rate of its record
    stored: StoredRecord | None = None  # the record of a recorded study
    curves: bool | None = None  # whether to keep curves; None follows the study
    # runs per chunk, rounded to two or more whole tiles; None for the default
    chunk_runs: int | None = None
    # numbers of draws of its results before each extension, ascending
    extended_at: tuple[int, ...] = ()
    directory: Path | None = None  # results directory; None for tables in memory
    overwrite: bool = False  # existing results are removed
    resume: bool = False  # existing results are continued
    source: str | None = None  # the study's file, or another label
    warnings: tuple[str, ...] = ()  # doubts about the study or its record, one line each
    notes: tuple[str, ...] = ()  # further information for the user, one line each
    forecast: Forecast | None = None  # expected runs, time, memory and disk space

    @property
    def input_hash(self) -> str:
        """Hash of study, record and reference, as hex digits, whatever the version of sinsjax.

        An extension of the study does not change it.
        """
        study = with_draws(self.study, min(self.extended_at)) if self.extended_at else self.study
        digest = hashlib.sha256(fingerprint(study).encode())
        if self.stored is not None:
            record, reference = self.stored
            arrays = [record.dtheta, record.dv, np.asarray([record.rate_hz])]
            arrays += [] if reference is None else [reference.time_s, reference.attitude_deg]
            for array in arrays:
                digest.update(np.ascontiguousarray(array).data)
        return digest.hexdigest()[:16]


class Task(NamedTuple):
    """A chunk of a study's runs."""

    name: str  # name of its files, without extension
    part: int  # number of its program in the scenario
    draws: tuple[int, int]  # first draw of its batch and the one after the last
    call: int  # number of the chunk of that batch
    runs: int
    # names of the datasets that it writes and their rows, in that order
    rows: tuple[tuple[str, int], ...]


class TaskResult(NamedTuple):
    """Result of one task."""

    task: Task
    # by dataset: tables, or sealed Parquet files if the job has a directory
    content: dict[str, Any]
    failures: int  # runs that diverged or became non-finite


def part_metadata(job: Job, input_hash: str, dataset: str, task: Task) -> dict[str, str]:
    """Return the metadata of a part of a job, without time or host, which would change its bytes.

    The job's `input_hash` is given, as it takes a while to compute.
    """
    chunk: dict[str, Any] = {"dataset": dataset, **task._asdict()}
    chunk |= {"rows": dict(task.rows)[dataset], "chunk_runs": job.chunk_runs}
    if before := [end for end in job.extended_at if end <= task.draws[0]]:
        chunk["extended_at"] = before
    return {STUDY_METADATA: input_hash, CHUNK_METADATA: json.dumps(chunk)}


class TaskRunner:
    """Thread-safe runner of a job's tasks."""

    def __init__(self, job: Job) -> None:
        """Check that a job can be run, by making its first batch."""
        require_floor(job.study)
        self.job, self.input_hash = job, job.input_hash
        self._scenario = scenario = Scenario(job.study, job.stored, curves=job.curves)
        self._tables = TableBuilder(job.study, has_truth=scenario.has_truth, curves=scenario.curves)
        self.schemas = self._tables.schemas
        self._tiles_per_chunk = None if job.chunk_runs is None else -(-job.chunk_runs // LANES)
        first_draws = min((*job.extended_at, job.study.n_draws))  # before any extension
        self._duplicates = [
            duplicates_to_skip(spec, first_draws, job.study.duplicate_of[ids])
            for spec, ids in zip(scenario.specs, scenario.variant_ids, strict=True)
        ]
        self._lock = threading.Lock()
        self._compilers = ThreadPoolExecutor(min(len(jax.devices()), _MOST_COMPILERS))
        self._compiling = lru_cache(None)(
            lambda program, draws: self._compilers.submit(self._compile, program, draws)
        )
        self._chunks = lru_cache(_CACHED_CHUNKS)(self._make_chunks)
        self._make_batch(0, self._split_draws(self.stages[0])[0], blank=True)

    @property
    def stages(self) -> list[range]:
        """Ranges of draws up to each interim analysis and extension, with independent tasks."""
        ends = sorted({*interim_draws(self.job.study), *self.job.extended_at})
        return [range(a, b) for a, b in zip([0, *ends], ends, strict=False)]

    def all_tasks_by_stage(self) -> list[list[Task]]:
        """Return the tasks of every stage."""
        numbers = [count() for _ in self._scenario.specs]
        return [
            [
                task
                for program, number in enumerate(numbers)
                for draws in self._split_draws(stage)
                for task in self._plan_batch(program, draws, number)
            ]
            for stage in self.stages
        ]

    def _plan_batch(self, program: int, draws: range, number: Iterator[int]) -> Iterator[Task]:
        """Yield the tasks of some draws of a program, whose chunks are numbered on."""
        spec, duplicates = self._scenario.specs[program], self._duplicates[program]
        ids = self._scenario.variant_ids[program] if duplicates is None else duplicates.computed
        layout = Layout(spec, len(draws), len(ids), tiles_per_chunk=self._tiles_per_chunk)
        for call in range(len(layout)):
            variant = layout.active(call).variant
            runs = len(variant) if duplicates is None else int(duplicates.counts[variant].sum())
            rows = tuple(
                (name, runs * (spec.intervals if name == "curves" else 1)) for name in self.schemas
            )
            name = f"part-{program:04d}-{next(number):06d}"
            yield Task(name, program, (draws.start, draws.stop), call, runs, rows)

    def _split_draws(self, stage: range) -> list[range]:
        """Return the draws of a stage in blocks whose drawn values fit in memory."""
        block = _DRAWS_PER_BLOCK if self.job.study.drawn_keys else len(stage)
        return [stage[first : first + block] for first in range(0, len(stage), block)]

    def compute(self, task: Task) -> TaskResult:
        """Compute one task: equal tables, and equal bytes, on any machine."""
        with self._lock:  # otherwise every thread would compile
            chunks = self._chunks(task.part, range(*task.draws))
        chunk = chunks.compute(task.call)
        if duplicates := self._duplicates[task.part]:
            chunk = duplicates.expand(chunk)
        content: dict[str, Any] = self._tables.make_tables(
            chunk, self._scenario.variant_ids[task.part]
        )
        failed = pc.is_in(content["summary"]["status"], pa.array(columns.FAILED))
        if self.job.directory is not None:
            for name, table in content.items():
                metadata = part_metadata(self.job, self.input_hash, name, task)
                content[name] = to_sealed_parquet(table, metadata)
        return TaskResult(task, content, pc.sum(failed).as_py() or 0)

    def compile(self, tasks: Iterable[Task], on_compiled: Callable[[Future], None]) -> None:
        """Begin to compile the programs of some tasks of one stage, in their order."""
        for program, of in groupby(tasks, lambda task: task.part):
            self._compiling(program, range(*next(of).draws)).add_done_callback(on_compiled)

    def close(self) -> None:
        """Drop the compilations that have not begun; the process would wait for them at its end."""
        self._compilers.shutdown(wait=False, cancel_futures=True)

    def _compile(self, program: int, draws: range) -> None:
        batch = self._make_batch(program, draws, blank=True)
        Chunks(batch, tiles_per_chunk=self._tiles_per_chunk).compile()

    def _make_chunks(self, program: int, draws: range) -> Chunks:
        compiling = self._compiling(program, draws)
        batch = self._make_batch(program, draws)  # meanwhile, on another core
        compiling.result()
        return Chunks(batch, tiles_per_chunk=self._tiles_per_chunk)

    def _make_batch(self, program: int, draws: range, *, blank: bool = False) -> Batch:
        """Return a batch; a blank one, to compile for, lacks the truth of a simulation."""
        duplicates, blank = self._duplicates[program], blank and self.job.stored is None
        variants = slice(None) if duplicates is None else duplicates.computed
        return self._scenario.batch(program, draws, variants=variants, blank=blank)


class Executor(NamedTuple):
    """Function that runs tasks, and facts about its machines.

    Attributes:
        run_tasks: yields results in any order. It takes the next task from the iterable only when
            it has room for it, so the caller can stop early.
        facts: manifest entries about the machines of this session.
        local: whether this process runs the tasks, and so compiles their programs.
    """

    run_tasks: Callable[[TaskRunner, Iterable[Task]], Iterator[TaskResult]]
    facts: dict[str, Any]
    local: bool = False


def local_executor() -> Executor:
    """Return an executor on all devices of this process: threads of one program on a CPU."""
    devices = len(jax.devices())
    return Executor(
        lambda runner, tasks: map_in_threads(runner.compute, tasks, devices),
        {"devices": devices},
        local=True,
    )


FIRST_INTERIM = 64
"""Draws at the first interim analysis; each further one doubles them."""


def interim_draws(study: Study) -> list[int]:
    """Return the numbers of draws at the interim analyses; the last is the maximum."""
    ends = [FIRST_INTERIM if study.stop_when else study.n_draws]
    while ends[-1] < study.n_draws:
        ends.append(2 * ends[-1])
    return [*ends[:-1], study.n_draws]


def interim_analysis_columns(study: Study) -> list[str]:
    """Return the columns of the summary that an interim analysis needs, that of its value last."""
    assert study.stop_when is not None
    name = study.stop_when.statistic
    if name == "success_rate":
        return ["run_id", "draw_id", "variant_id", "status"]
    truth = success_criteria(study).from_truth
    bands = {
        f"{columns.settle_column(band).name}_mean": columns.settle_column(band, truth=truth).name
        for band in settling_bands(study)
    }
    return ["run_id", "draw_id", "variant_id", bands[name]]


def widest_half_width(study: Study, table: pa.Table, draws: int) -> float:
    """Return the largest half width over the variants of the statistic's 95 % interval.

    It is infinite if a variant has too few settled runs for an interval. The table has
    `interim_analysis_columns` of the summary in any order, with all runs of the first draws.
    """
    # Late: scipy takes a quarter of a second, and few studies need it.
    from sinsjax import analysis

    rows = table.filter(pc.less(table["draw_id"], draws)).sort_by("run_id")
    column, widest = interim_analysis_columns(study)[-1], 0.0
    for _, runs in analysis.group_rows(rows, ["variant_id"]):
        if column == "status":
            estimate = analysis.share(analysis.numeric_column(runs, "status=ok"))
        else:
            estimate = analysis.mean(analysis.numeric_column(runs, column))
        half = (estimate.high - estimate.low) / 2
        widest = max(widest, math.inf if math.isnan(half) else half)
    return widest
