"""A results directory: its files, its lock, and the files that sinsjax owns.

It contains ``summary/`` and optionally ``curves/`` (Parquet datasets, a part per
chunk), ``study.toml`` (the resolved study), ``manifest.json`` (versions, chunks, timing),
``figures/`` and ``reruns/``. Its author may be unknown, so only regular files are opened, and none
through a link. The directory itself may be a link.
"""

import hashlib
import json
import os
import re
import socket
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import filelock
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sinsjax import columns
from sinsjax.errors import InputError
from sinsjax.execution import sealed
from sinsjax.execution.sealed import DamagedError
from sinsjax.messages import shorten, to_one_line
from sinsjax.platform.files import atomic_write, make_folder, read_regular_file, unwritable_message
from sinsjax.study.files import check_nesting

MANIFEST, STUDY = "manifest.json", "study.toml"
ESTIMATES = "estimates"
"""Dataset of version 1.0, which is not read any more; it is removed with the other results."""

DATASETS = ("summary", "curves", ESTIMATES)
"""A part of the summary is written last: it implies its counterpart in the curves."""

RERUN_FILES = ("summary.parquet", "curve.parquet", "curve.png")
"""Files of a repeated run."""

LOCK, WRITER, FIGURES = ".lock", ".writer", ".figures.json"
"""The lock, the name of its last owner, and the list of drawn figures."""

_FILES = (MANIFEST, STUDY, LOCK, WRITER, FIGURES, "tuned.toml", "history.parquet")
_FOLDERS = (*DATASETS, "figures", "reruns", "grid", "sobol", "evaluation")
_CLOCK_TICK_NS = 50_000_000
"""Above the clock tick of a file system, ns: any later change has another modification time."""

_MAX_LIST_BYTES = 2**16
"""Largest size of the files WRITER and FIGURES, bytes."""


class FileState(NamedTuple):
    """State of a file; a changed file compares unequal."""

    path: Path
    inode: int
    size: int
    mtime_ns: int

    @classmethod
    def from_path(cls, path: Path) -> "FileState":
        """Return the state of a file."""
        status = path.stat()
        return cls(path.absolute(), status.st_ino, status.st_size, status.st_mtime_ns)

    @property
    def is_settled(self) -> bool:
        """Return whether any later change will alter the modification time."""
        return time.time_ns() - self.mtime_ns > _CLOCK_TICK_NS


class _ManifestEntry(BaseModel):
    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class Session(_ManifestEntry):
    """Manifest entry of a process that wrote results.

    Attributes:
        started_unix_s: start time, s since 1970.
        wall_s: duration, s.
        versions: of the packages that may change the rows.
        instructions: instruction set that computed the rows.
    """

    started_unix_s: float
    wall_s: float
    versions: dict[str, str] = {}
    instructions: str | None = None


class StoredPart(_ManifestEntry):
    """Manifest entry of a part: its path in the directory, and its number of rows."""

    file: str
    rows: int


class StoredChunk(_ManifestEntry):
    """Manifest entry of a chunk; without files it is missing.

    Attributes:
        name: name of its parts.
        state: "done" or "missing".
        runs: number of runs.
        seconds: time taken without compilation, s.
        files: its parts.
    """

    name: str
    state: str
    runs: int
    seconds: float | None = None
    files: list[StoredPart] = []


class Manifest(_ManifestEntry):
    """The entries of a manifest that sinsjax itself reads.

    Attributes:
        identity: of the job, see `tasks.Job.identity`.
        fingerprint: of the study.
        curves: whether curves are kept; None follows the study.
        chunk_runs: runs per chunk, as given to the job.
        extended_at: numbers of draws before each extension, as in the job.
        runs_done: number of runs whose results are stored.
        study: sections of the resolved study.
        sessions: processes that wrote results.
        chunks: all chunks of the study.
    """

    identity: str
    fingerprint: str = ""
    curves: bool | None
    chunk_runs: Annotated[int, Field(ge=1)] | None
    extended_at: tuple[Annotated[int, Field(ge=1)], ...] = ()
    runs_done: int = 0
    study: dict[str, Any] = {}
    sessions: list[Session] = []
    chunks: list[StoredChunk] = []


def results_path(directory: str | Path) -> Path:
    """Return the path of a results directory.

    Raises:
        InputError: the path is empty.
    """
    if not str(directory):
        raise InputError("the results directory must not be empty (use '.' for the current one)")
    return Path(directory)


def check_directory(directory: Path) -> None:
    """Reject a directory in which a link or a pipe replaces a file or folder of results.

    Raises:
        InputError: names the entry, or the directory is a file, cannot be read, or has a name that
            is not UTF-8, which Arrow cannot open.
    """
    try:
        os.fspath(directory).encode()
    except UnicodeEncodeError:
        text = "results cannot be stored under a name that is not UTF-8 (rename it)"
        raise InputError(f"{directory}: {text}") from None
    try:
        if directory.exists() and not directory.is_dir():
            raise InputError(f"{directory}: is a file, not a directory")
        for name in _FILES:
            _check_kind(directory / name, stat.S_ISREG, "regular file")
        for name in _FOLDERS:
            _check_kind(directory / name, stat.S_ISDIR, "folder")
    except OSError as error:
        raise InputError(unwritable_message(directory, error)) from error


def _check_kind(path: Path, is_kind: Any, kind: str) -> None:
    with suppress(FileNotFoundError):
        mode = path.lstat().st_mode
        if stat.S_ISLNK(mode):
            text = "is a symbolic link, and results are not read or written through links"
            raise InputError(f"{path}: {text} (remove it, or give another directory)")
        if not is_kind(mode):
            raise InputError(f"{path}: is not a {kind} (remove it, or give another directory)")


def existing_names(directory: Path, names: Iterable[str]) -> list[str]:
    """Return the names that exist in a directory, which may be missing itself.

    Raises:
        InputError: the directory cannot be used, see `check_directory`.
    """
    check_directory(directory)
    return [name for name in names if (directory / name).exists()]


def list_parts(directory: Path, dataset: str) -> list[Path]:
    """Return the parts of a dataset by name; a file has its final name only once it is complete."""
    return sorted(path for path in directory.glob(f"{dataset}/*.parquet") if is_part_name(path))


def is_part_name(path: Path) -> bool:
    """Return whether a file name is that of a part."""
    return re.fullmatch(r"part-\d{4,}-\d{6,}\.parquet", path.name) is not None


def read_manifest(directory: str | Path) -> dict[str, Any]:
    """Read the manifest of a results directory.

    Args:
        directory: results directory.

    Returns:
        Its entries, as JSON values.

    Raises:
        InputError: there is no manifest, it has changed since it was written (`DamagedError`), or
            another version wrote it (`OtherVersionError`).

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> _ = sinsjax.run_into(study, "out")
        >>> manifest = sinsjax.read_manifest("out")
        >>> manifest["state"], manifest["runs_done"], manifest["seed"]
        ('complete', 6, 1)
    """
    directory = Path(directory)
    path = directory / MANIFEST
    try:
        manifest = sealed.read_sealed_json(path)
    except FileNotFoundError:
        text = f"contains no results ({MANIFEST} is missing)"
        if any(list_parts(directory, name) for name in DATASETS):
            text = f"{MANIFEST} is missing (`--resume` writes it again)"
        raise InputError(f"{directory}: {text}") from None
    except DamagedError as error:
        _check_version(directory, _read_unsealed_manifest(path))
        raise DamagedError(f"{error} (`--resume` writes it again)") from None
    _check_version(directory, manifest)
    check_nesting(manifest, path)
    return manifest


def find_manifest(directory: Path) -> Manifest | None:
    """Return the manifest of a results directory; None if it is missing or damaged.

    Raises:
        OtherVersion: another version wrote it.
        InputError: it cannot be read.
    """
    try:
        file = FileState.from_path(directory / MANIFEST)
    except OSError:
        return None
    if file not in _manifests:
        try:
            manifest = Manifest.model_validate(read_manifest(directory))
        except (DamagedError, ValidationError):
            return None
        if not file.is_settled:
            return manifest
        _manifests[file] = manifest
    return _manifests[file]


_manifests: dict[FileState, Manifest] = {}
"""Manifests read by this process: a report needs one for every dataset."""


class OtherVersionError(InputError):
    """Results written by another version of sinsjax."""


def _check_version(directory: Path, manifest: Mapping[str, Any]) -> None:
    schema = str(manifest.get("schema", columns.SCHEMA_VERSION))
    if schema == columns.SCHEMA_VERSION:
        return
    versions = manifest.get("versions")
    version = str(versions.get("sinsjax", "")) if isinstance(versions, dict) else ""
    raise OtherVersionError(
        f"{directory}: contains results of"
        f" {shorten(to_one_line(f'sinsjax {version}'.strip()), 40)},"
        f" whose columns (schema {shorten(to_one_line(schema), 20)}) this version does not read"
        " (run the study again, into another directory or with --overwrite, or use that version)"
    )


def _read_unsealed_manifest(path: Path) -> dict[str, Any]:
    """Return a manifest without a seal, as older versions wrote it; empty if there is none."""
    try:
        manifest = json.loads(read_regular_file(path))
    except (OSError, ValueError, RecursionError):
        return {}
    return manifest if isinstance(manifest, dict) and "fingerprint" in manifest else {}


# --- one writer at a time -----------------------------------------------------------------------


def lock_directory(directory: Path) -> filelock.FileLock:
    """Lock a directory, created if missing, against other writers.

    The operating system releases the lock when the process ends, in whatever way.

    Raises:
        InputError: another process is writing there, or the directory is not writable.
    """
    make_folder(directory)
    check_directory(directory)
    file_lock = _acquire_lock(directory)
    with suppress(InputError):  # the lock holds without the writer's name
        with atomic_write(directory / WRITER) as file:
            file.write(f"pid {os.getpid()} on {socket.gethostname()}\n".encode())
    return file_lock


def check_unlocked(directory: Path) -> None:
    """Reject a directory that another process is writing to.

    This check precedes all others, since the content is changing.

    Raises:
        InputError: names that process, or the lock cannot be acquired.
    """
    check_directory(directory)
    if (directory / LOCK).exists():
        _acquire_lock(directory).release()


def _acquire_lock(directory: Path) -> filelock.FileLock:
    file_lock = filelock.FileLock(directory / LOCK)
    try:
        file_lock.acquire(blocking=False)
    except filelock.Timeout:
        text = f"{directory}: another process is writing there{_format_writer(directory)}"
        raise InputError(f"{text} (wait until it ends)") from None
    except OSError as error:
        raise InputError(unwritable_message(directory, error)) from error
    return file_lock


def _format_writer(directory: Path) -> str:
    try:
        name = read_regular_file(directory / WRITER)[:_MAX_LIST_BYTES].decode().strip()
    except (OSError, ValueError):
        return ""
    return f": {shorten(to_one_line(name))}" if name else ""


# --- the files that sinsjax wrote; it removes no others -------------------------------------------


def stale_temp_files(directory: Path) -> list[Path]:
    """Return temporary files left by processes killed while writing results or a tuning run."""
    names = [f".{name}" for name in (MANIFEST, STUDY, WRITER, FIGURES, "tuned.toml")]
    patterns = (f"{name}.*.tmp" for name in [*names, ".history.parquet", "figures/.*.png"])
    parts = (f"{name}/.part-*.tmp" for name in DATASETS)
    candidates = (path for pattern in (*patterns, *parts) for path in directory.glob(pattern))
    return [path for path in candidates if re.search(r"\.\d+\.tmp$", path.name)]


def owned_files(directory: Path) -> list[Path]:
    """Return the files that sinsjax wrote, identified by name, and figures by their list.

    This excludes files added by the user, and figures changed since they were drawn.
    """
    parts = (path for name in DATASETS for path in list_parts(directory, name))
    numbers = (path for path in directory.glob("reruns/*") if re.fullmatch(r"\d+", path.name))
    reruns = (
        number / name for number in numbers if _is_real_folder(number) for name in RERUN_FILES
    )
    files = [path for path in (*reruns, directory / STUDY) if path.is_file()]
    return [*parts, *files, *_unchanged_figures(directory)]


def _is_real_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def register_figures(images: Mapping[str, bytes], directory: Path) -> None:
    """List the figures drawn in a directory, and remove those of earlier reports.

    A figure changed since it was drawn belongs to the user, and remains.

    Args:
        images: contents of PNG files by file name.
        directory: results directory.

    Raises:
        InputError: the list cannot be written.
    """
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in images.items()}
    for path in _unchanged_figures(directory):
        if path != directory / FIGURES and path.name not in images:
            with suppress(OSError):  # the directory may be read only
                path.unlink()
    with atomic_write(directory / FIGURES) as file:
        file.write((json.dumps(digests, indent=1) + "\n").encode())


def _unchanged_figures(directory: Path) -> Iterator[Path]:
    """Yield the listed figures that are unchanged since they were drawn, and the list itself."""
    for name, digest in _figure_digests(directory).items():
        path = directory / "figures" / Path(name).name
        with suppress(OSError, InputError):
            if hashlib.sha256(read_regular_file(path)).hexdigest() == digest:
                yield path
    if (directory / FIGURES).is_file():
        yield directory / FIGURES


def _figure_digests(directory: Path) -> dict[str, str]:
    try:
        listed = json.loads(read_regular_file(directory / FIGURES))
    except (OSError, ValueError, RecursionError):  # InputError is a ValueError
        return {}
    return {str(k): str(v) for k, v in listed.items()} if isinstance(listed, dict) else {}
