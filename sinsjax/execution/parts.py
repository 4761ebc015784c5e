"""Parts of a results directory, and their verification against the manifest.

A Parquet page has a 32-bit checksum, but the footer has none; so each file is compared with its
SHA-256 in the manifest before it is used, once per process.
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
from sinsjax.execution.belongings import check_name
from sinsjax.messages import first_line, shortened
from sinsjax.study.files import require_shallow

MANIFEST = "manifest.json"
_HINT = "`sinsjax sweep --resume` recomputes broken parts"
_OTHERWISE = {
    "summary": ("estimates", "estimates of variants, and no runs (`read_estimates` reads them)"),
    "estimates": ("summary", "runs, and no estimates of variants (`read_summary` reads them)"),
}
"""For a dataset that is not there: the one that may be, and what a directory of that holds."""

_TICK_NS = 10**9
_READERS = 4  # threads; hashing releases Python's lock


class _File(NamedTuple):
    """A file at a moment; a changed file compares unequal."""

    path: Path
    size: int
    mtime_ns: int

    @classmethod
    def of(cls, path: Path) -> "_File":
        there = path.stat()
        return cls(path.absolute(), there.st_size, there.st_mtime_ns)

    @property
    def is_settled(self) -> bool:
        """Whether any later change will show in the time, despite a file system's coarse clock."""
        return time.time_ns() - self.mtime_ns > _TICK_NS


_found: dict[_File, str] = {}
"""SHA-256 of the files that this process has hashed."""

_recorded: dict[_File, dict[str, str]] = {}
"""SHA-256 of the parts by their manifest, for the manifests that this process has read."""


def query(
    directory: Path, name: str, question: Callable[[ds.Dataset], Any], *, verify: bool = True
) -> Any:
    """Query a dataset, verifying page checksums.

    Args:
        directory: results directory.
        name: name of the dataset.
        question: function of the dataset that gives the answer.
        verify: whether to compare the parts with the manifest first.

    Raises:
        InputError: there are no parts, or a part has changed or cannot be read.
    """
    check_name(directory)
    if not is_there(directory, name, verify=verify):
        other, why = _OTHERWISE.get(name, ("", ""))
        found = why if other and any(find(directory, other)) else f"no results (no part in {name}/)"
        raise InputError(f"{directory}: holds {found}")
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
    """Whether a dataset has any parts.

    Args:
        directory: results directory.
        name: name of the dataset.
        verify: whether to check the manifest too.

    Raises:
        InputError: the manifest lists parts, but the directory has none.
    """
    if any(find(directory, name)):
        return True
    if verify:
        _verify(directory, name, ())
    return False


def find(directory: Path, name: str) -> Iterator[Path]:
    """Parts of a dataset; a file has its final name only once it is complete."""
    return directory.glob(f"{name}/part-[0-9]*.parquet")


def read_manifest(directory: str | Path) -> dict[str, Any]:
    """Read the manifest of a results directory.

    Raises:
        InputError: there is no readable manifest.
    """
    try:
        manifest = json.loads(Path(directory, MANIFEST).read_text(encoding="utf-8"))
        require_shallow(manifest, MANIFEST)
    except (OSError, ValueError, RecursionError) as error:
        what = shortened(str(error))
        raise InputError(f"{directory}: holds no readable {MANIFEST} ({what})") from error
    if not isinstance(manifest, dict):
        raise InputError(f"{directory}: holds no readable {MANIFEST} (not a JSON object)")
    return manifest


def _verify(directory: Path, name: str, parts: Iterable[Path]) -> None:
    """Compare parts with the manifest, if there is one."""
    recorded = {k: sha for k, sha in _checksums(directory).items() if k.startswith(f"{name}/")}
    there = {f"{name}/{path.name}": path for path in parts}
    for file in sorted(recorded.keys() - there.keys()):
        # It may have been written after `parts` were listed and before the manifest was read.
        if not (directory / file).exists():
            raise InputError(f"{directory / file}: listed in the manifest but missing ({_HINT})")
    known = [file for file in there if file in recorded]  # others are newer than the manifest
    with ThreadPoolExecutor(_READERS) as pool:
        found = pool.map(_sha256, map(there.__getitem__, known))
        for file, sha in zip(known, found, strict=True):
            if sha != recorded[file]:
                raise InputError(
                    f"{directory / file}: has changed: its SHA-256 differs from the manifest's"
                    f" ({_HINT})"
                )


def _checksums(directory: Path) -> dict[str, str]:
    """SHA-256 of every part in the manifest, by its path in the directory."""
    try:
        file = _File.of(directory / MANIFEST)
    except FileNotFoundError:
        return {}
    if (known := _recorded.get(file)) is not None:
        return known
    chunks = read_manifest(directory).get("chunks", [])
    try:
        files = [entry for chunk in chunks for entry in chunk.get("files", ())]
        recorded = {str(entry["file"]): str(entry["sha256"]) for entry in files}
    except (AttributeError, KeyError, TypeError):
        raise InputError(
            f"{directory}: {MANIFEST}: invalid chunks (`sinsjax sweep --resume` rewrites them)"
        ) from None
    if file.is_settled:
        _recorded[file] = recorded
    return recorded


def _sha256(path: Path) -> str:
    file = _File.of(path)
    if (known := _found.get(file)) is not None:
        return known
    with path.open("rb") as content:
        sha = hashlib.file_digest(content, "sha256").hexdigest()
    if file.is_settled:
        _found[file] = sha
    return sha
