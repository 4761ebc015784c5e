"""How much XLA optimises what tests compile.

As shipped, but for tests marked ``optimised(False)``: those of what is read, written, told and
chosen, and of numbers to a tolerance. They take programs that are compiled in half the time. What
is held against other bits, oracles, seconds or bytes of memory is compiled as users have it.
"""

import os

import jax
import pytest

from sinsjax.engine import batch

_LEAST = "jax_disable_most_optimizations"


def suit(item: pytest.Item) -> None:
    """Set the level that a test asks for, here and in processes that it starts.

    JAX does not tell programs in memory apart by their level; those of the other one are dropped.
    """
    mark = item.get_closest_marker("optimised")
    least = mark is not None and not mark.args[0]
    if jax.config.values[_LEAST] == least:
        return
    jax.config.update(_LEAST, least)
    os.environ[_LEAST.upper()] = str(int(least))
    batch._trace.cache_clear()
    jax.clear_caches()
