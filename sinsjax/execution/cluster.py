"""Dask workers as the executor of a study: local processes, or those of an existing scheduler.

Workers return Parquet files and write nothing; the main process writes all of them. Dask reassigns
the tasks of a lost worker. The job, which may contain a long record, is a Dask variable: the
scheduler stores it, and every worker process, early or late, reads it once.
"""

import logging
import multiprocessing
import os
import pickle
import queue
import signal
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
from sinsjax.platform import affinity, runtime, xla

CONNECT_S = 10.0
"""Time allowed for a scheduler to answer, and for workers to appear before a warning, s."""

PATIENCE_S = 600.0
"""Time to wait for a worker if there is none, s."""

AHEAD = 2
"""Tasks submitted per worker thread, so that no thread waits for its next one."""

_LOOK_S = 2.0
_RETRIES = 2
_INSTRUCTIONS = "instruction set"


@contextmanager
def executor(*, workers: int | None = None, scheduler: str | None = None) -> Iterator[Executor]:
    """Run tasks on Dask workers, for the duration of a ``with`` block.

    Args:
        workers: processes to start on this machine, one per core; they end with the block. As with
            all processes that Python spawns, a script that calls this must have its code below
            ``if __name__ == "__main__":``.
        scheduler: address of a scheduler to use instead, ``tcp://host:port``.

    Yields:
        Executor for `sinsjax.run_into`.

    Raises:
        InputError: Dask is not installed, there are more processes than cores, no scheduler
            answers within 10 s, it has no worker for 10 min, or the workers' package versions or
            instruction sets differ. Running tasks also raises it if a task fails repeatedly.
    """
    try:
        import distributed  # noqa: F401
    except ImportError:
        text = '--workers and --scheduler need Dask: pip install "sinsjax[cluster]"'
        raise InputError(text) from None
    with ExitStack() as stack:
        stack.enter_context(_log_silenced())
        if scheduler is None:
            client = stack.enter_context(_start_workers(workers or runtime.usable_cores()))
        else:
            client = stack.enter_context(_connect(scheduler))
        pool = _Workers(client, scheduler or "--workers")
        stack.callback(pool.forget_job)
        threads = pool.wait()
        facts = {
            "workers": len(threads),
            "threads": sum(threads.values()),
            "scheduler": scheduler or "local",
            "instructions": pool.instructions,  # of the machines that compute the rows
        }
        yield Executor(pool.run_tasks, facts)


@contextmanager
def _log_silenced() -> Iterator[None]:
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
                socket.create_connection(addressing.parse_host_port(location), CONNECT_S).close()
            answers.put(Client(address, timeout=CONNECT_S, set_as_default=False))
        except OSError as error:
            answers.put(error.strerror or first_error_line(error))
        except ValueError as error:
            answers.put(first_error_line(error))
        except Exception:  # depends on the service
            answers.put("another service does")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", VersionMismatchWarning)  # we compare those that matter
        # In a thread, since a client waits forever for a service that is silent or speaks HTTP.
        threading.Thread(target=connect, daemon=True).start()
        try:
            answer = answers.get(timeout=CONNECT_S)
        except queue.Empty:
            answer = f"no answer in {CONNECT_S:g} s"
    if isinstance(answer, str):
        raise InputError(f"{address}: no Dask scheduler answers there ({answer})")
    return answer


@contextmanager
def _start_workers(number: int) -> Iterator[Any]:
    """Yield a client of a scheduler in this process, with child processes as workers."""
    import dask
    from distributed import Client, LocalCluster

    cores = runtime.usable_cores()
    if number > cores:
        raise InputError(f"workers: {number} exceeds the {cores} available cores")
    with ExitStack() as stack:
        changes = {
            "distributed.worker.multiprocessing-method": "spawn",  # JAX does not survive a fork
            "distributed.comm.timeouts.connect": f"{CONNECT_S:g}s",  # to a dead worker, for results
        }
        stack.enter_context(dask.config.set(changes))
        with _signals_blocked():
            local = LocalCluster(
                n_workers=number,
                threads_per_worker=1,
                memory_limit=0,
                dashboard_address=None,
                scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # not the whole network
                env={"JAX_PLATFORMS": os.environ.get("JAX_PLATFORMS", "cpu")},
                silence_logs=logging.CRITICAL,
            )
            stack.enter_context(local)
            client = stack.enter_context(Client(local, set_as_default=False))
        yield client


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """Block Ctrl-C and SIGTERM in threads started here, and in the processes they start.

    A terminal sends Ctrl-C, and a batch system SIGTERM, to all processes; only the main process
    should handle them, and it lets the workers finish.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # The first lock starts Python's resource tracker, which would unblock the signals.
    multiprocessing.get_context("spawn").Lock()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Workers:
    """The workers of a scheduler, as seen from the main process.

    Attributes:
        instructions: the instruction set of all workers; empty before `wait`.
    """

    def __init__(self, client: Any, name: str) -> None:
        self.instructions = ""
        self._client, self._name = client, name
        self._threads: dict[str, int] = {}  # of each worker at the last search
        self._seen_s = time.monotonic()  # when there was a worker
        self._warned = False
        self._job: Any = None  # variable with the job of this runner
        self._runner: TaskRunner | None = None

    def wait(self) -> dict[str, int]:
        """Wait for workers, check them, and return the number of threads of each."""
        while not self.instructions:
            if not self.find():
                time.sleep(_LOOK_S / 10)
                continue
            # Dask's own question first: workers may have another sinsjax, or none.
            found = self._ask(self._client.get_versions, packages=list(runtime.RESULT_PACKAGES))
            ours = {name: found["client"]["packages"][name] for name in runtime.RESULT_PACKAGES}
            for worker, theirs in found["workers"].items():
                _require_same(worker, theirs["packages"], ours)
            sets = self._ask(self._client.run, xla.instruction_set, on_error="ignore")
            for worker, instructions in sorted(sets.items()):
                self.instructions = self.instructions or instructions
                theirs = {_INSTRUCTIONS: instructions}
                _require_same(worker, theirs, {_INSTRUCTIONS: self.instructions})
        return self._threads

    def run_tasks(self, runner: TaskRunner, tasks: Iterable[Task]) -> Iterator[EncodedResult]:
        """Run tasks, see `Executor`."""
        from distributed import wait

        versions = runtime.relevant_versions()
        required = {name: versions[name] for name in runtime.RESULT_PACKAGES}
        required |= packages_of(runner.job.study.methods) | {_INSTRUCTIONS: self.instructions}
        run = partial(run_task, self._share_job(runner), required)
        left, pending = iter(tasks), dict[Any, Task]()
        self._seen_s = time.monotonic()
        try:
            while True:
                room = AHEAD * max(1, sum(self.find().values())) - len(pending)
                if batch := list(islice(left, max(0, room))):
                    futures = self._ask(self._client.map, run, batch, pure=False, retries=_RETRIES)
                    pending |= zip(futures, batch, strict=True)
                if not pending:
                    return
                try:
                    with self._client.as_current():
                        finished = wait(list(pending), _LOOK_S, "FIRST_COMPLETED").done
                except TimeoutError:
                    continue
                except CancelledError as error:  # as the client does if the connection is lost
                    raise self._lost() from error
                for future in finished:
                    encoded = self._result(pending.pop(future), future)
                    future.release()  # or Dask computes it again if its worker is lost
                    yield encoded
        finally:
            if pending and self._client.status == "running":
                self._client.cancel(list(pending))

    def find(self) -> dict[str, int]:
        """Return the number of threads of each worker; warn about lost and missing workers."""
        before, self._threads = self._threads, dict(self._ask(self._client.nthreads))
        if lost := sorted(before.keys() - self._threads):
            which = f"{lost[0]} and {len(lost) - 1} more" if len(lost) > 1 else lost[0]
            print_warning(f"{which}: worker lost, its tasks run again ({len(self._threads)} left)")
        if self._threads:
            self._seen_s, self._warned = time.monotonic(), False
            return self._threads
        waited_s = time.monotonic() - self._seen_s
        if waited_s > PATIENCE_S:
            raise InputError(f"{self._name}: no worker for {PATIENCE_S / 60:g} min")
        if waited_s > CONNECT_S and not self._warned:
            self._warned = True
            how = f"; start one: dask worker {self._name}" if "://" in self._name else ""
            print_warning(f"{self._name}: no workers (waiting up to {PATIENCE_S / 60:g} min{how})")
        return self._threads

    def forget_job(self) -> None:
        """Remove the job from the scheduler."""
        if self._job is not None:
            self._job.delete()
        self._job = self._runner = None

    def _share_job(self, runner: TaskRunner) -> str:
        """Store the job of a runner on the scheduler, once; return the variable's name."""
        from distributed import Variable

        if self._runner is not runner:
            self.forget_job()
            self._job = Variable(f"sinsjax-{uuid.uuid4().hex}", client=self._client)
            self._ask(self._job.set, pickle.dumps(runner.job))
            self._runner = runner
        return str(self._job.name)

    def _result(self, task: Task, future: Any) -> EncodedResult:
        from distributed import KilledWorker

        if future.status != "error":
            return self._ask(future.result)
        error = self._ask(future.exception)
        if isinstance(error, InputError):
            text = str(error)
        elif isinstance(error, KilledWorker):
            text = f"{error.allowed_failures + 1} workers died while running it (out of memory?)"
        else:
            text = f"failed on a worker: {type(error).__name__}: {first_error_line(error)}"
        raise InputError(f"{task.name}: {text}") from error

    def _ask(self, question: Callable[..., Any], *args: Any, **named: Any) -> Any:
        try:
            return question(*args, **named)
        except Exception as error:  # Dask raises many different ones
            raise self._lost() from error

    def _lost(self) -> InputError:
        kept = "results so far are kept: the same again with --resume, in Python resume=True"
        return InputError(f"{self._name}: lost the scheduler ({kept})")


def _require_same(worker: str, theirs: Mapping[str, Any], required: Mapping[str, Any]) -> None:
    """Refuse a worker whose rows could differ from those of others."""
    for name, value in required.items():
        if theirs.get(name) != value:
            remedy = "install the same version on every worker"
            if name == _INSTRUCTIONS:
                remedy = "start all with XLA_FLAGS=--xla_cpu_max_isa= set to the smaller one"
            raise InputError(
                f"{worker}: the worker has {name} {theirs.get(name) or '(none)'}, not {value}:"
                f" rows could differ ({remedy})"
            )


# --- On the workers ------------------------------------------------------------------------------

_runners: dict[str, TaskRunner] = {}  # of this process, by the name of the job; at most one
_preparing = threading.Lock()


def run_task(job_name: str, required: Mapping[str, str], task: Task) -> EncodedResult:
    """Run a task on a Dask worker.

    Args:
        job_name: name of the variable with the job.
        required: versions of packages, and the instruction set, that this process must have.
        task: one of the job's tasks.

    Raises:
        InputError: this process lacks something required, or the job cannot be run.
    """
    with _preparing:
        if job_name not in _runners:
            _runners.clear()
            _runners[job_name] = _prepare(job_name, required)
        runner = _runners[job_name]
    return runner.pack(task)


def _prepare(job_name: str, required: Mapping[str, str]) -> TaskRunner:
    """Configure a worker process and make the runner of a job."""
    import jax
    from distributed import Variable, get_worker

    worker = get_worker()
    theirs = runtime.relevant_versions() | {_INSTRUCTIONS: xla.instruction_set()}
    _require_same(worker.address, theirs, required)  # before unpickling, which needs the packages
    one_core = os.environ.get(affinity.VARIABLE, "1" if worker.state.nthreads == 1 else "0")
    if one_core.strip() == "1":
        affinity.pin_to_free_core()
    if platforms := os.environ.get("JAX_PLATFORMS"):  # Dask may have set it after JAX read it
        jax.config.update("jax_platforms", platforms)
    runtime.configure(devices=1)
    return TaskRunner(pickle.loads(Variable(job_name).get(timeout=1.0)))
