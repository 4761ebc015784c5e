"""One writer at a time in a results directory, and its name for those who come second.

The operating system holds the lock, and releases it when the process ends in whatever way.
"""

import os
import socket
from contextlib import suppress
from pathlib import Path

import filelock

from sinsjax.errors import InputError
from sinsjax.execution.belongings import check_name
from sinsjax.messages import one_line, shortened
from sinsjax.platform.files import make_folder, unwritable

LOCK = ".lock"
WRITER = ".writer"
"""Names the last process that took the lock; filelock may empty the lock's own file."""


def locked(directory: Path) -> filelock.FileLock:
    """Lock a directory, created if missing, against other writers.

    Raises:
        InputError: another process is writing there, or the directory cannot be written or has a
            name that is not UTF-8.
    """
    check_name(directory)
    make_folder(directory)
    lock = _acquired(directory)
    with suppress(OSError):  # whoever cannot be named is respected all the same
        (directory / WRITER).write_text(f"pid {os.getpid()} on {socket.gethostname()}\n")
    return lock


def check_unlocked(directory: Path) -> None:
    """Reject a directory that another process is writing to.

    Asked before all else: what is there changes, and anything said of it would mislead.

    Raises:
        InputError: names that process, or the lock cannot be taken, or the name is not UTF-8.
    """
    check_name(directory)
    if os.path.isfile(directory / LOCK):  # whatever cannot be looked at is told by other checks
        _acquired(directory).release()


def _acquired(directory: Path) -> filelock.FileLock:
    lock = filelock.FileLock(directory / LOCK)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout:
        text = f"{directory}: another process is writing there{_writer(directory)}"
        raise InputError(f"{text} (wait until it ends)") from None
    except OSError as error:
        raise InputError(unwritable(directory, error)) from error
    return lock


def _writer(directory: Path) -> str:
    try:
        name = (directory / WRITER).read_text(encoding="utf-8").strip()
    except (OSError, ValueError):
        return ""
    return f": {shortened(one_line(name))}" if name else ""
