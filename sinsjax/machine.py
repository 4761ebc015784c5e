"""What the operating system tells about this machine, and the folder that this user has on it."""

import os
import stat
import tempfile
from pathlib import Path


def cpu() -> dict[str, str]:
    """The first processor's entries in ``/proc/cpuinfo``; empty where there is none."""
    try:
        first = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0]
    except OSError:
        return {}
    entries = (line.partition(":") for line in first.splitlines())
    return {key.strip(): value.strip() for key, _, value in entries}


def temporary_folder() -> Path:
    """This user's folder below the system's temporary one; it need not be there."""
    user = os.getuid() if hasattr(os, "getuid") else "user"
    return Path(tempfile.gettempdir()) / f"sinsjax-{user}"


def is_private(folder: Path) -> bool:
    """Whether a folder is this user's and nobody else can write there.

    Raises:
        OSError: there is no such folder.
    """
    about = folder.lstat()
    theirs = hasattr(os, "getuid") and about.st_uid != os.getuid()
    return not theirs and not about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
