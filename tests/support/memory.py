"""Limits on memory, which hold on a slow or busy machine too, where limits on time do not."""

import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def at_most_mb(limit: float) -> Iterator[None]:
    """Fail if Python and NumPy allocate more than this at any time, MB."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
    assert peak < limit, f"{peak:.0f} MB"
