"""Directories of results as tests look at them: parts, checksums, what must not be there."""

import hashlib
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from studies import small_study

from sinsjax.batch import spread
from sinsjax.config import Study
from sinsjax.work import Executor, Packed, Task, Workshop

CHUNK_RUNS = 128
CHUNKS = 12


def sweep_study(**changes: Any) -> Study:
    """Two worlds of 16 variants: 12 chunks of `CHUNK_RUNS` runs, 2 s each, with curves."""
    sections: dict[str, Any] = {
        "study": {"draws": 48, "duration_s": 2.0, "window_s": [0, 2], "curves": True},
        "axes": {
            "yaw_amplitude_deg": [2.8, 0.0],
            "p0_yaw_deg": [10.0 * i for i in range(1, 17)],
        },
    }
    for name, change in changes.items():
        sections[name] = sections.get(name, {}) | change
    return small_study(**sections)


def parts(directory: Path) -> dict[str, bytes]:
    """The bytes of every part, by its place in the directory."""
    found = (p for name in ("summary", "curves") for p in directory.glob(f"{name}/*.parquet"))
    return {path.relative_to(directory).as_posix(): path.read_bytes() for path in found}


def times(directory: Path) -> dict[str, int]:
    """When every part was written, by its place in the directory."""
    return {name: (directory / name).stat().st_mtime_ns for name in parts(directory)}


def everything(directory: Path) -> dict[str, tuple[bytes, int]]:
    """Bytes and time of every file but the lock."""
    return {
        str(path.relative_to(directory)): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in sorted(directory.rglob("*"))
        if path.is_file() and path.name != ".lock"
    }


def manifest(directory: Path) -> dict[str, Any]:
    return json.loads((directory / "manifest.json").read_text())


def assert_checksums(directory: Path) -> None:
    """Every part is in the manifest, with its checksum, and nothing else is."""
    told = {f["file"]: f["sha256"] for c in manifest(directory)["chunks"] for f in c["files"]}
    assert told == {name: hashlib.sha256(b).hexdigest() for name, b in parts(directory).items()}


def assert_complete(directory: Path, whole: Path) -> None:
    """A directory holds what an uninterrupted run left, to the last bit, and nothing else."""
    assert parts(directory) == parts(whole)
    assert_checksums(directory)
    told = manifest(directory)
    assert told["state"] == "complete"
    assert {chunk["state"] for chunk in told["chunks"]} == {"done"}
    assert told["runs_done"] == told["runs"] == sum(chunk["runs"] for chunk in told["chunks"])
    assert not list(directory.rglob("*.tmp"))


class Recorder:
    """Does tasks on this machine, and remembers which."""

    def __init__(self) -> None:
        self.done: list[str] = []

    @property
    def executor(self) -> Executor:
        return Executor(self._do, {})

    def _do(self, workshop: Workshop, tasks: Iterable[Task]) -> Iterator[Packed]:
        for packed in spread(workshop.pack, tasks, 2):
            self.done.append(packed.task.name)
            yield packed
