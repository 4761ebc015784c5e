"""The results of a job as its chunks are computed: a directory of Parquet parts, or tables.

Every file of a directory is written under a temporary name, synced and renamed, so a sweep killed
at any point leaves only complete parts. A part carries its own checksum, study and chunk: it counts
whether or not the manifest lists it yet.
"""

import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import pyarrow as pa
import pyarrow.parquet as pq

from sinsjax import columns
from sinsjax.errors import InputError
from sinsjax.execution import directory as places
from sinsjax.execution import resume as resuming
from sinsjax.execution.directory import DATASETS, MANIFEST, STUDY, find_manifest
from sinsjax.execution.results import part_marks
from sinsjax.execution.sealed import sealed_json
from sinsjax.execution.tasks import EncodedResult, Task, TaskResult, TaskRunner
from sinsjax.platform.files import atomic_write, read_regular_file, unwritable_message
from sinsjax.study.identity import fingerprint, sections_of
from sinsjax.study.load import study_to_toml

_MANIFEST_SHARE = 0.05  # largest share of the time spent on writing manifests
_MANIFEST_EVERY_S = 1.0  # least interval: writing manifests blocks the threads
_OF_ALL = ("versions", "instructions", "devices", "devices_are")
"""Entries of the last session that are repeated for the whole directory."""


@runtime_checkable
class Sink(Protocol):
    """Where the results of a job are put."""

    place: str

    def missing(self, tasks: Iterable[Task]) -> list[Task]:
        """Return the tasks whose results are not stored yet."""
        ...

    def add(self, result: Any) -> None:
        """Add the result of one task."""
        ...

    def summary(self, names: list[str]) -> pa.Table:
        """Return some columns of all stored rows of the summary."""
        ...

    def finish(self, state: str, **facts: Any) -> None:
        """Record that the job is "complete" or "interrupted"."""
        ...


class MemoryStore:
    """The tables of a job in memory.

    Attributes:
        place: words for where results are.
    """

    place = "memory"

    def __init__(self) -> None:
        self._tables: dict[str, list[pa.Table]] = {}

    def missing(self, tasks: Iterable[Task]) -> list[Task]:
        """Return all tasks."""
        return list(tasks)

    def add(self, result: TaskResult) -> None:
        """Add the tables of one task."""
        for name, table in result.tables.items():
            self._tables.setdefault(name, []).append(table)

    def summary(self, names: list[str]) -> pa.Table:
        """Return some columns of all rows of the summary."""
        return self.tables()["summary"].select(names)

    def finish(self, state: str, **facts: Any) -> None:
        """Nothing remains to be done."""

    def tables(self) -> dict[str, pa.Table]:
        """Return the rows of all tasks by dataset, in any order."""
        return {name: pa.concat_tables(tables) for name, tables in self._tables.items()}


class Store:
    """The only writer of a results directory.

    Attributes:
        directory: results directory.
        place: words for where results are.
    """

    def __init__(self, runner: TaskRunner, facts: dict[str, Any] | None = None) -> None:
        """Lock and prepare the directory of a job.

        Args:
            runner: task runner of the job.
            facts: manifest entries about the machines of this session.

        Raises:
            InputError: the directory cannot be written, has another writer, or had one since the
                job was prepared.
        """
        job = runner.job
        assert job.directory is not None
        self.directory, self.place = job.directory, str(job.directory)
        self._runner = runner
        self._session = {**(facts or {}), "started_unix_s": round(time.time(), 3)}
        self._since = time.monotonic()
        self._facts: dict[str, Any] = {}
        self._chunks: dict[str, dict[str, Any]] = {}
        self._sessions: list[dict[str, Any]] = []
        self._planned: list[Task] = []
        self._next_manifest = 0.0
        self._lock = places.lock(self.directory)
        try:
            self._begin()
        except BaseException:
            self.release()
            raise

    def _begin(self) -> None:
        job = self._runner.job
        if resuming.state_of(self.directory) != job.seen:
            raise InputError(f"{self.directory}: another process has just written there")
        _remove(places.stale_temporary_files(self.directory))
        if not job.resume:
            _remove(places.owned_files(self.directory))
        if job.resume and (known := find_manifest(self.directory)):
            self._sessions = [session.model_dump() for session in known.sessions]
            self._chunks = {c.name: c.model_dump() for c in known.chunks if c.state == "done"}
        else:
            # First, so that the files of a killed run are recognised as results.
            self._write_manifest("running")
            self._write_study()

    def _write_study(self) -> None:
        _write(self.directory / STUDY, study_to_toml(self._runner.job.study).encode())

    def release(self) -> None:
        """Unlock the directory."""
        self._lock.release()

    def missing(self, tasks: Iterable[Task]) -> list[Task]:
        """Return the tasks without complete parts; remove parts of unknown or incomplete tasks.

        Args:
            tasks: all tasks of the study.

        Raises:
            InputError: the directory cannot be written.
        """
        self._planned = list(tasks)
        missing = []
        for task in self._planned:
            if self._is_stored(task):
                seconds = self._chunks.get(task.name, {}).get("seconds")
                self._chunks[task.name] = self._entry(task, seconds)
            else:
                self._chunks.pop(task.name, None)
                missing.append(task)
        known = {task.name for task in self._planned}
        self._chunks = {name: c for name, c in self._chunks.items() if name in known}
        parts = (path for name in DATASETS for path in places.list_parts(self.directory, name))
        _remove(path for path in parts if path.stem not in self._chunks)
        self._write_manifest("running")
        self._write_study()  # last: an extension not yet in the manifest can be requested again
        return missing

    def add(self, result: EncodedResult) -> None:
        """Write the parts of one task.

        Raises:
            InputError: the directory cannot be written.
        """
        for dataset, _ in result.task.rows:
            path = self._path(dataset, result.task)
            try:
                path.parent.mkdir(exist_ok=True)
            except OSError as error:
                raise InputError(unwritable_message(path, error)) from error
            _write(path, result.files[dataset])
        self._chunks[result.task.name] = self._entry(result.task, round(result.seconds, 4))
        if time.monotonic() >= self._next_manifest:
            self._write_manifest("running")

    def summary(self, names: list[str]) -> pa.Table:
        """Return some columns of all stored rows of the summary."""
        done = (task for task in self._planned if task.name in self._chunks)
        paths = [self._path("summary", task) for task in done]
        return pa.concat_tables([pq.ParquetFile(path).read(columns=names) for path in paths])

    def finish(self, state: str, **facts: Any) -> None:
        """Write the last manifest of this session.

        Args:
            state: "complete" or "interrupted".
            facts: further entries.
        """
        self._facts |= facts
        if state == "complete":  # tasks that [stop_when] skipped are not missing
            self._planned = [task for task in self._planned if task.name in self._chunks]
        self._write_manifest(state)

    def _path(self, dataset: str, task: Task) -> Path:
        return self.directory / dataset / f"{task.name}.parquet"

    def _entry(self, task: Task, seconds: float | None) -> dict[str, Any]:
        """Manifest entry of a task with complete parts."""
        files = [
            {"file": f"{dataset}/{task.name}.parquet", "rows": rows} for dataset, rows in task.rows
        ]
        done = {"name": task.name, "state": "done", "runs": task.runs, "seconds": seconds}
        return done | {"files": files}

    def _is_stored(self, task: Task) -> bool:
        """Whether all parts of a task are complete and intact."""
        for dataset, _ in task.rows:
            try:
                content = read_regular_file(self._path(dataset, task))
            except (OSError, InputError):
                return False
            if part_marks(content) != self._runner.marks(dataset, task):
                return False
        return True

    def _write_manifest(self, state: str) -> None:
        began = time.monotonic()
        job = self._runner.job
        study = job.study
        this = self._session | {"wall_s": round(began - self._since, 3)}
        sessions = [*self._sessions, this]
        chunks = [
            self._chunks.get(t.name, {"name": t.name, "state": "missing", "runs": t.runs})
            for t in self._planned
        ]
        record = None if job.stored is None else job.stored.record
        content = sealed_json(
            {
                "schema": columns.SCHEMA_VERSION,
                "state": state,
                "fingerprint": fingerprint(study),
                "identity": self._runner.identity,
                "seed": study.seed,
                "runs": study.n_draws * study.n_variants,
                "runs_done": sum(chunk["runs"] for chunk in self._chunks.values()),
                "curves": self._runner.scenario.curves,
                "chunk_runs": job.chunk_runs,
                **({"extended_at": job.extended_at} if job.extended_at else {}),
                "config": job.source,
                "record": None if record is None else Path(record.source).name,
                "record_latitude_deg": None if record is None else record.latitude_deg,
                "warnings": job.warnings,
                **self._facts,
                "started_unix_s": sessions[0]["started_unix_s"],
                "wall_s": round(sum(session["wall_s"] for session in sessions), 3),
                **{key: this[key] for key in _OF_ALL if key in this},
                "sessions": sessions,
                "study": sections_of(study),
                "chunks": chunks,
            }
        )
        _write(self.directory / MANIFEST, content)
        ended = time.monotonic()
        wait_s = max(_MANIFEST_EVERY_S, (ended - began) / _MANIFEST_SHARE)
        self._next_manifest = ended + wait_s


def _write(path: Path, content: bytes) -> None:
    with atomic_write(path) as file:
        file.write(content)


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink()
        except OSError as error:
            raise InputError(unwritable_message(path, error)) from error
