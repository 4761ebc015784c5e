"""The timer of all benchmarks: workloads in turns, medians and spreads, and the conditions.

Machines are shared and drift, so workloads to be compared are timed in turns. Compilation is timed
separately, and a workload's call waits for its result.
"""

import os
import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from sinsjax.platform import compile_cache, machine, runtime, xla

Row = dict[str, Any]
"""A measurement: ``name``, its numbers, and the conditions."""


class Workload(NamedTuple):
    """A function to time.

    Attributes:
        name: name of the row.
        runs: runs per call.
        steps: steps of each run.
        compile_s: compilation time, s.
        call: does the work, waits for its end and returns the time it took, s.
        dtype: type of the run's state.
        devices: number of devices that share the work.
    """

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
    seconds: list[list[float]] = [[] for _ in workloads]
    for _ in range(repeats):
        for workload, times_s in zip(workloads, seconds, strict=True):
            times_s.append(workload.call())
    return seconds


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
    return [
        timing_row(workload, times_s) for workload, times_s in zip(workloads, seconds, strict=True)
    ]


def time_ratios(
    workload: Workload, base: Workload, times_s: Sequence[float], base_times_s: Sequence[float]
) -> list[float]:
    """Return the ratios of a workload's time per step per run to the base's, turn by turn.

    Args:
        workload: workload to compare.
        base: workload to compare with.
        times_s: times of the workload's calls, s.
        base_times_s: times of the base's calls in the same turns, s.
    """
    return [
        workload.ns_per_step_run(ours) / base.ns_per_step_run(theirs)
        for ours, theirs in zip(times_s, base_times_s, strict=True)
    ]


def measure_relative_to_base(
    base: Workload, workloads: Sequence[Workload], repeats: int
) -> list[Row]:
    """Time workloads and a base in turns, with the ratios of their times.

    Args:
        base: workload to compare with.
        workloads: workloads to compare.
        repeats: number of turns.

    Returns:
        The base's row, then one per workload with ``ratio``, the median over the turns of the ratio
        of its time per step per run to the base's, and ``ratio_spread``, half the range.
    """
    first, *others = time_in_turns([base, *workloads], repeats)
    rows = [timing_row(base, first)]
    for workload, times_s in zip(workloads, others, strict=True):
        rows.append(ratio_row(workload, times_s, time_ratios(workload, base, times_s, first)))
    return rows


def ratio_row(workload: Workload, times_s: Sequence[float], ratios_to_base: Sequence[float]) -> Row:
    """The row of a workload with ``ratio`` and ``ratio_spread``, from its ratios to a base."""
    return timing_row(workload, times_s) | median_and_spread("ratio", ratios_to_base)


def median_and_spread(name: str, values: Sequence[float]) -> Row:
    """Return two entries of a row: the median of some values, and half their range."""
    found = TimingSpread.from_values(values)
    return {name: round(found.median, 3), f"{name}_spread": round(found.half_range, 3)}


def measurement_conditions() -> Row:
    """Return the conditions of a measurement; starts JAX.

    Returns:
        ``cpu`` with its ``family`` and ``ghz`` (None if unknown), ``cores`` of the machine,
        ``instructions`` (instruction set in use) and ``avx512``, ``platform`` (of JAX: cpu, gpu),
        ``device`` (its kind), versions of ``sinsjax``, ``jax``, ``jaxlib`` and ``python``
        and ``options`` (XLA:CPU options that are set: all, none, or their names).
    """
    import jax

    facts, entries = runtime.info(), machine.cpu_info()
    device = jax.devices()[0]
    return {
        "cpu": facts["cpu"],
        "family": f"{entries.get('cpu family', '?')}/{entries.get('model', '?')}",
        "ghz": float(entries["cpu MHz"]) / 1e3 if "cpu MHz" in entries else None,
        "instructions": facts["instructions"],
        "avx512": facts["avx512"],
        "cores": os.cpu_count(),
        "platform": device.platform,
        "device": device.device_kind,
        "sinsjax": facts["sinsjax"],
        "jax": facts["jax"],
        "jaxlib": facts["jaxlib"],
        "python": facts["python"],
        "options": _describe_options(facts["options"]),
    }


def _describe_options(options: dict[str, str | None]) -> str:
    required = {option.name: option.value for option in xla.required_options()}
    set_names = [name for name, value in options.items() if value == required[name]]
    if len(set_names) == len(required):
        return "all"
    return " ".join(name.removeprefix("xla_cpu_") for name in set_names) or "none"


def pin_to_one_core() -> None:
    """Pin this process to one core, and disable the compile cache.

    Must be called before XLA sizes its thread pool.
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    os.environ[compile_cache.VARIABLE] = "0"  # because compilation is timed too
    runtime.configure(devices=1)
