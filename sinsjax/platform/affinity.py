"""One core per process, for workers that share a machine.

XLA sizes its thread pool by the cores available to the process when JAX starts, and threads that
migrate between cores cost time, so a worker is pinned to a core before: ``SINSJAX_ONE_CORE=1`` in
its environment makes `runtime.configure` do so. An operating system lock for each core marks it as
occupied and is released when the process ends: restarted workers, and workers of several
schedulers on one machine, find other cores.
"""

import os
import platform
from contextlib import suppress
from pathlib import Path
from typing import Any

from sinsjax.platform import machine

VARIABLE = "SINSJAX_ONE_CORE"

_lock: Any = None  # held until the process ends


def pin_if_requested() -> None:
    """Pin this process to one core if the environment requests it."""
    if os.environ.get(VARIABLE, "").strip() == "1":
        pin_to_free_core()


def pin_to_free_core() -> int | None:
    """Pin this process and all its threads to a core not taken by another such process.

    Returns:
        The core; None, leaving the process unpinned, if no core is free or the system does not
        support it.
    """
    global _lock
    if _lock is not None or not hasattr(os, "sched_setaffinity"):
        return None
    import filelock  # here, because importing it is slower than the rest of this module

    # Where the folder is unsafe or the disk has no locks, running unpinned is not an error.
    with suppress(OSError):
        # In a folder writable by others, a planted link could redirect the lock file.
        folder = machine.ensure_private_folder(machine.user_temporary_folder())
        for core in sorted(os.sched_getaffinity(0)):
            lock = filelock.FileLock(folder / f"core-{platform.node()}-{core}.lock", timeout=0)
            with suppress(filelock.Timeout):
                lock.acquire()
                _pin_all_threads(core)
                _lock = lock
                return core
    return None


def _pin_all_threads(core: int) -> None:
    pinned: set[int] = set()
    # A thread not yet pinned may start others meanwhile; threads inherit the core of their parent.
    while missed := _thread_ids() - pinned:
        for thread in missed:
            with suppress(ProcessLookupError):  # the thread has ended
                os.sched_setaffinity(thread, {core})
        pinned |= missed


def _thread_ids() -> set[int]:
    return {int(path.name) for path in Path("/proc/self/task").glob("*")} or {0}
