"""JAX's persistent compilation cache, in a private folder.

It is on, in this user's cache folder, with a jaxlib in `SAFE_JAXLIB`, unless the environment
variable ``SINSJAX_COMPILE_CACHE`` is 0; 1 enables it with any jaxlib, and a path moves it there.
A program compiled for one CPU may be rejected or crash on another, and options change programs, so
there is a subfolder for each jaxlib version, processor and value of ``XLA_FLAGS``. Whoever can
write there can run code here, so it must be this user's alone, see `machine.ensure_private_folder`.

JAX limits its size. An entry without an access time was cut short by a full disk or a kill; it
would stop all later writing and is removed here.
"""

import hashlib
import importlib.metadata
import os
import warnings
from pathlib import Path

from sinsjax.errors import InputError
from sinsjax.platform import machine

VARIABLE = "SINSJAX_COMPILE_CACHE"

SAFE_JAXLIB = frozenset({"0.10.2"})
"""jaxlib versions tested against every known fault of the cache; on some processors 0.9.1 to 0.10.1
reject all their own entries, with a warning at every start."""

MAX_BYTES = 2**28
"""Size limit of a folder, about a hundred programs; JAX removes the least recently used first."""

_MIN_COMPILE_S = 0.2
_SIZE = "JAX_COMPILATION_CACHE_MAX_SIZE"  # JAX's own variable takes precedence over `MAX_BYTES`

_reason_off = "sinsjax.configure() was not called"


def reason_off() -> str:
    """Return the reason why the cache is off."""
    return _reason_off


def enable_cache() -> Path | None:
    """Turn JAX's compilation cache on, and return its folder; None for a reason, see `reason_off`.

    Raises:
        InputError: the requested folder cannot be created, or others can write there.
    """
    global _reason_off
    import jax  # here, to keep importing this module cheap

    setting = os.environ.get(VARIABLE, "").strip()
    version = importlib.metadata.version("jaxlib")
    if setting == "0":
        _reason_off = f"{VARIABLE}=0"
    elif not setting and jax.config.values["jax_compilation_cache_dir"]:
        _reason_off = "JAX already has a compilation cache"
    elif not setting and version not in SAFE_JAXLIB:
        _reason_off = f"not tested with jaxlib {version}; {VARIABLE}=1 enables it anyway"
    else:
        try:
            return _use_folder(Path(setting) if setting not in ("", "1") else None)
        except OSError as error:
            _reason_off = f"{error.filename or setting}: {error.strerror or error}"
        if setting:
            raise InputError(f"{VARIABLE}: {_reason_off}")
    return None


def _use_folder(root: Path | None) -> Path:
    """Use the folder for this jaxlib, processor and options, created if missing."""
    import jax

    root = root or machine.user_cache_folder() / "compiled"
    cpu, version = machine.cpu_info(), importlib.metadata.version("jaxlib")
    parts = [cpu.get(key, "") for key in ("model name", "flags")]
    parts.append(os.environ.get("XLA_FLAGS", ""))
    digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]
    folder = machine.ensure_private_folder(root / f"jaxlib-{version}-{digest}")
    # At worst a program is compiled again.
    warnings.filterwarnings("ignore", "Error writing persistent compilation cache entry")
    if _SIZE not in os.environ:
        jax.config.update("jax_compilation_cache_max_size", MAX_BYTES)
        for entry in folder.glob("*-cache"):
            # JAX writes the file of the access time last.
            if not entry.with_name(f"{entry.name.removesuffix('-cache')}-atime").exists():
                entry.unlink(missing_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _MIN_COMPILE_S)
    return folder
