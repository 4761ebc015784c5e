"""Optimisation level of XLA for programs of tests.

As shipped, but for tests marked ``optimised(False)``, whose programs are compiled in a quarter of
the time and run up to nine times as long: tests of what is read, written and chosen, and of numbers
to a tolerance. Compiled as users have them are programs whose bits are compared with those of
others, the golden studies, and whatever takes long to run.
"""

import ctypes
import gc
import os
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import Any

import jax
import pytest
from jax._src import compiler  # no public setting says what is compiled everywhere in a process

from sinsjax.engine import batch
from sinsjax.platform import machine, runtime
from support.memory import process_bytes

_LEAST_OPTION = "jax_disable_most_optimizations"

LARGE_BYTES, LARGEST_BYTES = 1350 * 2**20, 1500 * 2**20
"""Memory of a process above which it drops its programs after a module of tests, and after any
test."""

SPARED_OPTIONS = {
    "xla_disable_hlo_passes": "simplify-while-loops,while-loop-invariant-code-motion",
    "xla_llvm_enable_alias_scope_metadata": False,
    "xla_llvm_enable_noalias_metadata": False,
}
"""What JAX's own setting leaves on, a third of the time: passes over loops, and what LLVM would
need for the optimisations that are off."""


def has_least_optimisation(item: pytest.Item) -> bool:
    """Whether a test requests the lowest level."""
    mark = item.get_closest_marker("optimised")
    return mark is not None and not mark.args[0]


def set_optimisation_level(item: pytest.Item) -> None:
    """Set the level that a test requests, here and in processes that it starts.

    JAX does not distinguish programs in memory by level; those of the other level are dropped.
    """
    level = has_least_optimisation(item)
    if jax.config.values[_LEAST_OPTION] == level:
        return
    jax.config.update(_LEAST_OPTION, level)
    os.environ[_LEAST_OPTION.upper()] = str(int(level))
    drop_programs()


def drop_programs() -> None:
    """Forget every program of this process; the cache on disk has those that took long."""
    batch._traced.cache_clear()
    jax.clear_caches()


def drop_programs_above(limit_bytes: int) -> None:
    """Forget all programs if this process has more memory."""
    if process_bytes("VmRSS") > limit_bytes:
        drop_programs()
        gc.collect()
        with suppress(OSError, AttributeError):  # another libc, which gives memory back by itself
            ctypes.CDLL("libc.so.6").malloc_trim(0)


def share_cache(repository: Path) -> None:
    """Keep compiled programs for this run's other processes and for the next run.

    In ``.pytest_cache`` unless ``SINSJAX_COMPILE_CACHE`` says otherwise; nowhere if others may
    write there, as JAX would run what they put there.
    """
    # Most programs here are small: the next process reads one sooner than it compiles it.
    runtime._MIN_COMPILE_S = 0.05
    # To keep a limit, JAX reads the times of all entries whenever it writes one.
    os.environ.setdefault(runtime._CACHE_SIZE, "-1")
    if runtime.CACHE_VARIABLE not in os.environ:
        try:
            folder = machine.ensure_private_folder(repository / ".pytest_cache" / "compiled")
        except OSError:
            folder = None
        os.environ[runtime.CACHE_VARIABLE] = str(folder or 0)


def install_spared_options() -> None:
    """Extend the lowest level by the `SPARED_OPTIONS`, if this JAX supports it."""
    given = getattr(compiler, "get_compile_options", None)
    if given is None:
        return

    @wraps(given)
    def options(*args: Any, **settings: Any) -> Any:
        made = given(*args, **settings)
        if jax.config.values[_LEAST_OPTION]:
            made.env_option_overrides = [*made.env_option_overrides, *SPARED_OPTIONS.items()]
        return made

    compiler.get_compile_options = options
