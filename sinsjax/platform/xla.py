"""XLA:CPU options that compile the loop over samples to one vectorised native function.

By default XLA:CPU calls every small fusion of a scan body as a separate function, at several times
the cost of a 5-state filter's arithmetic, and LLVM leaves the largest of these loops scalar, as it
would need more runtime overlap checks than its default limit. XLA reads its options from
``XLA_FLAGS`` once, when the backend starts, so `apply_options` runs when `sinsjax` is imported: it
adds `OPTIONS` and changes nothing else.

LLVM's options apply to the whole process. The one in `OPTIONS` costs other programs nothing; those
of `loop_options` suit loops over lanes in double precision and may slow down others, so they are
set only by an explicit call of `runtime.configure`.

Set the environment variable ``SINSJAX_XLA_OPTIONS=0`` to leave ``XLA_FLAGS`` unchanged.
"""

import contextlib
import functools
import importlib.metadata
import json
import os
import re
import sys
import tempfile
import warnings
from pathlib import Path
from typing import NamedTuple

from sinsjax.platform import machine, xla_trial

EXTRA_FLAG = "xla_backend_extra_options"
OPT_OUT = "SINSJAX_XLA_OPTIONS"


class Option(NamedTuple):
    """One option of XLA:CPU, or of LLVM underneath.

    Attributes:
        name: its key; LLVM options begin with two hyphens.
        value: its value.
        extra: whether it is passed in ``--xla_backend_extra_options``. XLA silently ignores an
            unknown key there, whereas an unknown plain flag ends the process when the backend
            starts, and an unknown LLVM option does so at the first compilation.
    """

    name: str
    value: str
    extra: bool = True

    @property
    def flag(self) -> str:
        """The name that jaxlib may not know: the LLVM option, or the flag that carries it."""
        return EXTRA_FLAG if self.extra and not self.name.startswith("--") else self.name


OPTIONS = (
    Option("xla_cpu_prefer_vector_width", "512", extra=False),
    Option("xla_cpu_copy_insertion_use_region_analysis", "true", extra=False),
    Option("xla_cpu_small_while_loop_byte_threshold", "1000000000"),
    Option("xla_cpu_use_multi_output_fusion", "true"),
    Option("--vectorize-memory-check-threshold", "100000"),
)
"""The options set on import."""

TESTED_JAXLIB = frozenset({"0.10.0", "0.10.2"})
"""jaxlib versions on which all options were seen to take effect in a compiled loop."""

_WIDTHS = {"AVX512": "8", "AVX2": "4", "AVX": "4", "SSE4_2": "4"}
_FLAG = re.compile(r"""(?:^|(?<=\s))--(\w+)=(\"[^\"]*\"|'[^']*'|\S*)""")


class OptionsWarning(UserWarning):
    """The XLA options could not be set: results are the same, loops run several times slower."""


def opted_out() -> bool:
    """Whether ``SINSJAX_XLA_OPTIONS=0`` is set."""
    return os.environ.get(OPT_OUT, "").strip() == "0"


def flag_values(flags: str) -> dict[str, str]:
    """Every flag and extra option in a value of ``XLA_FLAGS``, by name; the last one wins."""
    values: dict[str, str] = {}
    for name, quoted in _FLAG.findall(flags):
        value = quoted.strip("\"'")
        if name == EXTRA_FLAG:
            values.update(item.partition("=")[::2] for item in value.split(",") if item)
        else:
            values[name] = value
    return values


def names_a_file(flags: str) -> bool:
    """Whether a value of ``XLA_FLAGS`` names a file that contains the flags."""
    return bool(flags.strip()) and not flags.lstrip().startswith("-")


def given() -> dict[str, str]:
    """The options set by ``XLA_FLAGS``, or by the file that it names, see `flag_values`."""
    flags = os.environ.get("XLA_FLAGS", "")
    if names_a_file(flags):
        with contextlib.suppress(OSError, ValueError):
            flags = Path(flags.strip()).read_text(encoding="utf-8")
    return flag_values(flags)


def instructions() -> str:
    """The instruction set in use: this machine's, limited by ``XLA_FLAGS``."""
    return machine.instructions(given().get("xla_cpu_max_isa", ""))


def loop_options() -> tuple[Option, ...]:
    """LLVM's options for loops over lanes in double precision, by the instruction set in use.

    Wider vectors than LLVM would choose, one per iteration. No options outside x86.
    """
    width = _WIDTHS.get(instructions())
    if width is None:
        return ()
    return Option("--force-vector-width", width), Option("--force-vector-interleave", "1")


def wanted() -> tuple[Option, ...]:
    """All options, including those for loops."""
    return (*OPTIONS, *loop_options())


def merge_options(
    flags: str, refused: frozenset[str] = frozenset(), options: tuple[Option, ...] = OPTIONS
) -> str:
    """Extend a value of ``XLA_FLAGS`` by the options that it does not set.

    Args:
        flags: the user's value. Every flag and extra option in it is kept unchanged.
        refused: flags that this jaxlib does not know.
        options: options to set.

    Returns:
        The new value. Extra options are appended to an existing ``--xla_backend_extra_options``.
    """
    present = flag_values(flags)
    carried = options if EXTRA_FLAG not in refused else [o for o in options if not o.extra]
    missing = [o for o in carried if o.name not in present and o.flag not in refused]
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
    """Add `OPTIONS` to ``XLA_FLAGS``, extending the user's value.

    Does nothing if the user has opted out or has set every option. A jaxlib not in `TESTED_JAXLIB`
    is first tried in a separate process, once per version and user, because an unknown flag would
    end this one.

    Warns:
        OptionsWarning: a JAX backend has already started, ``XLA_FLAGS`` names a file, or jaxlib
            does not know a flag.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if opted_out() or all(option.name in flag_values(flags) for option in OPTIONS):
        return
    if names_a_file(flags):
        _warn(f"XLA_FLAGS names the file {flags.strip()}; put {merge_options('')} there")
    elif backend_started():
        _warn(f"JAX has started already; import sinsjax first or set XLA_FLAGS={merge_options('')}")
    else:
        refused = refused_flags(_jaxlib())
        if refused:
            names = ", ".join(f"--{flag.removeprefix('--')}" for flag in sorted(refused))
            _warn(f"jaxlib {_jaxlib()} does not know {names}")
        os.environ["XLA_FLAGS"] = merge_options(flags, refused)


def apply_loop_options() -> None:
    """Add `loop_options` to ``XLA_FLAGS``, unless JAX has started or the user has opted out."""
    flags = os.environ.get("XLA_FLAGS", "")
    if not (opted_out() or names_a_file(flags) or backend_started()):
        os.environ["XLA_FLAGS"] = merge_options(flags, refused_flags(_jaxlib()), loop_options())


def backend_started() -> bool:
    """Whether a JAX backend has started in this process, after which XLA reads no more options."""
    # JAX has no public function for this that does not start it.
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bridge is not None and bridge.backends_are_initialized()


def refused_flags(jaxlib: str) -> frozenset[str]:
    """The flags of the `wanted` options that a jaxlib version does not know.

    Args:
        jaxlib: the installed version. One not in `TESTED_JAXLIB` is tried in a separate process
            (some seconds); the result is stored in the user's cache folder.

    Returns:
        Names of flags; all of them if the trial failed.
    """
    options = wanted()
    needed = frozenset(option.flag for option in options)
    if jaxlib in TESTED_JAXLIB:
        return frozenset()
    known = _read_cache()
    if needed <= known.get(jaxlib, {}).keys():
        return frozenset(flag for flag in needed if not known[jaxlib][flag])
    refused = xla_trial.refused(lambda found: merge_options("", found, options))
    if refused is None:
        return needed
    _write_cache(known | {jaxlib: {flag: flag not in refused for flag in sorted(needed)}})
    return refused


@functools.cache
def vectorised() -> float | None:
    """Share of a small step's arithmetic that is vectorised under the current ``XLA_FLAGS``.

    Compiled in a separate process, which takes some seconds; None if unknown.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    trial = None if names_a_file(flags) else xla_trial.attempt(flags)
    return trial.vectorised if trial else None


def _warn(what: str) -> None:
    warnings.warn(
        f"sinsjax's XLA options are not in force, loops run slower: {what} ({OPT_OUT}=0 silences "
        "this warning)",
        OptionsWarning,
        stacklevel=3,
    )


@functools.cache
def _jaxlib() -> str:
    return importlib.metadata.version("jaxlib")


def _cache_file() -> Path:
    return machine.cache_folder() / "xla_options.json"


def _read_cache() -> dict[str, dict[str, bool]]:
    try:
        known = json.loads(_cache_file().read_text(encoding="utf-8"))
        return {str(version): dict(flags) for version, flags in known.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _write_cache(known: dict[str, dict[str, bool]]) -> None:
    # Without the cache, the next import takes a second longer.
    with contextlib.suppress(OSError):
        path = _cache_file()
        machine.private_folder(path.parent)
        with tempfile.NamedTemporaryFile(
            "w", dir=path.parent, suffix=".tmp", delete=False, encoding="utf-8"
        ) as file:
            json.dump(known, file, indent=1)
        os.replace(file.name, path)
