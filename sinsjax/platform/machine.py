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

_ACL = "system.posix_acl_access"
_BY_OTHERS = "other users can write there"


class UnsafeFolderError(PermissionError):
    """A folder that other users could write to or replace."""

    def __init__(self, folder: Path, reason: str) -> None:
        super().__init__(errno.EPERM, reason, str(folder))


def cpu_info() -> dict[str, str]:
    """The first processor's entries in ``/proc/cpuinfo``; empty on systems without it."""
    try:
        first = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0]
    except OSError:
        return {}
    entries = (line.partition(":") for line in first.splitlines())
    return {key.strip(): value.strip() for key, _, value in entries}


def instruction_set(max_isa: str = "") -> str:
    """The instruction set that programs are compiled for, as far as it can change a last bit.

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
    """Return this user's cache folder; it may not exist yet.

    Raises:
        OSError: the user has no home directory.
    """
    import platformdirs  # here, because most processes do not need it

    folder = platformdirs.user_cache_path("sinsjax", appauthor=False)
    if not folder.is_absolute():
        raise OSError(errno.ENOENT, "this user has no cache folder", str(folder))
    return folder


def ensure_private_folder(folder: Path) -> Path:
    """A folder that no other user can write to or replace, created if missing.

    Missing folders are created for this user alone (mode 0700). Every parent must be owned by this
    user or the superuser and must not be writable by others, except a sticky folder of the
    superuser such as ``/tmp``, where only owners can rename. A group whose only member is this
    user does not count as others. Nothing is created below an unsafe folder.

    Args:
        folder: its path.

    Returns:
        The path without symbolic links, which is the one to use: links may be changed later.

    Raises:
        UnsafeFolderError: other users could write there. For this error and the next, ``strerror``
            has the reason and ``filename`` the folder.
        OSError: the folder cannot be created.
    """
    try:
        real = folder.resolve()
    except RuntimeError as error:  # a loop of links, in Python 3.11 and 3.12
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(folder)) from error
    path = [*reversed(real.parents), real]
    existing = [place for place in path if _exists(place)]
    for place in existing:
        _require_private_folder(place, is_target=place == real)
    for place in path[len(existing) :]:
        # Another process of this user may have created it; one of another user fails the check.
        with suppress(FileExistsError):
            place.mkdir(mode=0o700)
        _require_private_folder(place, is_target=place == real)
    return real


def _exists(place: Path) -> bool:
    try:
        place.lstat()
    except FileNotFoundError:
        return False
    return True


def _require_private_folder(folder: Path, *, is_target: bool) -> None:
    """Reject a folder that other users could write to or replace."""
    about = folder.lstat()  # not following links: the path was resolved, so a link is a new one
    if not stat.S_ISDIR(about.st_mode):
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(folder))
    if not hasattr(os, "geteuid"):  # Windows, where a profile is private to its user
        return
    user = os.geteuid()
    if about.st_uid not in ({user} if is_target else {user, 0}):
        raise UnsafeFolderError(folder, "owned by another user")
    sticky = about.st_uid == 0 and about.st_mode & stat.S_ISVTX and not is_target
    if sticky:
        return
    if about.st_mode & stat.S_IWOTH:
        raise UnsafeFolderError(folder, _BY_OTHERS)
    if about.st_mode & stat.S_IWGRP and (
        _has_access_control_list(folder) or not _is_only_group_member(user, about.st_gid)
    ):
        raise UnsafeFolderError(folder, _BY_OTHERS)


def _has_access_control_list(place: Path) -> bool:
    """Return whether there is an access control list; the group's bits are then its mask."""
    if not hasattr(os, "listxattr"):
        return False
    try:
        return _ACL in os.listxattr(place, follow_symlinks=False)
    except OSError:  # a file system without such lists
        return False


def _is_only_group_member(user: int, group: int) -> bool:
    """Return whether a user is the only member of a group; False if that cannot be determined."""
    import grp
    import pwd

    try:
        name, about = pwd.getpwuid(user).pw_name, grp.getgrgid(group)
    except KeyError:
        return False
    accounts = pwd.getpwall()
    others = {entry.pw_name for entry in accounts if entry.pw_gid == group} | set(about.gr_mem)
    # A directory service may not list accounts; a group named after the user is the user's own.
    listed = any(entry.pw_name == name for entry in accounts)
    return others <= {name, "root"} and (listed or about.gr_name == name)
