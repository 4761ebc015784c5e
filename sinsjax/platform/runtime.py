"""What this process computes with: virtual devices, precision, and what `info` tells of it.

XLA's options are those of `xla`: importing `sinsjax` sets some, `configure` the rest.
"""

import functools
import importlib.metadata
import os
import platform
from typing import Any

from sinsjax.errors import InputError
from sinsjax.platform import machine, xla

DECISIVE = ("sinsjax", "jax", "jaxlib", "numpy", "scipy", "pyarrow")
"""Packages whose versions decide rows, or the bytes of their files."""


def package_version() -> str:
    """The version of sinsjax as installed; ``0+source`` in a tree that is not installed."""
    try:
        return importlib.metadata.version("sinsjax")
    except importlib.metadata.PackageNotFoundError:
        return "0+source"


def configure(devices: int | None = None, x64: bool = True) -> None:
    """Set the number of CPU devices and the precision of JAX; call it before any computation.

    Importing sinsjax never does this, since both change the whole program, as do LLVM's options
    for loops over lanes (`xla.loop_options`), which are set here if JAX has not started. Programs
    that take long to compile are kept for the next process, see `compile_cache`.

    Args:
        devices: CPU devices, at least 1: how many threads run a program. None takes what
            ``JAX_NUM_CPU_DEVICES`` or ``--xla_force_host_platform_device_count`` says, else one for
            each usable core.
        x64: whether JAX computes in double precision. The engine's default needs it.

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
                f"JAX has started with {running} CPU device(s), too late to ask for {wanted}: "
                "call sinsjax.platform.runtime.configure before any JAX computation"
            )
    jax.config.update("jax_enable_x64", x64)
    compile_cache.enable()


def require_backend() -> None:
    """Start JAX's backend, or say why it does not start.

    Raises:
        InputError: the platform that ``JAX_PLATFORMS`` asks for is not there.
    """
    import jax

    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        asked = os.environ.get("JAX_PLATFORMS", "")
        why = str(error).partition("\n")[0] or "there is no such device"
        raise InputError(f"JAX_PLATFORMS={asked}: JAX does not start: {why}") from error


def require_x64() -> None:
    """Refuse to compute in single precision, which loses the Earth's turn within a sample.

    Raises:
        RuntimeError: if double precision is off.
    """
    import jax

    if not jax.config.values["jax_enable_x64"]:
        raise RuntimeError("double precision is off: call sinsjax.configure() first")


def usable_cores() -> int:
    """How many cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def versions() -> dict[str, str]:
    """The versions of Python and of the packages in `DECISIVE`."""
    packages = {name: _version(name) for name in DECISIVE if name != "sinsjax"}
    return {"sinsjax": package_version(), "python": platform.python_version(), **packages}


def session() -> dict[str, Any]:
    """What this process brings to results, for a manifest: versions, machine, XLA's options."""
    cpu = machine.cpu()
    return {
        "versions": versions(),
        "platform": platform.platform(),
        "cpu": cpu.get("model name") or platform.processor() or platform.machine(),
        "instructions": xla.instructions(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def facts() -> dict[str, Any]:
    """What this process computes with; starts JAX's backend and compiles a tiny loop.

    Returns:
        All of `versions`; ``platform``, ``cpu``; ``instructions``: the set in force; ``avx512``:
        whether it is that one, None where it cannot be told; ``cores``, ``devices``, ``x64``;
        ``compile_cache``: the folder of compiled programs, or off and why; ``options``: each XLA
        option with its value in ``XLA_FLAGS`` or None; ``opted_out``; ``jaxlib_tested``: whether
        this version is in `xla.TESTED_JAXLIB`; ``fused_loop``, ``multi_output_fusion``: what
        `sinsjax.platform.hlo.options_seen` finds.
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
    """`facts`, and what a small step becomes in a process of its own, which takes some seconds.

    Returns:
        All of `facts`; ``vectorised``: share of the step's arithmetic in vectorised loops, None
        where it cannot be told; ``forgone``: what is left out for want of `configure`, or None.
    """
    known = facts()
    refused = xla.refused_flags(_version("jaxlib"))
    loops = [option for option in xla.loop_options() if option.flag not in refused]
    missing = [option.name for option in loops if known["options"][option.name] is None]
    forgone = None
    if missing and not xla.opted_out():
        forgone = (
            f"{' and '.join(missing)}: call sinsjax.configure() before JAX starts (and name no file"
            " in XLA_FLAGS) for loops up to a quarter faster; they hold for the whole process"
        )
    return known | {"vectorised": xla.vectorised(), "forgone": forgone}


@functools.cache
def _version(package: str) -> str:
    return importlib.metadata.version(package)


def _default_devices() -> int:
    import jax

    chosen = int(jax.config.values["jax_num_cpu_devices"])
    if chosen >= 1:
        return chosen
    forced = xla.flag_values(os.environ.get("XLA_FLAGS", "")).get(
        "xla_force_host_platform_device_count", ""
    )
    return int(forced) if forced.isdigit() and int(forced) else usable_cores()
