"""What the operating system tells about this machine, and the folders that this user has on it.

It imports nothing that starts a thread: `affinity` needs it before jax is there.
"""

import errno
import math
import os
import platform
import shutil
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

_SETS = {"AVX512": "avx512f", "AVX2": "avx2", "AVX": "avx", "SSE4_2": "sse4_2"}
"""Instruction sets of x86 as XLA names them, the largest first, and a flag of each."""

_ACL = "system.posix_acl_access"
_BY_OTHERS = "others can write there"


class Unsafe(PermissionError):
    """A folder that others could put something in, or something else in its stead."""

    def __init__(self, place: Path, why: str) -> None:
        super().__init__(errno.EPERM, why, str(place))


def cpu() -> dict[str, str]:
    """The first processor's entries in ``/proc/cpuinfo``; empty where there is none."""
    try:
        first = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0]
    except OSError:
        return {}
    entries = (line.partition(":") for line in first.splitlines())
    return {key.strip(): value.strip() for key, _, value in entries}


def instructions(limit: str = "") -> str:
    """The instruction set that programs are compiled to, as far as it decides a last bit.

    Args:
        limit: value of ``--xla_cpu_max_isa``, the largest set that XLA may use.

    Returns:
        ``AVX512``, ``AVX2``, ``AVX`` or ``SSE4_2``, as that option names them, ``SVE`` or ``NEON``;
        the kind of processor where the system does not tell. What comes after AVX-512 on x86 is
        for short integers and halves, and counts as AVX-512.
    """
    told = cpu()
    flags = (told.get("flags") or told.get("Features") or "").split()
    if "asimd" in flags:
        return "SVE" if "sve" in flags else "NEON"
    names = list(_SETS)
    here = [name for name in names if _SETS[name] in flags]
    allowed = names[names.index(limit.upper()) :] if limit.upper() in names else names
    unknown = f"{platform.machine()} to {allowed[0]}" if allowed != names else platform.machine()
    return next((name for name in here if name in allowed), unknown)


def memory_bytes() -> float:
    """Memory that this process can have at the most; infinite where nothing tells."""
    told = [math.inf]
    with suppress(ValueError, OSError, AttributeError):
        told.append(float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")))
    for limit in ("memory.max", "memory/memory.limit_in_bytes"):
        with suppress(ValueError, OSError):
            told.append(float(Path("/sys/fs/cgroup", limit).read_text(encoding="ascii")))
    return min(told)


def free_bytes(folder: Path) -> float:
    """Room on the disk that a folder is on, or would be; infinite where nothing tells."""
    for there in (folder.absolute(), *folder.absolute().parents):
        with suppress(OSError):
            return float(shutil.disk_usage(there).free)
    return math.inf


def temporary_folder() -> Path:
    """This user's folder below the system's temporary one; it need not be there."""
    user = os.getuid() if hasattr(os, "getuid") else "user"
    return Path(tempfile.gettempdir()) / f"sinsjax-{user}"


def cache_folder() -> Path:
    """This user's folder for what can be made again; it need not be there.

    Raises:
        OSError: the user has no home.
    """
    import platformdirs  # here, for most processes do without

    folder = platformdirs.user_cache_path("sinsjax", appauthor=False)
    if not folder.is_absolute():
        raise OSError(errno.ENOENT, "this user has no cache folder", str(folder))
    return folder


def private_folder(folder: Path) -> Path:
    """A folder that nobody else can write in or take away, made if it is not there.

    What is missing is made for this user alone (mode 0700). Every folder above has to belong to
    this user or to the superuser, and others may write in none, but in one that is sticky and the
    superuser's, such as ``/tmp``: there nobody renames what is somebody else's. Members of a group
    that this user is alone in are no others. Nothing is made below a folder that is not safe.

    Args:
        folder: where.

    Returns:
        The folder without symbolic links, which is the one to be used: links may be changed later.

    Raises:
        Unsafe: others could put something there. Of this error and the next, ``strerror`` says
            what is wrong and ``filename`` where.
        OSError: it cannot be made.
    """
    try:
        real = folder.resolve()
    except RuntimeError as error:  # Python 3.11 and 3.12: links in a circle
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(folder)) from error
    path = [*reversed(real.parents), real]
    there = [place for place in path if _is_there(place)]
    for place in there:
        _check(place, own=place == real)
    for place in path[len(there) :]:
        # Another process of this user may be as far; whoever else was quicker is found below.
        with suppress(FileExistsError):
            place.mkdir(mode=0o700)
        _check(place, own=place == real)
    return real


def _is_there(place: Path) -> bool:
    try:
        place.lstat()
    except FileNotFoundError:
        return False
    return True


def _check(place: Path, *, own: bool) -> None:
    """Refuses a place that others could put something in, or something else in its stead."""
    about = place.lstat()  # no link is followed: there was none, so it is new, and somebody's
    if not stat.S_ISDIR(about.st_mode):
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(place))
    if not hasattr(os, "geteuid"):  # Windows: a profile is its user's
        return
    this = os.geteuid()
    if about.st_uid not in ({this} if own else {this, 0}):
        raise Unsafe(place, "belongs to somebody else")
    sticky = about.st_uid == 0 and about.st_mode & stat.S_ISVTX and not own
    if sticky:
        return
    if about.st_mode & stat.S_IWOTH:
        raise Unsafe(place, _BY_OTHERS)
    if about.st_mode & stat.S_IWGRP and (_has_list(place) or not _is_alone(this, about.st_gid)):
        raise Unsafe(place, _BY_OTHERS)


def _has_list(place: Path) -> bool:
    """Whether an access control list names who may write; the group's bits are then its mask."""
    if not hasattr(os, "listxattr"):
        return False
    try:
        return _ACL in os.listxattr(place, follow_symlinks=False)
    except OSError:  # a file system without them
        return False


def _is_alone(user: int, group: int) -> bool:
    """Whether nobody else is in a group; not so where that cannot be told."""
    import grp
    import pwd

    try:
        name, about = pwd.getpwuid(user).pw_name, grp.getgrgid(group)
    except KeyError:
        return False
    accounts = pwd.getpwall()
    others = {entry.pw_name for entry in accounts if entry.pw_gid == group} | set(about.gr_mem)
    # A directory service need not list its accounts; a group of the user's name is the user's own.
    listed = any(entry.pw_name == name for entry in accounts)
    return others <= {name, "root"} and (listed or about.gr_name == name)
