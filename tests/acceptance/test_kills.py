"""Sweeps in separate processes that are killed, stopped and disturbed, and lose nothing."""

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support.studies import small_study
from support.sweep_directories import (
    CHUNK_RUNS,
    assert_complete,
    modification_times,
    read_manifest_entries,
    read_parts,
)

from sinsjax.execution.directory import is_intact
from sinsjax.execution.results import read_curves, read_summary
from sinsjax.platform import runtime
from sinsjax.study.load import study_to_toml

pytestmark = [pytest.mark.nightly, pytest.mark.optimised(False)]

ROOT = Path(__file__).parents[2]
RECORDS = 3.0
STUDY = small_study(
    study={"draws": 160, "duration_s": RECORDS, "window_s": [0, RECORDS], "curves": True},
    alignment={"method": "compass", "phi_e0_deg": 0.1, "phi_n0_deg": 0.1},
    compass={"level_time_s": 1.0},
    axes={"yaw_amplitude_deg": [2.8, 0.0], "phi_u0_deg": [0.1 * i for i in range(16)]},
)
"""Two environments of 16 variants; every process traces its program, a compass's is fastest."""
CHUNKS = STUDY.n_draws * STUDY.n_variants // CHUNK_RUNS
DEADLINE_S = 120.0

NEVER = ("never", "", 0)
NAMED = (
    ("half", "*/manifest.json", 1),
    ("before", "*/manifest.json", 1),
    ("after", "*/manifest.json", 1),
    ("before", "curves/*", 1),
    ("after", "curves/*", 1),
    ("before", "summary/*", 2),
    ("after", "summary/*", 2),
    ("half", "summary/*", 2),
    ("half", "*/manifest.json", 1),
    ("before", "*/manifest.json", 2),
)
"""The first three find an empty directory: those are its first manifest."""


class Sweeps:
    """Starter of sweeping processes into one directory."""

    def __init__(self, folder: Path, out: Path) -> None:
        self.out, self._folder = out, folder
        self.study = folder / "study.toml"
        self.study.write_text(study_to_toml(STUDY))
        self._all: list[subprocess.Popen] = []

    def start(
        self,
        *options: str,
        point: tuple[str, str, int] = NEVER,
        how: str = "--resume",
        pause_s: float = 0.0,
    ) -> subprocess.Popen:
        """Return a sweeping process that is killed at a point."""
        words = ["sweep", self.study, "-o", self.out, how, "--chunk-runs", CHUNK_RUNS, *options]
        paths = os.pathsep.join(map(str, (ROOT, ROOT / "tests")))
        environment = {runtime.CACHE_VARIABLE: str(self._folder / "cache"), "PYTHONPATH": paths}
        process = subprocess.Popen(
            [sys.executable, "-m", "support.killed_commands", *map(str, (*point, pause_s, *words))],
            env=os.environ | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._all.append(process)
        return process

    def sweep(self, *options: str, how: str = "--resume") -> tuple[int, str, str]:
        """Run a sweep to its end."""
        return ended(self.start(*options, how=how))

    def close(self) -> None:
        """End the remaining processes."""
        for process in self._all:
            process.kill()
            process.communicate()


def ended(process: subprocess.Popen) -> tuple[int, str, str]:
    """Return exit code, output and error output of a process that ends by itself."""
    output, error = process.communicate(timeout=DEADLINE_S)
    return process.returncode, output, error


def wait(process: subprocess.Popen, until: Callable[[], bool]) -> None:
    """Wait until a process has done something."""
    since = time.monotonic()
    while not until():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < since + DEADLINE_S
        time.sleep(0.002)


def count(out: Path) -> int:
    return len(list(out.glob("summary/*.parquet")))


def written(path: Path) -> int:
    return path.stat().st_mtime_ns if path.exists() else 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("kills")


@pytest.fixture(scope="module")
def whole(folder: Path) -> Iterator[Path]:
    """Results of an uninterrupted run on one device; all other runs here use two."""
    sweeps = Sweeps(folder, folder / "whole")
    code, _, error = sweeps.sweep("--devices", "1")
    assert (code, error) == (0, "")
    assert count(sweeps.out) == CHUNKS
    yield sweeps.out
    sweeps.close()


@pytest.fixture
def sweeps(folder: Path, whole: Path, tmp_path: Path) -> Iterator[Sweeps]:
    sweeps = Sweeps(folder, tmp_path / "out")
    yield sweeps
    sweeps.close()


def assert_sound(out: Path, whole: Path, made: dict[str, int]) -> None:
    """Check that results after a kill are readable, part of the whole, and lost nothing.

    Args:
        out: the directory that a process died in.
        whole: an uninterrupted run's.
        made: when every part was written that had been made before; those found now are added.
    """
    there, expected = read_parts(out), read_parts(whole)
    assert {name: expected[name] for name in there} == there
    summaries = {name for name in there if name.startswith("summary")}
    assert {name.replace("summary", "curves") for name in summaries} <= there.keys()
    now = modification_times(out)
    assert {name: now.get(name) for name in made} == made, "a part was lost, or made twice"
    done = summaries | {name.replace("summary", "curves") for name in summaries}
    made |= {name: now[name] for name in done}
    if summaries:
        rows = read_summary(out)
        all_rows = read_summary(whole)
        assert rows.num_rows == CHUNK_RUNS * len(summaries) == read_summary(out).num_rows
        assert rows.equals(all_rows.take(rows["run_id"]))
        curves = read_curves(out, rows["run_id"].to_pylist())
        assert curves.num_rows == RECORDS * rows.num_rows
    if (out / "manifest.json").exists():
        assert is_intact((out / "manifest.json").read_bytes())


def test_sweep_resumes_after_twenty_kills_without_loss(sweeps: Sweeps, whole: Path) -> None:
    """Ten kills at named points, ten spread over the sweep, all on one directory."""
    out, chance = sweeps.out, random.Random(5)
    chunk_s = read_manifest_entries(whole)["wall_s"] / CHUNKS
    named, kills = iter(NAMED), {"named": 0, "spread": 0}
    order = "nnnn ss n s n s n s n s n s n sss".replace(" ", "")
    made: dict[str, int] = {}
    for point in (NEVER if kind == "s" else next(named) for kind in order):
        before, there = written(out / "manifest.json"), count(out)
        process = sweeps.start(point=point, pause_s=0.2)
        if point is NEVER:
            if kills["spread"] == 0:  # while JAX is imported and starts
                time.sleep(2.0)
            elif kills["spread"] == 1:  # while it compiles
                wait(process, lambda before=before: written(out / "manifest.json") > before)
            else:
                wait(process, lambda there=there: count(out) > there)
            time.sleep(chance.uniform(0, chunk_s))
            process.send_signal(signal.SIGKILL)
        assert ended(process)[0] == -signal.SIGKILL, point
        kills["spread" if point is NEVER else "named"] += 1
        assert_sound(out, whole, made)
    assert kills == {"named": 10, "spread": 10}
    assert count(out) < CHUNKS
    code, told, error = sweeps.sweep()
    assert (code, error) == (0, "")
    assert " of 5,120 runs, already done" in told
    assert_sound(out, whole, made)
    assert_complete(out, whole)
    assert read_summary(out).equals(read_summary(whole))
    assert read_curves(out).equals(read_curves(whole))


def test_second_writer_is_refused_until_first_process_dies(sweeps: Sweeps, whole: Path) -> None:
    """The lock is the operating system's, so it is released however the process dies."""
    first = sweeps.start()
    wait(first, lambda: count(sweeps.out) > 0)
    first.send_signal(signal.SIGSTOP)  # holds on, and writes no more
    before = modification_times(sweeps.out)
    for how in ("--resume", "--overwrite"):
        code, _, error = sweeps.sweep(how=how)
        assert code == 2
        told = rf"error: {sweeps.out}: another process is writing there \(wait .*\)\n"
        assert re.fullmatch(told, error)
    assert modification_times(sweeps.out) == before
    first.send_signal(signal.SIGKILL)
    assert ended(first)[0] == -signal.SIGKILL
    code, _, error = sweeps.sweep()
    assert (code, error) == (0, "")
    assert_complete(sweeps.out, whole)


def test_sweep_stopped_by_signals_resumes_without_loss(sweeps: Sweeps, whole: Path) -> None:
    """One signal finishes the running chunks; two end at once, and lose nothing else."""
    out, made = sweeps.out, dict[str, int]()
    for number in (signal.SIGINT, signal.SIGTERM):
        process, there = sweeps.start(pause_s=0.2), count(out)
        wait(process, lambda there=there: count(out) > there)
        process.send_signal(number)
        code, told, error = ended(process)
        assert code == 130
        assert "Stopping after the running chunks" in " ".join(told.split())
        done = f"{count(out) * CHUNK_RUNS:,} of {CHUNKS * CHUNK_RUNS:,} runs are in {out}"
        again = f"sinsjax sweep {sweeps.study} -o {out} --chunk-runs {CHUNK_RUNS} --resume"
        assert error == f"interrupted: {done} (continue: {again})\n"
        state = read_manifest_entries(out)
        assert state["state"] == "interrupted"
        assert state["runs_done"] == count(out) * CHUNK_RUNS
        assert not list(out.rglob("*.tmp")) and not (out / "figures").exists()
        assert_sound(out, whole, made)
    process, there = sweeps.start(pause_s=0.2), count(out)
    wait(process, lambda: count(out) > there)
    process.send_signal(signal.SIGSTOP)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGCONT):  # the first two come together
        process.send_signal(number)
    code, _, error = ended(process)
    assert code in (128 + signal.SIGINT, 128 + signal.SIGTERM) and error == ""
    assert read_manifest_entries(out)["state"] == "running"
    assert_sound(out, whole, made)
    code, _, error = sweeps.sweep()
    assert (code, error) == (0, "")
    assert_sound(out, whole, made)
    assert_complete(out, whole)


MORE = 200


@pytest.mark.parametrize(
    ("point", "began"),
    [
        (("half", "*/manifest.json", 1), False),
        (("after", "*/manifest.json", 1), False),
        (("after", "*/study.toml", 1), False),
        (("half", "summary/*", 1), True),
        (("after", "summary/*", 1), True),
    ],
)
def test_killed_extension_keeps_existing_results(
    sweeps: Sweeps, whole: Path, point: tuple[str, str, int], began: bool
) -> None:
    """No part of the results is replaced, so their number never decreases."""
    out, before = sweeps.out, read_parts(whole)
    shutil.copytree(whole, out)
    there = modification_times(out)
    process = sweeps.start("--draws", str(MORE), point=point)
    assert ended(process)[0] == -signal.SIGKILL
    assert {name: modification_times(out)[name] for name in there} == there
    rows = read_summary(out)
    assert rows["draw_id"].to_numpy().max() >= STUDY.n_draws - 1
    assert (rows.num_rows > CHUNKS * CHUNK_RUNS) <= began
    code, _, error = sweeps.sweep("--draws", str(MORE))
    assert (code, error) == (0, "")
    assert {name: content for name, content in read_parts(out).items() if name in before} == before
    rows = read_summary(out)
    assert rows["run_id"].to_pylist() == list(range(MORE * STUDY.n_variants))
