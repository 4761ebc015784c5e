"""Compiled programs kept from one process to the next: by JAX, in a folder watched over here.

Kept in this user's cache folder with a jaxlib of `SAFE_JAXLIB`, unless the environment variable
``SINSJAX_COMPILE_CACHE`` is 0; 1 asks for it with any jaxlib, and a folder moves it there. A
program compiled for one CPU may be refused or die on another, and other options make other
programs, so below that folder there is one for each jaxlib version, processor and value of
``XLA_FLAGS``. Whoever can write there can run code here, so it must be this user's alone, see
`machine.private_folder`.

JAX takes an entry as it finds it, and keeps one that it cannot read: cut short by a full disk or a
kill, it is in the way for ever, and an entry without its time of access ends all writing. So an
entry is vouched for, by its digest, once it is whole, and those that nobody vouches for are removed
before JAX looks.
"""

import hashlib
import importlib.metadata
import json
import os
import shutil
import sys
import warnings
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from sinsjax.errors import InputError
from sinsjax.platform import machine
from sinsjax.platform.files import replacing

VARIABLE = "SINSJAX_COMPILE_CACHE"

SAFE_JAXLIB = frozenset({"0.10.2"})
"""jaxlib versions with which every fault known of the cache was tried; 0.9.1 to 0.10.1 refuse all
that they kept on some processors, and say so at every start."""

MOST_BYTES = 2**28
"""Size that a folder is kept to, some hundred programs; the least recently used go first."""

MOST_FOLDERS = 8
"""Folders of other versions, processors and options that are left beside the one in use."""

_WORTH_KEEPING_S = 0.2
_PATIENCE_S = 5.0  # for another process, which holds the lock for milliseconds
_SUMS = "sums.json"
_ENTRY, _USED = "-cache", "-atime"  # what JAX's names of a program and of its last use end in

_COMPILED = "/jax/core/compile/backend_compile_duration"
_ZSTANDARD = b"\x28\xb5\x2f\xfd"

_why_off = "not asked for: configure() was not called"


def why_off() -> str:
    """Why nothing is kept, if it is not."""
    return _why_off


def enable() -> Path | None:
    """Turn JAX's compilation cache on, unless the environment or something unsafe is against it.

    Returns:
        The folder in use, or None; `why_off` then tells why.

    Raises:
        InputError: the folder asked for cannot be made, or others can write there or replace it.
    """
    global _why_off
    import filelock  # here, as JAX, for those who want neither
    import jax

    asked = os.environ.get(VARIABLE, "").strip()
    version = importlib.metadata.version("jaxlib")
    if asked == "0":
        _why_off = f"{VARIABLE}=0"
    elif not asked and jax.config.values["jax_compilation_cache_dir"]:
        _why_off = "JAX keeps programs already"
    elif not asked and version not in SAFE_JAXLIB:
        _why_off = f"not tried with jaxlib {version}; {VARIABLE}=1 asks for it all the same"
    else:
        try:
            return _keep_in(_folder(asked))
        except InputError as error:  # a full disk
            _why_off = str(error)
            return None
        except filelock.Timeout:
            _why_off = f"another process keeps the lock of {_folder(asked)}"
            return None
        except OSError as error:
            run = ", and what the cache holds is run" if isinstance(error, machine.Unsafe) else ""
            _why_off = f"{error.filename or asked}: {error.strerror or error}{run}"
        except RuntimeError:  # of expanduser
            _why_off = f"{asked}: there is no such user, or without a home"
        if asked:
            raise InputError(f"{VARIABLE}: {_why_off}")
    return None


def _folder(asked: str) -> Path:
    """The folder for this jaxlib, processor and these options, made if it is not there."""
    by_name = asked not in ("", "1")
    root = Path(asked).expanduser() if by_name else machine.cache_folder() / "compiled"
    return machine.private_folder(root / _key())


def _key() -> str:
    """The jaxlib version, and a digest of the processor's model and abilities and the options."""
    cpu = machine.cpu()
    what = [cpu.get(key, "") for key in ("model name", "flags")] + [os.environ.get("XLA_FLAGS", "")]
    digest = hashlib.sha256("\n".join(what).encode()).hexdigest()[:12]
    return f"jaxlib-{importlib.metadata.version('jaxlib')}-{digest}"


def _keep_in(folder: Path) -> Path:
    import jax

    with _locked(folder):
        _remove_unvouched(folder)
    os.utime(folder)
    _remove_old(folder)
    warnings.filterwarnings("ignore", r"Error (reading|writing) persistent compilation cache entry")
    jax.config.update("jax_compilation_cache_max_size", MOST_BYTES)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING_S)

    _watch(folder)
    return folder


@cache
def _watch(folder: Path) -> None:
    """Vouches for what this process compiles, as soon as JAX has written it."""
    import jax.monitoring

    def compiled(event: str, seconds: float, **about: Any) -> None:
        if event == _COMPILED and seconds >= _WORTH_KEEPING_S:
            with suppress(OSError, InputError):  # it will be compiled again
                vouch(folder)

    jax.monitoring.register_event_duration_secs_listener(compiled)


def vouch(folder: Path) -> None:
    """Note the digests of entries that are whole, so that later processes take them.

    Raises:
        OSError: the folder cannot be read, or another process keeps the lock.
        InputError: it cannot be written.
    """
    with _locked(folder):
        known = _sums(folder)
        new = [entry for entry in _entries(folder) if entry.name not in known]
        if sums := {entry.name: _digest(entry) for entry in new if _is_whole(entry)}:
            _note(folder, known | sums)


def _remove_unvouched(folder: Path) -> None:
    sums = _sums(folder)
    for entry in _entries(folder):
        if not _used(entry).is_file() or _digest(entry) != sums.get(entry.name):
            entry.unlink(missing_ok=True)
            _used(entry).unlink(missing_ok=True)
    there = {entry.name for entry in _entries(folder)}
    if gone := sums.keys() - there:  # by JAX too, which makes room
        _note(folder, {name: told for name, told in sums.items() if name not in gone})


def _remove_old(folder: Path) -> None:
    """Removes folders of other versions, processors and options, the longest unused first."""
    with suppress(OSError):
        others = [other for other in folder.parent.glob("jaxlib-*") if other != folder]
        for other in sorted(others, key=lambda other: other.stat().st_mtime)[:-MOST_FOLDERS]:
            shutil.rmtree(other, ignore_errors=True)


def _locked(folder: Path) -> Any:
    """The lock that JAX takes to read and write entries."""
    import filelock

    return filelock.FileLock(folder / ".lockfile", timeout=_PATIENCE_S)


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.glob(f"*{_ENTRY}"))


def _used(entry: Path) -> Path:
    return entry.with_name(entry.name.removesuffix(_ENTRY) + _USED)


def _sums(folder: Path) -> dict[str, str]:
    try:
        told = json.loads((folder / _SUMS).read_bytes())
    except (OSError, ValueError):
        return {}
    return told if isinstance(told, dict) else {}


def _note(folder: Path, sums: dict[str, str]) -> None:
    with replacing(folder / _SUMS) as file:
        file.write(json.dumps(sums).encode())


def _digest(entry: Path) -> str:
    return hashlib.sha256(entry.read_bytes()).hexdigest()


def _is_whole(entry: Path) -> bool:
    """Whether an entry can be unpacked, as JAX does it: one cut short when written cannot."""
    packed = entry.read_bytes()
    try:
        _unpacker(packed)(packed)
    except Exception:  # whatever the library has for it
        return False
    return True


def _unpacker(packed: bytes) -> Callable[[bytes], bytes]:
    """Of the library that JAX packed an entry with, where it found the quicker one or not."""
    if not packed.startswith(_ZSTANDARD):
        return zlib.decompress
    if sys.version_info >= (3, 14):
        return import_module("compression.zstd").decompress
    return import_module("zstandard").ZstdDecompressor().decompress
