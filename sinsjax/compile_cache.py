"""Compiled programs kept from one process to the next, for those who ask for it.

Off unless the environment variable ``SINSJAX_COMPILE_CACHE`` is set: to 1 for a folder of this
user and machine below the system's temporary one, or to a folder. A program compiled for one CPU
may be refused or die on another, so below that folder there is one for each jaxlib version and
processor; and whoever can write there can run code here, so it must belong to this user alone.
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
        InputError: the folder cannot be made, or others can write to it.
    """
    asked = os.environ.get(VARIABLE, "").strip()
    if asked in ("", "0"):
        return None
    import jax

    folder = (machine.temporary_folder() if asked == "1" else Path(asked).expanduser()) / _key()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        private = machine.is_private(folder)
    except OSError as error:
        raise InputError(f"{VARIABLE}: {folder}: {error.strerror}") from None
    if not private:
        raise InputError(f"{VARIABLE}: {folder}: others can write there, and what it holds is run")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING_S)
    return folder


def _key() -> str:
    """The jaxlib version, and a digest of the processor's model and abilities."""
    cpu = machine.cpu()
    what = "\n".join(cpu.get(key, "") for key in ("model name", "flags"))
    digest = hashlib.sha256(what.encode()).hexdigest()[:12]
    return f"jaxlib-{importlib.metadata.version('jaxlib')}-{digest}"
