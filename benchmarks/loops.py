"""For information: the same step as a plain NumPy loop and as a Numba loop over one run.

Both are checked to give the engine's attitude to 1e-9 rad before they are timed. The Numba loop
needs the extra: ``pip install ".[benchmark]"``.
"""

import sys
import time
from collections.abc import Callable

import common
import numpy as np

from sinsjax.bench import baseline
from sinsjax.bench.baseline import AlignmentSettings
from sinsjax.bench.cases import (
    default_group,
    first_run_arguments,
    numpy_baseline_workload,
    remove_noise,
)
from sinsjax.bench.timing import Row, Workload, measure_workloads
from sinsjax.engine.lanes import Group

CHECKED = 2000
"""Samples over which the Numba loop is compared."""

Loop = Callable[[np.ndarray, np.ndarray, AlignmentSettings], tuple[np.ndarray, np.ndarray]]
"""As `sinsjax.bench.baseline.align_with_numpy_loop`."""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time the loops in turns.

    Returns:
        ``numpy_loop``, and ``numba_loop`` where Numba is installed.
    """
    group = remove_noise(default_group())
    # Checked against the engine where it is made.
    cases = [numpy_baseline_workload(group)._replace(name="numpy_loop")]
    try:
        import numba_loop
    except (ImportError, OSError) as error:
        print(f"warning: no numba_loop: {error}", file=sys.stderr)
    else:
        cases.append(numba_case(numba_loop.align, group, 2 * CHECKED if quick else None))
    return measure_workloads(cases, repeats)


def numba_case(loop: Loop, group: Group, samples: int | None) -> Workload:
    """The loop over a group's first run, compared with the NumPy one.

    Args:
        loop: compiled when it is first called.
        group: noise-free.
        samples: how many; None takes the whole run.

    Raises:
        RuntimeError: the two differ by more than 1e-9.
    """
    increments, start, setting = first_run_arguments(group)
    since = time.perf_counter()
    ours = loop(increments[:CHECKED], start, setting)[0]
    compile_s = time.perf_counter() - since
    theirs = baseline.align_with_numpy_loop(increments[:CHECKED], start, setting)[0]
    if not np.allclose(ours, theirs, rtol=0, atol=1e-9):
        raise RuntimeError(f"the Numba loop and the NumPy loop differ: {ours} and {theirs}")
    taken = increments[:samples]

    def call() -> float:
        since = time.process_time()
        loop(taken, start, setting)
        return time.process_time() - since

    return Workload("numba_loop", 1, len(taken), compile_s, call)


if __name__ == "__main__":
    common.main(rows)
