"""JAX's persistent compilation cache, in a folder whose entries are verified here.

It is on, in this user's cache folder, with a jaxlib in `SAFE_JAXLIB`, unless the environment
variable ``SINSJAX_COMPILE_CACHE`` is 0; 1 enables it with any jaxlib, and a path moves it there.
A program compiled for one CPU may be rejected or crash on another, and options change programs, so
there is a subfolder for each jaxlib version, processor and value of ``XLA_FLAGS``. Anyone who can
write there can run code here, so the folder must be this user's alone, see
`machine.private_folder`.

JAX uses entries unverified and never replaces one that it cannot read: an entry truncated by a full
disk or a kill stays for good, and one without its access time file stops all writing. So the digest
of each complete entry is recorded, and entries without a matching digest are removed before JAX
reads the folder.
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
"""jaxlib versions tested against every known fault of the cache; on some processors 0.9.1 to 0.10.1
reject all their own entries, with a warning at every start."""

MOST_BYTES = 2**28
"""Size limit of a folder, about a hundred programs; the least recently used are removed first."""

MOST_FOLDERS = 8
"""Folders of other versions, processors and options that are kept beside the one in use."""

_WORTH_KEEPING_S = 0.2
_PATIENCE_S = 5.0  # other processes hold the lock for milliseconds
_DIGESTS = "sums.json"
_ENTRY, _USED = "-cache", "-atime"  # suffixes of JAX's files of a program and of its access time

_COMPILED = "/jax/core/compile/backend_compile_duration"
_ZSTANDARD = b"\x28\xb5\x2f\xfd"

_why_off = "sinsjax.configure() was not called"


def why_off() -> str:
    """Why the cache is off, if it is."""
    return _why_off


def enable() -> Path | None:
    """Turn JAX's compilation cache on, unless the environment forbids it or it would be unsafe.

    Returns:
        The folder in use, or None; `why_off` then gives the reason.

    Raises:
        InputError: the requested folder cannot be created, or others can write to or replace it.
    """
    global _why_off
    import filelock  # here, like JAX, to keep importing this module cheap
    import jax

    setting = os.environ.get(VARIABLE, "").strip()
    version = importlib.metadata.version("jaxlib")
    if setting == "0":
        _why_off = f"{VARIABLE}=0"
    elif not setting and jax.config.values["jax_compilation_cache_dir"]:
        _why_off = "JAX already has a compilation cache"
    elif not setting and version not in SAFE_JAXLIB:
        _why_off = f"not tested with jaxlib {version}; {VARIABLE}=1 enables it anyway"
    else:
        try:
            return _keep_in(_folder(setting))
        except InputError as error:  # a full disk
            _why_off = str(error)
            return None
        except filelock.Timeout:
            _why_off = f"another process holds the lock of {_folder(setting)}"
            return None
        except OSError as error:
            run = ", and cached programs are executed" if isinstance(error, machine.Unsafe) else ""
            _why_off = f"{error.filename or setting}: {error.strerror or error}{run}"
        except RuntimeError:  # from expanduser
            _why_off = f"{setting}: no such user, or a user without a home directory"
        if setting:
            raise InputError(f"{VARIABLE}: {_why_off}")
    return None


def _folder(setting: str) -> Path:
    """The folder for this jaxlib, processor and options, created if missing."""
    by_name = setting not in ("", "1")
    root = Path(setting).expanduser() if by_name else machine.cache_folder() / "compiled"
    return machine.private_folder(root / _key())


def _key() -> str:
    """The jaxlib version, and a digest of the processor's model and features and the options."""
    cpu = machine.cpu()
    what = [cpu.get(key, "") for key in ("model name", "flags")] + [os.environ.get("XLA_FLAGS", "")]
    digest = hashlib.sha256("\n".join(what).encode()).hexdigest()[:12]
    return f"jaxlib-{importlib.metadata.version('jaxlib')}-{digest}"


def _keep_in(folder: Path) -> Path:
    import jax

    with _locked(folder):
        _remove_unverified(folder)
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
    """Record the digest of each program this process compiles, as soon as JAX has written it."""
    import jax.monitoring

    def compiled(event: str, seconds: float, **about: Any) -> None:
        if event == _COMPILED and seconds >= _WORTH_KEEPING_S:
            with suppress(OSError, InputError):  # at worst the program is compiled again
                record_digests(folder)

    jax.monitoring.register_event_duration_secs_listener(compiled)


def record_digests(folder: Path) -> None:
    """Record the digests of new complete entries, so that later processes keep them.

    Raises:
        OSError: the folder cannot be read, or another process holds the lock.
        InputError: it cannot be written.
    """
    with _locked(folder):
        known = _digests(folder)
        new = [entry for entry in _entries(folder) if entry.name not in known]
        if digests := {entry.name: _digest(entry) for entry in new if _is_complete(entry)}:
            _write_digests(folder, known | digests)


def _remove_unverified(folder: Path) -> None:
    digests = _digests(folder)
    for entry in _entries(folder):
        if not _used(entry).is_file() or _digest(entry) != digests.get(entry.name):
            entry.unlink(missing_ok=True)
            _used(entry).unlink(missing_ok=True)
    present = {entry.name for entry in _entries(folder)}
    if digests.keys() - present:  # JAX evicts entries too
        _write_digests(folder, {name: d for name, d in digests.items() if name in present})


def _remove_old(folder: Path) -> None:
    """Remove folders of other versions, processors and options, the longest unused first."""
    with suppress(OSError):
        others = [other for other in folder.parent.glob("jaxlib-*") if other != folder]
        for other in sorted(others, key=lambda other: other.stat().st_mtime)[:-MOST_FOLDERS]:
            shutil.rmtree(other, ignore_errors=True)


def _locked(folder: Path) -> Any:
    """The lock that JAX holds to read and write entries."""
    import filelock

    return filelock.FileLock(folder / ".lockfile", timeout=_PATIENCE_S)


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.glob(f"*{_ENTRY}"))


def _used(entry: Path) -> Path:
    return entry.with_name(entry.name.removesuffix(_ENTRY) + _USED)


def _digests(folder: Path) -> dict[str, str]:
    try:
        stored = json.loads((folder / _DIGESTS).read_bytes())
    except (OSError, ValueError):
        return {}
    return stored if isinstance(stored, dict) else {}


def _write_digests(folder: Path, digests: dict[str, str]) -> None:
    with replacing(folder / _DIGESTS) as file:
        file.write(json.dumps(digests).encode())


def _digest(entry: Path) -> str:
    return hashlib.sha256(entry.read_bytes()).hexdigest()


def _is_complete(entry: Path) -> bool:
    """Whether an entry can be decompressed, as JAX will do; a truncated one cannot."""
    packed = entry.read_bytes()
    try:
        _decompressor(packed)(packed)
    except Exception:  # whatever the library raises
        return False
    return True


def _decompressor(packed: bytes) -> Callable[[bytes], bytes]:
    """The counterpart of the compression that JAX used: Zstandard if installed, else zlib."""
    if not packed.startswith(_ZSTANDARD):
        return zlib.decompress
    if sys.version_info >= (3, 14):
        return import_module("compression.zstd").decompress
    return import_module("zstandard").ZstdDecompressor().decompress
