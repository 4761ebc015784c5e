"""The parts of a directory of results, and whether they are what was written.

A page of Parquet has a checksum of 32 bits, a footer has none: what the manifest says of a whole
file is compared before anything in it is believed, once a process for every file.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.dataset as ds

from sinsjax.errors import InputError
from sinsjax.messages import first_line, shortened

MANIFEST = "manifest.json"
_HINT = "`sinsjax sweep --resume` makes broken parts again"
_TICK_NS = 10**9
_READERS = 4  # hashing leaves Python's lock alone


class _File(NamedTuple):
    """A file as it is at a moment: one that changes is another."""

    path: Path
    size: int
    mtime_ns: int

    @classmethod
    def of(cls, path: Path) -> "_File":
        there = path.stat()
        return cls(path.absolute(), there.st_size, there.st_mtime_ns)

    @property
    def is_settled(self) -> bool:
        """Whether a later change has a later time: clocks of file systems tick coarsely."""
        return time.time_ns() - self.mtime_ns > _TICK_NS


_found: dict[_File, str] = {}
"""The SHA-256 of the files that this process has read whole."""

_told: dict[_File, dict[str, str]] = {}
"""What the manifests that this process has read say of their parts."""


def ask(
    directory: Path, name: str, question: Callable[[ds.Dataset], Any], *, verify: bool = True
) -> Any:
    """The answer to a question about a dataset, its pages checked.

    Args:
        directory: of the results.
        name: of the dataset.
        question: asked of all of its parts.
        verify: whether the parts are compared with the manifest first.

    Raises:
        InputError: there is no part, one is not what was written, or it cannot be read.
    """
    if not is_there(directory, name, verify=verify):
        raise InputError(f"{directory}: holds no results (no part in {name}/)")
    parts = sorted(find(directory, name))
    checked = ds.ParquetFragmentScanOptions(page_checksum_verification=True)
    form = ds.ParquetFileFormat(default_fragment_scan_options=checked)
    try:
        if verify:
            _verify(directory, name, parts)
        return question(ds.dataset(parts, format=form))
    except (OSError, pa.ArrowException) as error:
        what = first_line(error)
        raise InputError(f"{directory / name}: cannot be read: {what} ({_HINT})") from error


def is_there(directory: Path, name: str, *, verify: bool = True) -> bool:
    """Whether a dataset has a part.

    Args:
        directory: of the results.
        name: of the dataset.
        verify: whether the manifest is asked, too.

    Raises:
        InputError: the manifest has parts, and the directory has none.
    """
    if any(find(directory, name)):
        return True
    if verify:
        _verify(directory, name, ())
    return False


def find(directory: Path, name: str) -> Iterator[Path]:
    """The parts of a dataset, whole ones as they have their names, and nothing else."""
    return directory.glob(f"{name}/part-[0-9]*.parquet")


def read_manifest(directory: str | Path) -> dict[str, Any]:
    """The manifest of a directory of results.

    Raises:
        InputError: there is none that can be read.
    """
    try:
        manifest = json.loads(Path(directory, MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        what = shortened(str(error))
        raise InputError(f"{directory}: holds no readable {MANIFEST} ({what})") from error
    if not isinstance(manifest, dict):
        raise InputError(f"{directory}: holds no readable {MANIFEST} (it is no table)")
    return manifest


def _verify(directory: Path, name: str, parts: Iterable[Path]) -> None:
    """Compares parts with the manifest; without one there is nothing to compare them with."""
    told = {file: sha for file, sha in _checksums(directory).items() if file.startswith(f"{name}/")}
    there = {f"{name}/{path.name}": path for path in parts}
    for file in sorted(told.keys() - there.keys()):
        # One that came after `parts` were listed, and before the manifest was read, is there.
        if not (directory / file).exists():
            raise InputError(f"{directory / file}: is missing, by the manifest ({_HINT})")
    known = [file for file in there if file in told]  # what is newer than it, it does not know
    with ThreadPoolExecutor(_READERS) as pool:
        found = pool.map(_sha256, map(there.__getitem__, known))
        for file, sha in zip(known, found, strict=True):
            if sha != told[file]:
                raise InputError(
                    f"{directory / file}: is not what was written: its SHA-256 is not that of the"
                    f" manifest ({_HINT})"
                )


def _checksums(directory: Path) -> dict[str, str]:
    """The SHA-256 of every part that the manifest knows, by its place in the directory."""
    try:
        file = _File.of(directory / MANIFEST)
    except FileNotFoundError:
        return {}
    if (known := _told.get(file)) is not None:
        return known
    chunks = read_manifest(directory).get("chunks", [])
    try:
        files = [entry for chunk in chunks for entry in chunk.get("files", ())]
        told = {str(entry["file"]): str(entry["sha256"]) for entry in files}
    except (AttributeError, KeyError, TypeError):
        raise InputError(
            f"{directory}: {MANIFEST}: its chunks cannot be read (`sinsjax sweep --resume`)"
        ) from None
    if file.is_settled:
        _told[file] = told
    return told


def _sha256(path: Path) -> str:
    file = _File.of(path)
    if (known := _found.get(file)) is not None:
        return known
    with path.open("rb") as content:
        sha = hashlib.file_digest(content, "sha256").hexdigest()
    if file.is_settled:
        _found[file] = sha
    return sha
