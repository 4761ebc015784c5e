"""Messages about workers and schedulers, and an executor on workers of this process."""

import re
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import distributed
import pytest
from support.studies import add_true_reference, small_study

from sinsjax.arena.simulated_record import simulated_record
from sinsjax.errors import InputError
from sinsjax.execution import cluster
from sinsjax.execution.tasks import Job, Task, TaskResult, TaskRunner
from sinsjax.platform import runtime, xla
from sinsjax.study.load import study_from_dict

pytestmark = pytest.mark.optimised(False)


@pytest.fixture
def local_cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[distributed.LocalCluster]:
    """A scheduler with two workers of one thread, all in this process."""
    monkeypatch.setattr(runtime, "configure", lambda devices: None)  # has been done
    monkeypatch.setattr(cluster, "_runners", {})
    options: dict[str, Any] = {"n_workers": 2, "threads_per_worker": 1, "processes": False}
    options |= {"scheduler_kwargs": {"dashboard_address": "127.0.0.1:0"}, "protocol": "tcp"}
    with distributed.LocalCluster(dashboard_address=None, **options) as local_cluster:
        yield local_cluster


@pytest.fixture
def scheduler(local_cluster: distributed.LocalCluster) -> str:
    """Address of that scheduler."""
    return str(local_cluster.scheduler_address)


@pytest.fixture(scope="module")
def runner() -> TaskRunner:
    """Return a runner of several tasks that need a record; a compass is compiled quickly."""
    study = study_from_dict(
        {
            "study": {"duration_s": 2.0, "rate_hz": 100.0, "window_s": [0, 2]},
            "alignment": {"method": "compass", "phi_e0_deg": 0.1},
            "compass": {"level_time_s": 1.0},
            "coarse": {"coarse_duration_s": 1.0},
            "record": {"format": "psins", "start_s": [0.0, 1.0, 2.0]},
            "axes": {"phi_u0_deg": [i / 100 for i in range(300)]},
        }
    )
    stored = add_true_reference(simulated_record(small_study()))
    return TaskRunner(Job(study, stored, chunk_runs=128, directory=Path("out")))


def make_up_result(self: TaskRunner, task: Task) -> TaskResult:
    """A result without runs in it, in place of `TaskRunner.compute`."""
    return TaskResult(task, {"summary": f"{task.name} of {self.identity}".encode()}, 0)


@pytest.mark.nightly(fast=("made up",))
@pytest.mark.parametrize("rows", ["made up", "computed"])
def test_workers_give_same_files_and_read_job_once(
    rows: str, scheduler: str, runner: TaskRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    if rows == "made up":
        monkeypatch.setattr(TaskRunner, "compute", make_up_result)
    read, get = list[str](), distributed.Variable.get

    def counting(variable: Any, *args: Any, **named: Any) -> Any:
        read.append(variable.name)
        return get(variable, *args, **named)

    monkeypatch.setattr(distributed.Variable, "get", counting)
    (tasks,) = runner.plan_tasks()
    taken: list[Task] = []

    def offered() -> Iterator[Task]:
        for task in tasks:
            taken.append(task)
            yield task

    found: dict[str, TaskResult] = {}
    facts = {"workers": 2, "threads": 2, "scheduler": scheduler}
    with cluster.executor(scheduler=scheduler) as executor:
        assert executor.facts == facts | {"instructions": xla.instruction_set()}
        for encoded in executor.run_tasks(runner, offered()):
            found[encoded.task.name] = encoded
            assert len(taken) < len(found) + 2 * cluster.TASKS_PER_THREAD
        again = list(executor.run_tasks(runner, tasks[:1]))
    assert len(tasks) > 5 and found.keys() == {task.name for task in tasks}
    assert all(found[task.name].content == runner.compute(task).content for task in tasks)
    assert again[0].content == found[tasks[0].name].content
    assert len(read) == 1


def test_finished_tasks_are_released_from_scheduler(
    local_cluster: distributed.LocalCluster, runner: TaskRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise Dask would compute them again when their worker is lost."""
    submit, kept = distributed.Client.map, list[Any]()

    def keeping(*args: Any, **named: Any) -> Any:
        futures = submit(*args, **named)
        kept.extend(futures)
        return futures

    monkeypatch.setattr(distributed.Client, "map", keeping)
    monkeypatch.setattr(TaskRunner, "compute", make_up_result)
    (tasks,) = runner.plan_tasks()
    with cluster.executor(scheduler=local_cluster.scheduler_address) as executor:
        assert len(list(executor.run_tasks(runner, tasks))) == len(tasks) == len(kept)
        until = time.monotonic() + 20.0
        while local_cluster.scheduler.tasks and time.monotonic() < until:
            time.sleep(0.01)
        assert not local_cluster.scheduler.tasks


def test_task_that_fails_repeatedly_is_named(
    scheduler: str, runner: TaskRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[str] = []

    def fail(self: TaskRunner, task: Task) -> TaskResult:
        tried.append(task.name)
        raise ValueError("no such thing\nat all")

    (tasks,) = runner.plan_tasks()
    monkeypatch.setattr(TaskRunner, "compute", fail)
    line = "^part-0000-000000: failed on a worker: ValueError: no such thing$"
    with cluster.executor(scheduler=scheduler) as executor, pytest.raises(InputError, match=line):
        list(executor.run_tasks(runner, tasks[:1]))
    assert len(tried) == 3


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere"])
def test_unreachable_scheduler_address_is_reported(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT_S", 0.3)
    with pytest.raises(InputError) as refused, cluster.executor(scheduler=address):
        pass
    assert re.fullmatch(rf"{address}: no Dask scheduler answers there \(.+\)", str(refused.value))


@pytest.mark.parametrize(
    ("required", "line"),
    [
        ({"brings-a-method": "1.0"}, r"the worker has brings-a-method \(none\), not 1.0: .*"),
        ({"instruction set": "VAX"}, r"the worker has instruction set \S+, not VAX: .* smaller\)"),
    ],
)
def test_late_worker_that_differs_is_refused_before_reading_job(
    required: dict[str, str], line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("distributed.get_worker", lambda: SimpleNamespace(address="tcp://far:1"))
    monkeypatch.setattr(cluster, "_runners", {})
    task = Task("part-0000-000000", 0, (0, 1), 0, 1, ())
    with pytest.raises(InputError, match=f"^tcp://far:1: {line}"):
        cluster.run_task_on_worker("job", required, task)
