"""XLA:CPU options that compile the loop over samples to one vectorised native function.

By default XLA:CPU calls every small fusion of a scan body as a separate function, at several times
the cost of a 5-state filter's arithmetic, and LLVM leaves the largest of these loops scalar, as it
would need more runtime overlap checks than its default limit. XLA reads its options from
``XLA_FLAGS`` once, when JAX starts, so `runtime.configure` calls `apply_options` before that. The
options affect every program of the process.

Set the environment variable ``SINSJAX_XLA_OPTIONS=0`` to leave ``XLA_FLAGS`` unchanged.
"""

import contextlib
import functools
import importlib.metadata
import json
import os
import re
import subprocess
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from sinsjax.errors import InputError
from sinsjax.platform import machine
from sinsjax.platform.files import atomic_write

EXTRA_FLAG = "xla_backend_extra_options"
OPT_OUT = "SINSJAX_XLA_OPTIONS"


class XlaOption(NamedTuple):
    """One option of XLA:CPU, or of LLVM underneath.

    Attributes:
        name: its key; LLVM options begin with two hyphens.
        value: its value.
        extra: whether it is passed in ``--xla_backend_extra_options``. XLA silently ignores an
            unknown key there, whereas an unknown plain flag ends the process when JAX starts, and
            an unknown LLVM option does so at the first compilation.
    """

    name: str
    value: str
    extra: bool = True


TESTED_JAXLIB = frozenset({"0.10.0", "0.10.2"})
"""jaxlib versions on which all options were seen to take effect in a compiled loop."""

_OPTIONS = (
    XlaOption("xla_cpu_prefer_vector_width", "512", extra=False),
    XlaOption("xla_cpu_copy_insertion_use_region_analysis", "true", extra=False),
    XlaOption("xla_cpu_small_while_loop_byte_threshold", "1000000000"),
    XlaOption("xla_cpu_use_multi_output_fusion", "true"),
    XlaOption("--vectorize-memory-check-threshold", "100000"),
)
_WIDTHS = {"AVX512": "8", "AVX2": "4", "AVX": "4", "SSE4_2": "4"}
_FLAG = re.compile(r"""(?:^|(?<=\s))--(\w+)=(\"[^\"]*\"|'[^']*'|\S*)""")

_TRIAL = "import jax\njax.config.update('jax_enable_x64', True)\njax.jit(lambda x: x + 1.0)(1.0)\n"
_TRIAL_S = 120.0


class ConfigurationWarning(UserWarning):
    """JAX could not be set up as intended: runs can be slower, results differ by rounding."""


def is_opted_out() -> bool:
    """Return whether ``SINSJAX_XLA_OPTIONS=0`` is set."""
    return os.environ.get(OPT_OUT, "").strip() == "0"


def parse_flags(flags: str) -> dict[str, str]:
    """Return the flags and extra options in a value of ``XLA_FLAGS`` by name; the last one wins."""
    values: dict[str, str] = {}
    for name, quoted in _FLAG.findall(flags):
        value = quoted.strip("\"'")
        if name == EXTRA_FLAG:
            values.update(item.partition("=")[::2] for item in value.split(",") if item)
        else:
            values[name] = value
    return values


def names_a_file(flags: str) -> bool:
    """Return whether a value of ``XLA_FLAGS`` names a file that contains the flags."""
    return bool(flags.strip()) and not flags.lstrip().startswith("-")


def current_options() -> dict[str, str]:
    """The options set by ``XLA_FLAGS``, or by the file that it names, see `parse_flags`."""
    flags = os.environ.get("XLA_FLAGS", "")
    if names_a_file(flags):
        with contextlib.suppress(OSError, ValueError):
            flags = Path(flags.strip()).read_text(encoding="utf-8")
    return parse_flags(flags)


def instruction_set() -> str:
    """The instruction set in use: this machine's, limited by ``XLA_FLAGS``."""
    return machine.instruction_set(current_options().get("xla_cpu_max_isa", ""))


def required_options() -> tuple[XlaOption, ...]:
    """The options for the instruction set in use.

    On x86 they include LLVM's options for loops over lanes in double precision: wider vectors than
    LLVM would choose, one per iteration.
    """
    width = _WIDTHS.get(instruction_set())
    if width is None:
        return _OPTIONS
    loops = XlaOption("--force-vector-width", width), XlaOption("--force-vector-interleave", "1")
    return _OPTIONS + loops


def missing_options() -> tuple[XlaOption, ...]:
    """The options that ``XLA_FLAGS`` does not set and this jaxlib knows; none if opted out."""
    unset = _unset_options()
    refused = refused_options(_jaxlib_version()) if unset else frozenset()
    return tuple(option for option in unset if option.name not in refused)


def merge_options(flags: str, options: Sequence[XlaOption]) -> str:
    """Extend a value of ``XLA_FLAGS`` by the options that it does not set.

    Args:
        flags: the user's value. Every flag and extra option in it is kept unchanged.
        options: options to set.

    Returns:
        The new value. Extra options are appended to an existing ``--xla_backend_extra_options``.
    """
    present = parse_flags(flags)
    missing = [option for option in options if option.name not in present]
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


def extended_flags() -> str:
    """``XLA_FLAGS`` with the missing options added; unchanged if it names a file."""
    flags = os.environ.get("XLA_FLAGS", "")
    return flags if names_a_file(flags) else merge_options(flags, missing_options())


def apply_options() -> None:
    """Add the missing options to ``XLA_FLAGS``; has an effect only before JAX starts.

    Warns:
        ConfigurationWarning: ``XLA_FLAGS`` names a file without all the options, or jaxlib does not
            know some of them.
    """
    flags, missing = os.environ.get("XLA_FLAGS", ""), missing_options()
    if names_a_file(flags) and missing:
        _warn_incomplete_options(
            f"XLA_FLAGS names the file {flags.strip()}; add {merge_options('', missing)} to it"
        )
    elif missing:
        os.environ["XLA_FLAGS"] = extended_flags()
    if not names_a_file(flags) and (refused := _unset_options()):
        names = ", ".join(f"--{option.name.removeprefix('--')}" for option in refused)
        _warn_incomplete_options(f"jaxlib {_jaxlib_version()} does not know {names}")


def has_backend_started() -> bool:
    """Return whether a JAX backend has started, after which XLA reads no more options."""
    # JAX has no public function for this that does not start it.
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bridge is not None and bridge.backends_are_initialized()


@functools.cache
def refused_options(jaxlib: str) -> frozenset[str]:
    """The names of the `required_options` options that a jaxlib version does not know.

    An unknown option would end this process, so a version not in `TESTED_JAXLIB` is tried in a
    separate one, first with all the options and, if it fails, with each alone. The answer is stored
    in the user's cache folder.

    Args:
        jaxlib: the installed version.

    Returns:
        Names of options; all of them if nothing can be tried.
    """
    options = required_options()
    if jaxlib in TESTED_JAXLIB:
        return frozenset()
    key, trial_results = f"jaxlib {jaxlib} {merge_options('', options)}", _read_trial_results()
    if key not in trial_results:
        if not can_compile(""):
            return frozenset(option.name for option in options)
        refused = [] if can_compile(merge_options("", options)) else options
        names = [option.name for option in refused if not can_compile(merge_options("", [option]))]
        trial_results[key] = names
        _write_trial_results(trial_results)
    return frozenset(trial_results[key])


def can_compile(flags: str) -> bool:
    """Return whether a separate process compiles a small program with a value of ``XLA_FLAGS``."""
    settings = {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "false"}
    try:
        process = subprocess.run(
            # -P keeps modules of the working directory off the path.
            [sys.executable or "", "-P", "-c", _TRIAL],
            env=os.environ | settings | {"XLA_FLAGS": flags},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_TRIAL_S,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return process.returncode == 0


def _unset_options() -> tuple[XlaOption, ...]:
    present = current_options()
    return () if is_opted_out() else tuple(o for o in required_options() if o.name not in present)


def _warn_incomplete_options(problem: str) -> None:
    warnings.warn(
        f"sinsjax's XLA options are not all in effect, runs may be several times slower: {problem}"
        f" ({OPT_OUT}=0 silences this warning)",
        ConfigurationWarning,
        stacklevel=4,
    )


@functools.cache
def _jaxlib_version() -> str:
    return importlib.metadata.version("jaxlib")


def _trial_results_file() -> Path:
    return machine.user_cache_folder() / "xla_options.json"


def _read_trial_results() -> dict[str, list[str]]:
    """The options refused in earlier trials, by jaxlib version and options tried."""
    try:
        stored = json.loads(_trial_results_file().read_text(encoding="utf-8"))
        return {key: names for key, names in stored.items() if isinstance(names, list)}
    except (OSError, ValueError, AttributeError):
        return {}


def _write_trial_results(results: dict[str, list[str]]) -> None:
    # If nothing can be stored, the next process tries again.
    with contextlib.suppress(OSError, InputError):
        machine.ensure_private_folder(_trial_results_file().parent)
        with atomic_write(_trial_results_file()) as file:
            file.write(json.dumps(results, indent=1).encode())
