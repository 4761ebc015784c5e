"""Division of a study into tasks, each with the same result on any machine and in any order.

A task is one chunk of runs, computed by one call of the compiled program. The division depends only
on the study, so that a task can be repeated anywhere.
"""

import hashlib
import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pyarrow as pa

from sinsjax import columns
from sinsjax.engine.alike import find_alike
from sinsjax.engine.batch import Calls, in_threads, targets
from sinsjax.engine.build import Scenario
from sinsjax.engine.lanes import LANES, Group
from sinsjax.execution import results, sealed, stopping
from sinsjax.execution.directory import FileState
from sinsjax.execution.forecast import Forecast
from sinsjax.execution.linearity import Linearity
from sinsjax.execution.outputs import output_of
from sinsjax.records.reference import StoredRecord
from sinsjax.study.identity import fingerprint, with_draws
from sinsjax.study.study import Study

_DRAWS_READY = 2**16  # about 30 MB if everything is drawn
_PARTS_READY = 3  # a part has its own increments; threads at the border of two parts need both


class Job(NamedTuple):
    """A study that is ready to run, see `prepare.prepare`.

    Attributes:
        study: checked study, at the rate of its record.
        stored: the record of a recorded study.
        curves: whether to keep curves; None follows the study.
        chunk_runs: runs per chunk, rounded to two or more whole tiles; None for the default.
        extended_at: numbers of draws that its results had before each extension, ascending.
        directory: results directory; None for tables in memory.
        overwrite: whether existing results are removed.
        resume: whether existing results are continued.
        seen: state of the directory's manifest when it was checked.
        source: the study's file, or words for it.
        warnings: doubts about the study or its record, one line each.
        notes: what a user should know beside that, one line each.
        forecast: expected runs, time, memory and disk space.
    """

    study: Study
    stored: StoredRecord | None = None
    curves: bool | None = None
    chunk_runs: int | None = None
    extended_at: tuple[int, ...] = ()
    directory: Path | None = None
    overwrite: bool = False
    resume: bool = False
    seen: FileState | None = None
    source: str | None = None
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    forecast: Forecast | None = None

    @property
    def first_draws(self) -> int:
        """Number of draws that its results began with."""
        return min((*self.extended_at, self.study.n_draws))

    @property
    def identity(self) -> str:
        """Hash of everything that determines the rows: the study and its record, as hex digits.

        It stays the same when the study is extended.
        """
        study = with_draws(self.study, self.first_draws) if self.extended_at else self.study
        whole = hashlib.sha256(fingerprint(study).encode())
        if self.stored is not None:
            record, reference = self.stored
            arrays = [record.dtheta, record.dv, np.asarray([record.rate_hz])]
            arrays += [] if reference is None else [reference.time_s, reference.attitude_deg]
            for array in arrays:
                whole.update(np.ascontiguousarray(array).data)
        return whole.hexdigest()[:16]


class Task(NamedTuple):
    """A chunk of a study's runs.

    Attributes:
        name: name of its files, without extension.
        part: number of the part, see `TaskRunner`.
        draws: first draw of its group and the one after the last.
        call: number of the call in the group's plan.
        runs: number of runs.
        rows: names of the datasets that it writes and their rows, in that order.
    """

    name: str
    part: int
    draws: tuple[int, int]
    call: int
    runs: int
    rows: tuple[tuple[str, int], ...]


class TaskResult(NamedTuple):
    """Tables of one task.

    Attributes:
        task: the task.
        tables: by dataset.
        failures: runs that diverged or became non-finite.
        seconds: time taken without compilation, s.
    """

    task: Task
    tables: dict[str, pa.Table]
    failures: int
    seconds: float


class EncodedResult(NamedTuple):
    """A task's tables as Parquet files.

    Attributes:
        task: the task.
        files: contents by the name of the dataset.
        failures: runs that diverged or became non-finite.
        seconds: time taken without compilation, s.
    """

    task: Task
    files: dict[str, bytes]
    failures: int
    seconds: float


class TaskRunner:
    """Thread-safe runner of a job's tasks.

    Its parts are those of the study (`build`).

    Attributes:
        job: the job.
        identity: hash that identifies the job.
        scenario: the study, ready to run.
        layouts: columns of all datasets.
    """

    def __init__(self, job: Job) -> None:
        """Check a job by building its first part.

        Raises:
            InputError: the record does not fit, or the study cannot be run.
        """
        self.job = job
        self.scenario = Scenario(job.study, job.stored, curves=job.curves)
        self._output = output_of(self.scenario)
        self.layouts = self._output.layouts
        self._programs = [self._output.program(static) for static in self.scenario.programs]
        self._linearity = Linearity(self.scenario) if job.study.checks_linearity else None
        self._tiles = None if job.chunk_runs is None else -(-job.chunk_runs // LANES)
        self.identity = job.identity
        self._lock = threading.Lock()
        kinds = job.study.duplicate_of
        self._alike = [
            find_alike(static, job.first_draws, kinds[ids])
            for static, ids in zip(self._programs, self.scenario.variant_ids, strict=True)
        ]
        self._part = lru_cache(_PARTS_READY)(self._made)
        self._blank = lru_cache(1)(partial(self._made, blank=True))
        self._calls = lru_cache(_PARTS_READY)(self._compile)
        first = self._blocks(self.stages[0])[0]
        if self.scenario.stored is None:
            self._blank(0, first)
        else:
            self._part(0, first)

    @property
    def stages(self) -> list[range]:
        """Ranges of draws, to each interim analysis and extension; one changes no other's tasks."""
        ends = sorted({*stopping.interim_draws(self.job.study), *self.job.extended_at})
        return [range(a, b) for a, b in zip([0, *ends], ends, strict=False)]

    def tasks(self) -> list[list[Task]]:
        """The tasks of every stage."""
        study, before = self.job.study, [0] * len(self._programs)
        staged = []
        for stage in self.stages:
            tasks: list[Task] = []
            for part, draws in product(range(len(self._programs)), self._blocks(stage)):
                new = self._cut(part, draws, before[part])
                before[part] += len(new)
                tasks += new
            staged.append(tasks)
        assert sum(t.runs for tasks in staged for t in tasks) == study.n_draws * study.n_variants
        return staged

    def _cut(self, part: int, draws: range, before: int) -> list[Task]:
        """Tasks of some draws of a part, after so many."""
        alike, ids = self._alike[part], self.scenario.variant_ids[part]
        count = len(ids) if alike is None else len(alike.computed)
        static, tasks = self._programs[part], []
        plan = self._output.plan(static, len(draws), count, self._tiles)
        for call in range(len(plan)):
            runs = plan.runs(call) if alike is None else alike.runs(plan, call)
            records = {name: static.records if name == "curves" else 1 for name in self.layouts}
            rows = tuple((name, runs * each) for name, each in records.items())
            name = f"part-{part:04d}-{before + call:06d}"
            tasks.append(Task(name, part, (draws.start, draws.stop), call, runs, rows))
        return tasks

    def _blocks(self, stage: range) -> list[range]:
        """The draws of a stage in groups that fit in memory with their drawn values."""
        if not self.job.study.drawn_keys:
            return [stage]
        firsts = range(stage.start, stage.stop, _DRAWS_READY)
        return [range(first, min(first + _DRAWS_READY, stage.stop)) for first in firsts]

    def do(self, task: Task) -> TaskResult:
        """Compute the tables of one task."""
        with self._lock:  # otherwise every thread would compile
            calls = self._calls(task.part, range(*task.draws))
        since = time.perf_counter()
        chunk = calls.chunk(task.call)
        if alike := self._alike[task.part]:
            chunk = alike.spread(chunk)
        tables = self._output.tables(chunk, self.scenario.variant_ids[task.part])
        if self._linearity:
            tables = {"estimates": self._linearity.checked(task.part, tables["estimates"])}
        seconds = time.perf_counter() - since
        return TaskResult(task, tables, self._output.failures(tables), seconds)

    def pack(self, task: Task) -> EncodedResult:
        """Compute the Parquet files of one task: the same bytes on any machine."""
        _, tables, failures, seconds = self.do(task)
        files = {name: self.parquet(name, table, task) for name, table in tables.items()}
        return EncodedResult(task, files, failures, seconds)

    def parquet(self, dataset: str, table: pa.Table, task: Task) -> bytes:
        """Return a table of a task as a sealed Parquet file: the same rows give the same bytes.

        Raises:
            ValueError: the table lacks columns of the dataset.
        """
        schema = columns.arrow_schema(self.layouts[dataset])
        return sealed.sealed_parquet(table.cast(schema), self.marks(dataset, task))

    def marks(self, dataset: str, task: Task) -> dict[str, str]:
        """Return the metadata of a part, without time or host, which would change its bytes."""
        chunk: dict[str, Any] = {"dataset": dataset, **task._asdict()}
        chunk |= {"rows": dict(task.rows)[dataset], "chunk_runs": self.job.chunk_runs}
        if before := [end for end in self.job.extended_at if end <= task.draws[0]]:
            chunk["extended_at"] = before
        return {results.STUDY_MARK: self.identity, results.CHUNK_MARK: json.dumps(chunk)}

    def _made(self, number: int, draws: range, *, blank: bool = False) -> Group:
        alike = self._alike[number]
        variants = None if alike is None else alike.computed
        part = self.scenario.part(number, draws, variants=variants, blank=blank)
        return self._output.group(part.group)

    def _compile(self, part: int, draws: range) -> Calls:
        output = self._output
        if self.scenario.stored is not None:
            return output.calls(self._part(part, draws), self._tiles)
        engine = output.calls(self._blank(part, draws), self._tiles)
        with ThreadPoolExecutor(1) as beside:
            compiling = beside.submit(engine.compile)
            made = self._part(part, draws)  # meanwhile, on another core
            compiling.result()
        return output.calls(made, self._tiles)


class Executor(NamedTuple):
    """A means of running tasks.

    Attributes:
        do: yields results in any order, as Parquet files for a directory. It takes the next task
            from the iterable only when it has room for it, so that the caller can stop early.
        facts: manifest entries about the machines of this session.
    """

    do: Callable[[TaskRunner, Iterable[Task]], Iterator[Any]]
    facts: dict[str, Any]


def on_this_machine() -> Executor:
    """Executor on all devices of this process: threads of one program on a CPU."""
    devices = len(jax.devices())
    are = "threads over one program" if len(targets()) == 1 else "devices with a program each"
    return Executor(
        lambda runner, tasks: in_threads(runner.pack, tasks, devices),
        {"devices": devices, "devices_are": are},
    )


def in_memory() -> Executor:
    """Return an executor on all devices of this process whose results are tables."""
    return Executor(lambda runner, tasks: in_threads(runner.do, tasks, len(jax.devices())), {})
