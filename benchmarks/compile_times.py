"""CPU seconds of tracing and compiling the program of a few methods, each once a repeat."""

import statistics
import time

import common
import jax
from cases import TILES, default_group, method_group
from timing import Row

from sinsjax.engine.batch import compile_program, plan
from sinsjax.engine.lanes import tiles_of

NAMES = ("kalman5", "kalman10", "unscented", "compass", "optimisation")


def rows(quick: bool, repeats: int) -> list[Row]:
    """Return a row a method: the median and half range of the CPU time, s, of all threads."""
    out = []
    for name in NAMES[:1] if quick else NAMES:
        group = default_group() if name == "kalman5" else method_group(name)
        tiles = tiles_of(group, plan(group, tiles_per_chunk=TILES)[0])
        taken = []
        for _ in range(repeats):
            jax.clear_caches()
            since = time.process_time()
            compile_program(group, tiles)
            taken.append(time.process_time() - since)
        spread = (max(taken) - min(taken)) / 2
        median = statistics.median(taken)
        out.append({"name": name, "cpu_s": round(median, 2), "cpu_s_spread": round(spread, 2)})
    return out


if __name__ == "__main__":
    common.main(rows, repeats=3)
