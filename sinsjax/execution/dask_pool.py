"""Tasks done by Dask workers: processes of this machine, or those of a scheduler.

The workers hand Parquet files back and write nothing; the process that asked writes them all. A
worker that is lost costs the tasks that it had, which Dask gives to others. Every answer carries
what the worker computed it with, so that no row of another version is ever written.
"""

import pickle
import queue
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from itertools import islice
from typing import Any

from sinsjax.errors import InputError
from sinsjax.execution import dask_client
from sinsjax.execution.dask_worker import Wanting, WorkerAnswer, WorkerMachine, answer, versions
from sinsjax.execution.tasks import EncodedResult, Executor, Job, Task, TaskRunner
from sinsjax.messages import first_line
from sinsjax.platform import runtime, xla

AHEAD = 2
"""Tasks that a thread of a worker has at a time, so that it never waits for the next one."""

_RETRIES = 2
_PATIENCE_S = 600.0  # without any worker
_LOOK_S = 2.0


@contextmanager
def executor(*, workers: int | None = None, scheduler: str | None = None) -> Iterator[Executor]:
    """Dask workers that do tasks, for the time of a ``with`` block.

    Args:
        workers: processes to start on this machine, each on a core of its own; they end with the
            block. As with all processes that Python spawns, a script that calls this has its
            code below ``if __name__ == "__main__":``.
        scheduler: address of a scheduler to use instead, ``tcp://host:port``.

    Yields:
        Executor for `sinsjax.run_into`. A record travels to every worker once.

    Raises:
        InputError: Dask is not installed, there are more processes than cores, no scheduler
            answers within 10 s, it has no worker for 10 min, or a worker has another version of
            what decides the rows, or another instruction set than the others. Tasks raise it too
            where one fails again and again.
    """
    with ExitStack() as stack:
        if scheduler is None:
            client = stack.enter_context(dask_client.local(workers or runtime.usable_cores()))
        else:
            client = stack.enter_context(dask_client.connected(scheduler))
        pool = DaskPool(client, scheduler or "--workers")
        facts = {"workers": pool.ready(), "scheduler": scheduler or "local"}
        yield Executor(pool.do, facts | pool.facts())


class _SubmittedTasks:
    """Tasks that workers have, and how a job reaches every worker once.

    A record may be long, so a task goes without its job. A worker that wants the job says so, and
    is sent it with that task; others that come back from there meanwhile wait until it has been
    brought. Data of Dask's own would keep tasks near those that have it, and be lost with them.
    """

    def __init__(self, client: Any, job: Job) -> None:
        self._client, self._sent = client, pickle.dumps(job)
        self._key = f"sinsjax-{job.identity}-{job.curves}-{job.chunk_runs}"
        self._under_way: dict[str, tuple[Task, Any, str | None]] = {}
        self._waiting: dict[str, list[Task]] = {}
        self._sendings = 0
        self.finished: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def __len__(self) -> int:
        return len(self._under_way) + sum(map(len, self._waiting.values()))

    def send(self, task: Task, to: str | None = None) -> None:
        """Give a task to any worker; with the job, to one that wants it if that is still there."""
        self._sendings += 1
        # No dependency on data of one worker, near which Dask would keep the tasks.
        future = self._client.submit(
            answer,
            self._key,
            None if to is None else self._sent,
            task,
            key=f"{self._key}-{task.name}-{self._sendings}",
            retries=_RETRIES,
            **({} if to is None else {"workers": [to], "allow_other_workers": True}),
        )
        self._under_way[future.key] = task, future, to
        future.add_done_callback(self.finished.put)

    def take(self, future: Any) -> tuple[Task, Any, str | None]:
        """Of a future that is done: its task, itself, and the worker that it brought the job."""
        return self._under_way.pop(future.key)

    def bring(self, worker: str, task: Task) -> None:
        """A worker handed a task back, wanting the job."""
        if worker in self._waiting:
            self._waiting[worker].append(task)
        else:
            self._waiting[worker] = []
            self.send(task, to=worker)

    def brought(self, worker: str | None) -> None:
        """A worker has the job, if any: what waited for that goes out again."""
        for task in self._waiting.pop(worker, ()) if worker else ():
            self.send(task)

    def cancel(self) -> None:
        """Leave what is under way."""
        if self._under_way:
            self._client.cancel([future for _, future, _ in self._under_way.values()])


class DaskPool:
    """The workers of a scheduler, seen from the process that asks."""

    def __init__(self, client: Any, name: str) -> None:
        self._client, self._name = client, name
        self._machine: WorkerMachine | None = None
        self._instructions = ("", "")  # of all workers, and the one that told it first
        self._told = self._waiting = False

    def ready(self) -> int:
        """Wait for workers, check their versions and instructions; tells how many there are."""
        since = time.monotonic()
        while not (there := self._threads()):
            self._alone(since)
            time.sleep(_LOOK_S / 10)
        # Dask compares by name, so this works whatever sinsjax the workers have, or none.
        found = self._ask("get_versions", packages=list(runtime.DECISIVE))
        ours = found["client"]["packages"]
        for worker, about in found["workers"].items():
            _check_versions(worker, about["packages"], ours)
        sets = self._ask("run", function=xla.instructions, on_error="ignore")
        for worker, instructions in sorted(sets.items()):
            self._check_instructions(worker, instructions)
        return len(there)

    def facts(self) -> dict[str, Any]:
        """What the manifest says of the workers: they make the rows, not the process that asks."""
        instructions, _ = self._instructions
        return {"instructions": instructions} if instructions else {}

    def do(self, runner: TaskRunner, tasks: Iterable[Task]) -> Iterator[EncodedResult]:
        """See `Executor`."""
        submitted = _SubmittedTasks(self._client, runner.job)
        left = iter(tasks)
        try:
            while True:
                room = AHEAD * max(1, sum(self._threads().values())) - len(submitted)
                for task in islice(left, max(0, room)):
                    submitted.send(task)
                if not submitted:
                    return
                task, future, to = submitted.take(self._next(submitted.finished))
                got = self._result(task, future)
                future.release()
                if isinstance(got, Wanting):
                    submitted.bring(got.worker, task)
                    continue
                submitted.brought(to)
                self.check(got)
                yield got.encoded
        finally:
            if self._client.status == "running":
                submitted.cancel()

    def _next(self, finished: queue.SimpleQueue) -> Any:
        """The next task that is done or failed."""
        seen = time.monotonic()
        while True:
            try:
                return finished.get(timeout=_LOOK_S)
            except queue.Empty:
                if self._threads():
                    seen, self._waiting = time.monotonic(), False
                else:
                    self._alone(seen)

    def _result(self, task: Task, future: Any) -> WorkerAnswer | Wanting:
        from distributed import KilledWorker

        if future.status != "error":
            try:
                return future.result()
            except (CancelledError, OSError) as lost:
                raise self._gone() from lost
        error = future.exception()
        if isinstance(error, InputError):
            text = str(error)
        elif isinstance(error, KilledWorker):
            text = f"{error.allowed_failures + 1} workers died with it (out of memory?)"
        else:
            text = f"failed on a worker: {type(error).__name__}: {first_line(error)}"
        raise InputError(f"{task.name}: {text}") from error

    def check(self, answer: WorkerAnswer) -> None:
        """Refuse rows of other versions or instructions; say once that machines differ."""
        _check_versions(answer.worker, answer.versions, versions())
        self._check_instructions(answer.worker, answer.machine.instructions)
        self._machine = self._machine or answer.machine
        if answer.machine != self._machine and not self._told:
            self._told = True
            _say(
                f"{answer.worker}: computes with {_said(answer.machine)}, others with"
                f" {_said(self._machine)}: rows may differ in their last digits"
            )

    def _check_instructions(self, worker: str, theirs: str) -> None:
        if not self._instructions[0]:
            self._instructions = theirs, worker
        ours, first = self._instructions
        if theirs != ours:
            raise InputError(
                f"{worker}: the worker has instruction set {theirs}, {first} has {ours}: rows"
                " would differ (start all with XLA_FLAGS=--xla_cpu_max_isa= and the smaller one)"
            )

    def _alone(self, since: float) -> None:
        """There are no workers: say so once, and give up in the end."""
        waited_s = time.monotonic() - since
        if waited_s > _PATIENCE_S:
            raise InputError(f"{self._name}: no worker for {_PATIENCE_S / 60:g} min")
        if waited_s > dask_client.CONNECT_S and not self._waiting:
            self._waiting = True
            _say(f"{self._name}: no worker there: waiting, {_PATIENCE_S / 60:g} min at the most")

    def _threads(self) -> dict[str, int]:
        """How many threads each worker has."""
        return dict(self._ask("nthreads"))

    def _ask(self, what: str, **arguments: Any) -> Any:
        try:
            return getattr(self._client, what)(**arguments)
        except Exception as error:  # Dask has many names for it
            raise self._gone() from error

    def _gone(self) -> InputError:
        return InputError(f"{self._name}: the scheduler is gone (--resume goes on)")


def _check_versions(worker: str, theirs: dict[str, Any], ours: dict[str, Any]) -> None:
    for name in runtime.DECISIVE:
        if theirs.get(name) != ours.get(name):
            raise InputError(
                f"{worker}: the worker has {name} {theirs.get(name) or '(none)'}, this process"
                f" {ours.get(name)}: rows could differ (install the same version)"
            )


def _said(about: WorkerMachine) -> str:
    options = ", ".join("=".join(option) for option in about.options) or "no XLA options"
    return f"{about.cpu} ({about.platform}; {options})"


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
