"""Streaming of a study's results to a directory, without losing or duplicating any.

Every file is written under a temporary name, synced and renamed, so a sweep killed at any point
leaves only complete parts. A part is verified by its own metadata and page checksums, which take
precedence over the manifest. The operating system releases the lock when the process ends.
"""

import hashlib
import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sinsjax import columns
from sinsjax.errors import InputError
from sinsjax.execution import belongings, locking
from sinsjax.execution import resume as resuming
from sinsjax.execution.belongings import DATASETS
from sinsjax.execution.parts import MANIFEST
from sinsjax.execution.tasks import EncodedResult, Job, Task, TaskRunner
from sinsjax.platform.files import replacing, unwritable
from sinsjax.study.fingerprint import fingerprint
from sinsjax.study.load import study_to_toml

_MANIFEST_SHARE = 0.05  # largest share of the time spent on writing manifests
_MANIFEST_EVERY_S = 1.0  # least interval: writing manifests blocks the threads
_OF_ALL = ("versions", "instructions", "devices", "devices_are")
"""Entries of the last session that are repeated for the whole directory."""


class Store:
    """The only writer of a results directory.

    Attributes:
        directory: results directory.
    """

    def __init__(
        self,
        directory: Path,
        runner: TaskRunner,
        *,
        resume: bool = False,
        overwrite: bool = False,
        facts: dict[str, Any] | None = None,
    ) -> None:
        """Lock and prepare a directory.

        Args:
            directory: results directory, created if missing.
            runner: task runner of the job.
            resume: whether to keep results of the same job and add to them.
            overwrite: whether to remove existing results.
            facts: manifest entries of the job, and of this process under ``session``.

        Raises:
            InputError: the directory holds results, cannot be written, or has another writer.
        """
        self.directory = directory
        self._runner, self._facts = runner, dict(facts or {})
        self._session = self._facts.pop("session", {}) | {"started_unix_s": round(time.time(), 3)}
        self._since = time.monotonic()
        self._chunks: dict[str, dict[str, Any]] = {}
        self._sessions: list[dict[str, Any]] = []
        self._planned: list[Task] = []
        self._next_manifest = 0.0
        resuming.check_free(directory, overwrite=overwrite or resume)
        self._lock = locking.locked(directory)
        try:
            self._begin(resume=resume, overwrite=overwrite)
        except BaseException:
            self.release()
            raise

    def _begin(self, *, resume: bool, overwrite: bool) -> None:
        # Again, since the directory may have changed before it was locked.
        resuming.check_free(self.directory, overwrite=overwrite or resume)
        job = self._runner.job
        if resume and self._resumed()[2:] != job[2:]:
            raise InputError(f"{self.directory}: another process has just written there")
        _remove(belongings.left_behind(self.directory))
        if not resume:
            _remove(belongings.made_here(self.directory))
        if resume and (known := resuming.manifest(self.directory)):
            self._sessions = [session.model_dump() for session in known.sessions]
            self._chunks = {c.name: c.model_dump() for c in known.chunks if c.state == "done"}
        else:
            # First, so that the files of a killed run are recognised as results.
            self._write_manifest("running")
            self._write_study()

    def _write_study(self) -> None:
        _write(self.directory / "study.toml", study_to_toml(self._runner.job.study).encode())

    def _resumed(self) -> Job:
        instructions = self._session.get("instructions")
        return resuming.resumed(self.directory, self._runner.job, instructions)

    def release(self) -> None:
        """Unlock the directory."""
        self._lock.release()

    def missing(self, tasks: Iterable[Task]) -> list[Task]:
        """Tasks without complete parts; parts of unknown or incomplete tasks are removed.

        Args:
            tasks: all tasks of the study.

        Raises:
            InputError: the directory cannot be written.
        """
        self._planned = list(tasks)
        missing = []
        for task in self._planned:
            found = self._found(task)
            if found is None:
                self._chunks.pop(task.name, None)
                missing.append(task)
            else:
                self._chunks[task.name] = found
        known = {task.name for task in self._planned}
        self._chunks = {name: c for name, c in self._chunks.items() if name in known}
        there = (p for name in DATASETS for p in self.directory.glob(f"{name}/*.parquet"))
        _remove(p for p in there if belongings.is_part(p) and p.stem not in self._chunks)
        self._write_manifest("running")
        self._write_study()  # last: an extension that is not yet in the manifest can be asked again
        return missing

    def write(self, encoded: EncodedResult) -> None:
        """Write the parts of one task.

        Raises:
            InputError: the directory cannot be written.
        """
        files = []
        for dataset, rows in encoded.task.rows:
            content = encoded.files[dataset]
            path = self._path(dataset, encoded.task)
            try:
                path.parent.mkdir(exist_ok=True)
            except OSError as error:
                raise InputError(unwritable(path, error)) from error
            _write(path, content)
            files.append(self._entry(path, rows, content))
        self._chunks[encoded.task.name] = {
            "name": encoded.task.name,
            "state": "done",
            "runs": encoded.task.runs,
            "seconds": round(encoded.seconds, 4),
            "files": files,
        }
        if time.monotonic() >= self._next_manifest:
            self._write_manifest("running")

    def summary(self, names: list[str]) -> pa.Table:
        """Some columns of all stored rows of the summary."""
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

    def _entry(self, path: Path, rows: int, content: bytes) -> dict[str, Any]:
        return {
            "file": path.relative_to(self.directory).as_posix(),
            "rows": rows,
            "sha256": hashlib.sha256(content).hexdigest(),
        }

    def _found(self, task: Task) -> dict[str, Any] | None:
        """Manifest entry of a task with complete parts; None if they are not."""
        known = self._chunks.get(task.name, {})
        recorded = {entry["file"]: entry for entry in known.get("files", [])}
        files = []
        for dataset, rows in task.rows:
            path = self._path(dataset, task)
            try:
                content = path.read_bytes()
            except OSError:
                return None
            entry = self._entry(path, rows, content)
            same = recorded.get(entry["file"]) == entry
            if not same and not self._is_whole(dataset, content, rows, task):
                return None
            files.append(entry)
        seconds = known.get("seconds")
        return {"name": task.name, "state": "done", "runs": task.runs, "seconds": seconds} | {
            "files": files
        }

    def _is_whole(self, dataset: str, content: bytes, rows: int, task: Task) -> bool:
        """Whether a part with unknown checksum is identical to its table written again."""
        try:
            part = pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True)
            table = part.read()
            # Pages have their own checksums, the footer has none.
            return table.num_rows == rows and self._runner.parquet(dataset, table, task) == content
        except (OSError, ValueError, pa.ArrowException):
            return False

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
        manifest = {
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
            **self._facts,
            "started_unix_s": sessions[0]["started_unix_s"],
            "wall_s": round(sum(session["wall_s"] for session in sessions), 3),
            **{key: this[key] for key in _OF_ALL if key in this},
            "sessions": sessions,
            "study": study.model_dump(mode="json", exclude_none=True),
            "chunks": chunks,
        }
        text = json.dumps(manifest, indent=1, allow_nan=False) + "\n"
        _write(self.directory / MANIFEST, text.encode())
        ended = time.monotonic()
        wait_s = max(_MANIFEST_EVERY_S, (ended - began) / _MANIFEST_SHARE)
        self._next_manifest = ended + wait_s


def _write(path: Path, content: bytes) -> None:
    with replacing(path) as file:
        file.write(content)


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink()
        except OSError as error:
            raise InputError(unwritable(path, error)) from error
