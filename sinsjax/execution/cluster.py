"""Dask workers as the executor of a study: those of a scheduler that the user has started.

Workers return Parquet files and write nothing; the main process writes all of them. Dask reassigns
the tasks of a lost worker. The job, which may contain a long record, is a Dask variable: the
scheduler stores it, and every worker process, early or late, reads it once.
"""

import logging
import os
import pickle
import queue
import socket
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import islice
from typing import Any

from sinsjax.console import print_warning
from sinsjax.errors import InputError
from sinsjax.execution.tasks import EncodedResult, Executor, Task, TaskRunner
from sinsjax.messages import first_error_line
from sinsjax.methods.registry import packages_of
from sinsjax.platform import runtime, xla

CONNECT_TIMEOUT_S = 10.0
"""Time allowed for a scheduler to answer, and for workers to appear before a warning, s."""

WORKER_TIMEOUT_S = 600.0
"""Time to wait for a worker if there is none, s."""

TASKS_PER_THREAD = 2
"""Tasks submitted per worker thread, so that no thread waits for its next one."""

_POLL_S = 2.0
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
        import distributed  # noqa: F401
    except ImportError:
        text = '--scheduler needs Dask: pip install "sinsjax[cluster]"'
        raise InputError(text) from None
    with ExitStack() as stack:
        stack.enter_context(_silence_log())
        client = stack.enter_context(_connect(scheduler))
        pool = _Workers(client, scheduler)
        stack.callback(pool.delete_job)
        threads = pool.wait_for_workers()
        facts = {
            "workers": len(threads),
            "threads": sum(threads.values()),
            "scheduler": scheduler,
            "instructions": pool.instructions,  # of the machines that compute the rows
        }
        yield Executor(pool.run_tasks, facts)


@contextmanager
def _silence_log() -> Iterator[None]:
    """Silence Dask's log unless the user configures it; one line reports each expected event."""
    import dask
    from distributed.utils import silence_logging_cmgr

    config, level = dask.config.config, logging.CRITICAL
    if {"logging", "logging-file-config"} & {*config, *config.get("distributed", {})}:
        yield
        return
    with silence_logging_cmgr(level), silence_logging_cmgr(level, "distributed.client"):
        yield


def _connect(address: str) -> Any:
    """Return a client of an existing scheduler."""
    from distributed import Client
    from distributed.comm import addressing
    from distributed.versions import VersionMismatchWarning

    answers: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def connect() -> None:
        try:
            scheme, location = addressing.parse_address(address)
            if scheme in ("tcp", "tls"):  # fails at once, and names the cause as Dask does not
                socket.create_connection(
                    addressing.parse_host_port(location), CONNECT_TIMEOUT_S
                ).close()
            answers.put(Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False))
        except OSError as error:
            answers.put(error.strerror or first_error_line(error))
        except ValueError as error:
            answers.put(first_error_line(error))
        except Exception:  # which one depends on the service
            answers.put("another service does")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", VersionMismatchWarning)  # we compare those that matter
        # In a thread, since a client waits forever for a service that is silent or speaks HTTP.
        threading.Thread(target=connect, daemon=True).start()
        try:
            answer = answers.get(timeout=CONNECT_TIMEOUT_S)
        except queue.Empty:
            answer = f"no answer in {CONNECT_TIMEOUT_S:g} s"
    if isinstance(answer, str):
        raise InputError(f"{address}: no Dask scheduler answers there ({answer})")
    return answer


class _Workers:
    """Client of a scheduler's workers, in the main process.

    Attributes:
        instructions: the instruction set of all workers; empty before `wait`.
    """

    def __init__(self, client: Any, name: str) -> None:
        self.instructions = ""
        self._client, self._name = client, name
        self._threads: dict[str, int] = {}  # per worker, when last counted
        self._last_worker_s = time.monotonic()  # last time with a worker
        self._warned = False
        self._job: Any = None  # Dask variable with the job of this runner
        self._runner: TaskRunner | None = None

    def wait_for_workers(self) -> dict[str, int]:
        """Wait for workers, check them, and return the number of threads per worker."""
        while not self.instructions:
            if not self.count_threads():
                time.sleep(_POLL_S / 10)
                continue
            # Through Dask first: workers may have another sinsjax, or none.
            versions = self._call_dask(
                self._client.get_versions, packages=list(runtime.RESULT_PACKAGES)
            )
            required = {
                name: versions["client"]["packages"][name] for name in runtime.RESULT_PACKAGES
            }
            for worker, installed in versions["workers"].items():
                _check_same_versions(worker, installed["packages"], required)
            instruction_sets = self._call_dask(
                self._client.run, xla.instruction_set, on_error="ignore"
            )
            for worker, instructions in sorted(instruction_sets.items()):
                self.instructions = self.instructions or instructions
                installed = {_INSTRUCTIONS: instructions}
                _check_same_versions(worker, installed, {_INSTRUCTIONS: self.instructions})
        return self._threads

    def run_tasks(self, runner: TaskRunner, tasks: Iterable[Task]) -> Iterator[EncodedResult]:
        """Run tasks, see `Executor`."""
        from distributed import wait

        versions = runtime.relevant_versions()
        required = {name: versions[name] for name in runtime.RESULT_PACKAGES}
        required |= packages_of(runner.job.study.methods) | {_INSTRUCTIONS: self.instructions}
        run = partial(run_task_on_worker, self._share_job(runner), required)
        remaining, pending = iter(tasks), dict[Any, Task]()
        self._last_worker_s = time.monotonic()
        try:
            while True:
                room = TASKS_PER_THREAD * max(1, sum(self.count_threads().values())) - len(pending)
                if batch := list(islice(remaining, max(0, room))):
                    futures = self._call_dask(
                        self._client.map, run, batch, pure=False, retries=_RETRIES
                    )
                    pending |= zip(futures, batch, strict=True)
                if not pending:
                    return
                try:
                    with self._client.as_current():
                        finished = wait(list(pending), _POLL_S, "FIRST_COMPLETED").done
                except TimeoutError:
                    continue
                except CancelledError as error:  # as the client does if the connection is lost
                    raise self._lost_scheduler_error() from error
                for future in finished:
                    encoded = self._task_result(pending.pop(future), future)
                    future.release()  # or Dask computes it again if its worker is lost
                    yield encoded
        finally:
            if pending and self._client.status == "running":
                self._client.cancel(list(pending))

    def count_threads(self) -> dict[str, int]:
        """Return the number of threads per worker; warn about lost and missing workers."""
        before, self._threads = self._threads, dict(self._call_dask(self._client.nthreads))
        if lost := sorted(before.keys() - self._threads):
            names = f"{lost[0]} and {len(lost) - 1} more" if len(lost) > 1 else lost[0]
            print_warning(f"{names}: worker lost, its tasks run again ({len(self._threads)} left)")
        if self._threads:
            self._last_worker_s, self._warned = time.monotonic(), False
            return self._threads
        waited_s = time.monotonic() - self._last_worker_s
        if waited_s > WORKER_TIMEOUT_S:
            raise InputError(f"{self._name}: no worker for {WORKER_TIMEOUT_S / 60:g} min")
        if waited_s > CONNECT_TIMEOUT_S and not self._warned:
            self._warned = True
            print_warning(
                f"{self._name}: no workers (waiting up to {WORKER_TIMEOUT_S / 60:g} min; start one:"
                f" dask worker {self._name})"
            )
        return self._threads

    def delete_job(self) -> None:
        """Remove the job from the scheduler."""
        if self._job is not None:
            self._job.delete()
        self._job = self._runner = None

    def _share_job(self, runner: TaskRunner) -> str:
        """Store the job of a runner on the scheduler, once; return the variable's name."""
        from distributed import Variable

        if self._runner is not runner:
            self.delete_job()
            self._job = Variable(f"sinsjax-{uuid.uuid4().hex}", client=self._client)
            self._call_dask(self._job.set, pickle.dumps(runner.job))
            self._runner = runner
        return str(self._job.name)

    def _task_result(self, task: Task, future: Any) -> EncodedResult:
        from distributed import KilledWorker

        if future.status != "error":
            return self._call_dask(future.result)
        error = self._call_dask(future.exception)
        if isinstance(error, InputError):
            text = str(error)
        elif isinstance(error, KilledWorker):
            text = f"{error.allowed_failures + 1} workers died while running it (out of memory?)"
        else:
            text = f"failed on a worker: {type(error).__name__}: {first_error_line(error)}"
        raise InputError(f"{task.name}: {text}") from error

    def _call_dask(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except Exception as error:  # Dask raises many different ones
            raise self._lost_scheduler_error() from error

    def _lost_scheduler_error(self) -> InputError:
        kept = "completed chunks are stored: repeat with --resume, in Python resume=True"
        return InputError(f"{self._name}: lost the scheduler ({kept})")


def _check_same_versions(
    worker: str, installed: Mapping[str, Any], required: Mapping[str, Any]
) -> None:
    """Refuse a worker whose rows could differ from those of the others."""
    for name, value in required.items():
        if installed.get(name) != value:
            remedy = "install the same version on every worker"
            if name == _INSTRUCTIONS:
                remedy = (
                    "start all workers with XLA_FLAGS=--xla_cpu_max_isa= set to the smaller one"
                )
            raise InputError(
                f"{worker}: the worker has {name} {installed.get(name) or '(none)'}, not {value}:"
                f" rows could differ ({remedy})"
            )


# --- On the workers ------------------------------------------------------------------------------

_runners: dict[str, TaskRunner] = {}  # of this process, by job name; at most one
_prepare_lock = threading.Lock()


def run_task_on_worker(job_name: str, required: Mapping[str, str], task: Task) -> EncodedResult:
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
    return runner.compute_files(task)


def _make_runner(job_name: str, required: Mapping[str, str]) -> TaskRunner:
    """Configure a worker process and create the runner of a job."""
    import jax
    from distributed import Variable, get_worker

    installed = runtime.relevant_versions() | {_INSTRUCTIONS: xla.instruction_set()}
    _check_same_versions(
        get_worker().address, installed, required
    )  # before unpickling, which needs the packages
    if platforms := os.environ.get("JAX_PLATFORMS"):  # Dask may have set it after JAX read it
        jax.config.update("jax_platforms", platforms)
    runtime.configure(devices=1)
    return TaskRunner(pickle.loads(Variable(job_name).get(timeout=1.0)))
