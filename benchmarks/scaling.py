"""A whole sweep on one device, on all of them, and through Dask workers, one a core."""

import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import common
import devices
import jax

from sinsjax.bench.timing import (
    Row,
    Workload,
    median_and_spread,
    time_in_turns,
    time_ratios,
    timing_row,
)
from sinsjax.engine.batch import map_in_threads as calls_on
from sinsjax.execution import cluster, run
from sinsjax.execution.tasks import EncodedResult, Executor, Task, TaskRunner
from sinsjax.study.study import Study

DURATION_S, DRAWS = 90.0, 384
"""Of the default sweep's runs: 122,880 of 9,000 steps, about a minute of a core."""


def rows(quick: bool, repeats: int) -> list[Row]:
    """Time the same sweep into Parquet in turns; everything is compiled and started before.

    Returns:
        ``sweep_devices_N`` and ``sweep_workers_N`` with ``speedup`` over one device, the median
        over the turns; for workers also ``start_s``, from nothing to workers that wait for tasks.
    """
    study = devices.sweep_study(*((9.0, 1) if quick else (DURATION_S, DRAWS)))
    most = len(jax.devices())
    with started(most) as (workers, start_s):
        cases = [
            sweep_case(f"sweep_devices_{n}", study, on_devices(n), n) for n in sorted({1, most})
        ]
        cases.append(sweep_case(f"sweep_workers_{most}", study, workers, most))
        seconds = time_in_turns(cases, repeats)
    out = []
    for case, taken in zip(cases, seconds, strict=True):
        measured = timing_row(case, taken)
        measured["compile_s"] = round(case.compile_s - measured["median_s"], 3)
        out.append(
            measured | median_and_spread("speedup", time_ratios(cases[0], case, seconds[0], taken))
        )
    out[-1]["start_s"] = round(start_s, 2)
    return out


@contextmanager
def started(workers: int) -> Iterator[tuple[Executor, float]]:
    """Dask workers, and how long it took to start them."""
    since = time.perf_counter()
    with cluster.executor(workers=workers) as executor:
        yield executor, time.perf_counter() - since


def on_devices(count: int) -> Executor:
    """Some of this process's devices."""

    def do(runner: TaskRunner, tasks: Iterable[Task]) -> Iterator[EncodedResult]:
        return calls_on(runner.compute_files, tasks, count)

    return Executor(do, {"devices": count})


def sweep_case(name: str, study: Study, executor: Executor, cores: int) -> Workload:
    """`run.run_into` as a case, called once before, so that everything is compiled.

    Its ``compile_s`` is all that the first call took.
    """
    call = partial(timed, study, executor)
    steps, runs = study.records * study.record_every, study.n_draws * study.n_variants
    return Workload(name, runs, steps, call(), call, "float64", cores)


def timed(study: Study, executor: Executor) -> float:
    """The seconds of a whole sweep."""
    with tempfile.TemporaryDirectory(prefix="sinsjax-sweep-") as folder:
        since = time.perf_counter()
        run.run_into(study, Path(folder) / "out", executor=executor)
        return time.perf_counter() - since


if __name__ == "__main__":
    common.main(rows, one_core=False, repeats=3)
