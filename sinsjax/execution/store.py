"""Storage of a job's results in a directory while its chunks are computed, and their continuation.

Every file of a directory is written under a temporary name, synced and renamed, so a sweep killed
at any point leaves only complete parts. A part contains its own checksum, study and chunk: it is
valid without the manifest, which has what all parts have in common.
"""

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sinsjax import columns
from sinsjax.errors import InputError
from sinsjax.execution import directory as places
from sinsjax.execution.directory import (
    DATASETS,
    MANIFEST,
    STUDY,
    Manifest,
    to_sealed_json,
    to_sealed_parquet,
)
from sinsjax.execution.results import read_part_metadata
from sinsjax.execution.tasks import Job, Task, TaskResult, part_metadata
from sinsjax.messages import shorten
from sinsjax.methods.registry import packages_of
from sinsjax.platform import runtime
from sinsjax.platform.files import make_folder, read_regular_file, write_file
from sinsjax.study.load import (
    describe_differences,
    fingerprint,
    sections_to_json,
    study_to_toml,
    with_draws,
)

_MANIFEST_EVERY_S = 1.0


def continue_job(job: Job) -> Job:
    """Return the job as a continuation of the results in its directory, if there are any.

    It keeps their runs per chunk and choice of curves. If it has more draws, it is marked as
    extended. Results of another study or record are refused.
    """
    assert job.directory is not None
    manifest = Manifest.find(job.directory)
    if manifest is None:
        return job
    ends, study, stored = {*manifest.extended_at}, job.study, manifest.draws or 0
    if manifest.fingerprint != fingerprint(study):
        if not 0 < stored <= (study.study.draws or 0) or (
            fingerprint(with_draws(study, stored)) != manifest.fingerprint
        ):
            text = "; ".join(describe_differences(manifest.study, study))
            raise InputError(f"{job.directory}: contains results of another study: {text}")
        ends.add(stored)
    job = job._replace(
        curves=manifest.curves, chunk_runs=manifest.chunk_runs, extended_at=tuple(sorted(ends))
    )
    if manifest.identity != job.input_hash:
        raise InputError(f"{job.directory}: contains results of another record or reference")
    return job


def _refuse_rows_of_other_versions(
    job: Job, manifest: Manifest, session: Mapping[str, Any]
) -> None:
    """Reject rows of other versions or another instruction set: last bits differ, and grow."""
    names = (*runtime.RESULT_PACKAGES, *packages_of(job.study.methods))
    used = [(name, manifest.versions.get(name), session["versions"][name]) for name in names]
    used.append(("instruction set", manifest.instructions, session["instructions"]))
    for name, there, here in used:
        if there not in (None, here):
            raise InputError(
                f"{job.directory}: was computed with {name} {shorten(there)}, but here is {here}"
                " (install that version, set XLA_FLAGS=--xla_cpu_max_isa for an instruction set, or"
                " give --overwrite)"
            )


@contextmanager
def locked_store(job: Job, session: Mapping[str, Any]) -> Iterator["DirectoryStore"]:
    """Lock and prepare the directory of a job, for the duration of a ``with`` block.

    ``session`` has manifest entries about the machines of this session.
    """
    assert job.directory is not None
    lock = places.lock_directory(job.directory)
    try:
        # Again, since the directory may have changed before it was locked.
        places.refuse_existing_results(job.directory, overwrite=job.overwrite, resume=job.resume)
        if job.resume and continue_job(job) != job:
            text = "another process has just written there (run again)"
            raise InputError(f"{job.directory}: {text}")
        store = DirectoryStore(job, session)
        places.remove_files(places.stale_temp_files(job.directory))
        if not job.resume:
            places.remove_files(places.owned_files(job.directory))
        yield store
    finally:
        lock.release()


class DirectoryStore:
    """The only writer of a results directory, see `locked_store`."""

    def __init__(self, job: Job, session: Mapping[str, Any]) -> None:
        """Continue the results in a locked directory, or begin new ones."""
        assert job.directory is not None
        self._job, self._directory, self._input_hash = job, job.directory, job.input_hash
        self._facts, self._done, self._next_manifest = dict(session), dict[str, Task](), 0.0
        before = Manifest.find(job.directory) if job.resume else None
        if before:
            _refuse_rows_of_other_versions(job, before, session)
        self._started_s = before.entries.get("started_unix_s") if before else round(time.time(), 3)
        self._start_s = time.monotonic() - ((before and before.wall_s) or 0.0)

    def missing_tasks(self, tasks: Iterable[Task]) -> list[Task]:
        """Return the tasks without complete parts; remove parts of unknown or incomplete tasks."""
        planned = list(tasks)
        self._done = {task.name: task for task in planned if self._is_stored(task)}
        parts = (path for name in DATASETS for path in places.list_parts(self._directory, name))
        places.remove_files(path for path in parts if path.stem not in self._done)
        self._write_manifest("running")  # first, to mark the files of a killed run as results
        write_file(self._directory / STUDY, study_to_toml(self._job.study).encode())
        return [task for task in planned if task.name not in self._done]

    def _is_stored(self, task: Task) -> bool:
        """Return whether all parts of a task are complete and intact."""
        for dataset, _ in task.rows:
            try:
                content = read_regular_file(self._part_path(dataset, task))
            except (OSError, InputError):
                return False
            expected = part_metadata(self._job, self._input_hash, dataset, task)
            if read_part_metadata(content) != expected:
                return False
        return True

    def add_result(self, result: TaskResult) -> None:
        """Write the parts of one task."""
        for dataset, _ in result.task.rows:
            path = self._part_path(dataset, result.task)
            make_folder(path.parent)
            write_file(path, result.content[dataset])
        self._done[result.task.name] = result.task
        if time.monotonic() >= self._next_manifest:
            self._write_manifest("running")

    def read_summary(self, names: list[str]) -> pa.Table:
        """Return some columns of all stored rows of the summary."""
        paths = (self._part_path("summary", task) for task in self._done.values())
        return pa.concat_tables([pq.ParquetFile(path).read(columns=names) for path in paths])

    def finish(self, state: str, **facts: Any) -> None:
        """Write the last manifest of this session, "complete" or "interrupted", with more facts."""
        self._facts |= facts
        self._write_manifest(state)

    def _part_path(self, dataset: str, task: Task) -> Path:
        return self._directory / dataset / f"{task.name}.parquet"

    def _write_manifest(self, state: str) -> None:
        job, study = self._job, self._job.study
        record = None if job.stored is None else job.stored.record
        entries = {
            "schema": columns.SCHEMA_VERSION,
            "state": state,
            "fingerprint": fingerprint(study),
            "identity": self._input_hash,
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
            "wall_s": round(time.monotonic() - self._start_s, 3),
            **self._facts,
            "study": sections_to_json(study),
        }
        write_file(self._directory / MANIFEST, to_sealed_json(entries))
        self._next_manifest = time.monotonic() + _MANIFEST_EVERY_S


def write_table(job: Job, summary: pa.Table) -> None:
    """Write a summary that was made elsewhere as the results of a job without curves."""
    rows = (("summary", len(summary)),)
    task = Task("part-0000-000000", 0, (0, job.study.n_draws), 0, len(summary), rows)
    content = to_sealed_parquet(summary, part_metadata(job, job.input_hash, "summary", task))
    with locked_store(job, runtime.describe_environment()) as store:
        store.missing_tasks([task])
        store.add_result(TaskResult(task, {"summary": content}, 0))
        store.finish("complete")
