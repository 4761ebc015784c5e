"""Configuration of this process: devices, precision, compiler options; and its description."""

import functools
import importlib.metadata
import os
import platform
import warnings
from typing import Any

from sinsjax.errors import InputError
from sinsjax.platform import machine, xla

RESULT_PACKAGES = ("sinsjax", "jax", "jaxlib", "numpy", "scipy", "pyarrow")
"""Packages whose versions may change result rows or the bytes of their files."""

_configured = False


def configure(devices: int | None = None) -> None:
    """Set double precision, the number of CPU devices and the compiler options of this process.

    Every command calls it, and so does every function that computes if it was not called before,
    see `ensure_configured`. Devices and compiler options (`xla`) can be set only until JAX starts,
    which it does at its first computation. Programs that take long to compile are cached for later
    processes, see `compile_cache`.

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

    from sinsjax.platform import compile_cache

    if devices is not None and devices < 1:
        raise InputError(f"devices: must be at least 1, not {devices}")
    chosen = jax.config.values["jax_num_cpu_devices"] if devices is None else devices
    if xla.has_backend_started():
        _warn_if_late(devices)
    else:
        xla.apply_options()
        jax.config.update("jax_num_cpu_devices", chosen if chosen >= 1 else usable_cores())
    _enable_x64()
    compile_cache.enable_cache()
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


def _warn_if_late(devices: int | None) -> None:
    """Warn that JAX has started without the compiler options or the devices asked for."""
    import jax

    running = max(1, jax.config.values["jax_num_cpu_devices"])
    arguments = "" if devices is None else f"devices={devices}"
    if xla.missing_options() and xla.options_work():
        problem = "without sinsjax's compiler options (runs are several times slower)"
    elif devices not in (None, running):
        problem = f"with {running} CPU device(s) instead of {devices}"
    else:
        return
    text = (
        f"JAX has started already, {problem}: restart Python or the notebook's kernel and call"
        f" sinsjax.configure({arguments}) before JAX computes anything"
    )
    warnings.warn(text, xla.ConfigurationWarning, stacklevel=3)


def start_backend() -> None:
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
        "instructions": xla.instruction_set(),
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

    from sinsjax.platform import compile_cache

    ensure_configured()
    environment = describe_environment()
    return {
        **environment.pop("versions"),
        **environment,
        "cores": usable_cores(),
        "devices": [str(device) for device in jax.devices()],
        "x64": bool(jax.config.jax_enable_x64),
        "compile_cache": jax.config.values["jax_compilation_cache_dir"]
        or f"off ({compile_cache.reason_off()})",
    }
