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
    """Something to time.

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

    def ns(self, seconds: float) -> float:
        """The time of a call in ns per step and run."""
        return seconds / (self.runs * self.steps) * 1e9


class TimingSpread(NamedTuple):
    """A median and half the range."""

    median: float
    half_range: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "TimingSpread":
        """The spread of at least one value."""
        return cls(statistics.median(values), (max(values) - min(values)) / 2)


def turns(timed: Sequence[Workload], repeats: int) -> list[list[float]]:
    """Time workloads in turns; gives the times of each workload's calls, s."""
    seconds: list[list[float]] = [[] for _ in timed]
    for _ in range(repeats):
        for case, taken in zip(timed, seconds, strict=True):
            taken.append(case.call())
    return seconds


def row(case: Workload, taken: Sequence[float]) -> Row:
    """The row of a workload, from the times of its calls, s."""
    found = TimingSpread.of(taken)
    return {
        "name": case.name,
        "ns_per_step_run": round(case.ns(found.median), 2),
        "runs": case.runs,
        "steps": case.steps,
        "dtype": case.dtype,
        "devices": case.devices,
        "compile_s": round(case.compile_s, 3),
        "median_s": round(found.median, 5),
        "spread_s": round(found.half_range, 5),
    }


def measure(timed: Sequence[Workload], repeats: int) -> list[Row]:
    """Time workloads in turns; gives one row each."""
    seconds = turns(timed, repeats)
    return [row(case, taken) for case, taken in zip(timed, seconds, strict=True)]


def ratios(
    case: Workload, base: Workload, taken: Sequence[float], its: Sequence[float]
) -> list[float]:
    """Ratios of a workload's time per step and run to the base's, turn by turn.

    Args:
        case: workload to compare.
        base: workload to compare with.
        taken: times of the workload's calls, s.
        its: times of the base's calls in the same turns, s.
    """
    return [case.ns(ours) / base.ns(theirs) for ours, theirs in zip(taken, its, strict=True)]


def measure_against(base: Workload, timed: Sequence[Workload], repeats: int) -> list[Row]:
    """Time workloads and a base in turns, with the ratios of their times.

    Args:
        base: workload to compare with.
        timed: workloads to compare.
        repeats: number of turns.

    Returns:
        The base's row, then one per workload with ``ratio``, the median over the turns of the ratio
        of its time per step and run to the base's, and ``ratio_spread``, half the range.
    """
    first, *others = turns([base, *timed], repeats)
    rows = [row(base, first)]
    for case, taken in zip(timed, others, strict=True):
        rows.append(row_against(case, taken, ratios(case, base, taken, first)))
    return rows


def row_against(case: Workload, taken: Sequence[float], found: Sequence[float]) -> Row:
    """The row of a workload with ``ratio`` and ``ratio_spread``, from its ratios to a base."""
    return row(case, taken) | spread("ratio", found)


def spread(name: str, values: Sequence[float]) -> Row:
    """Two entries of a row: the median of some values, and half their range."""
    found = TimingSpread.of(values)
    return {name: round(found.median, 3), f"{name}_spread": round(found.half_range, 3)}


def conditions() -> Row:
    """Conditions of a measurement; starts JAX.

    Returns:
        ``cpu`` with its ``family`` and ``ghz`` (None if unknown), ``cores`` of the machine,
        ``instructions`` (instruction set in use) and ``avx512``, ``platform`` (of JAX: cpu, gpu),
        ``device`` (its kind), versions of ``sinsjax``, ``jax``, ``jaxlib`` and ``python``
        and ``options`` (XLA:CPU options that are set: all, none, or their names).
    """
    import jax

    facts, entries = runtime.info(), machine.cpu()
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
        "options": _options_set(facts["options"]),
    }


def _options_set(options: dict[str, str | None]) -> str:
    wanted = {option.name: option.value for option in xla.wanted()}
    there = [name for name, value in options.items() if value == wanted[name]]
    if len(there) == len(wanted):
        return "all"
    return " ".join(name.removeprefix("xla_cpu_") for name in there) or "none"


def use_one_core() -> None:
    """Pin this process to one core, and disable the compile cache.

    Must be called before XLA sizes its thread pool.
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    os.environ[compile_cache.VARIABLE] = "0"  # because compilation is timed too
    runtime.configure(devices=1)
