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

from sinsjax import clients, runtime
from sinsjax.types import InputError
from sinsjax.work import Executor, Packed, Task, Workshop
from sinsjax.worker import Answer, Machine, answer, versions

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
        Executor for `sinsjax.run_into`. A record travels with every task.

    Raises:
        InputError: Dask is not installed, there are more processes than cores, no scheduler
            answers within 10 s, it has no worker for 10 min, or a worker has another version of
            what decides the rows, or another instruction set than the others. Tasks raise it too
            where one fails again and again.
    """
    with ExitStack() as stack:
        if scheduler is None:
            client = stack.enter_context(clients.local(workers or runtime.usable_cores()))
        else:
            client = stack.enter_context(clients.connected(scheduler))
        crew = Crew(client, scheduler or "--workers")
        facts = {"workers": crew.ready(), "scheduler": scheduler or "local"}
        yield Executor(crew.do, facts | crew.facts())


class Crew:
    """The workers of a scheduler, seen from the process that asks."""

    def __init__(self, client: Any, name: str) -> None:
        self._client, self._name = client, name
        self._machine: Machine | None = None
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
        sets = self._ask("run", function=runtime.instructions, on_error="ignore")
        for worker, instructions in sorted(sets.items()):
            self._check_instructions(worker, instructions)
        return len(there)

    def facts(self) -> dict[str, Any]:
        """What the manifest says of the workers: they make the rows, not the process that asks."""
        instructions, _ = self._instructions
        return {"instructions": instructions} if instructions else {}

    def do(self, workshop: Workshop, tasks: Iterable[Task]) -> Iterator[Packed]:
        """See `Executor`."""
        job = workshop.job
        key = f"sinsjax-{job.identity}-{job.curves}-{job.chunk_runs}"
        sent = pickle.dumps(job)
        finished: queue.SimpleQueue[Any] = queue.SimpleQueue()
        under_way: dict[str, tuple[Task, Any]] = {}
        left = iter(tasks)
        try:
            while True:
                room = AHEAD * max(1, sum(self._threads().values())) - len(under_way)
                for task in islice(left, max(0, room)):
                    # No dependency on data of one worker, near which Dask would keep the tasks.
                    future = self._client.submit(
                        answer, key, sent, task, key=f"{key}-{task.name}", retries=_RETRIES
                    )
                    under_way[future.key] = task, future
                    future.add_done_callback(finished.put)
                if not under_way:
                    return
                task, future = under_way.pop(self._next(finished).key)
                got = self._result(task, future)
                future.release()
                self.check(got)
                yield got.packed
        finally:
            if under_way and self._client.status == "running":
                self._client.cancel([future for _, future in under_way.values()])

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

    def _result(self, task: Task, future: Any) -> Answer:
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
            text = f"failed on a worker: {type(error).__name__}: {clients.first_line(error)}"
        raise InputError(f"{task.name}: {text}") from error

    def check(self, answer: Answer) -> None:
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
        if waited_s > clients.CONNECT_S and not self._waiting:
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


def _said(about: Machine) -> str:
    options = ", ".join("=".join(option) for option in about.options) or "no XLA options"
    return f"{about.cpu} ({about.platform}; {options})"


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
