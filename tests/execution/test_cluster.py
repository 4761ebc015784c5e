"""Real Dask workers produce the bytes of a local run, also if they are lost or late."""

import json
import os
import re
import signal
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
import tomli_w
from support.studies import BASE
from support.sweep_directories import read_parts

from sinsjax.errors import InputError
from sinsjax.execution import cluster, run
from sinsjax.execution.directory import read_manifest
from sinsjax.execution.results import read_summary
from sinsjax.platform import compile_cache, runtime, xla
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
        patch.setenv(compile_cache.VARIABLE, str(tmp_path_factory.mktemp("compiled")))
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
    """Start commands whose processes end with the test; Dask's by their words."""
    started: list[subprocess.Popen] = []

    def start(*words: str, **environment: str) -> subprocess.Popen:
        command = [sys.executable, "-m", *words]
        command += ["--no-dashboard"] if words[0] == "dask" else []
        kept = subprocess.DEVNULL if words[0] == "dask" else subprocess.PIPE
        options: dict[str, Any] = {"env": os.environ | environment, "text": True}
        options |= {"stdout": kept, "stderr": kept, "start_new_session": words[0] != "dask"}
        started.append(subprocess.Popen(command, **options))
        return started[-1]

    yield start
    for process in reversed(started):
        process.terminate()
        process.communicate(timeout=60)


@pytest.fixture
def scheduler(start: Start, tmp_path: Path, request: pytest.FixtureRequest) -> str:
    """Return the address of a scheduler without workers, with the environment of a parameter."""
    about = tmp_path / "scheduler.json"
    words = ("--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(about))
    start("dask", "scheduler", *words, **getattr(request, "param", {}))
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


def refusal_line(scheduler: str) -> str:
    with pytest.raises(InputError) as output, cluster.executor(scheduler=scheduler):
        pass
    return str(output.value)


@pytest.mark.skipif(runtime.usable_cores() < 2, reason="two workers need two cores, one each")
def test_lost_and_late_workers_give_same_bytes_as_local_run(
    start: Start, scheduler: str, study: Study, local_parts: dict[str, bytes], tmp_path: Path
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
    manifest = read_manifest(tmp_path / "out")
    assert (manifest["workers"], manifest["scheduler"]) == (2, scheduler)
    assert manifest["instructions"] == xla.instruction_set()


@pytest.mark.parametrize(
    "scheduler", [{"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}], indirect=True
)
@pytest.mark.parametrize("lost", ["worker", "scheduler"])
def test_lost_process_is_reported_and_results_are_kept(
    lost: str,
    start: Start,
    scheduler: str,
    study: Study,
    local_parts: dict[str, bytes],
    tmp_path: Path,
) -> None:
    """A task on a worker that dies is blamed, here at once; without a scheduler nothing works."""
    nanny = start("dask", "worker", scheduler, "--nthreads", "1")

    def kill() -> None:
        if lost == "worker":
            processes = psutil.Process(nanny.pid).children()
        else:
            processes = psutil.Process().children()
        wanted = {"worker": "spawn_main", "scheduler": "scheduler"}[lost]
        for process in processes:
            if any(wanted in word for word in process.cmdline()[1:4]):
                process.kill()

    line = {
        "worker": r"^part-0000-\d{6}: failed on a worker: KilledWorker: .* died while running it",
        "scheduler": rf"^{scheduler}: lost the scheduler \(completed chunks are stored",
    }[lost]
    with cluster.executor(scheduler=scheduler) as executor:
        options: dict[str, Any] = {"executor": executor, "on_progress": when_done(3, kill)}
        with pytest.raises(InputError, match=line):
            run.run_into(study, tmp_path / "out", chunk_runs=CHUNK, **options)
    there = read_parts(tmp_path / "out")
    assert len(there) >= 3 and there.items() <= local_parts.items()


@pytest.mark.parametrize("name", ["numpy", "instruction set"])
def test_workers_that_differ_are_refused(
    name: str, start: Start, scheduler: str, tmp_path: Path
) -> None:
    words = ("dask", "worker", scheduler, "--nthreads", "1")
    if name == "numpy":
        about = tmp_path / "numpy-1.0.dist-info"  # of which Dask would warn by a table
        about.mkdir()
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: numpy\nVersion: 1.0\n")
        start(*words, PYTHONPATH=f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    else:
        start(*words)
        start(*words, XLA_FLAGS="--xla_cpu_max_isa=SSE4_2")
    wait_for_workers(scheduler, 1 + (name != "numpy"))
    line = rf"tcp://127\.0\.0\.1:\d+: the worker has {name} .*, not .*: rows could differ"
    assert re.match(line, refusal_line(scheduler))


def test_scheduler_without_workers_is_refused_after_timeout(
    scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "WORKER_TIMEOUT_S", 0.5)
    assert refusal_line(scheduler).startswith(f"{scheduler}: no worker that runs sinsjax: ")


def test_signal_finishes_running_chunks_and_resume_completes_sweep(
    start: Start, scheduler: str, local_parts: dict[str, bytes], tmp_path: Path
) -> None:
    config, out = tmp_path / "study.toml", tmp_path / "out"
    config.write_text(tomli_w.dumps(STUDY))
    start("dask", "worker", scheduler, "--nthreads", "1")
    wait_for_workers(scheduler, 1)  # without one the sweep says so
    words = ["sinsjax", "sweep", str(config), "-o", str(out), "--chunk-runs", str(CHUNK)]
    process = start(*words, "--scheduler", scheduler)
    assert process.stdout is not None
    first = next(line for line in iter(process.stdout.readline, "") if "failed" in line)
    os.killpg(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 130, (first, output, errors)
    assert "Stopping after the running chunks" in output
    assert errors.startswith("interrupted: ") and errors.count("\n") == 1
    assert read_parts(out).items() < local_parts.items()
    assert read_manifest(out)["runs_done"] == read_summary(out).num_rows
    process = start(*words, "--scheduler", scheduler, "--resume")
    output, errors = process.communicate(timeout=300)
    assert (process.returncode, errors) == (0, "")
    assert read_parts(out) == local_parts
