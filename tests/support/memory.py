"""Memory of this process, and limits on it: unlike limits on time they hold on a busy machine."""

import tracemalloc
from contextlib import contextmanager, suppress
from pathlib import Path


def process_bytes(name):
    """Return a line of ``/proc/self/status``, such as VmRSS or VmHWM, in bytes; 0 without it."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith(f"{name}:"):
                return int(line.split()[1]) * 1024
    return 0


@contextmanager
def limit_memory_mb(limit):
    """Fail if Python and NumPy allocate more than this at any time, MB."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
    assert peak < limit, f"{peak:.0f} MB"
