"""Configuration of this process: devices, precision, compiler options, cache; its description."""

import functools
import hashlib
import importlib.metadata
import os
import platform
import warnings
from pathlib import Path
from typing import Any

from sinsjax.errors import InputError
from sinsjax.platform import machine

RESULT_PACKAGES = ("sinsjax", "jax", "jaxlib", "numpy", "scipy", "pyarrow")
"""Packages whose versions may change result rows or the bytes of their files."""

_configured = False


def configure(devices: int | None = None) -> None:
    """Set double precision, the number of CPU devices and the compiler options of this process.

    Every command calls it, and so does every function that computes if it was not called before,
    see `ensure_configured`. Devices and compiler options can be set only until JAX starts,
    which it does at its first computation. Programs that take long to compile are cached for later
    processes, see `enable_cache`.

    Args:
        devices: CPU devices, at least 1: the number of threads that run a program. None uses
            ``JAX_NUM_CPU_DEVICES`` if set, else one per usable core.

    Raises:
        InputError: `devices` is below 1, double precision is off in a block of ``jax.enable_x64``,
            or ``SINSJAX_COMPILE_CACHE`` names an unusable folder.

    Warns:
        ConfigurationWarning: if JAX has started with other devices or compiler options.

    Examples:
        >>> sinsjax.configure(devices=2)
        >>> sinsjax.info()["x64"]
        True
    """
    global _configured
    import jax

    if devices is not None and devices < 1:
        raise InputError(f"devices: must be at least 1, not {devices}")
    chosen = jax.config.values["jax_num_cpu_devices"] if devices is None else devices
    if machine.has_backend_started():
        _warn_if_jax_has_started_otherwise(devices)
    else:
        machine.apply_xla_options()
        jax.config.update("jax_num_cpu_devices", chosen if chosen >= 1 else usable_cores())
    _enable_x64()
    enable_cache()
    _configured = True


def ensure_configured() -> None:
    """Call `configure` unless it was called before; in any case turn double precision on."""
    if _configured:
        _enable_x64()
    else:
        configure()


def _enable_x64() -> None:
    """Turn double precision on: single precision loses the Earth's rotation within a sample."""
    import jax

    jax.config.update("jax_enable_x64", True)
    if not jax.config.jax_enable_x64:
        raise InputError("sinsjax needs double precision: call it outside jax.enable_x64(False)")


def _warn_if_jax_has_started_otherwise(devices: int | None) -> None:
    """Warn that JAX has started without the compiler options or the devices asked for."""
    import jax

    running = max(1, jax.config.values["jax_num_cpu_devices"])
    arguments = "" if devices is None else f"devices={devices}"
    if machine.missing_xla_options() and machine.xla_options_work():
        problem = "without sinsjax's compiler options (runs are several times slower)"
    elif devices not in (None, running):
        problem = f"with {running} CPU device(s) instead of {devices}"
    else:
        return
    text = (
        f"JAX has started already, {problem}: restart Python or the notebook's kernel and call"
        f" sinsjax.configure({arguments}) before JAX computes anything"
    )
    warnings.warn(text, machine.ConfigurationWarning, stacklevel=3)


def start_jax_on_chosen_platform() -> None:
    """Start JAX's backend, or raise an `InputError` if ``JAX_PLATFORMS`` is not available."""
    import jax

    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        reason = str(error).partition("\n")[0] or "no such device"
        text = f"JAX_PLATFORMS={os.environ.get('JAX_PLATFORMS', '')}: JAX does not start: {reason}"
        raise InputError(text) from error


def usable_cores() -> int:
    """Return the number of cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@functools.cache
def method_entry_points() -> tuple[importlib.metadata.EntryPoint, ...]:
    """Return the entry points of alignment methods in installed packages, none loaded."""
    found = importlib.metadata.entry_points(group="sinsjax.methods")
    return tuple(sorted(found, key=lambda point: point.name))


@functools.cache
def package_version() -> str:
    """Return the version of sinsjax; ``0+source`` if run from source without installation."""
    try:
        return importlib.metadata.version("sinsjax")
    except importlib.metadata.PackageNotFoundError:
        return "0+source"


def relevant_versions() -> dict[str, str]:
    """Return the versions of Python, of `RESULT_PACKAGES` and of packages with methods."""
    packages = {name: importlib.metadata.version(name) for name in RESULT_PACKAGES[1:]}
    bring = {point.dist.name: point.dist.version for point in method_entry_points() if point.dist}
    return {"sinsjax": package_version(), "python": platform.python_version(), **packages, **bring}


def describe_environment() -> dict[str, Any]:
    """Return the versions, machine and XLA options that may affect results, for a manifest."""
    cpu = machine.cpu_info()
    return {
        "versions": relevant_versions(),
        "platform": platform.platform(),
        "cpu": cpu.get("model name") or platform.processor() or platform.machine(),
        "instructions": machine.instruction_set(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def info() -> dict[str, Any]:
    """Return versions, devices and options of this process; configures it if necessary.

    Returns:
        All of `relevant_versions`; ``platform``, ``cpu``; ``instructions``: the set in use;
        ``xla_flags``: XLA's options; ``cores``, ``devices``, ``x64``; ``compile_cache``: the folder
        of compiled programs, or off and why.

    Examples:
        >>> sinsjax.info()["x64"]
        True
    """
    import jax

    ensure_configured()
    environment = describe_environment()
    return {
        **environment.pop("versions"),
        **environment,
        "cores": usable_cores(),
        "devices": [str(device) for device in jax.devices()],
        "x64": bool(jax.config.jax_enable_x64),
        "compile_cache": jax.config.values["jax_compilation_cache_dir"]
        or f"off ({reason_cache_is_off()})",
    }


CACHE_VARIABLE = "SINSJAX_COMPILE_CACHE"

CACHE_SAFE_JAXLIB = frozenset({"0.10.2"})
"""jaxlib versions tested against every known fault of the cache; on some processors 0.9.1 to 0.10.1
reject all their own entries, with a warning at every start."""

MAX_CACHE_BYTES = 2**28
"""Size limit of a folder, about a hundred programs; JAX removes the least recently used first."""

_MIN_COMPILE_S = 0.2
_CACHE_SIZE = (
    "JAX_COMPILATION_CACHE_MAX_SIZE"  # JAX's own variable takes precedence over `MAX_CACHE_BYTES`
)

_reason_cache_is_off = "sinsjax.configure() was not called"


def reason_cache_is_off() -> str:
    """Return the reason why the cache is off."""
    return _reason_cache_is_off


def enable_cache() -> Path | None:
    """Turn JAX's persistent compilation cache on, and return its private folder.

    It is on, in this user's cache folder, with a jaxlib in `CACHE_SAFE_JAXLIB`, unless the variable
    ``SINSJAX_COMPILE_CACHE`` is 0; 1 enables it with any jaxlib, and a path moves it there. None
    has a reason, see `reason_cache_is_off`. A program compiled for one CPU may be rejected or crash
    on another, and options change programs, so there is a subfolder for each jaxlib version,
    processor and value of ``XLA_FLAGS``. Whoever can write there can run code here, so it must be
    this user's alone. JAX limits its size. An entry without an access time was cut short by a full
    disk or a kill; it would stop all later writing and is removed here.

    Raises:
        InputError: the requested folder cannot be created, or others can write there.
    """
    global _reason_cache_is_off
    import jax  # here, to keep importing this module cheap

    setting = os.environ.get(CACHE_VARIABLE, "").strip()
    version = importlib.metadata.version("jaxlib")
    if setting == "0":
        _reason_cache_is_off = f"{CACHE_VARIABLE}=0"
    elif not setting and jax.config.values["jax_compilation_cache_dir"]:
        _reason_cache_is_off = "JAX already has a compilation cache"
    elif not setting and version not in CACHE_SAFE_JAXLIB:
        _reason_cache_is_off = (
            f"not tested with jaxlib {version}; {CACHE_VARIABLE}=1 enables it anyway"
        )
    else:
        try:
            return _use_cache_folder(Path(setting) if setting not in ("", "1") else None)
        except OSError as error:
            _reason_cache_is_off = f"{error.filename or setting}: {error.strerror or error}"
        if setting:
            raise InputError(f"{CACHE_VARIABLE}: {_reason_cache_is_off}")
    return None


def _use_cache_folder(root: Path | None) -> Path:
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
    if _CACHE_SIZE not in os.environ:
        jax.config.update("jax_compilation_cache_max_size", MAX_CACHE_BYTES)
        for entry in folder.glob("*-cache"):
            # JAX writes the file of the access time last.
            if not entry.with_name(f"{entry.name.removesuffix('-cache')}-atime").exists():
                entry.unlink(missing_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _MIN_COMPILE_S)
    return folder
