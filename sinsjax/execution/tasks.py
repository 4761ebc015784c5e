"""Division of a study into tasks, each with the same result on any machine and in any order.

A task is one chunk of runs, computed by one call of the compiled program. The division depends only
on the study, so that a task can be repeated anywhere.
"""

import hashlib
import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from itertools import product
from typing import Any, NamedTuple

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from sinsjax import columns
from sinsjax.engine.alike import find_alike
from sinsjax.engine.batch import Plan, in_threads, targets
from sinsjax.engine.build import Scenario
from sinsjax.engine.lanes import LANES, Group
from sinsjax.execution import stopping
from sinsjax.execution.linearity import Linearity
from sinsjax.execution.outputs import Output, outputs_of
from sinsjax.records.reference import StoredRecord
from sinsjax.study.acting import first_alike
from sinsjax.study.fingerprint import fingerprint, with_draws
from sinsjax.study.study import Study

_DRAWS_READY = 2**16  # about 30 MB if everything is drawn
_PARTS_READY = 3  # a part has its own increments; threads at the border of two parts need both


class Job(NamedTuple):
    """All that a worker needs to run a study.

    Attributes:
        study: checked study.
        stored: the record of a recorded study.
        curves: whether to keep curves; None follows the study.
        chunk_runs: runs per chunk, rounded to two or more whole tiles; None for the default.
        extended_at: numbers of draws that its results had before each extension, ascending.
    """

    study: Study
    stored: StoredRecord | None = None
    curves: bool | None = None
    chunk_runs: int | None = None
    extended_at: tuple[int, ...] = ()

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
        runs: number of runs; 0 where it concludes from those of others.
        rows: names of the datasets that it writes and their rows, in that order.
        rounds: of sampled errors that an expectation is made of.
    """

    name: str
    part: int
    draws: tuple[int, int]
    call: int
    runs: int
    rows: tuple[tuple[str, int], ...]
    rounds: int = 1


class TaskResult(NamedTuple):
    """Tables of one task.

    Attributes:
        task: the task.
        tables: by dataset.
        seconds: time taken without compilation, s.
    """

    task: Task
    tables: dict[str, pa.Table]
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


class _Part(NamedTuple):
    """A part of the study, and what becomes of it."""

    output: Output
    number: int


class TaskRunner:
    """Thread-safe runner of a job's tasks.

    Its parts are those of the study (`build`) for each of the study's outputs.

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
        outputs, programs = outputs_of(self.scenario), self.scenario.programs
        self.layouts = {name: layout for o in outputs for name, layout in o.layouts.items()}
        self._parts = [_Part(o, n) for o in outputs for n in range(len(programs))]
        self._concluding = len(programs) if len(outputs) > 1 else 0
        self._programs = [part.output.program(programs[part.number]) for part in self._parts]
        self._linearity = Linearity(self.scenario) if job.study.checks_linearity else None
        self._tiles = None if job.chunk_runs is None else -(-job.chunk_runs // LANES)
        self.identity = job.identity
        self._lock = threading.Lock()
        kinds = first_alike(job.study)
        self._alike = [
            None
            if self._concluding  # runs of blocks, and few estimates
            else find_alike(static, job.first_draws, kinds[self._ids(number)])
            for number, static in enumerate(self._programs)
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
        study, before = self.job.study, [0] * len(self._parts)
        staged = []
        for stage in self.stages:
            tasks: list[Task] = []
            parts = range(len(self._parts) - self._concluding)
            for part, draws in product(parts, self._blocks(stage)):
                new = self._cut(part, draws, before[part])
                before[part] += len(new)
                tasks += new
            staged.append(tasks)
        assert sum(t.runs for tasks in staged for t in tasks) == study.n_draws * study.n_variants
        return staged

    def concluding_tasks(self) -> list[Task]:
        """The tasks that conclude from the runs of all others, see `conclusion`."""
        parts = range(len(self._parts) - self._concluding, len(self._parts))
        tasks = (task for part in parts for task in self._cut(part, range(1), 0))
        return [task._replace(runs=0) for task in tasks]

    def _cut(self, part: int, draws: range, before: int) -> list[Task]:
        """Tasks of some draws of a part, after so many."""
        output, alike = self._parts[part].output, self._alike[part]
        count = len(self._ids(part)) if alike is None else len(alike.computed)
        static, tasks = self._programs[part], []
        plan = output.plan(static, len(draws), count, self._tiles)
        for call in range(len(plan)):
            runs = plan.runs(call)
            if alike is not None:
                assert isinstance(plan, Plan)
                runs = alike.runs(plan, call)
            records = {name: static.records if name == "curves" else 1 for name in output.layouts}
            rows = tuple((name, runs * each) for name, each in records.items())
            name = f"part-{part:04d}-{before + call:06d}"
            tasks.append(Task(name, part, (draws.start, draws.stop), call, runs, rows))
        return tasks

    def _ids(self, part: int) -> np.ndarray:
        """Numbers of a part's variants in the study."""
        return self.scenario.variant_ids[self._parts[part].number]

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
        ids, output = self._ids(task.part), self._parts[task.part].output
        since = time.perf_counter()
        chunk = calls.chunk(task.call)
        if alike := self._alike[task.part]:
            chunk = alike.spread(chunk)
        tables = output.tables(chunk, ids)
        if task.rounds > 1:
            from sinsjax.execution import controlled  # late, as all that needs scipy

            more = (calls.chunk(task.call, round_) for round_ in range(1, task.rounds))
            made = [tables["estimates"], *(output.tables(c, ids)["estimates"] for c in more)]
            tables = {"estimates": controlled.pooled(self.job.study, made)}
        if self._linearity:
            number = self._parts[task.part].number
            tables = {"estimates": self._linearity.checked(number, tables["estimates"])}
        return TaskResult(task, tables, time.perf_counter() - since)

    def failures(self, task: Task, tables: Mapping[str, pa.Table]) -> int:
        """Number of runs of a task that diverged or became non-finite."""
        return self._parts[task.part].output.failures(tables)

    def variants(self, task: Task) -> np.ndarray:
        """Numbers of the variants of a concluding task."""
        output, ids = self._parts[task.part].output, self._ids(task.part)
        plan = output.plan(self._programs[task.part], 1, len(ids), self._tiles)
        assert isinstance(plan, Plan)
        return ids[plan.busy(task.call)[1]]

    def pack(self, task: Task) -> EncodedResult:
        """Compute the Parquet files of one task: the same bytes on any machine."""
        return self.encoded(self.do(task))

    def encoded(self, result: TaskResult) -> EncodedResult:
        """The Parquet files of a result."""
        task, tables = result.task, result.tables
        files = {name: self.parquet(name, table, task) for name, table in tables.items()}
        return EncodedResult(task, files, self.failures(task, tables), result.seconds)

    def decoded(self, encoded: EncodedResult) -> TaskResult:
        """The tables of Parquet files."""
        files = encoded.files.items()
        tables = {name: pq.read_table(pa.BufferReader(content)) for name, content in files}
        return TaskResult(encoded.task, tables, encoded.seconds)

    def parquet(self, dataset: str, table: pa.Table, task: Task) -> bytes:
        """A table of a task as a Parquet file: the same rows give the same bytes.

        Raises:
            ValueError: the table lacks columns of the dataset.
        """
        schema = columns.schema(self.layouts[dataset])
        marked = table.cast(schema.with_metadata(schema.metadata | self._marks(task)))
        sink = pa.BufferOutputStream()
        # Numbers seldom repeat: a dictionary would make them larger and three times as slow.
        encoded = {"compression": "zstd", "use_dictionary": False, "write_page_checksum": True}
        pq.write_table(marked, sink, **encoded)
        return sink.getvalue().to_pybytes()

    def _marks(self, task: Task) -> dict[bytes, bytes]:
        """Metadata of a part, without time or host name, which would change its bytes."""
        chunk = {**task._asdict(), "chunk_runs": self.job.chunk_runs}
        del chunk["rows"], chunk["rounds"]
        if before := [end for end in self.job.extended_at if end <= task.draws[0]]:
            chunk["extended_at"] = before
        return {
            b"sinsjax.study": self.identity.encode(),
            b"sinsjax.chunk": json.dumps(chunk).encode(),
        }

    def _made(self, number: int, draws: range, *, blank: bool = False) -> Group:
        alike = self._alike[number]
        variants = None if alike is None else alike.computed
        output, of_study = self._parts[number]
        part = self.scenario.part(of_study, draws, variants=variants, blank=blank)
        return output.group(part.group)

    def _compile(self, part: int, draws: range) -> Any:
        output = self._parts[part].output
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
        do: yields results in any order. It takes the next task from the iterable only when it has
            room for it, so that the caller can stop early.
        facts: manifest entries about the machines of this session.
    """

    do: Callable[[TaskRunner, Iterable[Task]], Iterator[EncodedResult]]
    facts: dict[str, Any]


def on_this_machine() -> Executor:
    """Executor on all devices of this process: threads of one program on a CPU."""
    devices = len(jax.devices())
    are = "threads over one program" if len(targets()) == 1 else "devices with a program each"
    return Executor(
        lambda runner, tasks: in_threads(runner.pack, tasks, devices),
        {"devices": devices, "devices_are": are},
    )
