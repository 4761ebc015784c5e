"""One process, one core: for workers that share a machine.

XLA sizes its pool of threads by the cores that a process may run on when it starts, and threads
that move between cores cost time, so a worker is kept to a core before jax is imported:
``SINSJAX_ONE_CORE=1`` in its environment has ``import sinsjax`` do it. Which cores are free is told
by a lock of the operating system for each, which dies with its process: workers that are started
again, and those of several schedulers on one machine, find cores of their own.
"""

import os
import platform
from contextlib import suppress
from pathlib import Path
from typing import Any

from sinsjax.platform import machine

VARIABLE = "SINSJAX_ONE_CORE"

_lock: Any = None  # held until the process ends


def apply() -> None:
    """Keep this process to one core if the environment asks for it."""
    if os.environ.get(VARIABLE, "").strip() == "1":
        keep_to_one_core()


def keep_to_one_core() -> int | None:
    """Keep this process, with all threads it has, to a core that no other such process has.

    Returns:
        The core; None where there is no free one or the system cannot do it, and the process is
        left as it is.
    """
    global _lock
    if _lock is not None or not hasattr(os, "sched_setaffinity"):
        return None
    import filelock  # here, for it takes longer to import than all of this module

    # Not to be made, not ours alone, or on a disk without locks: a process that moves is no error.
    with suppress(OSError):
        # Where others can write, they could have us write anywhere.
        folder = machine.private_folder(machine.temporary_folder())
        for core in sorted(os.sched_getaffinity(0)):
            lock = filelock.FileLock(folder / f"core-{platform.node()}-{core}.lock", timeout=0)
            with suppress(filelock.Timeout):
                lock.acquire()
                _keep_to(core)
                _lock = lock
                return core
    return None


def _keep_to(core: int) -> None:
    kept: set[int] = set()
    # A thread that is not kept yet may start others meanwhile; one that is hands its core on.
    while missed := _threads() - kept:
        for thread in missed:
            with suppress(ProcessLookupError):  # it ended meanwhile
                os.sched_setaffinity(thread, {core})
        kept |= missed


def _threads() -> set[int]:
    return {int(path.name) for path in Path("/proc/self/task").glob("*")} or {0}
