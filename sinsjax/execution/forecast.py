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
from rich.filesize import decimal

from sinsjax.columns import Column
from sinsjax.engine.batch import CHUNK_RECORDS, LANES, MOST_PROGRAMS, STACKED_TILES
from sinsjax.engine.scenario import MOST_STORED_SAMPLES, PROGRAM_KEYS
from sinsjax.errors import InputError
from sinsjax.execution import tables
from sinsjax.messages import format_count
from sinsjax.methods.registry import METHODS
from sinsjax.platform import machine, runtime
from sinsjax.study.schema import NUMBERS_DRAWN, keys_acting_as
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study

# Measured times, s: to import, trace and report; to compile random processes, beyond the method;
# of a descent's step per sample, which few runs take in turn; to trace a descent.
_START_S, _PROCESS_COMPILE_S, _DESCENT_SAMPLE_S, _TRACE_S = 4.0, 3.0, 15e-6, 2.0

# Measured memory, bytes: of a process with JAX, and per program and core, sample, variant, run, row
# of curves, sample that a draw keeps for further passes, and point of a search.
_BASE_BYTES, _PROGRAM_BYTES, _SAMPLE_BYTES, _VARIANT_BYTES, _RUN_BYTES = 340e6, 30e6, 160, 600, 2
_RECORD_BYTES, _KEPT_BYTES, _POINT_BYTES = 500, 48, 2000

_NUMBER_BYTES = 6.4  # on disk: 0.6 to 0.95 of eight, with and without nulls
_DESCENT_PROGRAMS = 3  # of a descent: of the start points, the gradient and the ends
_SWITCH_KEYS = keys_acting_as("noise", "distortion", "sway", "process")
"""Keys that simplify the program if they are zero."""


class Forecast(NamedTuple):
    """Rough requirements of a study."""

    runs: int  # at most
    length_s: float  # of the longest run
    run_s: float  # time per run on one core
    run_bytes: float  # disk space per run
    memory: float  # peak, bytes
    programs: int  # to compile, unless they are in the compile cache
    compile_s: float  # of all programs on one core
    start_s: float = _START_S  # which more cores do not shorten

    def describe(self, cores: int) -> str:
        """Return one line for a user: what all runs cost."""
        later_s = self.start_s + self.runs * self.run_s / cores
        first_s = later_s + self.compile_s / min(cores, self.programs)
        return (
            f"{format_count(self.runs, 'run')} of up to {self.length_s:g} s: roughly"
            f" {_format_duration(later_s)} on {format_count(cores, 'core')}"
            f" ({_format_duration(first_s)} the first time, which compiles"
            f" {format_count(self.programs, 'program')}), {decimal(int(self.memory))} of memory,"
            f" {decimal(int(self.runs * self.run_bytes))} on disk."
        )


def forecast_sweep(study: Study, curves: bool | None = None) -> Forecast:
    """Return the forecast of a sweep; ``curves = None`` follows the study."""
    kept = study.study.curves if curves is None else curves
    return _forecast_runs(study, study.n_variants, study.n_draws * study.n_variants, curves=kept)


def forecast_tuning(study: Study) -> Forecast:
    """Return the forecast of a tuning run: its searches, then the evaluation of the best points.

    Schedules by the law are not counted, and the cost of a descent's steps is a rough guess.
    """
    tune, draws = study.tune, ((study.n_draws + 1) // 2, study.n_draws // 2)
    assert tune is not None
    if not study.record:
        draws = tune.tune_draws or 1, tune.evaluation_draws or 1
    space, variants = SearchSpace.from_study(study), study.n_variants
    free_keys = [len(space.used_variables(combination)) for combination in space.combinations]
    # A gradient stores its history alone.
    sizes = {"grid": sum(tune.grid_points**count for count in free_keys)}
    sizes["sobol"] = tune.sobol_points * len(free_keys)
    points = [sizes.get(name, 0) for name in tune.searches]
    most, candidates = max(points), len(tune.searches) + 1
    runs = variants * (sum(points) * draws[0] + candidates * draws[1])
    found = _forecast_runs(study, variants * max(most, candidates), runs, curves=False)
    descents = found.programs * len(free_keys) * ("gradient" in tune.searches)
    programs = found.programs + descents * _DESCENT_PROGRAMS
    steps = descents * tune.descent_steps * found.length_s * study.rate_hz
    return found._replace(
        memory=found.memory + _POINT_BYTES * most,
        programs=programs,
        compile_s=found.compile_s * programs / found.programs,
        start_s=_START_S + descents * _TRACE_S + steps * _DESCENT_SAMPLE_S,
    )


def check_resources(name: str, forecast: Forecast, directory: Path | None) -> None:
    """Refuse a study that exceeds this machine's memory, or the disk of its new results."""
    needs = [(name, "memory", forecast.memory, machine.available_memory_bytes())]
    if directory is not None:
        needed, free = forecast.runs * forecast.run_bytes, machine.free_disk_bytes(directory)
        needs.append((str(directory), "disk space", needed, free))
    for where, kind, needed, available in needs:
        if needed > available:
            text = f"{forecast.runs:,} runs need about {decimal(int(needed))} of {kind}"
            raise InputError(f"{where}: {text}, but there are only {decimal(int(available))}")


def _forecast_runs(study: Study, variants: int, runs: int, *, curves: bool) -> Forecast:
    """Return the forecast of some runs of a study's lengths and methods, at once."""
    records = max(span.records for span in study.distinct_spans)
    samples = records * study.record_every
    # Longer simulations do not store their increments.
    stored_samples = samples if study.is_recorded else min(samples, MOST_STORED_SAMPLES)
    methods, programs = [METHODS[name] for name in study.methods], _count_programs(study)
    kept_programs = min(programs * runtime.usable_cores(), MOST_PROGRAMS)
    memory = _BASE_BYTES + _PROGRAM_BYTES * kept_programs + _SAMPLE_BYTES * stored_samples
    memory += _VARIANT_BYTES * variants + _RUN_BYTES * runs
    if study.passes and study.is_active(*keys_acting_as("process", "quantum")):
        read_samples = max(span.records_read for span in study.distinct_spans) * study.record_every
        draws = min(study.n_draws, LANES * STACKED_TILES) * runtime.usable_cores()
        memory += _KEPT_BYTES * read_samples * draws
    run_bytes = _row_bytes(study, tables.summary_columns(study))
    if curves:
        run_bytes += records * _row_bytes(study, tables.curve_columns(study))
        memory += _RECORD_BYTES * min(runs * records, max(CHUNK_RECORDS, 2 * records))
    compile_s = sum(method.compile_s for method in methods) / len(methods)
    if study.is_active(*keys_acting_as("process")):
        compile_s += _PROCESS_COMPILE_S
    return Forecast(
        runs=runs,
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
    return _NUMBER_BYTES * sum(
        NUMBERS_DRAWN.get(column.name, 1)
        for column in columns
        if column.name in study.drawn_keys
        or (pa.types.is_floating(column.dtype) and column.name not in study.axis_keys)
    )


def _format_duration(seconds: float) -> str:
    for limit, unit, name in ((100, 1, "s"), (6000, 60, "min"), (360_000, 3600, "h")):
        if seconds < limit:
            return f"{max(1, math.ceil(seconds / unit))} {name}"
    return f"{math.ceil(seconds / 86400):,} days"
