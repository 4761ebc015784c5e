"""The engine beside the limit kernel, in alternating pairs on one core: how far from the limit?"""

import tempfile
from collections.abc import Callable, Sequence

import common

from sinsjax.bench.cases import (
    default_group,
    engine_workload,
    remove_noise,
    set_feedback_every_sample,
    shared_covariance_group,
    shorten_runs,
)
from sinsjax.bench.limit import find_compiler, limit_kernel_workload
from sinsjax.bench.timing import Row, Workload, ratio_row, time_in_turns, time_ratios, timing_row
from sinsjax.engine.lanes import Group

MADE: dict[str, Callable[[Group], Group]] = {
    "kalman_shared_record": lambda silent: silent,
    "kalman_feedback_each_sample": set_feedback_every_sample,
    "kalman_shared_covariance": shared_covariance_group,
}
"""What makes a row's group of the silent default sweep."""


def rows(quick: bool, repeats: int, names: Sequence[str] = tuple(MADE)) -> list[Row]:
    """Time ``limit_kernel`` and the engine in pairs, in CPU time.

    Args:
        quick: tiny sizes.
        repeats: pairs.
        names: of the engine's rows, in `MADE`.

    Returns:
        A row each for the kernel and for ``names``, which have ``ratios``, one a pair, with their
        median and half range.

    Raises:
        InputError: there is no gcc, or it cannot build the kernel.
    """
    gcc = find_compiler()
    group = remove_noise(default_group())
    if quick:
        group = shorten_runs(group, 2)
    with tempfile.TemporaryDirectory(prefix="sinsjax-limit-") as folder:
        kernel = limit_kernel_workload(gcc, folder, **({"steps": 200} if quick else {}))
        ours = [engine_workload(name, MADE[name](group)) for name in names]
        its, *taken = time_in_turns([kernel, *ours], repeats)
    return [
        timing_row(kernel, its),
        *(told(*pair, kernel, its) for pair in zip(ours, taken, strict=True)),
    ]


def told(case: Workload, taken: list[float], kernel: Workload, its: list[float]) -> Row:
    """The row of a case, with its ratios to the kernel."""
    found = time_ratios(case, kernel, taken, its)
    return ratio_row(case, taken, found) | {"ratios": [round(ratio, 3) for ratio in found]}


if __name__ == "__main__":
    common.main(rows)
