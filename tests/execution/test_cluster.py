"""Real Dask workers produce the bytes of a local run, also if they are lost or late."""

import json
import os
import re
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import distributed
import psutil
import pytest
from support.studies import BASE
from support.sweep_directories import read_parts

from sinsjax.errors import InputError
from sinsjax.execution import cluster, run
from sinsjax.execution.directory import read_manifest
from sinsjax.execution.results import read_summary
from sinsjax.platform import machine, runtime
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study

pytestmark = [pytest.mark.nightly, pytest.mark.optimised(False)]

CHUNK = 128
STUDY: dict[str, Any] = BASE | {
    "study": BASE["study"]
    | {"duration_s": 300.0, "rate_hz": 20.0, "window_s": [200, 300], "draws": 600},
    "alignment": {"method": "compass", "phi_e0_deg": 0.1, "phi_n0_deg": 0.1},
    "compass": {"level_time_s": 60.0},
    "axes": {"phi_u0_deg": [0.0, 0.3, 0.6, 1.0]},
}
"""2400 runs in 19 chunks of some 0.1 s; a compass is compiled quickly."""

Start = Callable[..., subprocess.Popen]


@pytest.fixture(scope="module", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Every worker is a new process: they share what is compiled, or would need minutes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(runtime.CACHE_VARIABLE, str(tmp_path_factory.mktemp("compiled")))
        yield


@pytest.fixture(scope="module")
def study() -> Study:
    return study_from_dict(STUDY)


@pytest.fixture(scope="module")
def local_parts(study: Study, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return the parts that this process computes."""
    out = tmp_path_factory.mktemp("here")
    run.run_into(study, out, chunk_runs=CHUNK)
    assert len(read_parts(out)) == 19 and "ok" in read_summary(out)["status"].to_pylist()
    return read_parts(out)


@pytest.fixture
def start() -> Iterator[Start]:
    """Start commands of Dask, whose processes end with the test."""
    started: list[subprocess.Popen] = []

    def start(*words: str, **environment: str) -> subprocess.Popen:
        command = [sys.executable, "-m", *words, "--no-dashboard"]
        null, variables = subprocess.DEVNULL, os.environ | environment
        started.append(subprocess.Popen(command, env=variables, stdout=null, stderr=null))
        return started[-1]

    yield start
    for process in reversed(started):
        process.terminate()
        process.wait(timeout=60)


@pytest.fixture
def scheduler(start: Start, tmp_path: Path) -> str:
    """Return the address of a scheduler without workers."""
    about = tmp_path / "scheduler.json"
    words = ("--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(about))
    start("dask", "scheduler", *words)
    for _ in range(600):
        with suppress(FileNotFoundError, json.JSONDecodeError):
            return str(json.loads(about.read_text())["address"])
        time.sleep(0.05)
    raise AssertionError("no scheduler within 30 s")


def wait_for_workers(scheduler: str, count: int) -> None:
    """Wait until a scheduler has so many workers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", distributed.versions.VersionMismatchWarning)
        with distributed.Client(scheduler, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=120)


def when_done(chunks: int, action: Callable[[], object]) -> Callable[[run.RunProgress], None]:
    """Return a progress callback that acts once, after some chunks."""
    left = [action]

    def on_progress(progress: run.RunProgress) -> None:
        if progress.done >= chunks * CHUNK and left:
            left.pop()()

    return on_progress


@pytest.mark.skipif(runtime.usable_cores() < 2, reason="two workers need two cores, one each")
def test_lost_and_late_workers_give_same_bytes_as_local_run(
    start: Start,
    scheduler: str,
    study: Study,
    local_parts: dict[str, bytes],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ("dask", "worker", scheduler, "--nthreads", "1", "--no-nanny")
    victim, _ = (start(*words) for _ in range(2))
    wait_for_workers(scheduler, 2)

    def replace() -> None:
        victim.kill()
        start(*words)

    with cluster.executor(scheduler=scheduler) as executor:
        options: dict[str, Any] = {"executor": executor, "on_progress": when_done(3, replace)}
        run.run_into(study, tmp_path / "out", chunk_runs=CHUNK, **options)
    assert read_parts(tmp_path / "out") == local_parts
    assert re.fullmatch(r"Warning: tcp://\S+: lost this worker, .*\n", capsys.readouterr().err)
    manifest = read_manifest(tmp_path / "out")
    assert (manifest["workers"], manifest["scheduler"]) == (2, scheduler)
    assert manifest["instructions"] == machine.instruction_set()


def test_lost_scheduler_is_reported_and_results_are_kept(
    start: Start, scheduler: str, study: Study, local_parts: dict[str, bytes], tmp_path: Path
) -> None:
    start("dask", "worker", scheduler, "--nthreads", "1")

    def kill() -> None:
        for process in psutil.Process().children():
            if any("scheduler" in word for word in process.cmdline()[1:4]):
                process.kill()

    with cluster.executor(scheduler=scheduler) as executor:
        options: dict[str, Any] = {"executor": executor, "on_progress": when_done(3, kill)}
        line = rf"^{scheduler}: lost the scheduler \(completed chunks are stored"
        with pytest.raises(InputError, match=line):
            run.run_into(study, tmp_path / "out", chunk_runs=CHUNK, **options)
    parts = read_parts(tmp_path / "out")
    assert len(parts) >= 3 and parts.items() <= local_parts.items()


def test_workers_that_differ_are_refused(start: Start, scheduler: str) -> None:
    for flags in ("", "--xla_cpu_max_isa=SSE4_2"):
        start("dask", "worker", scheduler, "--nthreads", "1", XLA_FLAGS=flags)
    wait_for_workers(scheduler, 2)
    line = r"^tcp://127\.0\.0\.1:\d+: the worker has instruction set .*, not .*: rows could differ"
    with pytest.raises(InputError, match=line), cluster.executor(scheduler=scheduler):
        pass
