"""Sweeps in separate processes that are killed or disturbed, and lose nothing.

`python benchmarks/soak.py --minutes N` kills, stops and disturbs sweeps and tunings at random.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
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

from sinsjax.execution.results import read_curves, read_summary
from sinsjax.platform import runtime
from sinsjax.study.load import study_to_toml

pytestmark = [pytest.mark.nightly, pytest.mark.optimised(False)]

ROOT = Path(__file__).parents[2]
STUDY = small_study(
    study={"draws": 160, "duration_s": 3.0, "window_s": [0, 3], "curves": True},
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
    """Processes that sweep into one directory, and when each part was written there."""

    def __init__(self, folder, out):
        self.out, self._folder = out, folder
        self.made = {}
        self.study = folder / "study.toml"
        self.study.write_text(study_to_toml(STUDY))
        self._all = []

    def start(self, *options, point=NEVER, pause_s=0.0):
        """Return a process that is killed at a point, and waits after each part."""
        words = ["sweep", self.study, "-o", self.out, "--chunk-runs", CHUNK_RUNS, *options]
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

    def complete(self, *options):
        """Sweep on to the end, without an error; return what is printed."""
        code, told, error = ended(self.start("--resume", *options))
        assert (code, error) == (0, "")
        return told

    def count(self):
        return len(list(self.out.glob("summary/*.parquet")))

    def start_and_wait(self):
        """Return a process that has written another part."""
        there, since = self.count(), time.monotonic()
        process = self.start("--resume", pause_s=0.2)
        while self.count() == there:
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < since + DEADLINE_S
            time.sleep(0.002)
        return process

    def assert_sound(self, whole):
        """Check that what is there is part of the whole, and that no part was lost or made twice.

        Curves go first: of the runs with a summary, they are there.
        """
        there, expected, now = read_parts(self.out), read_parts(whole), modification_times(self.out)
        assert {name: expected[name] for name in there} == there
        done = {name for name in there if name.startswith("summary")}
        done |= {name.replace("summary", "curves") for name in done}
        assert done <= there.keys()
        assert {name: now.get(name) for name in self.made} == self.made
        self.made |= {name: now[name] for name in done}
        if done:
            runs = read_summary(self.out)["run_id"].to_pylist()
            assert 2 * len(runs) == CHUNK_RUNS * len(done)
            assert read_curves(self.out, runs).num_rows == 3 * len(runs)

    def close(self):
        """End the remaining processes."""
        for process in self._all:
            process.kill()
            process.communicate()


def ended(process):
    """Return exit code, output and error output of a process that ends by itself."""
    output, error = process.communicate(timeout=DEADLINE_S)
    return process.returncode, output, error


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("kills")


@pytest.fixture(scope="module")
def whole(folder):
    """Results of an uninterrupted run on one device; all other runs here use two."""
    sweeps = Sweeps(folder, folder / "whole")
    sweeps.complete("--devices", "1")
    assert sweeps.count() == CHUNKS
    return sweeps.out


@pytest.fixture
def sweeps(folder, whole, tmp_path):
    sweeps = Sweeps(folder, tmp_path / "out")
    yield sweeps
    sweeps.close()


def test_sweep_resumes_after_twenty_kills_without_loss(sweeps, whole):
    """Ten kills at named points, ten spread over the sweep, all on one directory."""
    chance, chunk_s = random.Random(5), read_manifest_entries(whole)["wall_s"] / CHUNKS
    named = iter(NAMED)
    for kill, kind in enumerate("nnnnssnsnsnsnsnsnsss"):
        if kind == "n":
            process = sweeps.start("--resume", point=next(named), pause_s=0.2)
        elif kill == 4:  # while JAX is imported and starts
            process = sweeps.start("--resume", pause_s=0.2)
            time.sleep(2.0)
        else:
            process = sweeps.start_and_wait()
            time.sleep(chance.uniform(0, chunk_s))
        if kind == "s":
            process.kill()
        assert ended(process)[0] == -signal.SIGKILL, kill
        sweeps.assert_sound(whole)
    assert next(named, None) is None and sweeps.count() < CHUNKS
    assert " of 5,120 runs, already done" in sweeps.complete()
    sweeps.assert_sound(whole)
    assert_complete(sweeps.out, whole)


def test_second_writer_is_refused_until_first_process_dies(sweeps, whole):
    """The lock is the operating system's, so it is released however the process dies."""
    first = sweeps.start_and_wait()
    first.send_signal(signal.SIGSTOP)  # holds on, and writes no more
    before = modification_times(sweeps.out)
    for how in ("--resume", "--overwrite"):
        code, _, error = ended(sweeps.start(how))
        assert (code, error.count("\n")) == (2, 1)
        assert error.startswith(f"error: {sweeps.out}: another process is writing there (")
    assert modification_times(sweeps.out) == before
    first.kill()
    assert ended(first)[0] == -signal.SIGKILL
    sweeps.complete()
    assert_complete(sweeps.out, whole)


@pytest.mark.parametrize("file", ["*/manifest.json", "summary/*"])
def test_killed_extension_keeps_existing_results(sweeps, whole, file):
    """No part of the results is replaced, so their number never decreases."""
    out, more = Path(shutil.copytree(whole, sweeps.out)), ("--draws", "200")
    parts, times = read_parts(out), modification_times(out)
    assert ended(sweeps.start("--resume", *more, point=("half", file, 1)))[0] == -signal.SIGKILL
    assert times.items() <= modification_times(out).items()
    assert read_summary(out).num_rows >= CHUNKS * CHUNK_RUNS
    sweeps.complete(*more)
    assert parts.items() <= read_parts(out).items()
    assert read_summary(out)["run_id"].to_pylist() == list(range(200 * STUDY.n_variants))
