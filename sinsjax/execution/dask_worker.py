"""Code that runs on the workers of `dask_pool`.

Every answer includes the worker's versions and machine, so that no row of another version is ever
written, and a mix of machines is noticed.
"""

import logging
import os
import pickle
import threading
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, NamedTuple

from sinsjax.errors import InputError
from sinsjax.execution.tasks import EncodedResult, Job, Task, TaskRunner
from sinsjax.platform import affinity, runtime, xla


class WorkerMachine(NamedTuple):
    """Properties of a worker, besides the versions, that may change the last bits of its rows.

    Attributes:
        cpu: model of the processor.
        instructions: instruction set in use.
        options: names and values of the XLA:CPU options that are set.
        platform: JAX platform, cpu or gpu.
    """

    cpu: str
    instructions: str
    options: tuple[tuple[str, str], ...]
    platform: str


class WorkerAnswer(NamedTuple):
    """A worker's answer to a task.

    Attributes:
        encoded: files of the task.
        worker: address of the worker.
        versions: of the packages that may change the rows or the files.
        machine: see `WorkerMachine`.
    """

    encoded: EncodedResult
    worker: str
    versions: dict[str, str]
    machine: WorkerMachine


class Wanting(NamedTuple):
    """The answer of a worker that does not have the job of a task.

    Attributes:
        worker: address of the worker.
    """

    worker: str


def dask_setup(worker: Any) -> None:
    """Silence Dask's log; Dask calls this in local workers, which preload this module.

    The main process reports failures once; the log would only add that the process has gone.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL)


class SentJob(NamedTuple):
    """A job on its way to a worker.

    Attributes:
        packages: what its methods need, and in which version.
        pickled: the `Job`.
    """

    packages: dict[str, str]
    pickled: bytes


def answer(key: str, sent: SentJob | None, task: Task) -> WorkerAnswer | Wanting:
    """Run a task; called on a Dask worker.

    Args:
        key: identifies the job.
        sent: the job; None if the worker may already have it.
        task: one of the job's tasks.

    Raises:
        InputError: the job cannot be run here.
    """
    from distributed import get_worker

    worker = get_worker()
    if sent is not None:  # before it is unpickled, which would need them
        theirs = {name: runtime.version_or_none(name) for name in sent.packages}
        check_versions(worker.address, theirs, sent.packages, sent.packages)
    runner = _runner(key, sent, worker.state.nthreads)
    if runner is None:
        return Wanting(worker.address)
    return WorkerAnswer(runner.pack(task), worker.address, versions(), machine_here())


_held: dict[str, TaskRunner] = {}
_building = threading.Lock()


def _runner(key: str, sent: SentJob | None, threads: int) -> TaskRunner | None:
    """The task runner of a job, created once per worker and kept until the next job."""
    with _building:
        if key not in _held:
            if sent is None:
                return None
            if threads == 1 and os.environ.get(affinity.VARIABLE, "").strip() != "0":
                affinity.keep_to_one_core()
            runtime.configure(devices=1)
            _held.clear()
            job: Job = pickle.loads(sent.pickled)
            _held[key] = TaskRunner(job)
        return _held[key]


def check_versions(
    worker: str, theirs: Mapping[str, Any], ours: Mapping[str, Any], names: Iterable[str]
) -> None:
    """Refuse a worker with other versions of some packages."""
    for name in names:
        if theirs.get(name) != ours.get(name):
            raise InputError(
                f"{worker}: the worker has {name} {theirs.get(name) or '(none)'}, this process"
                f" {ours.get(name)}: rows could differ (install the same version on every worker)"
            )


def versions() -> dict[str, str]:
    """Versions of the packages in `runtime.DECISIVE`."""
    every = runtime.versions()
    return {name: every[name] for name in runtime.DECISIVE}


@cache
def machine_here() -> WorkerMachine:
    """Properties of this process; starts JAX's backend."""
    import jax

    given = xla.given()
    return WorkerMachine(
        cpu=runtime.session()["cpu"],
        instructions=xla.instructions(),
        options=tuple((o.name, given[o.name]) for o in xla.wanted() if o.name in given),
        platform=jax.default_backend(),
    )
