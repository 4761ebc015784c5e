"""How much XLA optimises what tests compile.

As shipped, but for tests marked ``optimised(False)``: those of what is read, written, told and
chosen, and of numbers to a tolerance. They take programs that are compiled in a quarter of the
time, and run up to nine times as long. What is held against oracles or seconds is compiled as users
have it, and so is what tests of the engine and of repeated passes hold against the bits of other
programs: whole studies that are cut, killed or resumed need not show it again. Nor need single runs
of a method over turns, rewinds and triggers, and limits and closed forms, which hold to a
tolerance: there a program for each case takes longer to compile than to run.
"""

import os
from functools import wraps
from typing import Any

import jax
import pytest
from jax._src import compiler  # no public setting says what is compiled everywhere in a process

from sinsjax.engine import batch

_LEAST = "jax_disable_most_optimizations"

SPARED = {
    "xla_disable_hlo_passes": "simplify-while-loops,while-loop-invariant-code-motion",
    "xla_llvm_enable_alias_scope_metadata": False,
    "xla_llvm_enable_noalias_metadata": False,
}
"""What JAX's own setting leaves on, a third of the time: passes over loops, and what LLVM would
need for the optimisations that are off."""


def least(item: pytest.Item) -> bool:
    """Whether a test asks for the least level."""
    mark = item.get_closest_marker("optimised")
    return mark is not None and not mark.args[0]


def suit(item: pytest.Item) -> None:
    """Set the level that a test asks for, here and in processes that it starts.

    JAX does not tell programs in memory apart by their level; those of the other one are dropped.
    """
    level = least(item)
    if jax.config.values[_LEAST] == level:
        return
    jax.config.update(_LEAST, level)
    os.environ[_LEAST.upper()] = str(int(level))
    batch._trace.cache_clear()
    jax.clear_caches()


def install() -> None:
    """Have the least level spare what JAX's own setting leaves on, if this JAX can."""
    given = getattr(compiler, "get_compile_options", None)
    if given is None:
        return

    @wraps(given)
    def options(*args: Any, **settings: Any) -> Any:
        made = given(*args, **settings)
        if jax.config.values[_LEAST]:
            made.env_option_overrides = [*made.env_option_overrides, *SPARED.items()]
        return made

    compiler.get_compile_options = options
