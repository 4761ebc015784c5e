"""Processor, memory and disk of this machine, and the user's folders on it."""

import errno
import math
import os
import platform
import shutil
import stat
from contextlib import suppress
from pathlib import Path

_INSTRUCTION_SETS = {"AVX512": "avx512f", "AVX2": "avx2", "AVX": "avx", "SSE4_2": "sse4_2"}
"""XLA's names of the x86 instruction sets, the largest first, with a CPU flag for each."""


def cpu_info() -> dict[str, str]:
    """Return the first processor's entries in ``/proc/cpuinfo``; empty on systems without it."""
    try:
        first = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0]
    except OSError:
        return {}
    entries = (line.partition(":") for line in first.splitlines())
    return {key.strip(): value.strip() for key, _, value in entries}


def instruction_set(max_isa: str = "") -> str:
    """Return the instruction set that programs are compiled for, if it can change a last bit.

    Args:
        max_isa: value of ``--xla_cpu_max_isa``, the largest set that XLA may use.

    Returns:
        ``AVX512``, ``AVX2``, ``AVX`` or ``SSE4_2``, as in that option, ``SVE`` or ``NEON``; the
        machine type if the system lists no flags. Later x86 extensions are for short integers
        and half precision and count as AVX-512.
    """
    entries = cpu_info()
    flags = (entries.get("flags") or entries.get("Features") or "").split()
    if "asimd" in flags:
        return "SVE" if "sve" in flags else "NEON"
    names = list(_INSTRUCTION_SETS)
    here = [name for name in names if _INSTRUCTION_SETS[name] in flags]
    allowed = names[names.index(max_isa.upper()) :] if max_isa.upper() in names else names
    unknown = f"{platform.machine()} to {allowed[0]}" if allowed != names else platform.machine()
    return next((name for name in here if name in allowed), unknown)


def available_memory_bytes() -> float:
    """Return the memory available to this process at most; infinite if unknown."""
    limits = [math.inf]
    with suppress(ValueError, OSError, AttributeError):
        limits.append(float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")))
    for limit in ("memory.max", "memory/memory.limit_in_bytes"):
        with suppress(ValueError, OSError):
            limits.append(float(Path("/sys/fs/cgroup", limit).read_text(encoding="ascii")))
    return min(limits)


def free_disk_bytes(folder: Path) -> float:
    """Return the free space on the disk of a folder, existing or not; infinite if unknown."""
    for path in (folder.absolute(), *folder.absolute().parents):
        with suppress(OSError):
            return float(shutil.disk_usage(path).free)
    return math.inf


def user_cache_folder() -> Path:
    """Return this user's cache folder, which may not exist yet, or raise an `OSError`."""
    import platformdirs  # here, because most processes do not need it

    folder = platformdirs.user_cache_path("sinsjax", appauthor=False)
    if not folder.is_absolute():
        raise OSError(errno.ENOENT, "this user has no cache folder", str(folder))
    return folder


def ensure_private_folder(folder: Path) -> Path:
    """Return a folder of this user that no other can write to, created if missing (mode 0700).

    Raises:
        OSError: it cannot be created, or is not this user's alone. ``strerror`` has the reason and
            ``filename`` the folder.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if hasattr(os, "geteuid"):  # not on Windows, where a profile is private to its user
        about = folder.stat()
        reason = "owned by another user" if about.st_uid != os.geteuid() else ""
        if about.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            reason = "other users can write there, and cached programs are executed"
        if reason:
            raise PermissionError(errno.EPERM, reason, str(folder))
    return folder
