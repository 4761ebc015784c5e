"""An executor on Dask workers of this process, and its refusals."""

import re
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import distributed
import pytest
from support.studies import small_study

from sinsjax.errors import InputError
from sinsjax.execution import cluster
from sinsjax.execution.tasks import Job, Task, TaskResult, TaskRunner
from sinsjax.platform import machine, runtime

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
def made(monkeypatch: pytest.MonkeyPatch) -> list[TaskRunner]:
    """Made-up results in place of `TaskRunner.compute`; the runners that make them."""
    made: list[TaskRunner] = []

    def compute(self: TaskRunner, task: Task) -> TaskResult:
        made.append(self)
        return TaskResult(task, {"summary": f"{task.name} of {self.identity}".encode()}, 0)

    monkeypatch.setattr(TaskRunner, "compute", compute)
    return made


@pytest.fixture
def runner() -> TaskRunner:
    """A runner of eight tasks."""
    study = small_study(axes={"phi_u0_deg": [i / 100 for i in range(1000)]})
    return TaskRunner(Job(study, chunk_runs=128, directory=Path("out")))


def test_workers_prepare_a_job_once_and_keep_no_finished_task(
    local_cluster: distributed.LocalCluster,
    runner: TaskRunner,
    made: list[TaskRunner],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Dask would compute a kept task again when its worker is lost."""
    (tasks,), taken, found = runner.plan_tasks(), list[Task](), dict[Task, TaskResult]()
    scheduler = local_cluster.scheduler_address
    submit, kept = distributed.Client.map, list[Any]()

    def keeping(*args: Any, **named: Any) -> Any:
        kept.extend(futures := submit(*args, **named))
        return futures

    monkeypatch.setattr(distributed.Client, "map", keeping)

    def offered() -> Iterator[Task]:
        for task in tasks:
            taken.append(task)
            yield task

    with cluster.executor(scheduler=scheduler) as executor:
        facts = {"workers": 2, "threads": 2, "scheduler": scheduler}
        assert executor.facts == facts | {"instructions": machine.instruction_set()}
        for result in executor.run_tasks(runner, offered()):
            found[result.task] = result
            assert len(taken) < len(found) + 2 * cluster.TASKS_PER_THREAD
        until = time.monotonic() + 20.0
        while local_cluster.scheduler.tasks and time.monotonic() < until:
            time.sleep(0.01)
        assert not local_cluster.scheduler.tasks
        (again,) = executor.run_tasks(runner, tasks[:1])
    assert len(tasks) > 5 and found.keys() == {*tasks}
    assert len({id(one) for one in made}) == 1 and runner not in made
    assert all(found[task].content == runner.compute(task).content for task in tasks)
    assert again.content == found[tasks[0]].content


def test_task_that_fails_repeatedly_is_named(
    local_cluster: distributed.LocalCluster, runner: TaskRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[str] = []

    def fail(self: TaskRunner, task: Task) -> TaskResult:
        tried.append(task.name)
        raise ValueError("no such thing\nat all")

    (tasks,) = runner.plan_tasks()
    monkeypatch.setattr(TaskRunner, "compute", fail)
    line = "^part-0000-000000: failed on a worker: ValueError: no such thing$"
    address = local_cluster.scheduler_address
    with cluster.executor(scheduler=address) as executor, pytest.raises(InputError, match=line):
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
def test_late_worker_that_differs_is_refused_before_unpickling_job(
    required: dict[str, str], line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("distributed.get_worker", lambda: SimpleNamespace(address="tcp://far:1"))
    monkeypatch.setattr(cluster, "_runners", {})
    task = Task("part-0000-000000", 0, (0, 1), 0, 1, ())
    with pytest.raises(InputError, match=f"^tcp://far:1: {line}"):
        cluster.run_task_on_worker("job", required, task, job=b"")
