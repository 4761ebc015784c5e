"""CPU seconds of tracing and compiling the program of a few methods, each once a repeat."""

import statistics
import time

import common
import jax
from cases import TILES, default_group, method_group
from timing import Row

from sinsjax.engine import batch

NAMES = ("kalman5", "kalman10", "unscented", "compass", "optimisation")


def rows(quick: bool, repeats: int) -> list[Row]:
    """Return a row a method: the median and half range of the CPU time, s, of all threads."""
    out = []
    for name in NAMES[:1] if quick else NAMES:
        group = default_group() if name == "kalman5" else method_group(name)
        layout = group.lay_out(tiles_per_chunk=TILES)
        taken = []
        for _ in range(repeats):
            jax.clear_caches()
            batch._traced.cache_clear()  # which keeps compiled programs
            since = time.process_time()
            batch.trace_program(group, layout).compiled()
            taken.append(time.process_time() - since)
        spread = (max(taken) - min(taken)) / 2
        median = statistics.median(taken)
        out.append({"name": name, "cpu_s": round(median, 2), "cpu_s_spread": round(spread, 2)})
    return out


if __name__ == "__main__":
    common.main(rows, repeats=3)
