"""Studies of many runs, and directories of their results: parts, checksums, manifests."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from sinsjax.engine.batch import map_in_threads
from sinsjax.execution.directory import DATASETS, SEAL_KEY, is_intact, to_sealed_json
from sinsjax.execution.tasks import Executor, Task, TaskResult, TaskRunner
from sinsjax.study.study import Study
from support.studies import small_study

SHORT: dict[str, Any] = {"duration_s": 2.0, "window_s": [0, 2], "curves": True}
CHUNK_RUNS = 128
CHUNKS = 12


def sweep_study(**changes: Any) -> Study:
    """Return a study of 2 environments with 16 variants: 12 chunks of `CHUNK_RUNS` runs."""
    axes = {"yaw_amplitude_deg": [2.8, 0.0], "p0_yaw_deg": [10.0 * i for i in range(1, 17)]}
    study = SHORT | {"draws": 48} | changes.pop("study", {})
    return small_study(study=study, axes=axes | changes.pop("axes", {}), **changes)


STUDIES: dict[str, dict[str, Any]] = {
    "worlds": {
        "study": SHORT | {"draws": 50},
        "axes": {
            "yaw_center_deg": [10.0, 100.0],
            "phi_u0_deg": [0.0, 10.0, 30.0],
            "reset_times_s": [[], [1.37]],
        },
    },
    "shared covariance": {
        "study": SHORT | {"draws": 200},
        "alignment": {"specific_force": "gravity"},
        "axes": {"phi_u0_deg": [0.0, 10.0, 30.0]},
    },
    "passes": {
        "study": SHORT | {"draws": 60},
        "passes": {"stored_s": 1.0},
        "axes": {"method": ["kalman5", "compass"], "phi_u0_deg": [0.0, 3.0]},
    },
    "drawn": {
        "study": SHORT | {"draws": 150},
        "motion": {"yaw_center_deg": None},
        "sensors": {"gyro_bias_deg_per_h": None},
        "alignment": {"phi_e0_deg": 1.0, "phi_n0_deg": None, "phi_u0_deg": None},
        "drawn": {
            "sampling": "sobol",
            "phi_u0_deg": {"uniform": [-10, 10]},
            "gyro_bias_deg_per_h": {"normal": [0, 0.01]},
            "yaw_center_deg": {"values": [0, 90, 180]},
            "phi_n0_deg": {"values": [0.0, 1.0]},
        },
        "axes": {"reset_count": [0, 1]},
        "resets": {"reset_cycle_s": 1.0},
    },
}


def make_study(name: str, draws: int | None = None) -> Study:
    """Return one of `STUDIES`, optionally with another number of draws."""
    study = small_study(**STUDIES[name])
    return study if draws is None else study.replace({"study.draws": draws})


def read_parts(directory: Path) -> dict[str, bytes]:
    """Return the bytes of every part, by its path in the directory."""
    paths = (p for name in DATASETS for p in directory.glob(f"{name}/*.parquet"))
    return {path.relative_to(directory).as_posix(): path.read_bytes() for path in paths}


def modification_times(directory: Path) -> dict[str, int]:
    """Return the modification time of every part, by its path in the directory."""
    return {name: (directory / name).stat().st_mtime_ns for name in read_parts(directory)}


def read_files_and_times(directory: Path) -> dict[str, tuple[bytes, int]]:
    """Return bytes and time of every file but the lock."""
    return {
        str(path.relative_to(directory)): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in sorted(directory.rglob("*"))
        if path.is_file() and path.name != ".lock"
    }


def read_manifest_entries(directory: Path) -> dict[str, Any]:
    return json.loads((directory / "manifest.json").read_text())


def assert_intact(directory: Path) -> None:
    """Assert that the manifest and all parts match their seals."""
    assert is_intact((directory / "manifest.json").read_bytes())
    assert all(map(is_intact, read_parts(directory).values()))


def rewrite_manifest(directory: Path, **changes: Any) -> None:
    """Replace entries of a manifest and seal it again."""
    content = read_manifest_entries(directory) | changes
    del content[SEAL_KEY]
    (directory / "manifest.json").write_bytes(to_sealed_json(content))


def assert_complete(directory: Path, reference: Path) -> None:
    """Assert that a directory equals that of an uninterrupted run, to the last bit."""
    assert read_parts(directory) == read_parts(reference)
    assert_intact(directory)
    entries = read_manifest_entries(directory)
    assert entries["state"] == "complete"
    assert entries["runs_done"] == entries["runs"]
    assert not list(directory.rglob("*.tmp"))


class TaskRecorder:
    """Executor on this machine that records the completed tasks."""

    def __init__(self) -> None:
        self.done: list[str] = []

    @property
    def executor(self) -> Executor:
        return Executor(self._run_tasks, {})

    def _run_tasks(self, runner: TaskRunner, tasks: Iterable[Task]) -> Iterator[TaskResult]:
        for encoded in map_in_threads(runner.compute, tasks, 2):
            self.done.append(encoded.task.name)
            yield encoded
