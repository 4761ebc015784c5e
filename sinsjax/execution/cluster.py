"""Dask workers as the executor of a study: those of a scheduler that the user has started.

Workers return Parquet files and write nothing; the main process writes all of them. Dask reassigns
the tasks of a lost worker. The job, which may contain a long record, is a Dask variable: the
scheduler stores it, and every worker process, early or late, reads it once.
"""

import logging
import os
import pickle
import threading
import time
import uuid
import warnings
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager
from functools import partial
from itertools import islice
from typing import Any

from sinsjax.console import print_warning
from sinsjax.errors import InputError
from sinsjax.execution.tasks import Executor, Task, TaskResult, TaskRunner
from sinsjax.messages import first_error_line
from sinsjax.methods.registry import packages_of
from sinsjax.platform import runtime, xla

CONNECT_TIMEOUT_S = 10.0
"""Time allowed for a scheduler to answer, and for workers to appear before a warning, s."""

WORKER_TIMEOUT_S = 600.0
"""Time to wait for a worker if there is none, s."""

TASKS_PER_THREAD = 2
"""Tasks submitted per worker thread, so that no thread waits for its next one."""

_POLL_S = 0.05
_RETRIES = 2
_INSTRUCTIONS = "instruction set"


@contextmanager
def executor(*, scheduler: str) -> Iterator[Executor]:
    """Run tasks on Dask workers, for the duration of a ``with`` block.

    Args:
        scheduler: address of their scheduler, ``tcp://host:port``.

    Yields:
        Executor for `sinsjax.run_into`.

    Raises:
        InputError: Dask is not installed, no scheduler answers within 10 s, it has no worker for
            10 min, or the workers' package versions or instruction sets differ. Running tasks also
            raises it if a task fails repeatedly.
    """
    try:
        from distributed.utils import silence_logging_cmgr
    except ImportError:
        text = '--scheduler needs Dask: pip install "sinsjax[cluster]"'
        raise InputError(text) from None
    none = logging.CRITICAL  # one line reports each expected event
    with (
        silence_logging_cmgr(none),
        silence_logging_cmgr(none, "distributed.client"),
        _connect(scheduler) as client,
    ):
        workers = _Workers(client, scheduler)
        try:
            yield Executor(workers.run_tasks, workers.check())
        finally:
            workers.delete_job()


def _connect(address: str) -> Any:
    """Return a client of an existing scheduler."""
    from distributed import Client
    from distributed.versions import VersionMismatchWarning

    answer: Future[Any] = Future()

    def connect() -> None:
        try:
            answer.set_result(Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False))
        except Exception as error:  # which one depends on what is wrong
            answer.set_exception(error)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", VersionMismatchWarning)  # we compare those that matter
        # In a thread, since a client waits forever for a service that is silent or speaks HTTP.
        threading.Thread(target=connect, daemon=True).start()
        try:
            return answer.result(CONNECT_TIMEOUT_S + 1.0)
        except Exception as error:
            reason = first_error_line(error) or "another service does, such as Dask's dashboard"
            raise InputError(f"{address}: no Dask scheduler answers there ({reason})") from None


class _Workers:
    """Workers of a scheduler, seen from the main process."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address = client, address
        self._threads: dict[str, int] = {}  # per worker, when last counted
        self._last_worker_s, self._warned = time.monotonic(), False
        self._required: dict[str, str] = {}
        self._job: Any = None  # Dask variable with the job of this runner
        self._runner: TaskRunner | None = None

    def check(self) -> dict[str, Any]:
        """Wait for workers, compare them, and return facts about them."""
        try:
            while not self._count_threads():
                time.sleep(_POLL_S)
            installed = self._client.run(_describe_process)
        except InputError:
            raise
        except Exception as error:  # workers may have another sinsjax, or none
            text = f"its workers cannot run sinsjax: {first_error_line(error)}"
            raise InputError(
                f"{self._address}: {text} (install the same version on every worker)"
            ) from error
        here, instructions = runtime.relevant_versions(), installed[min(installed)][_INSTRUCTIONS]
        self._required = {name: here[name] for name in runtime.RESULT_PACKAGES}
        self._required[_INSTRUCTIONS] = instructions
        for worker, found in installed.items():
            _check_same(worker, found, self._required)
        return {
            "workers": len(self._threads),
            "threads": sum(self._threads.values()),
            "scheduler": self._address,
            "instructions": instructions,  # of the machines that compute the rows
        }

    def run_tasks(self, runner: TaskRunner, tasks: Iterable[Task]) -> Iterator[TaskResult]:
        """Run tasks, see `Executor`."""
        from distributed import as_completed

        required = self._required | packages_of(runner.job.study.methods)
        remaining, running = iter(tasks), dict[Any, Task]()
        completed = as_completed(loop=self._client.loop)
        try:
            run = partial(run_task_on_worker, self._share_job(runner), required)
            while True:
                room = TASKS_PER_THREAD * max(1, self._count_threads()) - len(running)
                batch = list(islice(remaining, max(0, room)))
                futures = self._client.map(run, batch, pure=False, retries=_RETRIES)
                running |= zip(futures, batch, strict=True)
                completed.update(futures)
                if not running:
                    return
                if not completed.has_ready():
                    time.sleep(_POLL_S)
                for future in completed.next_batch(block=False):
                    result = _task_result(running.pop(future), future)
                    future.release()  # or Dask computes it again if its worker is lost
                    yield result
        except (InputError, GeneratorExit):
            raise
        except Exception as error:  # Dask raises many different ones
            kept = "completed chunks are stored: repeat with --resume, in Python resume=True"
            raise InputError(f"{self._address}: lost the scheduler ({kept})") from error
        finally:
            if running and self._client.status == "running":
                self._client.cancel(list(running))

    def _count_threads(self) -> int:
        """Return the number of threads; warn about lost and missing workers."""
        before, self._threads = self._threads, dict(self._client.nthreads())
        for worker in sorted(before.keys() - self._threads):
            text = f"worker lost, its tasks run again ({len(self._threads)} left)"
            print_warning(f"{worker}: {text}")
        waited_s = time.monotonic() - self._last_worker_s
        if self._threads:
            self._last_worker_s, self._warned = time.monotonic(), False
        elif waited_s > WORKER_TIMEOUT_S:
            raise InputError(f"{self._address}: no worker for {WORKER_TIMEOUT_S / 60:g} min")
        elif waited_s > CONNECT_TIMEOUT_S and not self._warned:
            self._warned = True
            print_warning(
                f"{self._address}: no workers (waiting up to {WORKER_TIMEOUT_S / 60:g} min; start"
                f" one: dask worker {self._address})"
            )
        return sum(self._threads.values())

    def _share_job(self, runner: TaskRunner) -> str:
        """Store the job of a runner on the scheduler, once; return the variable's name."""
        from distributed import Variable

        if self._runner is not runner:
            self.delete_job()
            self._job = Variable(f"sinsjax-{uuid.uuid4().hex}", client=self._client)
            self._job.set(pickle.dumps(runner.job))
            self._runner = runner
        return str(self._job.name)

    def delete_job(self) -> None:
        """Remove the job from the scheduler."""
        if self._job is not None and self._client.status == "running":
            self._job.delete()


def _task_result(task: Task, future: Any) -> TaskResult:
    from distributed import KilledWorker

    if future.status != "error":
        return future.result()
    error = future.exception()
    text = f"failed on a worker: {type(error).__name__}: {first_error_line(error)}"
    if isinstance(error, InputError):
        text = str(error)
    elif isinstance(error, KilledWorker):
        text = f"{error.allowed_failures + 1} workers died while running it (out of memory?)"
    raise InputError(f"{task.name}: {text}") from error


def _check_same(worker: str, installed: Mapping[str, Any], required: Mapping[str, Any]) -> None:
    """Refuse a worker whose rows could differ from those of the others."""
    for name, value in required.items():
        if installed.get(name) != value:
            remedy = "install the same version on every worker"
            if name == _INSTRUCTIONS:
                remedy = "start all workers with XLA_FLAGS=--xla_cpu_max_isa= set to the smaller"
            raise InputError(
                f"{worker}: the worker has {name} {installed.get(name) or '(none)'}, not {value}:"
                f" rows could differ ({remedy})"
            )


# --- On the workers ------------------------------------------------------------------------------

_runners: dict[str, TaskRunner] = {}  # of this process, by job name; at most one
_prepare_lock = threading.Lock()


def _describe_process() -> dict[str, str]:
    """Return the versions and the instruction set of this process."""
    return runtime.relevant_versions() | {_INSTRUCTIONS: xla.instruction_set()}


def run_task_on_worker(job_name: str, required: Mapping[str, str], task: Task) -> TaskResult:
    """Run a task on a Dask worker.

    Args:
        job_name: name of the variable with the job.
        required: versions of packages, and the instruction set, that this process must have.
        task: one of the job's tasks.

    Raises:
        InputError: this process lacks something required, or the job cannot be run.
    """
    with _prepare_lock:
        if job_name not in _runners:
            _runners.clear()
            _runners[job_name] = _make_runner(job_name, required)
        runner = _runners[job_name]
    return runner.compute(task)


def _make_runner(job_name: str, required: Mapping[str, str]) -> TaskRunner:
    """Compare and configure a worker process, and create the runner of a job."""
    import jax
    from distributed import Variable, get_worker

    # Before unpickling, which needs the packages.
    _check_same(get_worker().address, _describe_process(), required)
    if platforms := os.environ.get("JAX_PLATFORMS"):  # Dask may have set it after JAX read it
        jax.config.update("jax_platforms", platforms)
    runtime.configure(devices=1)
    return TaskRunner(pickle.loads(Variable(job_name).get(timeout=1.0)))
