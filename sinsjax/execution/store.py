"""Storage of a job's results in a directory while its chunks are computed.

Every file of a directory is written under a temporary name, synced and renamed, so a sweep killed
at any point leaves only complete parts. A part contains its own checksum, study and chunk: it is
valid without the manifest, which has what all parts have in common.
"""

import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sinsjax import columns
from sinsjax.errors import InputError
from sinsjax.execution import directory as results_directory
from sinsjax.execution import resume
from sinsjax.execution.directory import DATASETS, MANIFEST, STUDY, Manifest
from sinsjax.execution.results import read_part_metadata
from sinsjax.execution.sealed import to_sealed_json, to_sealed_parquet
from sinsjax.execution.tasks import Job, Task, TaskResult, part_metadata
from sinsjax.platform import runtime
from sinsjax.platform.files import atomic_write, make_folder, read_regular_file, unwritable_message
from sinsjax.study.identity import fingerprint, sections_to_json
from sinsjax.study.load import study_to_toml

_MANIFEST_EVERY_S = 1.0


class DirectoryStore:
    """The only writer of a results directory.

    Attributes:
        directory: results directory.
    """

    def __init__(self, job: Job, facts: Mapping[str, Any]) -> None:
        """Lock and prepare the directory of a job.

        Args:
            job: prepared job with a directory.
            facts: manifest entries about the machines of this session.

        Raises:
            InputError: the directory cannot be written, has another writer, or had one since the
                job was prepared.
        """
        assert job.directory is not None
        self.directory = job.directory
        self._job, self._identity, self._facts = job, job.identity, dict(facts)
        self._started_s = round(time.time(), 3)
        self._start_s, self._earlier_s = time.monotonic(), 0.0
        self._done: dict[str, Task] = {}
        self._next_manifest = 0.0
        self._lock = results_directory.lock_directory(self.directory)
        try:
            self._prepare_directory()
        except BaseException:
            self.unlock()
            raise

    def _prepare_directory(self) -> None:
        job = self._job  # checked again, since the directory may have changed before it was locked
        resume.check_available(self.directory, overwrite=job.overwrite, resume=job.resume)
        if job.resume and resume.continue_job(job) != job:
            text = "another process has just written there (run again)"
            raise InputError(f"{self.directory}: {text}")
        _remove_files(results_directory.stale_temp_files(self.directory))
        if not job.resume:
            _remove_files(results_directory.owned_files(self.directory))
        if job.resume and (manifest := Manifest.find(self.directory)):
            self._started_s = manifest.started_unix_s or self._started_s
            self._earlier_s = manifest.wall_s or 0.0
        else:
            # First, to mark the files of a killed run as results.
            self._write_manifest("running")
            self._write_study()

    def _write_study(self) -> None:
        _write_file(self.directory / STUDY, study_to_toml(self._job.study).encode())

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
        planned = list(tasks)
        self._done = {task.name: task for task in planned if self._is_stored(task)}
        parts = (
            path for name in DATASETS for path in results_directory.list_parts(self.directory, name)
        )
        _remove_files(path for path in parts if path.stem not in self._done)
        self._write_manifest("running")
        self._write_study()  # last: an extension missing in the manifest can be requested again
        return [task for task in planned if task.name not in self._done]

    def _is_stored(self, task: Task) -> bool:
        """Return whether all parts of a task are complete and intact."""
        for dataset, _ in task.rows:
            try:
                content = read_regular_file(self._part_path(dataset, task))
            except (OSError, InputError):
                return False
            expected = part_metadata(self._job, self._identity, dataset, task)
            if read_part_metadata(content) != expected:
                return False
        return True

    def add_result(self, result: TaskResult) -> None:
        """Write the parts of one task.

        Raises:
            InputError: the directory cannot be written.
        """
        for dataset, _ in result.task.rows:
            path = self._part_path(dataset, result.task)
            make_folder(path.parent)
            _write_file(path, result.content[dataset])
        self._done[result.task.name] = result.task
        if time.monotonic() >= self._next_manifest:
            self._write_manifest("running")

    def read_summary(self, names: list[str]) -> pa.Table:
        """Return some columns of all stored rows of the summary."""
        paths = (self._part_path("summary", task) for task in self._done.values())
        return pa.concat_tables([pq.ParquetFile(path).read(columns=names) for path in paths])

    def finish(self, state: str, **facts: Any) -> None:
        """Write the last manifest of this session.

        Args:
            state: "complete" or "interrupted".
            facts: further entries.
        """
        self._facts |= facts
        self._write_manifest(state)

    def _part_path(self, dataset: str, task: Task) -> Path:
        return self.directory / dataset / f"{task.name}.parquet"

    def _write_manifest(self, state: str) -> None:
        job, study = self._job, self._job.study
        record = None if job.stored is None else job.stored.record
        entries = {
            "schema": columns.SCHEMA_VERSION,
            "state": state,
            "fingerprint": fingerprint(study),
            "identity": self._identity,
            "seed": study.seed,
            "runs": study.n_draws * study.n_variants,
            "runs_done": sum(task.runs for task in self._done.values()),
            "curves": study.study.curves if job.curves is None else job.curves,
            "chunk_runs": job.chunk_runs,
            **({"extended_at": job.extended_at} if job.extended_at else {}),
            "config": job.source,
            "record": None if record is None else Path(record.source).name,
            "record_latitude_deg": None if record is None else record.latitude_deg,
            "warnings": job.warnings,
            "started_unix_s": self._started_s,
            "wall_s": round(self._earlier_s + time.monotonic() - self._start_s, 3),
            **self._facts,
            "study": sections_to_json(study),
        }
        _write_file(self.directory / MANIFEST, to_sealed_json(entries))
        self._next_manifest = time.monotonic() + _MANIFEST_EVERY_S


def write_table(job: Job, summary: pa.Table) -> None:
    """Write a summary that was made elsewhere as the results of a job.

    Args:
        job: job with a directory, without curves.
        summary: one row per run, with the columns of the study's summary.

    Raises:
        InputError: the directory cannot be written, has another writer, or had one since the job
            was prepared.
    """
    rows = (("summary", len(summary)),)
    task = Task("part-0000-000000", 0, (0, job.study.n_draws), 0, len(summary), rows)
    content = to_sealed_parquet(summary, part_metadata(job, job.identity, "summary", task))
    store = DirectoryStore(job, runtime.describe_environment())
    try:
        store.missing_tasks([task])
        store.add_result(TaskResult(task, {"summary": content}, 0))
        store.finish("complete")
    finally:
        store.unlock()


def _write_file(path: Path, content: bytes) -> None:
    with atomic_write(path) as file:
        file.write(content)


def _remove_files(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink()
        except OSError as error:
            raise InputError(unwritable_message(path, error)) from error
