"""Dask workers produce the bytes of a local run, also if they are lost or late."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from functools import partial
from types import SimpleNamespace

import distributed
import pytest
from support.studies import small_study
from support.sweep_directories import make_study, read_parts

import sinsjax
from sinsjax.errors import InputError
from sinsjax.execution import cluster
from sinsjax.execution.tasks import Task, TaskRunner
from sinsjax.platform import machine, runtime

pytestmark = pytest.mark.optimised(False)


@pytest.fixture
def local_cluster(monkeypatch):
    """A scheduler with two workers of one thread, all in this process."""
    monkeypatch.setattr(runtime, "configure", lambda devices: None)  # has been done
    monkeypatch.setattr(cluster, "_runners", {})
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": False, "protocol": "tcp"}
    options |= {"scheduler_kwargs": {"dashboard_address": "127.0.0.1:0"}}
    with distributed.LocalCluster(dashboard_address=None, **options) as local_cluster:
        yield local_cluster


def test_workers_prepare_a_job_once_and_keep_no_finished_task(local_cluster, tmp_path, monkeypatch):
    """Dask would compute a kept task again when its worker is lost."""
    study, made, kept = make_study("drawn"), [], []
    make_runner, submit = cluster._make_runner, distributed.Client.map

    def making(*args):
        made.append(args)
        return make_runner(*args)

    def keeping(*args, **named):
        kept.extend(futures := submit(*args, **named))
        return futures

    monkeypatch.setattr(cluster, "_make_runner", making)
    monkeypatch.setattr(distributed.Client, "map", keeping)
    address, scheduler = local_cluster.scheduler_address, local_cluster.scheduler
    with cluster.executor(scheduler=address) as executor:
        facts = {"workers": 2, "threads": 2, "scheduler": address}
        assert executor.facts == facts | {"instructions": machine.instruction_set()}
        sinsjax.run_into(study, tmp_path / "there", chunk_runs=128, executor=executor)
        until = time.monotonic() + 20.0
        while scheduler.tasks and time.monotonic() < until:
            time.sleep(0.01)
        assert not scheduler.tasks and len(kept) == 3 and len(made) == 1
    sinsjax.run_into(study, tmp_path / "here", chunk_runs=128)
    assert read_parts(tmp_path / "there") == read_parts(tmp_path / "here")


def test_task_that_fails_repeatedly_is_named(local_cluster, tmp_path, monkeypatch):
    tried = []

    def fail(self, task):
        tried.append(task.name)
        raise ValueError("no such thing\nat all")

    monkeypatch.setattr(TaskRunner, "compute", fail)
    line = "^part-0000-000000: failed on a worker: ValueError: no such thing$"
    address = local_cluster.scheduler_address
    with cluster.executor(scheduler=address) as executor, pytest.raises(InputError, match=line):
        sinsjax.run_into(small_study(), tmp_path / "out", executor=executor)
    assert len(tried) == 3


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere"])
def test_unreachable_scheduler_address_is_reported(address, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT_S", 0.3)
    line = rf"^{address}: no Dask scheduler answers there \(.+\)$"
    with pytest.raises(InputError, match=line), cluster.executor(scheduler=address):
        pass


@pytest.mark.parametrize(
    ("required", "line"),
    [
        ({"brings-a-method": "1.0"}, r"the worker has brings-a-method \(none\), not 1.0: .*"),
        ({"instruction set": "VAX"}, r"the worker has instruction set \S+, not VAX: .* smaller\)"),
    ],
)
def test_late_worker_that_differs_is_refused_before_unpickling_job(required, line, monkeypatch):
    monkeypatch.setattr("distributed.get_worker", lambda: SimpleNamespace(address="tcp://far:1"))
    monkeypatch.setattr(cluster, "_runners", {})
    task = Task("part-0000-000000", 0, (0, 1), 0, 1, ())
    with pytest.raises(InputError, match=f"^tcp://far:1: {line}"):
        cluster.run_task_on_worker("job", required, task, job=b"")


CHUNK = 128
STUDY = small_study(
    study={"duration_s": 300.0, "rate_hz": 20.0, "window_s": [200, 300], "draws": 600},
    alignment={"method": "compass", "phi_e0_deg": 0.1, "phi_n0_deg": 0.1},
    compass={"level_time_s": 60.0},
    axes={"phi_u0_deg": [0.0, 0.3, 0.6, 1.0]},
)
"""2400 runs in 19 chunks of some 0.1 s; a compass is compiled quickly."""


@pytest.fixture(scope="module")
def local_parts(tmp_path_factory):
    """The parts that this process computes; from now on, all processes share what is compiled."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(runtime.CACHE_VARIABLE, str(tmp_path_factory.mktemp("compiled")))
        results = sinsjax.run_into(STUDY, tmp_path_factory.mktemp("here"), chunk_runs=CHUNK)
        assert "ok" in results.summary["status"].to_pylist()
        yield read_parts(results.directory)


@contextmanager
def workers_with(*environments):
    """A cluster of a process for each environment, which is replaced when it dies."""
    here = {"host": "127.0.0.1", "dashboard": False}
    scheduler = {"cls": distributed.Scheduler, "options": here | {"port": 0}}
    options = here | {"nthreads": 1}
    workers = {
        str(i): {"cls": distributed.Nanny, "options": options | {"env": environment}}
        for i, environment in enumerate(environments)
    }
    with distributed.SpecCluster(workers, scheduler) as cluster:
        yield cluster


def sweep_until(action, address, out):
    """Run the study on workers into a directory; act once, after three chunks."""
    left = [action]

    def on_progress(progress):
        if progress.done >= 3 * CHUNK and left:
            left.pop()()

    with cluster.executor(scheduler=address) as executor:
        options = {"executor": executor, "on_progress": on_progress}
        return sinsjax.run_into(STUDY, out, chunk_runs=CHUNK, **options)


@pytest.mark.nightly
@pytest.mark.skipif(runtime.usable_cores() < 2, reason="two workers need two cores, one each")
def test_lost_and_late_workers_give_same_bytes_as_local_run(local_parts, tmp_path, capsys):
    with workers_with({}, {}) as two:
        address = two.scheduler_address
        kill = partial(os.kill, two.workers["0"].pid, signal.SIGKILL)  # and another one is started
        entries = sweep_until(kill, address, tmp_path / "out").manifest.entries
    assert read_parts(tmp_path / "out") == local_parts
    assert re.fullmatch(r"Warning: tcp://\S+: lost this worker, .*\n", capsys.readouterr().err)
    assert (entries["workers"], entries["scheduler"]) == (2, address)
    assert entries["instructions"] == machine.instruction_set()


@pytest.mark.nightly
def test_lost_scheduler_is_reported_and_results_are_kept(local_parts, tmp_path):
    about, null = tmp_path / "scheduler.json", subprocess.DEVNULL
    words = ("--no-dashboard", "--scheduler-file", str(about))
    commands = ("scheduler", "--host", "127.0.0.1", "--port", "0"), ("worker", "--nthreads", "1")
    scheduler, worker = (
        subprocess.Popen([sys.executable, "-m", "dask", *command, *words], stdout=null, stderr=null)
        for command in commands
    )
    try:
        address, until = "", time.monotonic() + 60.0
        while not address and time.monotonic() < until:
            time.sleep(0.05)
            with suppress(FileNotFoundError, json.JSONDecodeError):
                address = json.loads(about.read_text())["address"]
        line = rf"^{address}: lost the scheduler \(completed chunks are stored"
        with pytest.raises(InputError, match=line):
            sweep_until(scheduler.kill, address, tmp_path / "out")
    finally:
        for process in (worker, scheduler):
            process.terminate()
            process.wait(timeout=60)
    parts = read_parts(tmp_path / "out")
    assert len(parts) >= 3 and parts.items() <= local_parts.items()


@pytest.mark.nightly
def test_workers_that_differ_are_refused():
    line = r"^tcp://127\.0\.0\.1:\d+: the worker has instruction set .*, not .*: rows could differ"
    with (
        workers_with({}, {"XLA_FLAGS": "--xla_cpu_max_isa=SSE4_2"}) as two,
        pytest.raises(InputError, match=line),
        cluster.executor(scheduler=two.scheduler_address),
    ):
        pass
