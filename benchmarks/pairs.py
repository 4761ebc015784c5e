"""The engine beside the limit kernel, in alternating pairs on one core: how far from the limit?"""

import tempfile
from collections.abc import Callable, Sequence

import common

from sinsjax.bench.cases import (
    at_rest,
    default_group,
    engine,
    shortened,
    with_feedback_each_sample,
    without_noise,
)
from sinsjax.bench.limit import compiler, limit_kernel
from sinsjax.bench.timing import Row, Workload, ratios, row, row_against, turns
from sinsjax.engine.lanes import Group

MADE: dict[str, Callable[[Group], Group]] = {
    "kalman_shared_record": lambda silent: silent,
    "kalman_feedback_each_sample": with_feedback_each_sample,
    "kalman_shared_covariance": at_rest,
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
    gcc = compiler()
    group = without_noise(default_group())
    if quick:
        group = shortened(group, 2)
    with tempfile.TemporaryDirectory(prefix="sinsjax-limit-") as folder:
        kernel = limit_kernel(gcc, folder, **({"steps": 200} if quick else {}))
        ours = [engine(name, MADE[name](group)) for name in names]
        its, *taken = turns([kernel, *ours], repeats)
    return [row(kernel, its), *(told(*pair, kernel, its) for pair in zip(ours, taken, strict=True))]


def told(case: Workload, taken: list[float], kernel: Workload, its: list[float]) -> Row:
    """The row of a case, with its ratios to the kernel."""
    found = ratios(case, kernel, taken, its)
    return row_against(case, taken, found) | {"ratios": [round(ratio, 3) for ratio in found]}


if __name__ == "__main__":
    common.main(rows)
