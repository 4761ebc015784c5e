"""Files: atomic writing, reading without links, and those that the package brings along."""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.resources import files
from pathlib import Path
from typing import BinaryIO

from sinsjax.errors import InputError


def asset_path(name: str) -> Path:
    """Return the path of a file or folder of the repository, such as ``configs/imu``.

    A wheel has them in ``sinsjax/assets``, a source tree at its top.
    """
    installed = Path(str(files("sinsjax"))) / "assets" / name
    return installed if installed.exists() else Path(__file__).parents[2] / name


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


def write_file(path: str | Path, content: bytes) -> None:
    """Write a whole file with `atomic_write`."""
    with atomic_write(path) as file:
        file.write(content)


def read_regular_file(path: Path) -> bytes:
    """Read a regular file; nothing is read through a link or from a pipe.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is not a regular file, or cannot be read.
    """
    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            raise InputError(f"{path}: is not a regular file but a link, a folder or a pipe")
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
