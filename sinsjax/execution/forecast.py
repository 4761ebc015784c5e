"""Forecast of a study's runs, time, memory and disk space, before anything is created.

The estimates are rough and use only the lengths of the axes, so a study of a billion runs is
forecast, and rejected, as fast as one of three runs.
"""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from sinsjax.columns import Column
from sinsjax.engine.batch import CHUNK_RECORDS, LANES, STACKED_TILES
from sinsjax.engine.scenario import MOST_STORED_SAMPLES, PROGRAM_KEYS
from sinsjax.errors import InputError
from sinsjax.execution import schemas, stopping
from sinsjax.execution.directory import find_manifest
from sinsjax.messages import format_count
from sinsjax.methods.filters.keys import SCHEDULE_KEYS
from sinsjax.methods.registry import METHODS
from sinsjax.platform import machine, runtime
from sinsjax.study.schema import NUMBERS_DRAWN, keys_acting_as
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study

_COMPRESSION_RATIO = 0.8
"""Compression ratio of 8-byte numbers in Parquet: 0.6 to 0.95 on sweeps with and without nulls."""

_BASE_BYTES, _SAMPLE_BYTES, _VARIANT_BYTES, _RUN_BYTES, _RECORD_BYTES, _RESET_BYTES = (
    400e6,
    160,
    600,
    2,
    500,
    60,
)
"""Measured memory, bytes: of a process with JAX, and per sample, variant, run, record, reset."""

_START_S, _COMPILE_S = 3.0, 6.0
"""Measured times, s: to import, read and report, and to compile one program (5 to 8)."""

_DESCENT_PROGRAMS = 3
"""Programs of the descents of a combination: of the start points, the gradient and the ends."""

_DESCENT_SAMPLE_S = 15e-6
"""Measured time of a sample of a descent's step, s: its few runs take turns (13 to 20 us)."""

_TRACE_S = 2.0
"""Measured time to trace a gradient, s."""

_SWITCH_KEYS = keys_acting_as("noise", "distortion", "sway", "process")
"""Keys that simplify the program if they are zero."""

_MEASUREMENT_BYTES = 48  # bytes, of the stored samples of a call's draws

_BLOCK_BYTES = 8 * 17  # bytes, of a second that a run keeps for a fit

_POINT_BYTES = 2000  # bytes for each point of a search


class Batch(NamedTuple):
    """Runs whose results are stored in one directory.

    Attributes:
        name: subdirectory of the results directory; empty for that directory itself.
        runs: number of runs, at most.
        least_runs: number of runs, at least, if the study may stop early.
        variants: number of variants.
        points: number of points of a search.
    """

    name: str
    runs: int
    least_runs: int
    variants: int
    points: int = 0


class Forecast(NamedTuple):
    """Rough requirements of a study.

    Attributes:
        batches: batches of runs.
        run_bytes: disk space per run, bytes.
        run_s: time per run on one core, s.
        memory: peak memory, bytes.
        may_stop_early: whether the study may stop early.
        length_s: length of the longest run, s.
        programs: number of programs to compile, unless they are in the compile cache.
        descents_s: time of the steps of descents, which do not fill the cores, s.
        start_s: time to import, trace, read and report, s.
    """

    batches: tuple[Batch, ...]
    run_bytes: float
    run_s: float
    memory: float
    may_stop_early: bool
    length_s: float
    programs: int = 1
    descents_s: float = 0.0
    start_s: float = _START_S

    @property
    def runs(self) -> int:
        """Total number of runs."""
        return sum(batch.runs for batch in self.batches)

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
        duration = _format_duration(remaining * self.run_s / cores + self.descents_s)
        prefix = "At most " if self.may_stop_early else ""
        processors = format_count(cores, "worker thread" if threads else "core")
        programs = format_count(self.programs, "program")
        first_s = self.start_s + self.programs * _COMPILE_S
        first_time = f"{_format_duration(first_s)} the first time"
        return (
            f"{prefix}{runs}: roughly {duration} on {processors}, and"
            f" {_format_duration(self.start_s)} to start ({first_time},"
            f" which compiles {programs}), {format_bytes(self.memory)} of memory,"
            f" {format_bytes(remaining * self.run_bytes)}{' more' if done else ''} on disk"
        )


def forecast_sweep(study: Study, curves: bool | None = None) -> Forecast:
    """Return the forecast of a sweep.

    Args:
        study: checked study, whose rate is known.
        curves: whether to keep curves; None follows the study.
    """
    least_draws = min(study.n_draws, stopping.FIRST_INTERIM) if study.stop_when else study.n_draws
    variants = study.n_variants
    batch = Batch("", study.n_draws * variants, least_draws * variants, variants)
    return _forecast_batches(study, [batch], study.study.curves if curves is None else curves)


def forecast_tuning(study: Study, curves: bool | None = None) -> Forecast:
    """Return the forecast of a tuning run, which keeps no curves.

    The cost of a descent's steps is a rough guess.
    """
    tune = study.tune
    assert tune is not None
    if study.record:
        draws, evaluation_draws = (study.n_draws + 1) // 2, study.n_draws // 2
    else:
        draws, evaluation_draws = tune.tune_draws or 1, tune.evaluation_draws or 1
    space, variants = SearchSpace.from_study(study), study.n_variants
    free_keys = [len(space.used_variables(combination)) for combination in space.combinations]
    # The schedule by the law is one more point of each, if it exists.
    laws = len(free_keys) * any(v.key in SCHEDULE_KEYS for v in space.variables)
    points = {
        "grid": sum(tune.grid_points**count for count in free_keys) + laws,
        "sobol": tune.sobol_points * len(free_keys) + laws,
    }
    # A gradient stores its history alone.
    points_by_name = {s: max(1, points[s]) for s in tune.searches if s in points}
    batches = [
        Batch(name, n * variants * draws, n * variants * draws, n * variants, n)
        for name, n in points_by_name.items()
    ]
    candidates = (len(tune.searches) + 1 + bool(laws)) * variants
    batches.append(
        Batch(
            "evaluation", candidates * evaluation_draws, candidates * evaluation_draws, candidates
        )
    )
    forecast = _forecast_batches(study, batches, False)
    programs = forecast.programs
    descents = programs * len(free_keys) * ("gradient" in tune.searches)
    steps = descents * tune.descent_steps * forecast.length_s * study.rate_hz
    return forecast._replace(
        programs=programs + descents * _DESCENT_PROGRAMS,
        descents_s=steps * _DESCENT_SAMPLE_S,
        start_s=_START_S + descents * _TRACE_S,
    )


def check_resources(
    study: Study, forecast: Forecast, directory: Path | None, *, overwrite: bool, resume: bool
) -> None:
    """Reject a study that exceeds disk or memory; a resumed one needs only its missing runs.

    Args:
        study: checked study.
        forecast: forecast of the study.
        directory: results directory; None for tables in memory.
        overwrite: whether existing results are removed first.
        resume: whether existing results are kept.

    Raises:
        InputError: states what is needed and what is available.
    """
    if directory is not None:
        _check_disk_space(forecast, directory, overwrite=overwrite, resume=resume)
    available = machine.available_memory_bytes()
    if forecast.memory > available:
        raise InputError(
            f"{study.name}: {forecast.runs:,} runs need about {format_bytes(forecast.memory)} of"
            f" memory, but this machine has only {format_bytes(available)}"
        )


def _check_disk_space(
    forecast: Forecast, directory: Path, *, overwrite: bool, resume: bool
) -> None:
    needed = 0.0
    for batch in forecast.batches:
        done = count_stored_runs(directory / batch.name) if resume else 0
        needed += max(0, batch.least_runs - done) * forecast.run_bytes
    available = machine.free_disk_bytes(directory)
    if overwrite:
        available += _total_part_bytes(directory / batch.name for batch in forecast.batches)
    if needed > available:
        raise InputError(
            f"{directory}: the results of {forecast.runs:,} runs need about"
            f" {format_bytes(needed)}, but the disk has only {format_bytes(available)} free"
        )


def _forecast_batches(study: Study, batches: Sequence[Batch], curves: bool) -> Forecast:
    records = max(span.records for span in study.distinct_spans)
    samples = records * study.record_every
    methods = [METHODS[name] for name in study.methods]
    step_s = max(method.step_s for method in methods)
    run_bytes = _row_bytes(study, schemas.summary_columns(study))
    # Longer simulations do not store their increments.
    stored_samples = samples if study.is_recorded else min(samples, MOST_STORED_SAMPLES)
    memory = _BASE_BYTES + _SAMPLE_BYTES * stored_samples
    alternates = study.passes is not None and any(not s.rewinds for s in study.distinct_spans)
    if alternates and study.sequential_keys:
        read_samples = max(span.records_read for span in study.distinct_spans) * study.record_every
        draws = min(study.n_draws, LANES * STACKED_TILES) * runtime.usable_cores()
        memory += _MEASUREMENT_BYTES * read_samples * draws
    if any(METHODS[name].program.block_fit for name in study.methods):
        blocks = study.run_s * LANES * runtime.usable_cores()  # one per second or less
        memory += _BLOCK_BYTES * blocks
    counts = study.combinations("reset_count") if study.has("resets") else ()
    resets = [point["reset_count"] or 0 for point in counts]
    variant_bytes = _VARIANT_BYTES + _RESET_BYTES * max(resets, default=0)
    memory += max(
        variant_bytes * b.variants + _RUN_BYTES * b.runs + _POINT_BYTES * b.points for b in batches
    )
    if curves:
        run_bytes += records * _row_bytes(study, schemas.curve_columns(study))
        curve_records = max(batch.runs for batch in batches) * records
        memory += _RECORD_BYTES * min(curve_records, max(CHUNK_RECORDS, 2 * records))
    length_s = samples / study.rate_hz
    replays_s = (
        p["coarse_duration_s"] for p in study.coarse_stages if p["coarse_then"] == "replay"
    )
    steps = samples + max(replays_s, default=0.0) * study.rate_hz
    may_stop_early = study.stop_when is not None
    return Forecast(
        tuple(batches),
        run_bytes,
        steps * step_s,
        memory,
        may_stop_early,
        length_s,
        _count_programs(study),
    )


def _count_programs(study: Study) -> int:
    """Return the number of programs, from the swept keys that decide them, by value or by zero."""
    kinds = {(span.records, span.rewinds) for span in study.distinct_spans}
    count = len(kinds)
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
    numbers = 0
    for column in columns:
        if column.name in study.drawn_keys:
            numbers += NUMBERS_DRAWN[column.name]
        elif pa.types.is_floating(column.dtype) and column.name not in study.axis_keys:
            numbers += 1
    return 8 * _COMPRESSION_RATIO * numbers


def count_stored_runs(directory: Path) -> int:
    """Return the number of runs with stored results."""
    manifest = find_manifest(directory)
    return manifest.runs_done if manifest else 0


def _total_part_bytes(directories: Iterable[Path]) -> int:
    parts = (p for d in directories for p in d.glob("*/part-*.parquet"))
    return sum(path.stat().st_size for path in parts)


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
