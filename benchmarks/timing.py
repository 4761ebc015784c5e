"""The timer of all scripts: workloads in turns, medians and spreads, and the conditions.

Machines are shared and drift, so workloads to be compared are timed in turns. Compilation is timed
separately, and a workload's call waits for its result.
"""

import os
import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from sinsjax.platform import machine, runtime

_FACTS = ("cpu", "instructions", "sinsjax", "jax", "jaxlib", "python")

Row = dict[str, Any]
"""A measurement: ``name``, its numbers, and the conditions."""


class Workload(NamedTuple):
    """A function to time: ``call`` does the work, waits for its end and returns its time, s."""

    name: str
    runs: int
    steps: int
    compile_s: float
    call: Callable[[], float]
    dtype: str = "float64"
    devices: int = 1

    def ns_per_step_run(self, seconds: float) -> float:
        """The time of a call in ns per step per run."""
        return seconds / (self.runs * self.steps) * 1e9


class TimingSpread(NamedTuple):
    """A median and half the range."""

    median: float
    half_range: float

    @classmethod
    def from_values(cls, values: Sequence[float]) -> "TimingSpread":
        """The spread of at least one value."""
        return cls(statistics.median(values), (max(values) - min(values)) / 2)


def time_in_turns(workloads: Sequence[Workload], repeats: int) -> list[list[float]]:
    """Time workloads in turns, and return the times of each workload's calls, s."""
    turns = [[workload.call() for workload in workloads] for _ in range(repeats)]
    return [list(times_s) for times_s in zip(*turns, strict=True)]


def timing_row(workload: Workload, times_s: Sequence[float]) -> Row:
    """The row of a workload, from the times of its calls, s."""
    spread = TimingSpread.from_values(times_s)
    return {
        "name": workload.name,
        "ns_per_step_run": round(workload.ns_per_step_run(spread.median), 2),
        "runs": workload.runs,
        "steps": workload.steps,
        "dtype": workload.dtype,
        "devices": workload.devices,
        "compile_s": round(workload.compile_s, 3),
        "median_s": round(spread.median, 5),
        "spread_s": round(spread.half_range, 5),
    }


def measure_workloads(workloads: Sequence[Workload], repeats: int) -> list[Row]:
    """Time workloads in turns, and return a row for each."""
    seconds = time_in_turns(workloads, repeats)
    return [timing_row(*pair) for pair in zip(workloads, seconds, strict=True)]


def measure_relative_to_base(
    base: Workload, workloads: Sequence[Workload], repeats: int
) -> list[Row]:
    """Time workloads and a base in turns.

    Returns:
        The base's row, then one per workload with ``ratios`` of its time per step per run to the
        base's, turn by turn, their median ``ratio`` and half their range ``ratio_spread``.
    """
    first, *others = time_in_turns([base, *workloads], repeats)
    rows = [timing_row(base, first)]
    for workload, times_s in zip(workloads, others, strict=True):
        ratios = [
            workload.ns_per_step_run(ours) / base.ns_per_step_run(theirs)
            for ours, theirs in zip(times_s, first, strict=True)
        ]
        spread = TimingSpread.from_values(ratios)
        row = {"ratio": round(spread.median, 3), "ratio_spread": round(spread.half_range, 3)}
        row |= {"ratios": [round(ratio, 3) for ratio in ratios]}
        rows.append(timing_row(workload, times_s) | row)
    return rows


def measurement_conditions() -> Row:
    """Return the conditions; ``options`` of XLA:CPU are all, or some are missing."""
    import jax

    facts, entries = runtime.info(), machine.cpu_info()
    device = jax.devices()[0]
    present = machine.parse_xla_flags(facts["xla_flags"])
    missing = [name for name in machine.required_xla_options() if name not in present]
    return {key: facts[key] for key in _FACTS} | {
        "family": f"{entries.get('cpu family', '?')}/{entries.get('model', '?')}",
        "ghz": float(entries["cpu MHz"]) / 1e3 if "cpu MHz" in entries else None,
        "cores": os.cpu_count(),
        "platform": device.platform,
        "device": device.device_kind,
        "options": "without " + " ".join(missing) if missing else "all",
    }


def pin_to_one_core() -> None:
    """Pin this process to one core, before XLA sizes its threads; disable the compile cache."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    os.environ[runtime.CACHE_VARIABLE] = "0"  # because compilation is timed too
    runtime.configure(devices=1)
