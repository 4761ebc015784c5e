"""Tasks run by Dask workers, either local processes or those of an existing scheduler.

The workers return Parquet files and write nothing; the main process writes all of them. If a worker
is lost, Dask reassigns its tasks to others. Every answer includes the worker's versions, so that no
row of another version is ever written.
"""

import pickle
import queue
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from itertools import islice
from typing import Any

from sinsjax.alignment.methods import packages_of
from sinsjax.console import warn
from sinsjax.errors import InputError
from sinsjax.execution import dask_client
from sinsjax.execution.dask_worker import (
    SentJob,
    Wanting,
    WorkerAnswer,
    WorkerMachine,
    answer,
    check_versions,
    versions,
)
from sinsjax.execution.tasks import EncodedResult, Executor, Job, Task, TaskRunner
from sinsjax.messages import first_line
from sinsjax.platform import runtime, xla

AHEAD = 2
"""Tasks submitted per worker thread, so that no thread waits for the next one."""

_RETRIES = 2
_PATIENCE_S = 600.0  # without any worker
_LOOK_S = 2.0


@contextmanager
def executor(*, workers: int | None = None, scheduler: str | None = None) -> Iterator[Executor]:
    """Run tasks on Dask workers, for the duration of a ``with`` block.

    Args:
        workers: processes to start on this machine, one per core; they end with the block. As with
            all processes that Python spawns, a script that calls this must have its code below
            ``if __name__ == "__main__":``.
        scheduler: address of a scheduler to use instead, ``tcp://host:port``.

    Yields:
        Executor for `sinsjax.run_into`. A record is sent to every worker once.

    Raises:
        InputError: Dask is not installed, there are more processes than cores, no scheduler
            answers within 10 s, it has no worker for 10 min, or the workers' package versions or
            instruction sets differ. Running tasks also raises it if a task fails repeatedly.
    """
    with ExitStack() as stack:
        if scheduler is None:
            client = stack.enter_context(dask_client.local(workers or runtime.usable_cores()))
        else:
            client = stack.enter_context(dask_client.connected(scheduler))
        pool = DaskPool(client, scheduler or "--workers")
        there = pool.ready()
        facts = {
            "workers": len(there),
            "threads": sum(there.values()),
            "scheduler": scheduler or "local",
        }
        yield Executor(pool.do, facts | pool.facts())


class _SubmittedTasks:
    """Tasks submitted to workers, sending the job to every worker only once.

    A record may be long, so tasks are sent without their job. A worker without the job returns the
    task and is sent both again; other tasks it returns meanwhile wait until it has the job. Data
    scattered by Dask would bind tasks to the workers that hold it, and be lost with them.
    """

    def __init__(self, client: Any, job: Job) -> None:
        self._client = client
        self._sent = SentJob(packages_of(job.study.methods), pickle.dumps(job))
        self._key = f"sinsjax-{job.identity}-{job.curves}-{job.chunk_runs}-{job.study.n_draws}"
        self._under_way: dict[str, tuple[Task, Any, str | None]] = {}
        self._waiting: dict[str, list[Task]] = {}
        self._sendings = 0
        self.finished: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def __len__(self) -> int:
        return len(self._under_way) + sum(map(len, self._waiting.values()))

    def send(self, task: Task, to: str | None = None) -> None:
        """Submit a task to any worker; or, with the job, preferably to the worker ``to``."""
        self._sendings += 1
        # No dependency on scattered data, since Dask would bind the tasks to the worker with it.
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
        """Remove a finished future; gives its task, itself, and the worker sent the job with it."""
        return self._under_way.pop(future.key)

    def send_job(self, worker: str, task: Task) -> None:
        """Send a task again, with the job, to a worker that returned it for lack of the job."""
        if worker in self._waiting:
            self._waiting[worker].append(task)
        else:
            self._waiting[worker] = []
            self.send(task, to=worker)

    def job_received(self, worker: str | None) -> None:
        """Submit again the tasks that waited until a worker, if any, had the job."""
        for task in self._waiting.pop(worker, ()) if worker else ():
            self.send(task)

    def cancel(self) -> None:
        """Cancel all submitted tasks."""
        if self._under_way:
            self._client.cancel([future for _, future, _ in self._under_way.values()])


class DaskPool:
    """The workers of a scheduler, as seen from the main process."""

    def __init__(self, client: Any, name: str) -> None:
        self._client, self._name = client, name
        self._machine: WorkerMachine | None = None
        self._instructions = ("", "")  # of all workers, and the first worker that reported it
        self._warned = self._waiting = False
        self._known: set[str] = set()  # workers at the last look
        self._any = False  # whether there was ever one

    def ready(self) -> dict[str, int]:
        """Wait for workers and check their versions and instruction sets; gives their threads."""
        since = time.monotonic()
        while not (there := self._look()):
            self._alone(since)
            time.sleep(_LOOK_S / 10)
        # By package name, which works with any version of sinsjax on the workers, or none.
        found = self._ask("get_versions", packages=list(runtime.DECISIVE))
        ours = found["client"]["packages"]
        for worker, about in found["workers"].items():
            check_versions(worker, about["packages"], ours, runtime.DECISIVE)
        sets = self._ask("run", function=xla.instructions, on_error="ignore")
        for worker, instructions in sorted(sets.items()):
            self._check_instructions(worker, instructions)
        return there

    def facts(self) -> dict[str, Any]:
        """Manifest entries of the workers, which compute the rows instead of this process."""
        instructions, _ = self._instructions
        return {"instructions": instructions} if instructions else {}

    def do(self, runner: TaskRunner, tasks: Iterable[Task]) -> Iterator[EncodedResult]:
        """Run tasks, see `Executor`."""
        submitted = _SubmittedTasks(self._client, runner.job)
        left = iter(tasks)
        try:
            while True:
                room = AHEAD * max(1, sum(self._look().values())) - len(submitted)
                for task in islice(left, max(0, room)):
                    submitted.send(task)
                if not submitted:
                    return
                task, future, to = submitted.take(self._next(submitted.finished))
                got = self._result(task, future)
                future.release()
                if isinstance(got, Wanting):
                    submitted.send_job(got.worker, task)
                    continue
                submitted.job_received(to)
                self.check(got)
                yield got.encoded
        finally:
            if self._client.status == "running":
                submitted.cancel()

    def _next(self, finished: queue.SimpleQueue) -> Any:
        """The next future that finished or failed."""
        seen = time.monotonic()
        while True:
            try:
                return finished.get(timeout=_LOOK_S)
            except queue.Empty:
                if self._look():
                    seen, self._waiting = time.monotonic(), False
                else:
                    self._alone(seen)

    def _result(self, task: Task, future: Any) -> WorkerAnswer | Wanting:
        from distributed import KilledWorker

        if future.status != "error":
            try:
                return future.result()
            except (CancelledError, OSError) as lost:
                raise self._gone(lost) from lost
        error = future.exception()
        if isinstance(error, InputError):
            text = str(error)
        elif isinstance(error, KilledWorker):
            text = f"{error.allowed_failures + 1} workers died while running it (out of memory?)"
        else:
            text = f"failed on a worker: {type(error).__name__}: {first_line(error)}"
        raise InputError(f"{task.name}: {text}") from error

    def check(self, answer: WorkerAnswer) -> None:
        """Reject rows of other versions or instruction sets; warn once if machines differ."""
        check_versions(answer.worker, answer.versions, versions(), runtime.DECISIVE)
        self._check_instructions(answer.worker, answer.machine.instructions)
        self._machine = self._machine or answer.machine
        if answer.machine != self._machine and not self._warned:
            self._warned = True
            warn(
                f"{answer.worker}: computes with {_described(answer.machine)}, others with"
                f" {_described(self._machine)}: rows may differ in their last digits"
            )

    def _check_instructions(self, worker: str, theirs: str) -> None:
        if not self._instructions[0]:
            self._instructions = theirs, worker
        ours, first = self._instructions
        if theirs != ours:
            raise InputError(
                f"{worker}: the worker has instruction set {theirs}, {first} has {ours}: rows would"
                " differ (start all with XLA_FLAGS=--xla_cpu_max_isa= set to the smaller one)"
            )

    def _alone(self, since: float) -> None:
        """Warn once that there are no workers, and give up after a while."""
        waited_s = time.monotonic() - since
        if waited_s > _PATIENCE_S:
            raise InputError(f"{self._name}: no worker for {_PATIENCE_S / 60:g} min")
        if waited_s > dask_client.CONNECT_S and not self._waiting:
            self._waiting = True
            what = "all workers have left" if self._any else "no workers yet"
            how = f"; start one: dask worker {self._name}" if "://" in self._name else ""
            warn(f"{self._name}: {what} (waiting up to {_PATIENCE_S / 60:g} min{how})")

    def _look(self) -> dict[str, int]:
        """Number of threads of each worker; says which have left since the last look."""
        there = self._threads()
        gone = sorted(self._known - there.keys())
        self._known = set(there)
        self._any = self._any or bool(there)
        if gone:
            which = f"{gone[0]} and {len(gone) - 1} more" if len(gone) > 1 else gone[0]
            warn(f"{which}: worker lost, its tasks run again ({len(there)} left)")
        return there

    def _threads(self) -> dict[str, int]:
        """Number of threads of each worker."""
        return dict(self._ask("nthreads"))

    def _ask(self, what: str, **arguments: Any) -> Any:
        try:
            return getattr(self._client, what)(**arguments)
        except Exception as error:  # Dask raises many different ones
            raise self._gone(error) from error

    def _gone(self, error: BaseException) -> InputError:
        # A cancelled task is named first, which says nothing of the scheduler.
        why = first_line(error).rpartition(" reason: ")[2].rstrip(".") or type(error).__name__
        kept = "results so far are kept: the same again with --resume, in Python resume=True"
        return InputError(f"{self._name}: lost the scheduler: {why} ({kept})")


def _described(about: WorkerMachine) -> str:
    options = ", ".join("=".join(option) for option in about.options) or "no XLA options"
    return f"{about.cpu} ({about.platform}; {options})"
