"""Dask workers as the executor of a study: those of a scheduler that the user has started.

Workers return Parquet files and write nothing; the main process writes all of them. Dask reassigns
the tasks of a lost worker. The job, which may contain a long record, is the result of a Dask task:
workers pass it on to one another, and every worker process prepares it once.
"""

import hashlib
import logging
import os
import pickle
import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager
from functools import partial
from itertools import islice
from typing import Any

from sinsjax.errors import InputError
from sinsjax.execution.tasks import Executor, Task, TaskResult, TaskRunner
from sinsjax.messages import first_error_line, print_warning
from sinsjax.methods.registry import packages_of
from sinsjax.platform import machine, runtime

CONNECT_TIMEOUT_S = 10.0
"""Time allowed for a scheduler to answer, s."""

WORKER_TIMEOUT_S = 60.0
"""Time to wait for its first worker, s."""

TASKS_PER_THREAD = 2  # so that no thread waits for its next one
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
        InputError: Dask is not installed, no scheduler answers within 10 s, it has no worker within
            a minute, or the workers' package versions or instruction sets differ. Running tasks
            also raises it if a task fails repeatedly.
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
        required = _compare_workers(client, scheduler)
        facts = {
            "workers": len(client.nthreads()),
            "threads": sum(client.nthreads().values()),
            "scheduler": scheduler,
            "instructions": required[_INSTRUCTIONS],  # of the machines that compute the rows
        }
        yield Executor(partial(_run_tasks, client, scheduler, required), facts)


def _connect(address: str) -> Any:
    """Return a client of an existing scheduler.

    In a thread, since a client waits forever for a service that is silent or speaks HTTP.
    """
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
        threading.Thread(target=connect, daemon=True).start()
        try:
            return answer.result(CONNECT_TIMEOUT_S + 1.0)
        except Exception as error:
            reason = first_error_line(error) or "another service does, such as Dask's dashboard"
            raise InputError(f"{address}: no Dask scheduler answers there ({reason})") from None


def _compare_workers(client: Any, address: str) -> dict[str, str]:
    """Wait for a worker, and return the versions and instruction set that all must have."""
    try:
        client.wait_for_workers(1, timeout=WORKER_TIMEOUT_S)
        installed = client.run(_describe_process)
    except Exception as error:  # workers may have another sinsjax, or none
        text = f"no worker that runs sinsjax: {first_error_line(error)}"
        hint = f"start one with the same version: dask worker {address}"
        raise InputError(f"{address}: {text} ({hint})") from error
    required = {name: runtime.relevant_versions()[name] for name in runtime.RESULT_PACKAGES}
    required[_INSTRUCTIONS] = installed[min(installed)][_INSTRUCTIONS]
    for worker, found in installed.items():
        _refuse_other_versions(worker, found, required)
    return required


def _run_tasks(
    client: Any,
    address: str,
    required: Mapping[str, str],
    runner: TaskRunner,
    tasks: Iterable[Task],
) -> Iterator[TaskResult]:
    """Run tasks on the workers of a client, a few at a time, see `Executor`."""
    from distributed import as_completed

    content = pickle.dumps(runner.job)
    name = f"sinsjax-{hashlib.sha256(content).hexdigest()}"
    required = {**required, **packages_of(runner.job.study.methods)}
    remaining, running = iter(tasks), dict[Any, Task]()
    run = partial(run_task_on_worker, name, required)
    options = {"pure": False, "retries": _RETRIES}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a large graph: a record is sent once
            job = client.submit(bytes, content, key=name)
        completed, workers = as_completed(loop=client.loop), dict[str, int]()
        while True:
            before, workers = workers, client.nthreads()
            for worker in sorted(before.keys() - workers):
                print_warning(f"{worker}: lost this worker, others compute its chunks again")
            room = TASKS_PER_THREAD * max(1, sum(workers.values())) - len(running)
            if batch := list(islice(remaining, max(0, room))):
                futures = client.map(run, batch, job=job, **options)
                running |= zip(futures, batch, strict=True)
                completed.update(futures)
            if not running:
                return
            future = next(completed)
            task = running.pop(future)
            if future.status == "error":
                error = future.exception()
                reason = f"{type(error).__name__}: {first_error_line(error)}"
                raise InputError(f"{task.name}: failed on a worker: {reason}") from error
            result = future.result()
            future.release()  # or Dask computes it again if its worker is lost
            yield result
    except (InputError, GeneratorExit):
        raise
    except Exception as error:  # Dask raises many different ones
        kept = "completed chunks are stored: repeat with --resume, in Python resume=True"
        raise InputError(f"{address}: lost the scheduler ({kept})") from error
    finally:
        if running and client.status == "running":
            client.cancel(list(running))


def _refuse_other_versions(
    worker: str, installed: Mapping[str, Any], required: Mapping[str, Any]
) -> None:
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

_runners: dict[str, TaskRunner] = {}  # of this process, by name of the job; at most one
_prepare_lock = threading.Lock()


def _describe_process() -> dict[str, str]:
    """Return the versions and the instruction set of this process."""
    return runtime.relevant_versions() | {_INSTRUCTIONS: machine.instruction_set()}


def run_task_on_worker(
    name: str, required: Mapping[str, str], task: Task, *, job: bytes
) -> TaskResult:
    """Run a task of a pickled job on a Dask worker, which must have the required versions.

    The name of the job is unique to its content.
    """
    with _prepare_lock:
        if name not in _runners:
            _runners.clear()
            _runners[name] = _make_runner(job, required)
        runner = _runners[name]
    return runner.compute(task)


def _make_runner(job: bytes, required: Mapping[str, str]) -> TaskRunner:
    """Compare and configure a worker process, and create the runner of a job."""
    import jax
    from distributed import get_worker

    # Before unpickling, which needs the packages.
    _refuse_other_versions(get_worker().address, _describe_process(), required)
    if platforms := os.environ.get("JAX_PLATFORMS"):  # Dask may have set it after JAX read it
        jax.config.update("jax_platforms", platforms)
    runtime.configure(devices=1)
    return TaskRunner(pickle.loads(job))
