"""Storage of a job's results in a directory while its chunks are computed.

Every file of a directory is written under a temporary name, synced and renamed, so a sweep killed
at any point leaves only complete parts. A part contains its own checksum, study and chunk, so it is
valid whether or not the manifest lists it yet.
"""

import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sinsjax import columns
from sinsjax.errors import InputError
from sinsjax.execution import directory as results_directory
from sinsjax.execution import resume as resuming
from sinsjax.execution.directory import DATASETS, MANIFEST, STUDY, find_manifest
from sinsjax.execution.results import read_part_metadata
from sinsjax.execution.sealed import to_sealed_json
from sinsjax.execution.tasks import Task, TaskResult, TaskRunner
from sinsjax.platform.files import atomic_write, read_regular_file, unwritable_message
from sinsjax.study.identity import fingerprint, sections_to_json
from sinsjax.study.load import study_to_toml

_MANIFEST_SHARE = 0.05  # largest share of the time for writing manifests
_MANIFEST_EVERY_S = 1.0  # least interval: writing manifests blocks the threads
_SESSION_ENTRIES = ("versions", "instructions", "devices", "devices_are")
"""Entries of the last session that are repeated for the whole directory."""


class DirectoryStore:
    """The only writer of a results directory.

    Attributes:
        directory: results directory.
        place: location of the results, as text.
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
        self._start_s = time.monotonic()
        self._facts: dict[str, Any] = {}
        self._chunks: dict[str, dict[str, Any]] = {}
        self._sessions: list[dict[str, Any]] = []
        self._planned: list[Task] = []
        self._next_manifest = 0.0
        self._lock = results_directory.lock_directory(self.directory)
        try:
            self._prepare_directory()
        except BaseException:
            self.unlock()
            raise

    def _prepare_directory(self) -> None:
        job = self._runner.job
        if resuming.manifest_state(self.directory) != job.manifest_state:
            raise InputError(
                f"{self.directory}: another process has just written there (run again)"
            )
        _remove_files(results_directory.stale_temp_files(self.directory))
        if not job.resume:
            _remove_files(results_directory.owned_files(self.directory))
        if job.resume and (manifest := find_manifest(self.directory)):
            self._sessions = [session.model_dump() for session in manifest.sessions]
            self._chunks = {c.name: c.model_dump() for c in manifest.chunks if c.state == "done"}
        else:
            # First, to mark the files of a killed run as results.
            self._write_manifest("running")
            self._write_study()

    def _write_study(self) -> None:
        _write_file(self.directory / STUDY, study_to_toml(self._runner.job.study).encode())

    def unlock(self) -> None:
        """Unlock the directory."""
        self._lock.release()

    def missing_tasks(self, tasks: Iterable[Task]) -> list[Task]:
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
                self._chunks[task.name] = self._chunk_entry(task, seconds)
            else:
                self._chunks.pop(task.name, None)
                missing.append(task)
        known = {task.name for task in self._planned}
        self._chunks = {name: c for name, c in self._chunks.items() if name in known}
        parts = (
            path for name in DATASETS for path in results_directory.list_parts(self.directory, name)
        )
        _remove_files(path for path in parts if path.stem not in self._chunks)
        self._write_manifest("running")
        self._write_study()  # last: an extension missing in the manifest can be requested again
        return missing

    def add_result(self, result: TaskResult) -> None:
        """Write the parts of one task.

        Raises:
            InputError: the directory cannot be written.
        """
        for dataset, _ in result.task.rows:
            path = self._part_path(dataset, result.task)
            try:
                path.parent.mkdir(exist_ok=True)
            except OSError as error:
                raise InputError(unwritable_message(path, error)) from error
            _write_file(path, result.content[dataset])
        self._chunks[result.task.name] = self._chunk_entry(result.task, round(result.seconds, 4))
        if time.monotonic() >= self._next_manifest:
            self._write_manifest("running")

    def read_summary(self, names: list[str]) -> pa.Table:
        """Return some columns of all stored rows of the summary."""
        done = (task for task in self._planned if task.name in self._chunks)
        paths = [self._part_path("summary", task) for task in done]
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

    def _part_path(self, dataset: str, task: Task) -> Path:
        return self.directory / dataset / f"{task.name}.parquet"

    def _chunk_entry(self, task: Task, seconds: float | None) -> dict[str, Any]:
        """Return the manifest entry of a task with complete parts."""
        files = [
            {"file": f"{dataset}/{task.name}.parquet", "rows": rows} for dataset, rows in task.rows
        ]
        entry = {"name": task.name, "state": "done", "runs": task.runs, "seconds": seconds}
        return entry | {"files": files}

    def _is_stored(self, task: Task) -> bool:
        """Return whether all parts of a task are complete and intact."""
        for dataset, _ in task.rows:
            try:
                content = read_regular_file(self._part_path(dataset, task))
            except (OSError, InputError):
                return False
            if read_part_metadata(content) != self._runner.part_metadata(dataset, task):
                return False
        return True

    def _write_manifest(self, state: str) -> None:
        began = time.monotonic()
        job = self._runner.job
        study = job.study
        current_session = self._session | {"wall_s": round(began - self._start_s, 3)}
        sessions = [*self._sessions, current_session]
        chunks = [
            self._chunks.get(t.name, {"name": t.name, "state": "missing", "runs": t.runs})
            for t in self._planned
        ]
        record = None if job.stored is None else job.stored.record
        content = to_sealed_json(
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
                **{key: current_session[key] for key in _SESSION_ENTRIES if key in current_session},
                "sessions": sessions,
                "study": sections_to_json(study),
                "chunks": chunks,
            }
        )
        _write_file(self.directory / MANIFEST, content)
        ended = time.monotonic()
        wait_s = max(_MANIFEST_EVERY_S, (ended - began) / _MANIFEST_SHARE)
        self._next_manifest = ended + wait_s


def _write_file(path: Path, content: bytes) -> None:
    with atomic_write(path) as file:
        file.write(content)


def _remove_files(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink()
        except OSError as error:
            raise InputError(unwritable_message(path, error)) from error
