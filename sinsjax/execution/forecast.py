"""Forecast of a study's runs, time, memory and disk space, before anything is created.

The estimates are rough and use only the lengths of the axes, so that a study of a billion runs is
forecast, and rejected, as fast as one of three.
"""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from sinsjax.columns import Column
from sinsjax.engine.batch import CHUNK_RECORDS
from sinsjax.engine.build import PROGRAM_KEYS
from sinsjax.engine.lanes import LANES, STACKED_TILES
from sinsjax.engine.simulator import AMPLITUDES, DISTORTIONS, NOISES, OF_DISTURBANCES
from sinsjax.engine.truth import MOST_STORED_SAMPLES
from sinsjax.errors import InputError
from sinsjax.execution import layouts, stopping
from sinsjax.execution.directory import find_manifest
from sinsjax.messages import format_count
from sinsjax.methods.registry import METHODS
from sinsjax.platform import machine, runtime
from sinsjax.study.schema import NUMBERS_DRAWN
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study

_PACKED = 0.8
"""Compression ratio of 8-byte numbers in Parquet: 0.6 to 0.95 on sweeps with and without nulls."""

_BASE, _A_SAMPLE, _A_VARIANT, _A_RUN, _A_RECORD, _A_RESET = 400e6, 160, 600, 2, 500, 60
"""Measured memory, bytes: of a process with JAX, and of each of these."""

_START_S, _COMPILE_S = 3.0, 6.0
"""Measured time on a core of two: to import, read and report, and to compile a program (5 to 8)."""

_SWITCHES = {*NOISES, *DISTORTIONS, *AMPLITUDES, *OF_DISTURBANCES}
"""Keys without which a program does less, where they are zero."""

_CHECK = 12.0
"""Cost of the draws that tell how far covariance analysis holds for a variant, in plain runs."""

_A_MEASUREMENT = 48  # bytes, of the draws of a call whose records are kept

_A_POINT = 2000  # bytes for each point of a search


class Batch(NamedTuple):
    """Runs whose results are stored in one directory.

    Attributes:
        name: subdirectory of the results directory; empty for that directory itself.
        runs: number of runs, at most.
        sure: number of runs, at least, if the study may stop early.
        variants: number of variants.
        points: number of points of a search.
    """

    name: str
    runs: int
    sure: int
    variants: int
    points: int = 0


class Forecast(NamedTuple):
    """Rough requirements of a study.

    Attributes:
        batches: batches of runs.
        run_bytes: disk space per run, bytes.
        run_s: time per run on one core, s.
        memory: peak memory, bytes.
        at_most: whether the study may stop early.
        length_s: length of the longest run, s.
        noise_free: whether runs are without noise, one a variant.
        programs: number of programs to compile, unless they are in the compile cache.
    """

    batches: tuple[Batch, ...]
    run_bytes: float
    run_s: float
    memory: float
    at_most: bool
    length_s: float
    noise_free: bool = False
    programs: int = 1

    @property
    def runs(self) -> int:
        """Total number of runs."""
        return sum(batch.runs for batch in self.batches)

    def describe(self, cores: int, done: int = 0, *, threads: bool = False) -> str:
        """One line for a user, with the time that is left, or that nothing is left.

        Args:
            cores: number of cores that share the runs.
            done: number of runs whose results are there.
            threads: whether the cores are threads of workers, of whatever kind.
        """
        kind = "noise-free run" if self.noise_free else "run"
        runs = f"{format_count(self.runs, kind)} of up to {self.length_s:g} s"
        left = max(0, self.runs - done)
        if not left:
            return f"{runs}: nothing is left to run"
        if done:
            runs += f", {left:,} left"
        takes = _time(left * self.run_s / cores)
        most = "At most " if self.at_most else ""
        on = format_count(cores, "worker thread" if threads else "core")
        programs = format_count(self.programs, "program")
        first = f"{_time(_START_S + self.programs * _COMPILE_S)} the first time"
        return (
            f"{most}{runs}: roughly {takes} on {on}, and {_time(_START_S)} to start ({first},"
            f" which compiles {programs}), {_size(self.memory)} of memory,"
            f" {_size(left * self.run_bytes)}{' more' if done else ''} on disk"
        )


def of(study: Study, curves: bool | None = None) -> Forecast:
    """Forecast of a sweep.

    Args:
        study: checked study, whose rate is known.
        curves: whether to keep curves; None follows the study.
    """
    sure = min(study.n_draws, stopping.FIRST_INTERIM) if study.stop_when else study.n_draws
    variants = study.n_variants
    batch = Batch("", study.n_draws * variants, sure * variants, variants)
    return _forecast(study, [batch], study.study.curves if curves is None else curves)


def of_tuning(study: Study, curves: bool | None = None) -> Forecast:
    """Return the forecast of a tuning run, which keeps no curves.

    The cost of a descent's steps is only a guess.
    """
    tune = study.tune
    assert tune is not None
    if study.record:
        draws, judging = (study.n_draws + 1) // 2, study.n_draws // 2
    else:
        draws, judging = tune.tune_draws or 1, tune.evaluation_draws or 1
    space, variants = SearchSpace.from_study(study), study.n_variants
    free = [len(space.used(combination)) for combination in space.combinations]
    points = {
        "grid": sum(tune.grid_points**count for count in free),
        "sobol": tune.sobol_points * len(free),
        "random": tune.sobol_points * len(free),
        "gradient": tune.descent_starts * tune.descent_steps * (2 + max(free)),
    }
    # A search by covariance analysis keeps its history alone.
    kept = [search for search in tune.searches if search != "covariance"]
    wanted = {("equal_cost" if s == "gradient" else s): points[s] for s in kept}
    wanted = {name: max(1, count) for name, count in wanted.items()}
    batches = [
        Batch(name, n * variants * draws, n * variants * draws, n * variants, n)
        for name, n in wanted.items()
    ]
    found = (len(wanted) + 1 + (len(kept) < len(tune.searches))) * variants
    batches.append(Batch("evaluation", found * judging, found * judging, found))
    forecast = _forecast(study, batches, False)
    # A descent has programs of its own.
    return forecast._replace(programs=forecast.programs * (1 + ("gradient" in tune.searches)))


def require_room(
    study: Study, forecast: Forecast, directory: Path | None, *, overwrite: bool, resume: bool
) -> None:
    """Reject a study that exceeds the disk or the memory; a resumed one needs only missing runs.

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
        _require_disk(forecast, directory, overwrite=overwrite, resume=resume)
    there = machine.available_memory_bytes()
    if forecast.memory > there:
        raise InputError(
            f"{study.name}: {forecast.runs:,} runs need about {_size(forecast.memory)} of memory,"
            f" but this machine has only {_size(there)}"
        )


def _require_disk(forecast: Forecast, directory: Path, *, overwrite: bool, resume: bool) -> None:
    need = 0.0
    for batch in forecast.batches:
        done = runs_done(directory / batch.name) if resume else 0
        need += max(0, batch.sure - done) * forecast.run_bytes
    free = machine.free_disk_bytes(directory)
    if overwrite:
        free += _size_of_parts(directory / batch.name for batch in forecast.batches)
    if need > free:
        raise InputError(
            f"{directory}: the results of {forecast.runs:,} runs need about {_size(need)}, but the"
            f" disk has only {_size(free)} free"
        )


def _forecast(study: Study, batches: Sequence[Batch], curves: bool) -> Forecast:
    records = max(span.records for span in study.distinct_spans)
    samples = records * study.record_every
    methods = [METHODS[name] for name in study.methods]
    step_s = max(method.step_s for method in methods)
    if study.is_estimated:
        checks = _CHECK * study.checks_linearity
        step_s = max(method.step_s * (method.estimate_runs + checks) for method in methods)
    layout = layouts.estimates(study) if study.is_estimated else layouts.summary(study)
    run_bytes = _row_bytes(study, layout)
    # Longer simulations do not keep their increments.
    kept = samples if study.is_recorded else min(samples, MOST_STORED_SAMPLES)
    memory = _BASE + _A_SAMPLE * kept
    alternates = study.passes is not None and any(not s.rewinds for s in study.distinct_spans)
    if alternates and study.requires_sequential:
        read = max(span.read for span in study.distinct_spans) * study.record_every
        draws = min(study.n_draws, LANES * STACKED_TILES) * runtime.usable_cores()
        memory += _A_MEASUREMENT * read * draws
    counts = study.combinations("reset_count") if study.has("resets") else ()
    resets = [point["reset_count"] or 0 for point in counts]
    of_variant = _A_VARIANT + _A_RESET * max(resets, default=0)
    memory += max(of_variant * b.variants + _A_RUN * b.runs + _A_POINT * b.points for b in batches)
    if curves:
        run_bytes += records * _row_bytes(study, layouts.curves(study))
        most = max(batch.runs for batch in batches) * records
        memory += _A_RECORD * min(most, max(CHUNK_RECORDS, 2 * records))
    length_s = samples / study.rate_hz
    again = (p["coarse_duration_s"] for p in study.coarse_stages if p["coarse_then"] == "replay")
    steps = samples + max(again, default=0.0) * study.rate_hz
    at_most = study.stop_when is not None
    return Forecast(
        tuple(batches),
        run_bytes,
        steps * step_s,
        memory,
        at_most,
        length_s,
        study.is_estimated,
        _programs(study),
    )


def _programs(study: Study) -> int:
    """Number of programs, by what is swept of the keys that decide them, or do so by being zero."""
    kinds = {(span.records, span.rewinds) for span in study.distinct_spans}
    count = len(kinds)
    for dimension in study.dimensions:
        columns = [
            values if key in PROGRAM_KEYS else map(np.any, values)
            for key, values in dimension.items()
            if key in PROGRAM_KEYS or key in _SWITCHES
        ]
        count *= len(set(zip(*columns, strict=True))) or 1
    return count


def _row_bytes(study: Study, columns: Iterable[Column]) -> float:
    """Disk space per row, from its continuous numbers; swept values and counts compress well."""
    numbers = 0
    for column in columns:
        if column.name in study.drawn_keys:
            numbers += NUMBERS_DRAWN[column.name]
        elif pa.types.is_floating(column.dtype) and column.name not in study.axis_keys:
            numbers += 1
    return 8 * _PACKED * numbers


def runs_done(directory: Path) -> int:
    """Return the number of runs with stored results."""
    known = find_manifest(directory)
    return known.runs_done if known else 0


def _size_of_parts(directories: Iterable[Path]) -> int:
    parts = (p for d in directories for p in d.glob("*/part-*.parquet"))
    return sum(path.stat().st_size for path in parts)


def _size(count: float) -> str:
    """A number of bytes as text."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 999.5:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB" if count < 1e5 else f"{count:.1e} TB"


def _time(seconds: float) -> str:
    for most, unit, name in ((100, 1, "s"), (6000, 60, "min"), (360_000, 3600, "h")):
        if seconds < most:
            return f"{max(1, math.ceil(seconds / unit))} {name}"
    return f"{math.ceil(seconds / 86400):,} days"
