"""A results directory: its files, who may write to it, and which of its files sinsjax wrote.

It holds ``summary/`` or ``estimates/`` and optionally ``curves/`` (Parquet datasets with a part per
chunk), ``study.toml`` (the resolved study), ``manifest.json`` (versions, chunks, timing),
``figures/`` and ``reruns/``. Somebody else may have made it: nothing in it is opened through a
link, and nothing but regular files is opened. The directory itself may be a link.
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
from sinsjax.execution.sealed import Damaged
from sinsjax.messages import shorten, to_one_line
from sinsjax.platform.files import atomic_write, make_folder, read_regular_file, unwritable_message
from sinsjax.study.files import require_shallow

MANIFEST, STUDY = "manifest.json", "study.toml"
ONE_ROW_EACH = ("summary", "estimates")
"""Datasets with one row per run or per variant, written last: a part in them implies its
counterpart in the other datasets."""

DATASETS = (*ONE_ROW_EACH, "curves")
RERUN = ("summary.parquet", "curve.parquet", "curve.png")
"""Files of a repeated run."""

LOCK, WRITER, FIGURES = ".lock", ".writer", ".figures.json"
"""The lock, the name of the last process that took it, and the list of the figures drawn."""

_FILES = (MANIFEST, STUDY, LOCK, WRITER, FIGURES, "tuned.toml", "history.parquet")
_FOLDERS = (*DATASETS, "figures", "reruns", "grid", "sobol", "random", "equal_cost", "evaluation")
_TICK_NS = 50_000_000
"""More than the interval at which a file system's clock ticks: a later change has another time."""

_SPARSE = 2**16
"""Bytes of a file that names the writer or lists the figures."""


class FileState(NamedTuple):
    """A file at a moment; a changed file compares unequal."""

    path: Path
    inode: int
    size: int
    mtime_ns: int

    @classmethod
    def of(cls, path: Path) -> "FileState":
        """Return the state of a file."""
        there = path.stat()
        return cls(path.absolute(), there.st_ino, there.st_size, there.st_mtime_ns)

    @property
    def is_settled(self) -> bool:
        """Whether any later change will show in the time."""
        return time.time_ns() - self.mtime_ns > _TICK_NS


class _Entry(BaseModel):
    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class Session(_Entry):
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


class StoredPart(_Entry):
    """Manifest entry of a part: its path in the directory, and its number of rows."""

    file: str
    rows: int


class StoredChunk(_Entry):
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


class Manifest(_Entry):
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


def check_entries(directory: Path) -> None:
    """Reject a directory in which a link or a pipe takes the place of a file or folder of results.

    Raises:
        InputError: names the entry, or the directory is a file, cannot be read, or has a name that
            is not UTF-8, which Arrow cannot open.
    """
    try:
        os.fspath(directory).encode()
    except UnicodeEncodeError:
        text = "results cannot be kept under a name that is not UTF-8 (rename it)"
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
            raise InputError(f"{path}: is no {kind} (remove it, or give another directory)")


def present_names(directory: Path, names: Iterable[str]) -> list[str]:
    """Return those of some names that exist in a directory, which may be missing itself.

    Raises:
        InputError: the directory cannot be used, see `check_entries`.
    """
    check_entries(directory)
    return [name for name in names if (directory / name).exists()]


def list_parts(directory: Path, dataset: str) -> list[Path]:
    """Return the parts of a dataset by name; a file has its final name only once it is complete."""
    return sorted(path for path in directory.glob(f"{dataset}/*.parquet") if is_part(path))


def is_part(path: Path) -> bool:
    """Whether a file is named like a part, which no user's file is by chance."""
    return re.fullmatch(r"part-\d{4,}-\d{6,}\.parquet", path.name) is not None


def read_manifest(directory: str | Path) -> dict[str, Any]:
    """Read the manifest of a results directory.

    Args:
        directory: results directory.

    Returns:
        Its entries, as JSON has them.

    Raises:
        InputError: there is no manifest, it has changed since it was written (`Damaged`), or
            another version wrote it (`OtherVersion`).

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
        found = sealed.read_json(path)
    except FileNotFoundError:
        text = f"holds no results (there is no {MANIFEST})"
        if any(list_parts(directory, name) for name in DATASETS):
            text = f"{MANIFEST} is missing (`--resume` writes it again)"
        raise InputError(f"{directory}: {text}") from None
    except Damaged as error:
        _check_version(directory, _unsealed(path))
        raise Damaged(f"{error} (`--resume` writes it again)") from None
    _check_version(directory, found)
    require_shallow(found, path)
    return found


def find_manifest(directory: Path) -> Manifest | None:
    """Return the manifest of a results directory; None if it is missing or damaged.

    Raises:
        OtherVersion: another version wrote it.
        InputError: it cannot be read.
    """
    try:
        file = FileState.of(directory / MANIFEST)
    except OSError:
        return None
    if file not in _manifests:
        try:
            found = Manifest.model_validate(read_manifest(directory))
        except (Damaged, ValidationError):
            return None
        if not file.is_settled:
            return found
        _manifests[file] = found
    return _manifests[file]


_manifests: dict[FileState, Manifest] = {}
"""The manifests that this process has read: a report asks for one at every dataset it reads."""


class OtherVersion(InputError):
    """Results that another version of sinsjax wrote."""


def _check_version(directory: Path, manifest: Mapping[str, Any]) -> None:
    schema = str(manifest.get("schema", columns.SCHEMA_VERSION))
    if schema == columns.SCHEMA_VERSION:
        return
    versions = manifest.get("versions")
    version = str(versions.get("sinsjax", "")) if isinstance(versions, dict) else ""
    raise OtherVersion(
        f"{directory}: holds results of {shorten(to_one_line(f'sinsjax {version}'.strip()), 40)},"
        f" whose columns (schema {shorten(to_one_line(schema), 20)}) this version does not read"
        " (run the study again, into another directory or with --overwrite, or use that version)"
    )


def _unsealed(path: Path) -> dict[str, Any]:
    """A manifest without a seal, as older versions wrote them; empty if there is none."""
    try:
        found = json.loads(read_regular_file(path))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) and "fingerprint" in found else {}


# --- one writer at a time -----------------------------------------------------------------------


def lock(directory: Path) -> filelock.FileLock:
    """Lock a directory, created if missing, against other writers.

    The operating system holds the lock, and releases it when the process ends in whatever way.

    Raises:
        InputError: another process is writing there, or the directory is not writable.
    """
    make_folder(directory)
    check_entries(directory)
    held = _acquire(directory)
    with suppress(InputError):  # a writer without a name holds the lock all the same
        with atomic_write(directory / WRITER) as file:
            file.write(f"pid {os.getpid()} on {socket.gethostname()}\n".encode())
    return held


def check_unlocked(directory: Path) -> None:
    """Reject a directory that another process is writing to.

    Asked first: its content changes, and any other message about it would mislead.

    Raises:
        InputError: names that process, or the lock cannot be taken.
    """
    check_entries(directory)
    if (directory / LOCK).exists():
        _acquire(directory).release()


def _acquire(directory: Path) -> filelock.FileLock:
    held = filelock.FileLock(directory / LOCK)
    try:
        held.acquire(blocking=False)
    except filelock.Timeout:
        text = f"{directory}: another process is writing there{_writer(directory)}"
        raise InputError(f"{text} (wait until it ends)") from None
    except OSError as error:
        raise InputError(unwritable_message(directory, error)) from error
    return held


def _writer(directory: Path) -> str:
    try:
        name = read_regular_file(directory / WRITER)[:_SPARSE].decode().strip()
    except (OSError, ValueError):
        return ""
    return f": {shorten(to_one_line(name))}" if name else ""


# --- the files that sinsjax wrote; it never removes any others ------------------------------------


def stale_temporary_files(directory: Path) -> list[Path]:
    """Return temporary files left by processes killed while writing results or a tuning run."""
    names = [f".{name}" for name in (MANIFEST, STUDY, WRITER, FIGURES, "tuned.toml")]
    patterns = (f"{name}.*.tmp" for name in [*names, ".history.parquet", "figures/.*.png"])
    parts = (f"{name}/.part-*.tmp" for name in DATASETS)
    found = (path for pattern in (*patterns, *parts) for path in directory.glob(pattern))
    return [path for path in found if re.search(r"\.\d+\.tmp$", path.name)]


def owned_files(directory: Path) -> list[Path]:
    """Return the files that sinsjax wrote, identified by name, and figures by their list.

    This excludes files added by the user, and figures changed since they were drawn.
    """
    parts = (path for name in DATASETS for path in list_parts(directory, name))
    numbers = (path for path in directory.glob("reruns/*") if re.fullmatch(r"\d+", path.name))
    reruns = (number / name for number in numbers if _is_own_folder(number) for name in RERUN)
    files = [path for path in (*reruns, directory / STUDY) if path.is_file()]
    return [*parts, *files, *_figures(directory)]


def _is_own_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def list_figures(images: Mapping[str, bytes], directory: Path) -> None:
    """List the figures drawn in a directory, and remove earlier ones that are drawn no longer.

    A figure that has changed since it was drawn is a person's, and stays.

    Args:
        images: contents of PNG files by file name.
        directory: results directory.

    Raises:
        InputError: the list cannot be written.
    """
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in images.items()}
    for path in _figures(directory):
        if path != directory / FIGURES and path.name not in images:
            with suppress(OSError):  # of a directory that may be read only
                path.unlink()
    with atomic_write(directory / FIGURES) as file:
        file.write((json.dumps(digests, indent=1) + "\n").encode())


def _figures(directory: Path) -> Iterator[Path]:
    """Listed figures that have not changed since they were drawn, and the list itself."""
    for name, digest in _listed(directory).items():
        path = directory / "figures" / Path(name).name
        with suppress(OSError, InputError):
            if hashlib.sha256(read_regular_file(path)).hexdigest() == digest:
                yield path
    if (directory / FIGURES).is_file():
        yield directory / FIGURES


def _listed(directory: Path) -> dict[str, str]:
    try:
        listed = json.loads(read_regular_file(directory / FIGURES))
    except (OSError, ValueError, RecursionError):  # InputError is a ValueError
        return {}
    return {str(k): str(v) for k, v in listed.items()} if isinstance(listed, dict) else {}
