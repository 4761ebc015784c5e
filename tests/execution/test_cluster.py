"""Real Dask workers produce the bytes of a local run, also if they are lost or late."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import distributed
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tomli_w
from support.studies import BASE, small_study

from sinsjax.errors import InputError
from sinsjax.execution import cluster, run
from sinsjax.execution import tasks as study_tasks
from sinsjax.execution.directory import read_manifest
from sinsjax.platform import compile_cache, runtime, xla
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study

pytestmark = [pytest.mark.nightly, pytest.mark.optimised(False)]
needs_two_cores = pytest.mark.skipif(
    runtime.usable_cores() < 2, reason="two workers need two cores, one each"
)

CHUNK = 128
STUDY: dict[str, Any] = BASE | {
    "study": BASE["study"]
    | {"duration_s": 300.0, "rate_hz": 20.0, "window_s": [200, 300], "draws": 600},
    "alignment": {"method": "compass", "phi_e0_deg": 0.1, "phi_n0_deg": 0.1},
    "compass": {"level_time_s": 60.0},
    "axes": {"phi_u0_deg": [0.0, 0.3, 0.6, 1.0]},
}
"""2400 runs in 19 chunks of some 0.1 s; a compass is compiled quickly."""

Parts = dict[str, bytes]


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
def local_parts(study: Study, tmp_path_factory: pytest.TempPathFactory) -> Parts:
    """Return the parts that this process computes."""
    out = tmp_path_factory.mktemp("here")
    run.run_into(study, out, chunk_runs=CHUNK)
    return parts(out)


def parts(directory: Path) -> Parts:
    return {
        str(path.relative_to(directory)): path.read_bytes() for path in directory.glob("*/part-*")
    }


def rows(directory: Path) -> pa.Table:
    tables = [pq.read_table(path) for path in sorted(directory.glob("summary/*"))]
    return pa.concat_tables([t.replace_schema_metadata() for t in tables]).sort_by("run_id")


Begin = Callable[..., subprocess.Popen]


def refusal_line(**given: Any) -> str:
    """Return the error line of an executor with these arguments."""
    with pytest.raises(InputError) as output, cluster.executor(**given):
        pass
    return str(output.value)


@contextmanager
def dask_commands() -> Iterator[Begin]:
    """Start Dask commands that end with the block."""
    started: list[subprocess.Popen] = []

    def dask_command(*words: str, **environment: str) -> subprocess.Popen:
        command = [sys.executable, "-m", "dask", *words, "--no-dashboard"]
        with open(os.devnull, "w") as nowhere:
            process = subprocess.Popen(
                command, env=os.environ | environment, stdout=nowhere, stderr=nowhere
            )
        started.append(process)
        return process

    yield dask_command
    for process in reversed(started):
        process.terminate()
        process.wait(60)


@pytest.fixture
def start_command() -> Iterator[Begin]:
    """Start a Dask command that ends with the test."""
    with dask_commands() as start_command:
        yield start_command


@pytest.fixture
def scheduler(start_command: Begin, tmp_path: Path) -> str:
    """Return the address of a scheduler without workers."""
    return address_of_scheduler(start_command, tmp_path / "scheduler.json")


def address_of_scheduler(start_command: Begin, about: Path, **environment: str) -> str:
    """Start a scheduler that writes its address to a file, and return the address."""
    words = ("--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(about))
    start_command("scheduler", *words, **environment)
    for _ in range(600):
        with suppress(FileNotFoundError, json.JSONDecodeError):
            return str(json.loads(about.read_text())["address"])
        time.sleep(0.05)
    raise AssertionError("no scheduler within 30 s")


def worker_process(nanny: subprocess.Popen) -> psutil.Process:
    """Return the process that computes, which its nanny starts again if it is lost."""
    (process,) = (
        process
        for process in psutil.Process(nanny.pid).children()
        if any("spawn_main" in word for word in process.cmdline())
    )
    return process


@needs_two_cores
class TestTwoWorkers:
    """Of one scheduler, which ends with these tests."""

    @pytest.fixture(scope="class")
    @classmethod
    def two(cls, tmp_path_factory: pytest.TempPathFactory) -> Iterator[study_tasks.Executor]:
        with dask_commands() as start_command:
            about = tmp_path_factory.mktemp("scheduler") / "about.json"
            address = address_of_scheduler(start_command, about)
            for _ in range(2):
                start_command("worker", address, "--nthreads", "1")
            with distributed.Client(address, set_as_default=False) as client:
                client.wait_for_workers(2, timeout=60)
            with cluster.executor(scheduler=address) as executor:
                yield executor

    def test_workers_give_same_bytes_as_local_run(
        self, two: study_tasks.Executor, study: Study, local_parts: Parts, tmp_path: Path
    ) -> None:
        run.run_into(study, tmp_path, chunk_runs=CHUNK, executor=two)
        assert len(local_parts) == 19
        assert "ok" in rows(tmp_path)["status"].to_pylist()
        assert parts(tmp_path) == local_parts
        assert read_manifest(tmp_path)["workers"] == 2

    def test_filter_on_workers_gives_same_bytes_as_local_run(
        self, two: study_tasks.Executor, tmp_path: Path
    ) -> None:
        study = small_study(
            study={"draws": 500, "curves": True}, drawn={"gyro_scale_ppm": {"normal": [0, 9]}}
        )
        run.run_into(study, tmp_path / "here", chunk_runs=CHUNK)
        run.run_into(study, tmp_path / "there", chunk_runs=CHUNK, executor=two)
        assert len(parts(tmp_path / "here")) == 2 * 4
        assert parts(tmp_path / "here") == parts(tmp_path / "there")


class TestOneScheduler:
    """With a worker, and later a second one; it ends with the last of these tests."""

    @pytest.fixture(scope="class")
    @classmethod
    def start_command(cls) -> Iterator[Begin]:
        with dask_commands() as start_command:
            yield start_command

    @pytest.fixture(scope="class")
    @classmethod
    def scheduler(cls, start_command: Begin, tmp_path_factory: pytest.TempPathFactory) -> str:
        address = address_of_scheduler(
            start_command, tmp_path_factory.mktemp("scheduler") / "about.json"
        )
        start_command("worker", address, "--nthreads", "1")
        return address

    def test_external_scheduler_with_late_worker_gives_same_bytes(
        self, start_command: Begin, scheduler: str, study: Study, local_parts: Parts, tmp_path: Path
    ) -> None:
        """The executor waits for late workers and uses them."""
        joined = []

        def on_progress(progress: run.RunProgress) -> None:
            if progress.done and not joined:
                joined.append(start_command("worker", scheduler, "--nthreads", "1"))

        with cluster.executor(scheduler=scheduler) as executor:
            run.run_into(
                study, tmp_path, chunk_runs=CHUNK, executor=executor, on_progress=on_progress
            )
        assert parts(tmp_path) == local_parts
        manifest = read_manifest(tmp_path)
        assert (manifest["workers"], manifest["scheduler"]) == (1, scheduler)

    def test_lost_scheduler_is_reported_and_results_are_kept(
        self, scheduler: str, study: Study, local_parts: Parts, tmp_path: Path
    ) -> None:
        (process,) = (
            p
            for p in psutil.Process().children()
            if p.cmdline()[1:4] == ["-m", "dask", "scheduler"]
        )

        def on_progress(progress: run.RunProgress) -> None:
            if progress.done == 3 * CHUNK:
                process.kill()

        with (
            cluster.executor(scheduler=scheduler) as executor,
            pytest.raises(
                InputError, match=rf"^{scheduler}: lost the scheduler \(completed chunks are stored"
            ),
        ):
            run.run_into(
                study, tmp_path, chunk_runs=CHUNK, executor=executor, on_progress=on_progress
            )
        there = parts(tmp_path)
        assert len(there) >= 3 and there.items() <= local_parts.items()


def test_job_survives_loss_of_every_worker(
    start_command: Begin, scheduler: str, study: Study, local_parts: Parts, tmp_path: Path
) -> None:
    """The replacement of the only worker reads the job again."""
    nanny = start_command("worker", scheduler, "--nthreads", "1")
    killed: list[psutil.Process] = []

    def on_progress(progress: run.RunProgress) -> None:
        if progress.done >= 3 * CHUNK and not killed:
            killed.append(worker_process(nanny))
            killed[0].kill()

    with cluster.executor(scheduler=scheduler) as executor:
        run.run_into(
            study, tmp_path / "out", chunk_runs=CHUNK, executor=executor, on_progress=on_progress
        )
    assert killed and parts(tmp_path / "out") == local_parts


def test_task_that_kills_workers_is_named_in_error(
    start_command: Begin, study: Study, local_parts: Parts, tmp_path: Path
) -> None:
    none = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
    address = address_of_scheduler(start_command, tmp_path / "scheduler.json", **none)
    nanny = start_command("worker", address, "--nthreads", "1")

    def on_progress(progress: run.RunProgress) -> None:
        if progress.done == 2 * CHUNK:
            worker_process(nanny).kill()

    with (
        cluster.executor(scheduler=address) as executor,
        pytest.raises(InputError, match=r"^part-0000-\d{6}: 1 workers died while running it"),
    ):
        run.run_into(
            study, tmp_path / "out", chunk_runs=CHUNK, executor=executor, on_progress=on_progress
        )
    there = parts(tmp_path / "out")
    assert len(there) >= 2 and there.items() <= local_parts.items()


@needs_two_cores
def test_killed_worker_of_external_scheduler_loses_no_row(
    start_command: Begin,
    scheduler: str,
    study: Study,
    local_parts: Parts,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    victim, _ = (
        start_command("worker", scheduler, "--nthreads", "1", "--no-nanny") for _ in range(2)
    )
    with distributed.Client(scheduler, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
        addresses = {pid: address for address, pid in client.run(os.getpid).items()}
    killed = []

    def on_progress(progress: run.RunProgress) -> None:
        if progress.done >= 3 * CHUNK and not killed:
            killed.append(addresses[victim.pid])
            # Suspended with tasks in hand, it loses them a second later.
            victim.send_signal(signal.SIGSTOP)
            threading.Timer(1.0, victim.kill).start()

    with cluster.executor(scheduler=scheduler) as executor:
        assert executor.facts["workers"] == 2
        run.run_into(
            study, tmp_path / "out", chunk_runs=CHUNK, executor=executor, on_progress=on_progress
        )
    assert victim.wait(60) == -signal.SIGKILL
    assert parts(tmp_path / "out") == local_parts
    lost = f"Warning: {killed[0]}: worker lost, its tasks run again (1 left)\n"
    assert capsys.readouterr().err == lost


def test_workers_with_other_package_version_are_refused(
    start_command: Begin, scheduler: str, tmp_path: Path
) -> None:
    about = tmp_path / "numpy-1.0.dist-info"  # of which Dask would warn by a table
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: numpy\nVersion: 1.0\n")
    start_command("worker", scheduler, "--nthreads", "1", PYTHONPATH=str(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", distributed.versions.VersionMismatchWarning)
        with distributed.Client(scheduler, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=60)
    output = refusal_line(scheduler=scheduler)
    assert re.match(r"tcp://127\.0\.0\.1:\d+: the worker has numpy 1\.0, not", output)


def test_workers_with_differing_instruction_sets_are_refused(
    start_command: Begin, scheduler: str
) -> None:
    start_command("worker", scheduler, "--nthreads", "1")
    with cluster.executor(scheduler=scheduler) as executor:
        assert executor.facts["instructions"] == xla.instruction_set()
    start_command("worker", scheduler, "--nthreads", "1", XLA_FLAGS="--xla_cpu_max_isa=SSE4_2")
    with distributed.Client(scheduler, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
    output = refusal_line(scheduler=scheduler)
    assert re.match(r"tcp://127\.0\.0\.1:\d+: the worker has instruction set ", output)


def test_scheduler_without_workers_is_refused_after_timeout(
    scheduler: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT_S", 0.5)
    monkeypatch.setattr(cluster, "WORKER_TIMEOUT_S", 1.2)
    assert refusal_line(scheduler=scheduler) == f"{scheduler}: no worker for 0.02 min"
    assert capsys.readouterr().err.count("waiting") == 1


# --- The command --------------------------------------------------------------------------------

Sweep = Callable[..., subprocess.Popen]


@pytest.fixture
def sweep(tmp_path: Path) -> Iterator[Sweep]:
    """Start `sinsjax sweep` in a separate process group, as a shell does."""
    config = tmp_path / "study.toml"
    config.write_text(tomli_w.dumps(STUDY))
    started: list[subprocess.Popen] = []

    def start(out: Path, *words: str) -> subprocess.Popen:
        command = [sys.executable, "-m", "sinsjax", "sweep", str(config), "-o", str(out), *words]
        command += ["--chunk-runs", str(CHUNK)]
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def wait_for_first_chunk(process: subprocess.Popen) -> str:
    """Wait for the first chunk of a sweep and return the output."""
    assert process.stdout is not None
    lines = iter(process.stdout.readline, "")
    return next((line for line in lines if line.startswith("study: ")), "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_finishes_running_chunks_and_resume_completes_sweep(
    number: signal.Signals,
    start_command: Begin,
    scheduler: str,
    sweep: Sweep,
    local_parts: Parts,
    tmp_path: Path,
) -> None:
    start_command("worker", scheduler, "--nthreads", "1")
    with distributed.Client(scheduler, set_as_default=False) as client:
        client.wait_for_workers(1, timeout=120)  # without one the sweep says so
    out = tmp_path / "out"
    process = sweep(out, "--scheduler", scheduler)
    first = wait_for_first_chunk(process)
    os.killpg(process.pid, number)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 130, (first, output, errors)
    assert "Stopping after the running chunks" in output
    assert errors.startswith("interrupted: ") and errors.count("\n") == 1
    there = parts(out)
    assert there.items() < local_parts.items()
    assert read_manifest(out)["runs_done"] == rows(out).num_rows

    process = sweep(out, "--scheduler", scheduler, "--resume")
    output, errors = process.communicate(timeout=300)
    assert (process.returncode, errors) == (0, "")
    # What is left may be done before a rate is known.
    lines = [line for line in output.splitlines() if line.startswith("study: ")]
    assert lines and len(set(lines)) == len(lines)
    assert parts(out) == local_parts
