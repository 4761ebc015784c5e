"""Atomic writing of files, and file names."""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from sinsjax.errors import InputError


@contextmanager
def atomic_write(path: str | Path) -> Iterator[BinaryIO]:
    """Open a temporary file that replaces ``path`` when the block ends without an error.

    Raises:
        InputError: the target cannot be written.
    """
    target = Path(path)
    temporary = target.parent / f".{target.name}.{os.getpid()}.tmp"
    try:
        temporary.unlink(missing_ok=True)  # left by a process with the same number
        with open(temporary, "xb") as file:  # through no link that somebody has put there
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
        _sync_directory(target.parent)
    except OSError as error:
        raise InputError(unwritable_message(target, error)) from None
    finally:
        with suppress(OSError):
            temporary.unlink()


def read_regular_file(path: Path) -> bytes:
    """Read a regular file; nothing is read through a link or from a pipe.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is not a regular file, or cannot be read.
    """
    try:
        mode = path.lstat().st_mode
        if stat.S_ISLNK(mode):
            raise InputError(f"{path}: is a symbolic link (replace it by the file)")
        if not stat.S_ISREG(mode):
            raise InputError(f"{path}: is not a regular file (remove it)")
        return path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None


def make_folder(path: Path) -> None:
    """Create a folder and its missing parents, or raise an `InputError`."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(unwritable_message(path, error)) from None


def require_writable(path: Path, option_name: str) -> None:
    """Reject the file of an option that cannot be written, before any work is done."""
    if path.is_dir():
        raise InputError(f"{option_name} {path}: is a folder, give the name of a file")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise InputError(
            f"{option_name} {path}: cannot be written: {folder} is not a writable folder"
        )


def unwritable_message(path: Path, error: OSError) -> str:
    """Return the message about a file or directory that cannot be written."""
    return f"{path}: cannot be written: {error.strerror or error}"


def _sync_directory(directory: Path) -> None:
    """Make the new name survive a power cut, where the system can."""
    with suppress(OSError):
        handle = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
