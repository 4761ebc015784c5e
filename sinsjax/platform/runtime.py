"""Configuration of this process (devices, precision) and the facts that `info` reports.

For XLA's options see `xla`: importing `sinsjax` sets some of them, `configure` the rest.
"""

import functools
import importlib.metadata
import os
import platform
from typing import Any

from sinsjax.errors import InputError
from sinsjax.platform import machine, xla

DECISIVE = ("sinsjax", "jax", "jaxlib", "numpy", "scipy", "pyarrow")
"""Packages whose versions may change result rows or the bytes of their files."""


def package_version() -> str:
    """The installed version of sinsjax; ``0+source`` if run from source without installation."""
    try:
        return importlib.metadata.version("sinsjax")
    except importlib.metadata.PackageNotFoundError:
        return "0+source"


def configure(devices: int | None = None, x64: bool = True) -> None:
    """Set the number of CPU devices and the precision of JAX; call it before any computation.

    Importing sinsjax never does this, since both affect the whole process, as do LLVM's options
    for loops over lanes (`xla.loop_options`), which are set here unless JAX has started. Programs
    that take long to compile are cached for later processes, see `compile_cache`.

    Args:
        devices: CPU devices, at least 1: the number of threads that run a program. None takes
            ``JAX_NUM_CPU_DEVICES`` or ``--xla_force_host_platform_device_count`` if set, else one
            per usable core.
        x64: whether JAX computes in double precision, which the engine needs by default.

    Raises:
        ValueError: if `devices` is below 1.
        RuntimeError: if JAX has started with another number of CPU devices.
    """
    import jax

    from sinsjax.platform import compile_cache

    if devices is not None and devices < 1:
        raise ValueError(f"devices must be at least 1, not {devices}")
    wanted = devices if devices is not None else _default_devices()
    xla.apply_loop_options()
    if not xla.backend_started():
        jax.config.update("jax_num_cpu_devices", wanted)
    else:
        running = len(jax.local_devices(backend="cpu"))
        if running != wanted:
            raise RuntimeError(
                f"JAX has already started with {running} CPU device(s), not {wanted}: "
                "call sinsjax.platform.runtime.configure before any JAX computation"
            )
    jax.config.update("jax_enable_x64", x64)
    compile_cache.enable()


def require_backend() -> None:
    """Start JAX's backend.

    Raises:
        InputError: the platform requested by ``JAX_PLATFORMS`` is not available.
    """
    import jax

    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        platforms = os.environ.get("JAX_PLATFORMS", "")
        why = str(error).partition("\n")[0] or "no such device"
        raise InputError(f"JAX_PLATFORMS={platforms}: JAX does not start: {why}") from error


def require_x64() -> None:
    """Refuse to compute in single precision, which loses the Earth's rotation within a sample.

    Raises:
        RuntimeError: if double precision is off.
    """
    import jax

    if not jax.config.values["jax_enable_x64"]:
        raise RuntimeError("double precision is off: call sinsjax.configure() first")


def usable_cores() -> int:
    """Number of cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@functools.cache
def method_entry_points() -> tuple[importlib.metadata.EntryPoint, ...]:
    """Where other installed packages say that they bring alignment methods, none loaded."""
    found = importlib.metadata.entry_points(group="sinsjax.methods")
    return tuple(sorted(found, key=lambda point: point.name))


def versions() -> dict[str, str]:
    """The versions of Python, of the packages in `DECISIVE` and of those that bring methods."""
    packages = {name: _version(name) for name in DECISIVE if name != "sinsjax"}
    bring = {point.dist.name: point.dist.version for point in method_entry_points() if point.dist}
    return {"sinsjax": package_version(), "python": platform.python_version(), **packages, **bring}


def session() -> dict[str, Any]:
    """What may affect the results, for a manifest: versions, machine and XLA options."""
    cpu = machine.cpu()
    return {
        "versions": versions(),
        "platform": platform.platform(),
        "cpu": cpu.get("model name") or platform.processor() or platform.machine(),
        "instructions": xla.instructions(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def facts() -> dict[str, Any]:
    """Versions, devices and options of this process; starts JAX and compiles a tiny loop.

    Returns:
        All of `versions`; ``platform``, ``cpu``; ``instructions``: the instruction set in use;
        ``avx512``: whether that is AVX-512, None if unknown; ``cores``, ``devices``, ``x64``;
        ``compile_cache``: the folder of compiled programs, or off and why; ``options``: each XLA
        option with its value in ``XLA_FLAGS`` or None; ``opted_out``; ``jaxlib_tested``: whether
        this version is in `xla.TESTED_JAXLIB`; ``fused_loop``, ``multi_output_fusion``: see
        `sinsjax.platform.hlo.options_seen`.
    """
    import jax

    from sinsjax.platform import compile_cache
    from sinsjax.platform.hlo import options_seen

    present = xla.given()
    this, cpu = session(), machine.cpu()
    return {
        **this["versions"],
        "platform": this["platform"],
        "cpu": this["cpu"],
        "instructions": this["instructions"],
        "avx512": this["instructions"] == "AVX512" if "flags" in cpu else None,
        "cores": usable_cores(),
        "devices": [str(device) for device in jax.devices()],
        "x64": bool(jax.config.values["jax_enable_x64"]),
        "compile_cache": jax.config.values["jax_compilation_cache_dir"]
        or f"off ({compile_cache.why_off()})",
        "options": {option.name: present.get(option.name) for option in xla.wanted()},
        "opted_out": xla.opted_out(),
        "jaxlib_tested": _version("jaxlib") in xla.TESTED_JAXLIB,
        **options_seen(),
    }


def info() -> dict[str, Any]:
    """`facts`, and how well a small step vectorises in a separate process (some seconds).

    Returns:
        All of `facts`; ``vectorised``: share of the step's arithmetic in vectorised loops, None
        if unknown; ``forgone``: options missing because `configure` was not called, or None.
    """
    known = facts()
    refused = xla.refused_flags(_version("jaxlib"))
    loops = [option for option in xla.loop_options() if option.flag not in refused]
    missing = [option.name for option in loops if known["options"][option.name] is None]
    forgone = None
    if missing and not xla.opted_out():
        forgone = (
            f"{' and '.join(missing)}: call sinsjax.configure() before JAX starts (without a file"
            " in XLA_FLAGS) for loops up to a quarter faster; they affect the whole process"
        )
    return known | {"vectorised": xla.vectorised(), "forgone": forgone}


@functools.cache
def _version(package: str) -> str:
    return importlib.metadata.version(package)


def version_or_none(package: str) -> str | None:
    """The version of an installed package; None if it is not installed."""
    try:
        return _version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _default_devices() -> int:
    import jax

    chosen = int(jax.config.values["jax_num_cpu_devices"])
    if chosen >= 1:
        return chosen
    forced = xla.flag_values(os.environ.get("XLA_FLAGS", "")).get(
        "xla_force_host_platform_device_count", ""
    )
    return int(forced) if forced.isdigit() and int(forced) else usable_cores()
