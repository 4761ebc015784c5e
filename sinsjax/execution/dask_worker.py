"""What runs on a worker of `dask_pool`, and what it tells of itself.

Every answer carries what the worker computed it with, so that no row of another version is ever
written, and rows of unlike machines are noticed.
"""

import logging
import os
import pickle
import threading
from functools import cache
from typing import Any, NamedTuple

from sinsjax.execution.tasks import EncodedResult, Job, Task, TaskRunner
from sinsjax.platform import affinity, runtime, xla


class WorkerMachine(NamedTuple):
    """What decides the last bits of a worker's rows, beside the versions.

    Attributes:
        cpu: model.
        instructions: the instruction set in force.
        options: XLA:CPU options by name, as far as they are set.
        platform: of JAX: cpu, gpu.
    """

    cpu: str
    instructions: str
    options: tuple[tuple[str, str], ...]
    platform: str


class WorkerAnswer(NamedTuple):
    """What a worker hands back.

    Attributes:
        encoded: files of the task.
        worker: its address.
        versions: of the packages that decide the rows and the files.
        machine: see `WorkerMachine`.
    """

    encoded: EncodedResult
    worker: str
    versions: dict[str, str]
    machine: WorkerMachine


class Wanting(NamedTuple):
    """What a worker says that has not the job of a task.

    Attributes:
        worker: its address.
    """

    worker: str


def dask_setup(worker: Any) -> None:
    """Called by Dask in the workers that `dask_pool` starts, which preload this module.

    What fails is told to the process that asked, and told there once; what is left is that this
    process is gone.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL)


def answer(key: str, sent: bytes | None, task: Task) -> WorkerAnswer | Wanting:
    """Do a task; to be called by a Dask worker.

    Args:
        key: tells jobs apart.
        sent: pickled `Job`; None: it may be here already.
        task: one of its tasks.

    Raises:
        InputError: the job cannot be done here.
    """
    from distributed import get_worker

    worker = get_worker()
    runner = _runner(key, sent, worker.state.nthreads)
    if runner is None:
        return Wanting(worker.address)
    return WorkerAnswer(runner.pack(task), worker.address, versions(), machine_here())


_held: dict[str, TaskRunner] = {}
_building = threading.Lock()


def _runner(key: str, sent: bytes | None, threads: int) -> TaskRunner | None:
    """The task runner of a job, made once in a worker and kept until another job comes."""
    with _building:
        if key not in _held:
            if sent is None:
                return None
            if threads == 1 and os.environ.get(affinity.VARIABLE, "").strip() != "0":
                affinity.keep_to_one_core()
            runtime.configure(devices=1)
            _held.clear()
            job: Job = pickle.loads(sent)
            _held[key] = TaskRunner(job)
        return _held[key]


def versions() -> dict[str, str]:
    """The versions of the packages in `runtime.DECISIVE`."""
    every = runtime.versions()
    return {name: every[name] for name in runtime.DECISIVE}


@cache
def machine_here() -> WorkerMachine:
    """Of this process; starts JAX's backend."""
    import jax

    given = xla.given()
    return WorkerMachine(
        cpu=runtime.session()["cpu"],
        instructions=xla.instructions(),
        options=tuple((o.name, given[o.name]) for o in xla.wanted() if o.name in given),
        platform=jax.default_backend(),
    )
