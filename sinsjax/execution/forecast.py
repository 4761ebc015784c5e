"""Forecast of a study's runs, time, memory and disk space, before anything is created.

The estimates are rough and use only the lengths of the axes, so a study of a billion runs is
forecast, and rejected, as fast as one of three runs.
"""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from sinsjax.columns import Column
from sinsjax.engine.batch import CHUNK_RECORDS, LANES, STACKED_TILES
from sinsjax.engine.scenario import MOST_STORED_SAMPLES, PROGRAM_KEYS
from sinsjax.errors import InputError
from sinsjax.execution import schemas, stopping
from sinsjax.execution.directory import Manifest
from sinsjax.messages import format_count
from sinsjax.methods.filters.keys import SCHEDULE_KEYS
from sinsjax.methods.registry import METHODS
from sinsjax.platform import machine, runtime
from sinsjax.study.schema import NUMBERS_DRAWN, keys_acting_as
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study

# Measured times, s: to import, trace and report; to compile random processes, beyond the method;
# of a descent's step per sample, which few runs take in turn; to trace a descent.
_START_S, _PROCESS_COMPILE_S, _DESCENT_SAMPLE_S, _TRACE_S = 4.0, 3.0, 15e-6, 2.0

# Measured memory, bytes: of a process with JAX, and per sample, variant, run, row of curves, sample
# that a draw keeps for further passes, and point of a search.
_BASE_BYTES, _SAMPLE_BYTES, _VARIANT_BYTES, _RUN_BYTES = 400e6, 160, 600, 2
_RECORD_BYTES, _KEPT_BYTES, _POINT_BYTES = 500, 48, 2000

_COMPRESSION_RATIO = 0.8  # of 8-byte numbers in Parquet: 0.6 to 0.95, with and without nulls
_DESCENT_PROGRAMS = 3  # of a descent: of the start points, the gradient and the ends
_PROCESS_KEYS = keys_acting_as("process")
_SWITCH_KEYS = keys_acting_as("noise", "distortion", "sway", "process")
"""Keys that simplify the program if they are zero."""


class Forecast(NamedTuple):
    """Rough requirements of a study.

    Attributes:
        runs: number of runs, at most.
        least_runs: number of runs, at least, if the study may stop early.
        length_s: length of the longest run, s.
        run_s: time per run on one core, s.
        run_bytes: disk space per run, bytes.
        memory: peak memory, bytes.
        programs: number of programs to compile, unless they are in the compile cache.
        compile_s: time to compile all of them on one core, s.
        start_s: time that more cores do not shorten: to import, trace and report, and of the steps
            of descents, s.
        folders: subdirectories of the results, of a tuning run.
    """

    runs: int
    least_runs: int
    length_s: float
    run_s: float
    run_bytes: float
    memory: float
    programs: int
    compile_s: float
    start_s: float = _START_S
    folders: tuple[str, ...] = ("",)

    def describe(self, cores: int, done: int = 0, *, threads: bool = False) -> str:
        """Return one line for a user: the runs, the remaining time, memory and disk space.

        Args:
            cores: number of cores that share the runs.
            done: number of runs with stored results.
            threads: whether the cores are threads of Dask workers.
        """
        runs = f"{format_count(self.runs, 'run')} of up to {self.length_s:g} s"
        remaining = max(0, self.runs - done)
        if not remaining:
            return f"{runs}: all are done"
        if done:
            runs += f", {remaining:,} left"
        prefix = "At most " if self.least_runs < self.runs else ""
        processors = format_count(cores, "worker thread" if threads else "core")
        later_s = self.start_s + remaining * self.run_s / cores
        first_s = later_s + self.compile_s / min(cores, self.programs)
        later, first = map(_format_duration, (later_s, first_s))
        return (
            f"{prefix}{runs}: roughly {later} on {processors} ({first} the first time, which"
            f" compiles {format_count(self.programs, 'program')}),"
            f" {format_bytes(self.memory)} of memory,"
            f" {format_bytes(remaining * self.run_bytes)}{' more' if done else ''} on disk"
        )


def forecast_sweep(study: Study, curves: bool | None = None) -> Forecast:
    """Return the forecast of a sweep.

    Args:
        study: checked study, whose rate is known.
        curves: whether to keep curves; None follows the study.
    """
    variants, draws = study.n_variants, study.n_draws
    least_draws = min(draws, stopping.FIRST_INTERIM) if study.stop_when else draws
    kept = study.study.curves if curves is None else curves
    found = _forecast_runs(study, variants, draws * variants, curves=kept)
    return found._replace(least_runs=least_draws * variants)


def forecast_tuning(study: Study) -> Forecast:
    """Return the forecast of a tuning run: its searches, then their evaluation.

    The cost of a descent's steps is a rough guess.
    """
    tune = study.tune
    assert tune is not None
    draws = tune.tune_draws or 1, tune.evaluation_draws or 1
    if study.record:
        draws = (study.n_draws + 1) // 2, study.n_draws // 2
    space, variants = SearchSpace.from_study(study), study.n_variants
    free_keys = [len(space.used_variables(combination)) for combination in space.combinations]
    # The schedule by the law is one more point of each, if it exists.
    laws = len(free_keys) * any(v.key in SCHEDULE_KEYS for v in space.variables)
    # A gradient stores its history alone.
    sizes = {
        "grid": sum(tune.grid_points**count for count in free_keys) + laws,
        "sobol": tune.sobol_points * len(free_keys) + laws,
    }
    points = {name: sizes[name] for name in tune.searches if name in sizes}
    candidates = len(tune.searches) + 1 + bool(laws)
    runs = variants * (sum(points.values()) * draws[0] + candidates * draws[1])
    most = max(candidates, *points.values(), 0)
    found = _forecast_runs(study, variants * most, runs, curves=False)
    descents = found.programs * len(free_keys) * ("gradient" in tune.searches)
    programs = found.programs + descents * _DESCENT_PROGRAMS
    steps = descents * tune.descent_steps * found.length_s * study.rate_hz
    return found._replace(
        memory=found.memory + _POINT_BYTES * most,
        programs=programs,
        compile_s=found.compile_s * programs / found.programs,
        start_s=_START_S + descents * _TRACE_S + steps * _DESCENT_SAMPLE_S,
        folders=(*points, "evaluation"),
    )


def check_resources(
    name: str, forecast: Forecast, directory: Path | None, *, overwrite: bool, resume: bool
) -> None:
    """Reject a study that exceeds disk or memory; a resumed one needs only its missing runs.

    Args:
        name: name of the study.
        forecast: its forecast.
        directory: results directory; None for tables in memory.
        overwrite: whether existing results are removed first.
        resume: whether existing results are kept.

    Raises:
        InputError: states what is needed and what is available.
    """
    if directory is not None:
        done = count_stored_runs(directory, forecast.folders) if resume else 0
        needed = max(0, forecast.least_runs - done) * forecast.run_bytes
        free = machine.free_disk_bytes(directory)
        if overwrite:
            folders = (directory / name for name in forecast.folders)
            parts = (part for folder in folders for part in folder.glob("*/part-*.parquet"))
            free += sum(part.stat().st_size for part in parts)
        if needed > free:
            raise InputError(
                f"{directory}: the results of {forecast.runs:,} runs need about"
                f" {format_bytes(needed)}, but the disk has only {format_bytes(free)} free"
            )
    available = machine.available_memory_bytes()
    if forecast.memory > available:
        raise InputError(
            f"{name}: {forecast.runs:,} runs need about {format_bytes(forecast.memory)} of memory,"
            f" but this machine has only {format_bytes(available)}"
        )


def count_stored_runs(directory: Path, folders: Iterable[str] = ("",)) -> int:
    """Return the number of runs with stored results, in some folders of a directory."""
    manifests = (Manifest.find(directory / name) for name in folders)
    return sum(manifest.runs_done for manifest in manifests if manifest)


def _forecast_runs(study: Study, variants: int, runs: int, *, curves: bool) -> Forecast:
    """Return the forecast of some runs of a study's lengths and methods, at once."""
    records = max(span.records for span in study.distinct_spans)
    samples = records * study.record_every
    # Longer simulations do not store their increments.
    stored_samples = samples if study.is_recorded else min(samples, MOST_STORED_SAMPLES)
    memory = _BASE_BYTES + _SAMPLE_BYTES * stored_samples
    memory += _VARIANT_BYTES * variants + _RUN_BYTES * runs
    if study.passes is not None and study.is_active(*keys_acting_as("process", "quantum")):
        read_samples = max(span.records_read for span in study.distinct_spans) * study.record_every
        draws = min(study.n_draws, LANES * STACKED_TILES) * runtime.usable_cores()
        memory += _KEPT_BYTES * read_samples * draws
    run_bytes = _row_bytes(study, schemas.summary_columns(study))
    if curves:
        run_bytes += records * _row_bytes(study, schemas.curve_columns(study))
        memory += _RECORD_BYTES * min(runs * records, max(CHUNK_RECORDS, 2 * records))
    methods, programs = [METHODS[name] for name in study.methods], _count_programs(study)
    compile_s = sum(method.compile_s for method in methods) / len(methods)
    if study.is_active(*_PROCESS_KEYS):
        compile_s += _PROCESS_COMPILE_S
    return Forecast(
        runs=runs,
        least_runs=runs,
        length_s=samples / study.rate_hz,
        run_s=samples * max(method.step_s for method in methods),
        run_bytes=run_bytes,
        memory=memory,
        programs=programs,
        compile_s=programs * compile_s,
    )


def _count_programs(study: Study) -> int:
    """Return the number of programs, from the swept keys that decide them, by value or by zero."""
    count = len({span.records for span in study.distinct_spans})
    for dimension in study.dimensions:
        columns = [
            values if key in PROGRAM_KEYS else map(np.any, values)
            for key, values in dimension.items()
            if key in PROGRAM_KEYS or key in _SWITCH_KEYS
        ]
        count *= len(set(zip(*columns, strict=True))) or 1
    return count


def _row_bytes(study: Study, columns: Iterable[Column]) -> float:
    """Return the disk space per row, bytes; only continuous numbers count, others compress well."""
    numbers = sum(
        NUMBERS_DRAWN.get(column.name, 1)
        for column in columns
        if column.name in study.drawn_keys
        or (pa.types.is_floating(column.dtype) and column.name not in study.axis_keys)
    )
    return 8 * _COMPRESSION_RATIO * numbers


def format_bytes(count: float) -> str:
    """Return a number of bytes as text."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 999.5:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB" if count < 1e5 else f"{count:.1e} TB"


def _format_duration(seconds: float) -> str:
    for limit, unit, name in ((100, 1, "s"), (6000, 60, "min"), (360_000, 3600, "h")):
        if seconds < limit:
            return f"{max(1, math.ceil(seconds / unit))} {name}"
    return f"{math.ceil(seconds / 86400):,} days"
