"""What has to be set before XLA starts: its CPU options, virtual devices, and double precision.

By default XLA:CPU runs every small fusion of a scan body as a call of its own, which costs several
times the arithmetic of a 5-state filter. Three options together turn the whole loop into one
native function. XLA reads them from ``XLA_FLAGS`` once, when the backend starts, so `apply_options`
runs when `sinsjax` is imported. It adds these options and changes nothing else; virtual devices and
double precision are set by `configure`, on request only.

Set the environment variable ``SINSJAX_XLA_OPTIONS=0`` to leave ``XLA_FLAGS`` as it is.
"""

import contextlib
import functools
import importlib.metadata
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any, NamedTuple

from sinsjax import machine
from sinsjax.types import InputError

EXTRA_FLAG = "xla_backend_extra_options"
OPT_OUT = "SINSJAX_XLA_OPTIONS"


class Option(NamedTuple):
    """One XLA:CPU option.

    Attributes:
        name: its key.
        value: what it is set to.
        extra: whether it rides in ``--xla_backend_extra_options``. XLA ignores an unknown key
            there without a word, while an unknown plain flag ends the process.
    """

    name: str
    value: str
    extra: bool

    @property
    def flag(self) -> str:
        """The command-line flag that carries the option."""
        return EXTRA_FLAG if self.extra else self.name


OPTIONS = (
    Option("xla_cpu_prefer_vector_width", "512", extra=False),
    Option("xla_cpu_small_while_loop_byte_threshold", "1000000000", extra=True),
    Option("xla_cpu_use_multi_output_fusion", "true", extra=True),
)
"""The options, in one place."""

DECISIVE = ("sinsjax", "jax", "jaxlib", "numpy", "scipy", "pyarrow")
"""Packages whose versions decide rows, or the bytes of their files."""

TESTED_JAXLIB = frozenset({"0.10.0", "0.10.2", "0.11.2", "0.12.0.1"})
"""jaxlib versions on which all options were seen at work in a compiled loop."""

_FLAG = re.compile(r"--(\w+)=(\"[^\"]*\"|'[^']*'|\S*)")
_PROBE_TIMEOUT_S = 120.0


class OptionsWarning(UserWarning):
    """The XLA options could not be set: results are the same, loops run several times slower."""


def package_version() -> str:
    """The version of sinsjax as installed; ``0+source`` in a tree that is not installed."""
    try:
        return importlib.metadata.version("sinsjax")
    except importlib.metadata.PackageNotFoundError:
        return "0+source"


def opted_out() -> bool:
    """Whether ``SINSJAX_XLA_OPTIONS=0`` is set."""
    return os.environ.get(OPT_OUT, "").strip() == "0"


def flag_values(flags: str) -> dict[str, str]:
    """Every flag and extra option in a value of ``XLA_FLAGS``, by name; the last of a name wins."""
    values: dict[str, str] = {}
    for name, quoted in _FLAG.findall(flags):
        value = quoted.strip("\"'")
        if name == EXTRA_FLAG:
            values.update(item.partition("=")[::2] for item in value.split(",") if item)
        else:
            values[name] = value
    return values


def merge_options(flags: str, refused: frozenset[str] = frozenset()) -> str:
    """Extend a value of ``XLA_FLAGS`` by the options it does not name yet.

    Args:
        flags: the user's value. Every flag and extra option in it is kept as it stands.
        refused: flags that this jaxlib does not know.

    Returns:
        The new value. Extra options join an existing ``--xla_backend_extra_options``.
    """
    present = flag_values(flags)
    missing = [o for o in OPTIONS if o.name not in present and o.flag not in refused]
    plain = [f"--{o.name}={o.value}" for o in missing if not o.extra]
    extra = ",".join(f"{o.name}={o.value}" for o in missing if o.extra)
    existing = [m for m in _FLAG.finditer(flags) if m[1] == EXTRA_FLAG]
    if extra and existing:
        value = existing[-1][2]
        end = existing[-1].end() - (value[-1:] in {'"', "'"})
        comma = "," if value.strip("\"'") else ""
        flags = flags[:end] + comma + extra + flags[end:]
    elif extra:
        plain.append(f"--{EXTRA_FLAG}={extra}")
    return " ".join([flags.strip(), *plain]).strip()


def apply_options() -> None:
    """Add the XLA:CPU options to ``XLA_FLAGS``, extending what the user has set.

    Does nothing where the user opted out or has set every option. A jaxlib that is not in
    `TESTED_JAXLIB` is first tried in a separate process, once a version and user, because a flag
    it does not know would end this one.

    Warns:
        OptionsWarning: when it is too late (a JAX backend has started), when ``XLA_FLAGS`` names a
            file, or when jaxlib does not know a flag.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if opted_out() or all(option.name in flag_values(flags) for option in OPTIONS):
        return
    if flags.strip() and not flags.lstrip().startswith("-"):
        _warn(f"XLA_FLAGS names the file {flags.strip()}; put {merge_options('')} there")
    elif backend_started():
        _warn(f"JAX has started already; import sinsjax first or set XLA_FLAGS={merge_options('')}")
    else:
        refused = refused_flags(_version("jaxlib"))
        if refused:
            names = ", ".join(f"--{flag}" for flag in sorted(refused))
            _warn(f"jaxlib {_version('jaxlib')} does not take {names}")
        os.environ["XLA_FLAGS"] = merge_options(flags, refused)


def backend_started() -> bool:
    """Whether a JAX backend is up in this process, after which XLA reads no more options."""
    # JAX has no public way to ask without starting one.
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bridge is not None and bridge.backends_are_initialized()


def refused_flags(jaxlib: str) -> frozenset[str]:
    """The flags of `OPTIONS` that a jaxlib version does not know.

    Args:
        jaxlib: the version installed here. One that is not in `TESTED_JAXLIB` is tried in a
            separate process (about a second); the answer is kept in the user's cache folder.

    Returns:
        Names of flags; all of them where the trial gave no answer.
    """
    needed = frozenset(option.flag for option in OPTIONS)
    if jaxlib in TESTED_JAXLIB:
        return frozenset()
    known = _read_cache()
    if needed <= known.get(jaxlib, {}).keys():
        return frozenset(flag for flag in needed if not known[jaxlib][flag])
    refused = _probe()
    if refused is None:
        return needed
    _write_cache(known | {jaxlib: {flag: flag not in refused for flag in sorted(needed)}})
    return refused


def configure(devices: int | None = None, x64: bool = True) -> None:
    """Set the number of CPU devices and the precision of JAX; call it before any computation.

    Importing sinsjax never does this, since both change the whole program. With
    ``SINSJAX_COMPILE_CACHE`` in the environment compiled programs are kept, see `compile_cache`.

    Args:
        devices: virtual CPU devices, at least 1. None takes what ``JAX_NUM_CPU_DEVICES`` or
            ``--xla_force_host_platform_device_count`` says, else one for each usable core.
        x64: whether JAX computes in double precision. The engine's default needs it.

    Raises:
        ValueError: if `devices` is below 1.
        RuntimeError: if JAX has started with another number of CPU devices.
    """
    import jax

    from sinsjax import compile_cache

    if devices is not None and devices < 1:
        raise ValueError(f"devices must be at least 1, not {devices}")
    wanted = devices if devices is not None else _default_devices()
    if not backend_started():
        jax.config.update("jax_num_cpu_devices", wanted)
    else:
        running = len(jax.local_devices(backend="cpu"))
        if running != wanted:
            raise RuntimeError(
                f"JAX has started with {running} CPU device(s), too late to ask for {wanted}: "
                "call sinsjax.runtime.configure before any JAX computation"
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


def instructions() -> str:
    """The instruction set in force: this machine's, as far as ``XLA_FLAGS`` lets XLA use it."""
    flags = os.environ.get("XLA_FLAGS", "").strip()
    if flags and not flags.startswith("-"):  # the name of a file with the flags
        with contextlib.suppress(OSError, ValueError):
            flags = Path(flags).read_text(encoding="utf-8")
    return machine.instructions(flag_values(flags).get("xla_cpu_max_isa", ""))


def session() -> dict[str, Any]:
    """What this process brings to results, for a manifest: versions, machine, XLA's options."""
    cpu = machine.cpu()
    return {
        "versions": versions(),
        "platform": platform.platform(),
        "cpu": cpu.get("model name") or platform.processor() or platform.machine(),
        "instructions": instructions(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def info() -> dict[str, Any]:
    """What this process computes with; starts JAX's backend and compiles a tiny loop.

    Returns:
        All of `versions`; ``platform``, ``cpu``; ``instructions``: the set in force; ``avx512``:
        whether it is that one, None where it cannot be told; ``cores``, ``devices``, ``x64``;
        ``compile_cache``: the folder of compiled programs, or off; ``options``: each XLA option
        with its value in ``XLA_FLAGS`` or None; ``opted_out``; ``jaxlib_tested``: whether this
        version is in `TESTED_JAXLIB`; ``fused_loop``, ``multi_output_fusion``: what
        `sinsjax.hlo.options_seen` finds.
    """
    import jax

    from sinsjax.hlo import options_seen

    present = flag_values(os.environ.get("XLA_FLAGS", ""))
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
        "compile_cache": jax.config.values["jax_compilation_cache_dir"] or "off",
        "options": {option.name: present.get(option.name) for option in OPTIONS},
        "opted_out": opted_out(),
        "jaxlib_tested": _version("jaxlib") in TESTED_JAXLIB,
        **options_seen(),
    }


def _warn(what: str) -> None:
    warnings.warn(
        f"sinsjax's XLA options are not in force, loops run slower: {what} ({OPT_OUT}=0 silences "
        "this warning)",
        OptionsWarning,
        stacklevel=3,
    )


@functools.cache
def _version(package: str) -> str:
    return importlib.metadata.version(package)


def _default_devices() -> int:
    import jax

    chosen = int(jax.config.values["jax_num_cpu_devices"])
    if chosen >= 1:
        return chosen
    forced = flag_values(os.environ.get("XLA_FLAGS", "")).get(
        "xla_force_host_platform_device_count", ""
    )
    return int(forced) if forced.isdigit() and int(forced) else usable_cores()


def _probe() -> frozenset[str] | None:
    """The flags that this jaxlib refuses, found in a separate process; None without an answer."""
    refused: frozenset[str] = frozenset()
    while True:
        flags = merge_options("", refused)
        environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
        try:
            trial = subprocess.run(
                [sys.executable or "", "-c", "import jax; jax.devices()"],
                env=environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=_PROBE_TIMEOUT_S,
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        if trial.returncode == 0:
            return refused
        complaint = re.search(r"Unknown flags? in XLA_FLAGS:(.*)", trial.stderr)
        named = {name for name, _ in _FLAG.findall(complaint[1])} if complaint else set()
        if named <= refused:
            return None
        refused |= named


def _cache_file() -> Path:
    return machine.cache_folder() / "xla_options.json"


def _read_cache() -> dict[str, dict[str, bool]]:
    try:
        known = json.loads(_cache_file().read_text(encoding="utf-8"))
        return {str(version): dict(flags) for version, flags in known.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _write_cache(known: dict[str, dict[str, bool]]) -> None:
    # A cache that cannot be written costs a second at the next import, no more.
    with contextlib.suppress(OSError):
        path = _cache_file()
        machine.private_folder(path.parent)
        with tempfile.NamedTemporaryFile(
            "w", dir=path.parent, suffix=".tmp", delete=False, encoding="utf-8"
        ) as file:
            json.dump(known, file, indent=1)
        os.replace(file.name, path)
