"""This machine, its processor, memory and folders, and XLA's options for a loop over samples.

The options compile that loop to one vectorised native function. By default XLA:CPU calls every
small fusion of a scan body as a separate function, at several times the cost of a 5-state filter's
arithmetic, and LLVM leaves the largest of these loops scalar, as it would need more runtime overlap
checks than its default limit. XLA reads its options from ``XLA_FLAGS`` once, when JAX starts, so
`runtime.configure` calls `apply_xla_options` before that. The options affect every program of the
process. Set the environment variable ``SINSJAX_XLA_OPTIONS=0`` to leave ``XLA_FLAGS`` unchanged.
"""

import errno
import functools
import hashlib
import importlib.metadata
import math
import os
import platform
import re
import shutil
import stat
import subprocess
import sys
import warnings
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


def instruction_set(max_isa: str | None = None) -> str:
    """Return the instruction set that programs are compiled for, if it can change a last bit.

    Args:
        max_isa: the largest set that XLA may use, "" for no limit; None for that of ``XLA_FLAGS``.

    Returns:
        ``AVX512``, ``AVX2``, ``AVX`` or ``SSE4_2``, as in that option, ``SVE`` or ``NEON``; the
        machine type if the system lists no flags. Later x86 extensions are for short integers
        and half precision and count as AVX-512.
    """
    if max_isa is None:
        present = parse_xla_flags(os.environ.get("XLA_FLAGS", ""))
        max_isa = present.get("xla_cpu_max_isa", "")
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


EXTRA_FLAG = "xla_backend_extra_options"
"""The flag whose value has further options. XLA ignores an unknown key there, whereas an unknown
plain flag ends the process when JAX starts, and one of LLVM (``--``) at the first compilation."""

OPT_OUT = "SINSJAX_XLA_OPTIONS"

TESTED_JAXLIB = frozenset({"0.10.0", "0.10.2"})
"""jaxlib versions on which all options were seen to take effect in a compiled loop."""

_PLAIN = {
    "xla_cpu_prefer_vector_width": "512",
    "xla_cpu_copy_insertion_use_region_analysis": "true",
}
_EXTRA = {
    "xla_cpu_small_while_loop_byte_threshold": "1000000000",
    "xla_cpu_use_multi_output_fusion": "true",
    "--vectorize-memory-check-threshold": "100000",
}
_WIDTHS = {"AVX512": "8", "AVX2": "4", "AVX": "4", "SSE4_2": "4"}

_TRIAL = "import jax\njax.config.update('jax_enable_x64', True)\njax.jit(lambda x: x + 1.0)(1.0)\n"
_TRIAL_S = 120.0


class ConfigurationWarning(UserWarning):
    """JAX could not be set up as intended: runs can be slower, results differ by rounding."""


def parse_xla_flags(flags: str) -> dict[str, str]:
    """Return the flags and extra options in a value of ``XLA_FLAGS`` by name; the last one wins."""
    words = re.sub(rf"""--{EXTRA_FLAG}=|[,"']""", " ", flags).split()
    pairs = (re.sub("^--xla_", "xla_", word).partition("=") for word in words)
    return {name: value for name, _, value in pairs}


def required_xla_options() -> dict[str, str]:
    """Return the options for the instruction set in use, by name.

    On x86 they include LLVM's options for loops over lanes in double precision: wider vectors than
    LLVM would choose, one per iteration.
    """
    options = _PLAIN | _EXTRA
    if width := _WIDTHS.get(instruction_set()):
        options |= {"--force-vector-width": width, "--force-vector-interleave": "1"}
    return options


def missing_xla_options() -> dict[str, str]:
    """Return the options that ``XLA_FLAGS`` does not set; none with ``SINSJAX_XLA_OPTIONS=0``."""
    if os.environ.get(OPT_OUT, "").strip() == "0":
        return {}
    present = parse_xla_flags(os.environ.get("XLA_FLAGS", ""))
    return {name: value for name, value in required_xla_options().items() if name not in present}


def merge_xla_options(flags: str, options: dict[str, str]) -> str:
    """Return a value of ``XLA_FLAGS`` with further options; XLA collects the extra ones."""
    words = {name: f"{name}={value}" for name, value in options.items()}
    plain = [f"--{word}" for name, word in words.items() if name in _PLAIN]
    extra = ",".join(word for name, word in words.items() if name not in _PLAIN)
    return " ".join([flags, *plain, *([f"--{EXTRA_FLAG}={extra}"] if extra else [])]).strip()


def apply_xla_options() -> None:
    """Add the missing options to ``XLA_FLAGS``; has an effect only before JAX starts.

    Warns:
        ConfigurationWarning: ``XLA_FLAGS`` names a file, or this jaxlib refuses the options.
    """
    flags, missing, problem = os.environ.get("XLA_FLAGS", "").strip(), missing_xla_options(), ""
    if not missing:
        return
    if flags and not flags.startswith("-"):
        problem = f"XLA_FLAGS names the file {flags}; add {merge_xla_options('', missing)}"
    elif not xla_options_work():
        problem = f"jaxlib {importlib.metadata.version('jaxlib')} refuses them"
    else:
        os.environ["XLA_FLAGS"] = merge_xla_options(flags, missing)
    if problem:
        warnings.warn(
            "sinsjax's XLA options are not all in effect, runs may be several times slower:"
            f" {problem} ({OPT_OUT}=0 silences this warning)",
            ConfigurationWarning,
            stacklevel=3,
        )


def has_backend_started() -> bool:
    """Return whether a JAX backend has started, after which XLA reads no more options."""
    # JAX has no public function for this that does not start it.
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bridge is not None and bridge.backends_are_initialized()


@functools.cache
def xla_options_work() -> bool:
    """Return whether this jaxlib knows all options; an unknown one would end this process.

    A version not in `TESTED_JAXLIB` is tried in a separate process, until one trial succeeds, which
    a file in the user's cache folder marks.
    """
    version = importlib.metadata.version("jaxlib")
    flags = merge_xla_options("", required_xla_options())
    if version in TESTED_JAXLIB:
        return True
    with suppress(OSError):
        folder = ensure_private_folder(user_cache_folder())
        digest = hashlib.sha256(f"{version} {flags}".encode()).hexdigest()[:16]
        mark = folder / f"xla-options-{digest}"
        if mark.exists() or _can_compile(flags):
            mark.touch()
            return True
    return False


def _can_compile(flags: str) -> bool:
    """Return whether a separate process compiles a small program with a value of ``XLA_FLAGS``."""
    settings = {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "false"}
    # -P keeps modules of the working directory off the path.
    command = [sys.executable or "", "-P", "-c", _TRIAL]
    environment, null = os.environ | settings | {"XLA_FLAGS": flags}, subprocess.DEVNULL
    try:
        process = subprocess.run(
            command, env=environment, stdin=null, capture_output=True, timeout=_TRIAL_S
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return process.returncode == 0
