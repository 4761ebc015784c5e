"""How much XLA optimises what tests compile.

As shipped, but for tests marked ``optimised(False)``: those of what is read, written, told and
chosen, and of numbers to a tolerance. They take programs that are compiled in a half to a fifth of
the time, and run four times as long. What is held against oracles or seconds is compiled as
users have it, and so is what tests of the engine and of repeated passes hold against the bits of
other programs: whole studies that are cut, killed or resumed need not show it again.
"""

import os

import jax
import pytest

from sinsjax.engine import batch

_LEAST = "jax_disable_most_optimizations"


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
