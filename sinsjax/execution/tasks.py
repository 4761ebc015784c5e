"""A study cut into tasks, and what one task gives: the same on any machine, in any order.

A task is a chunk of runs, a call of the compiled program. How a study is cut depends on the study
and on nothing else, so that a task can be done, lost and done again anywhere.
"""

import hashlib
import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator
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
from sinsjax.engine.batch import Calls, Plan, in_threads, targets
from sinsjax.engine.build import Scenario
from sinsjax.engine.lanes import LANES, Group
from sinsjax.execution import stopping
from sinsjax.execution.tables import Tables
from sinsjax.records.reference import StoredRecord
from sinsjax.study.acting import first_alike
from sinsjax.study.fingerprint import fingerprint
from sinsjax.study.study import Study

_DRAWS_READY = 2**16  # some 30 MB where everything is drawn
_PARTS_READY = 3  # a part has its own increments; threads at the seam of two parts need both


class Job(NamedTuple):
    """What is to be run; all that a worker has to know.

    Attributes:
        study: checked study.
        tape: the record of a recorded study.
        curves: whether curves are kept; None takes the study's word.
        chunk_runs: runs a chunk, rounded to whole tiles, two or more; None leaves it to the study.
    """

    study: Study
    tape: StoredRecord | None = None
    curves: bool | None = None
    chunk_runs: int | None = None

    @property
    def identity(self) -> str:
        """Hex digits that tell the rows that this job gives: of the study and of its record."""
        whole = hashlib.sha256(fingerprint(self.study).encode())
        if self.tape is not None:
            record, reference = self.tape
            arrays = [record.dtheta, record.dv, np.asarray([record.rate_hz])]
            arrays += [] if reference is None else [reference.time_s, reference.attitude_deg]
            for array in arrays:
                whole.update(np.ascontiguousarray(array).data)
        return whole.hexdigest()[:16]


class Task(NamedTuple):
    """A chunk of a study's runs.

    Attributes:
        name: of its files, without extension.
        part: number of the part, see `build`.
        draws: first draw of its group and the one after the last.
        call: number of the call in the group's plan.
        runs: how many it has.
        records: rows of curves a run.
    """

    name: str
    part: int
    draws: tuple[int, int]
    call: int
    runs: int
    records: int


class TaskResult(NamedTuple):
    """Tables of one task.

    Attributes:
        task: whose.
        summary: one row a run.
        curves: one row a run and record time, or None.
        seconds: what it took, without compiling.
    """

    task: Task
    summary: pa.Table
    curves: pa.Table | None
    seconds: float


class EncodedResult(NamedTuple):
    """A task's tables as Parquet files.

    Attributes:
        task: whose.
        files: bytes by the name of the dataset.
        failures: runs that diverged or broke.
        seconds: what the task took, without compiling.
    """

    task: Task
    files: dict[str, bytes]
    failures: int
    seconds: float


class TaskRunner:
    """Does the tasks of a job; every thread may ask it to.

    Attributes:
        job: whose tasks.
        identity: of the job.
        scenario: its study, ready to be run.
        tables: that its rows go into.
    """

    def __init__(self, job: Job) -> None:
        """Check a job, by making its first part.

        Raises:
            InputError: a record that does not fit, or a study that cannot be run.
            RuntimeError: double precision is off.
        """
        self.job = job
        self.scenario = Scenario(job.study, job.tape, curves=job.curves)
        self.tables = Tables(job.study, has_truth=self.scenario.has_truth)
        self._tiles = None if job.chunk_runs is None else -(-job.chunk_runs // LANES)
        self.identity = job.identity
        self._lock = threading.Lock()
        kinds = first_alike(job.study)
        self._alike = [
            find_alike(static, job.study.n_draws, kinds[ids])
            for static, ids in zip(self.scenario.programs, self.scenario.variant_ids, strict=True)
        ]
        self._part = lru_cache(_PARTS_READY)(self._made)
        self._blank = lru_cache(1)(partial(self._made, blank=True))
        self._calls = lru_cache(_PARTS_READY)(self._compile)
        first = self._blocks(self.stages[0])[0]
        if self.scenario.tape is None:
            self._blank(0, first)
        else:
            self._part(0, first)

    @property
    def stages(self) -> list[range]:
        """Draws that are run one after another, with a look at the results between them."""
        ends = stopping.interim_draws(self.job.study)
        return [range(a, b) for a, b in zip([0, *ends], ends, strict=False)]

    def tasks(self) -> list[list[Task]]:
        """The tasks of every stage."""
        study, scenario = self.job.study, self.scenario
        records = [s.records if scenario.curves else 0 for s in scenario.programs]
        before = [0] * len(scenario.programs)
        staged = []
        for stage in self.stages:
            tasks = []
            parts = enumerate(zip(scenario.programs, scenario.variant_ids, strict=True))
            for (part, (static, ids)), draws in product(parts, self._blocks(stage)):
                alike = self._alike[part]
                count = len(ids) if alike is None else len(alike.computed)
                plan = Plan(static, len(draws), count, tiles_a_chunk=self._tiles)
                ends = (draws.start, draws.stop)
                for call in range(len(plan)):
                    name = f"part-{part:04d}-{before[part] + call:06d}"
                    runs = plan.runs(call) if alike is None else alike.runs(plan, call)
                    tasks.append(Task(name, part, ends, call, runs, records[part]))
                before[part] += len(plan)
            staged.append(tasks)
        assert sum(t.runs for tasks in staged for t in tasks) == study.n_draws * study.n_variants
        return staged

    def _blocks(self, stage: range) -> list[range]:
        """The draws of a stage, in groups that fit into memory with all that is drawn for them."""
        if not self.job.study.drawn_keys:
            return [stage]
        firsts = range(stage.start, stage.stop, _DRAWS_READY)
        return [range(first, min(first + _DRAWS_READY, stage.stop)) for first in firsts]

    def do(self, task: Task) -> TaskResult:
        """The tables of one task."""
        with self._lock:  # or every thread would compile
            calls = self._calls(task.part, range(*task.draws))
        ids = self.scenario.variant_ids[task.part]
        since = time.perf_counter()
        chunk = calls.chunk(task.call)
        if alike := self._alike[task.part]:
            chunk = alike.spread(chunk)
        seconds = time.perf_counter() - since
        curves = None if chunk.curves is None else self.tables.curves(chunk, ids)
        return TaskResult(task, self.tables.summary(chunk, ids), curves, seconds)

    def pack(self, task: Task) -> EncodedResult:
        """The Parquet files of one task: the same bytes wherever it is done."""
        result = self.do(task)
        tables = {"summary": result.summary}
        if result.curves is not None:
            tables["curves"] = result.curves
        files = {name: self.parquet(name, table, task) for name, table in tables.items()}
        return EncodedResult(task, files, failures(result.summary), result.seconds)

    def parquet(self, dataset: str, table: pa.Table, task: Task) -> bytes:
        """A table of a task as a Parquet file: the same rows give the same bytes.

        Raises:
            ValueError: the table has not the columns of the dataset.
        """
        made = self.tables
        layout = made.summary_columns if dataset == "summary" else made.curve_columns
        schema = columns.schema(layout)
        marked = table.cast(schema.with_metadata(schema.metadata | self._marks(task)))
        sink = pa.BufferOutputStream()
        # Numbers seldom repeat: coded by a dictionary they are larger, and take thrice as long.
        encoded = {"compression": "zstd", "use_dictionary": False, "write_page_checksum": True}
        pq.write_table(marked, sink, **encoded)
        return sink.getvalue().to_pybytes()

    def _marks(self, task: Task) -> dict[bytes, bytes]:
        """What a part says of itself in its metadata: no time and no host, which would differ."""
        chunk = {**task._asdict(), "chunk_runs": self.job.chunk_runs}
        del chunk["records"]
        return {
            b"sinsjax.study": self.identity.encode(),
            b"sinsjax.chunk": json.dumps(chunk).encode(),
        }

    def _made(self, number: int, draws: range, *, blank: bool = False) -> Group:
        alike = self._alike[number]
        variants = None if alike is None else alike.computed
        return self.scenario.part(number, draws, variants=variants, blank=blank).group

    def _compile(self, part: int, draws: range) -> Calls:
        if self.scenario.tape is not None:
            return Calls(self._part(part, draws), tiles_a_chunk=self._tiles)
        blank = self._blank(part, draws)
        engine = Calls(blank, tiles_a_chunk=self._tiles)
        with ThreadPoolExecutor(1) as beside:
            compiling = beside.submit(engine.compile)
            made = self._part(part, draws)  # XLA takes another core for its truth
            compiling.result()
        return Calls(made, tiles_a_chunk=self._tiles)


def failures(summary: pa.Table) -> int:
    """How many runs of a summary diverged, or ended in no number."""
    status = summary["status"].to_pylist()
    return status.count("diverged") + status.count("nonfinite")


class Executor(NamedTuple):
    """Who does tasks.

    Attributes:
        do: hands tasks back when they are done, in any order. It takes the next one from the
            iterable when it has a place for it, and no more once the iterable ends.
        facts: what the manifest says of this session's machines.
    """

    do: Callable[[TaskRunner, Iterable[Task]], Iterator[EncodedResult]]
    facts: dict[str, Any]


def on_this_machine() -> Executor:
    """All devices of this process: on a CPU threads over one program, else a program each."""
    devices = len(jax.devices())
    are = "threads over one program" if len(targets()) == 1 else "devices with a program each"
    return Executor(
        lambda runner, tasks: in_threads(runner.pack, tasks, devices),
        {"devices": devices, "devices_are": are},
    )
