"""The engine beside the limit kernel, in alternating pairs on one core: how far from the limit?"""

import tempfile
from collections.abc import Callable, Sequence

import common
from cases import (
    default_group,
    engine_workload,
    remove_noise,
    set_feedback_every_sample,
    shared_covariance_group,
    shorten_runs,
)
from limit import find_compiler, limit_kernel_workload
from timing import Row, Workload, measure_relative_to_base

from sinsjax.engine.batch import Batch

MADE: dict[str, Callable[[Batch], Batch]] = {
    "kalman_shared_record": lambda silent: silent,
    "kalman_feedback_each_sample": set_feedback_every_sample,
    "kalman_shared_covariance": shared_covariance_group,
}
"""What makes a row's group of the silent default sweep."""

CALLS = 5
"""Calls of the engine in a turn, of which the fastest counts: the kernel's time is such, too."""


def fastest_of_calls(workload: Workload) -> Workload:
    """The workload with a turn of `CALLS` calls, timed by the fastest, which has no neighbour."""
    return workload._replace(call=lambda: min(workload.call() for _ in range(CALLS)))


def rows(quick: bool, repeats: int, names: Sequence[str] = tuple(MADE)) -> list[Row]:
    """Time ``limit_kernel`` and the engine's rows of these names in pairs, in CPU time."""
    gcc = find_compiler()
    group = remove_noise(default_group())
    if quick:
        group = shorten_runs(group, 2)
    with tempfile.TemporaryDirectory(prefix="sinsjax-limit-") as folder:
        kernel = limit_kernel_workload(gcc, folder, steps=200 if quick else 20000)
        ours = [fastest_of_calls(engine_workload(name, MADE[name](group))) for name in names]
        return measure_relative_to_base(kernel, ours, repeats)


if __name__ == "__main__":
    common.main(rows)
