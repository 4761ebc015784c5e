"""Compiled programs kept from one process to the next, for those who ask for it.

Off unless the environment variable ``SINSJAX_COMPILE_CACHE`` is set: to 1 for a folder in this
user's cache folder, or to a folder. A program compiled for one CPU may be refused or die on
another, so below that folder there is one for each jaxlib version and processor; and whoever can
write there can run code here, so it must be this user's alone, see `machine.private_folder`.
"""

import hashlib
import importlib.metadata
import os
from pathlib import Path

from sinsjax import machine
from sinsjax.types import InputError

VARIABLE = "SINSJAX_COMPILE_CACHE"

_WORTH_KEEPING_S = 0.2


def enable() -> Path | None:
    """Turn JAX's compilation cache on if the environment asks for it.

    Returns:
        The folder in use, or None.

    Raises:
        InputError: the folder cannot be made, or others can write there or replace it.
    """
    asked = os.environ.get(VARIABLE, "").strip()
    if asked in ("", "0"):
        return None
    import jax

    try:
        root = machine.cache_folder() / "compiled" if asked == "1" else Path(asked).expanduser()
        folder = machine.private_folder(root / _key())
    except RuntimeError:  # of expanduser
        raise InputError(f"{VARIABLE}: {asked}: there is no such user, or without a home") from None
    except OSError as error:
        run = ", and what the cache holds is run" if isinstance(error, machine.Unsafe) else ""
        where = error.filename or asked
        raise InputError(f"{VARIABLE}: {where}: {error.strerror}{run}") from None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING_S)
    return folder


def _key() -> str:
    """The jaxlib version, and a digest of the processor's model and abilities."""
    cpu = machine.cpu()
    what = "\n".join(cpu.get(key, "") for key in ("model name", "flags"))
    digest = hashlib.sha256(what.encode()).hexdigest()[:12]
    return f"jaxlib-{importlib.metadata.version('jaxlib')}-{digest}"
