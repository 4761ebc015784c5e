"""What a directory of results holds, and whether a study may be written there."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import filelock
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sinsjax.errors import InputError
from sinsjax.execution.belongings import DATASETS
from sinsjax.execution.parts import MANIFEST, find, read_manifest
from sinsjax.execution.tasks import Job
from sinsjax.messages import one_line, shortened
from sinsjax.platform import runtime, xla
from sinsjax.platform.files import unwritable
from sinsjax.study.fingerprint import fingerprint
from sinsjax.study.load import load_study
from sinsjax.study.study import Study

LOCK = ".lock"
_NAMES = (*DATASETS, "figures", "study.toml", MANIFEST)


def locked(directory: Path) -> filelock.FileLock:
    """Take hold of a directory, which is made if it is missing: nobody else writes there.

    The lock is the operating system's: released, or let go by a process that ends.

    Raises:
        InputError: somebody writes there, or nobody can.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        lock = filelock.FileLock(directory / LOCK)
        lock.acquire(blocking=False)
    except filelock.Timeout:
        raise InputError(f"{directory}: another process is writing there") from None
    except OSError as error:
        raise InputError(unwritable(directory, error)) from error
    return lock


class _Checked(BaseModel):
    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class RunSession(_Checked):
    """What a manifest says of a process that wrote.

    Attributes:
        started_unix_s: when.
        wall_s: how long.
        versions: of the packages that decide rows.
        instructions: the instruction set that its rows were made with.
    """

    started_unix_s: float
    wall_s: float
    versions: dict[str, str] = {}
    instructions: str | None = None


class File(_Checked):
    """What a manifest says of a part: its place in the directory, its rows and its checksum."""

    file: str
    rows: int
    sha256: str


class Done(_Checked):
    """What a manifest says of a chunk; without files it is not done."""

    name: str
    state: str
    seconds: float | None = None
    files: list[File] = []


class Manifest(_Checked):
    """What of a manifest is needed to go on with its results.

    Attributes:
        identity: of the job, see `Job.identity`.
        curves: whether curves are kept; None takes the study's word.
        chunk_runs: runs a chunk, as the job was given it.
        sessions: processes that wrote.
        chunks: every chunk of the study.
    """

    identity: str
    curves: bool | None
    chunk_runs: Annotated[int, Field(ge=1)] | None
    sessions: list[RunSession] = []
    chunks: list[Done] = []


def manifest(directory: Path) -> Manifest | None:
    """The manifest of a directory; None if it has none with which one can go on."""
    try:
        return Manifest.model_validate(read_manifest(directory))
    except (InputError, ValidationError):
        return None


def resumed(directory: Path, job: Job, instructions: str | None = None) -> Job:
    """A job as the directory of its results began it: with its chunks, and with curves or not.

    Args:
        directory: where its results are.
        job: as it is asked for now.
        instructions: the instruction set of whoever will do it; None is this process's.

    Raises:
        InputError: the directory holds results of another study or record, the keys that differ
            are named; or of another version or instruction set.
    """
    kept = _kept_study(directory)
    if kept is not None and fingerprint(kept) != fingerprint(job.study):
        text = "; ".join(differences(kept, job.study)) or "another version wrote them"
        raise InputError(f"{directory}: holds results of another study: {text}")
    known = manifest(directory) or _told_by_parts(directory)
    if known is None:
        if (directory / MANIFEST).exists():
            raise InputError(
                f"{directory}: holds results of another version of sinsjax, which cannot be gone on"
                " with (give --overwrite to replace them)"
            )
        return job
    _check_chunks(directory, known)
    job = job._replace(curves=known.curves, chunk_runs=known.chunk_runs)
    _check_versions(directory, known)
    _check_instructions(directory, known, instructions or xla.instructions())
    if known.identity != job.identity:
        what = "study" if kept is None else "record or reference"
        raise InputError(f"{directory}: holds results of another {what}")
    return job


def _check_versions(directory: Path, known: Manifest) -> None:
    """Refuses to add rows of other versions: last bits and chunks may differ."""
    here = runtime.versions()
    for session in known.sessions:
        for name in runtime.DECISIVE:
            there = shortened(one_line(session.versions.get(name, here[name])))
            if there != here[name]:
                raise InputError(
                    f"{directory}: was made with {name} {there}, here is {here[name]}: install that"
                    " one, or give --overwrite"
                )


def _check_instructions(directory: Path, known: Manifest, here: str) -> None:
    """Refuses to add rows of another instruction set: last bits differ, and grow over a run."""
    for session in known.sessions:
        if (there := shortened(one_line(session.instructions or here))) != here:
            raise InputError(
                f"{directory}: was made with instruction set {there}, here is {here}: use a machine"
                f" with that one, or XLA_FLAGS=--xla_cpu_max_isa={there} on a larger, or give"
                " --overwrite"
            )


def _kept_study(directory: Path) -> Study | None:
    """The study of a directory; None if it cannot be read: its parts know whose they are."""
    try:
        return load_study(directory / "study.toml")
    except InputError:
        return None


def _check_chunks(directory: Path, known: Manifest) -> None:
    """Refuses to cut a study otherwise than its parts are: all of them would be made again."""
    cuts = set()
    for said in _parts_say(directory):
        if said.chunk_runs == known.chunk_runs:
            return
        cuts.add("none" if said.chunk_runs is None else said.chunk_runs)
    if cuts:
        here = "none" if known.chunk_runs is None else known.chunk_runs
        raise InputError(
            f"{directory}: manifest.json: chunk_runs: is {here}, but its parts were made with"
            f" {min(cuts, key=str)} (put that back, or give --overwrite)"
        )


def _told_by_parts(directory: Path) -> Manifest | None:
    """What the first part that can be read says of all; None if there is none."""
    return next(_parts_say(directory), None)


def _parts_say(directory: Path) -> Iterator[Manifest]:
    """What each part that can be read says of all."""
    curves = True if any(find(directory, "curves")) else None
    for path in sorted(find(directory, "summary")):
        try:
            said = pq.read_schema(path).metadata or {}
            chunk, identity = json.loads(said[b"sinsjax.chunk"]), said[b"sinsjax.study"].decode()
            yield Manifest(identity=identity, curves=curves, chunk_runs=chunk["chunk_runs"])
        except (OSError, ValueError, RecursionError, pa.ArrowException, KeyError, TypeError):
            continue


def differences(there: Study, here: Study) -> list[str]:
    """The keys in which two studies differ, with both values, as far as results depend on them."""
    old, new = _by_key(there), _by_key(here)
    found = [
        f"{key}: {_said(old.get(key))} there, {_said(new.get(key))} here"
        for key in dict.fromkeys((*old, *new))
        if old.get(key) != new.get(key)
    ]
    return found or ["its keys stand in another order"]


def _by_key(study: Study) -> dict[str, Any]:
    """The values of a study by the place and key that its file gives them."""
    content = study.model_dump(exclude={"tune"}, exclude_none=True)
    for key in ("name", "unchecked"):
        content["study"].pop(key, None)
    tables = {f"axes.{name}": keys for name, keys in content.pop("zips", {}).items()}
    drawn = content.pop("drawn", {})
    tables["drawn"] = drawn.get("laws", {}) | {k: v for k, v in drawn.items() if k != "laws"}
    for i, case in enumerate(content.pop("cases", ())):
        tables[f"cases {i}"] = case
    return {
        f"[{table}] {key}": value
        for table, keys in (content | tables).items()
        for key, value in keys.items()
    }


def _said(value: Any) -> str:
    text = "none" if value is None else str(list(value) if isinstance(value, tuple) else value)
    return shortened(text, 60)


def check_free(directory: Path, *, overwrite: bool) -> None:
    """Refuse a directory that holds results, unless they may be used, or files like ours.

    Results are known by their manifest or their parts: other files of our names are never touched.

    Raises:
        InputError: the directory cannot be used.
    """
    taken = names_taken(directory, _NAMES)
    if not taken:
        return
    if not _is_ours(directory):
        raise InputError(f"{directory}: holds a {taken[0]} that is no result: give another one")
    if not overwrite:
        raise InputError(
            f"{directory}: holds results already (give --resume to go on with them, or --overwrite"
            " to replace them)"
        )


def names_taken(directory: Path, names: Iterable[str]) -> list[str]:
    """Which of some names a directory has already, which need not be there itself.

    Raises:
        InputError: it is a file, or cannot be looked into.
    """
    try:
        if directory.exists() and not directory.is_dir():
            raise InputError(f"{directory}: is a file, not a directory")
        return [name for name in names if (directory / name).exists()]
    except OSError as error:
        raise InputError(unwritable(directory, error)) from error


def _is_ours(directory: Path) -> bool:
    """Whether a directory holds results, by its manifest, or its parts where that is none."""
    try:
        if "fingerprint" in read_manifest(directory):
            return True
    except InputError:
        pass
    return _told_by_parts(directory) is not None


def named(directory: str | Path) -> Path:
    """A directory as it is given.

    Raises:
        InputError: it has no name: that is no way to say *here*.
    """
    if not str(directory):
        raise InputError("the directory of results must not be empty (the current one is '.')")
    return Path(directory)
