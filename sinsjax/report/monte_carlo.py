"""The report of any study: statistics of its variants, curves, and figures over its axes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_difference, format_estimate
from sinsjax.analysis.formats import format_heading_error, format_percent
from sinsjax.analysis.references import compare_with_first_group
from sinsjax.analysis.summaries import REQUIRED_COLUMNS, read_estimate
from sinsjax.columns import report_time_columns
from sinsjax.execution.results import Results
from sinsjax.methods.registry import METHODS
from sinsjax.plots.curves import select_runs_by_line
from sinsjax.plots.labels import describe_point
from sinsjax.report.attitude import attitude_table, attitude_verdict
from sinsjax.report.axis_figures import build_axis_figures, repeated_variants_note
from sinsjax.report.base import (
    MAX_ROWS,
    MIN_DRAWS_FOR_INTERVALS,
    Block,
    Fact,
    Picture,
    Report,
    Table,
    build_table,
    describe_intervals,
)
from sinsjax.report.consistency import consistency_blocks, covariance_cautions
from sinsjax.report.grouping import BINS_NOTE, bin_drawn_keys
from sinsjax.report.level import level_verdict
from sinsjax.report.verdict import SweepOutcome, describe_held_out, sweep_verdict
from sinsjax.study.keys import is_condition_key
from sinsjax.study.success import success_columns, success_measures

_END = "phi_u_arcmin"


def build_report(
    source: Results, *, with_tables: bool = True, warnings_shown: bool = False
) -> Report:
    """The verdict and the figures of a study, and all tables if they are wanted.

    Args:
        source: the results.
        with_tables: whether to compute the tables.
        warnings_shown: whether the user has seen the study's warnings.

    Raises:
        InputError: runs are missing.
    """
    assert source.draws  # raises if draws are missing
    yaw = analysis.numeric_column(source.rows(["phi_u_arcmin"]), "phi_u_arcmin")
    has_truth = bool(np.isfinite(yaw).any())
    needs_attitude = source.study.is_recorded or not has_truth
    blocks: list[Block] = [*_curve_figures(source)]
    if has_truth:
        blocks += [*build_axis_figures(source), *consistency_blocks(source)]
    if with_tables and needs_attitude:
        blocks.append(attitude_table(source))
    if with_tables and has_truth:
        blocks += [*repeated_variants_note(source), *_all_tables(source)]
    build_verdict = attitude_verdict if needs_attitude else sweep_verdict
    if not any(METHODS[name].finds_heading for name in source.study.methods):
        build_verdict = level_verdict
    verdict = build_verdict(source, warnings_shown=warnings_shown)
    facts = [*verdict.facts, *_program_facts(source), *covariance_cautions(source)]
    return verdict._replace(facts=facts, blocks=blocks)


def _program_facts(source: Results) -> Iterator[Fact]:
    """Yield heading error and success of each program outside sinsjax."""
    if not source.study.study.external:
        return
    criterion = source.success_measures[0]
    table = source.rows(["method", *REQUIRED_COLUMNS, *success_columns(source.study)])
    names = [f"{_END}_rms", criterion.rate_column]
    for row in analysis.summarise(table, ["method"], names).to_pylist():
        if row["method"] in source.study.study.external:
            error = format_heading_error(read_estimate(row, names[0]))
            share = format_percent(read_estimate(row, names[1]))
            text = f"{error}' rms from true north, {share} % {criterion.description}"
            yield Fact("Program", f"{row['method']}: {text}")


def statistics_table(source: Results, keys: Sequence[str], title: str, *, note: str = "") -> Table:
    """Return the statistics of each group of runs that share some keys, as a table."""
    columns = _statistic_columns(source)
    table = source.distinct_rows([*keys, *REQUIRED_COLUMNS, *success_columns(source.study)])
    rows = analysis.summarise(table, keys, [column.name for column in columns]).to_pylist()
    cells = [
        ("runs", lambda row: str(row["n"])),
        *((column.header, column.format_cell) for column in columns),
    ]
    return build_table(title, keys, rows, cells, note)


class _StatisticColumn(NamedTuple):
    """A column of statistics in a table: its header, the statistic, and its format."""

    header: str
    name: str
    format_value: Callable[[Estimate], str]
    needs_floor: bool = False  # whether it counts from the bias floor

    def format_cell(self, row: Mapping[str, Any]) -> str:
        """Return the statistic as text from a row of `analysis.summarise`."""
        if self.needs_floor and row["no_floor"] == row["n"]:
            return "no bias floor"
        return self.format_value(read_estimate(row, self.name))


def _statistic_columns(source: Results) -> list[_StatisticColumn]:
    """Return the columns of success, settling time and heading error, by each criterion."""
    seconds, arcmin = (partial(format_estimate, digits=digits) for digits in (0, 1))
    yards = source.success_measures
    missing = [yard for yard in success_measures(source.study) if yard not in yards]
    aim = "the reference" if source.study.is_recorded else "its bias floor"
    return [
        *(
            _StatisticColumn(f"ok: {y.description} (%)", y.rate_column, format_percent, not y.truth)
            for y in yards
        ),
        *(
            _StatisticColumn(f"ok: {y.description} (%)", y.rate_column, lambda _: "no bias floor")
            for y in missing
        ),
        *(
            _StatisticColumn(
                f"time to {y.description}, median (s)",
                f"{y.settle_column}_median",
                seconds,
                not y.truth,
            )
            for y in yards
        ),
        _StatisticColumn(
            "heading error at the end, rms (arcmin)", f"{_END}_rms", format_heading_error
        ),
        _StatisticColumn(
            f"signed mean from {aim} (arcmin)", "phi_u_from_floor_arcmin_mean", arcmin, True
        ),
    ]


def heading_error_table(source: Results, keys: Sequence[str], title: str) -> Table:
    """Return the heading errors from the truth, at each report time and at the end, as a table."""
    times_s = source.study.study.report_times_s or ()
    times = {report_time_columns(time)[0].name: f"{time:g} s" for time in times_s} | {
        _END: "the end"
    }
    table = source.distinct_rows([*keys, *REQUIRED_COLUMNS, *times])
    cells = [
        ("runs", lambda row: str(row["n"])),
        ("at", lambda row: row["at"]),
        ("rms", lambda row: format_heading_error(row["rms"])),
        ("90 % of the runs below", lambda row: format_heading_error(row["q90"])),
    ]
    rows = list(analysis.heading_error_statistics(table, keys, times))
    unbounded = (
        any(np.isnan(row["q90"].high) for row in rows) and source.draws >= MIN_DRAWS_FOR_INTERVALS
    )
    few = f" {analysis.FEW_DRAWS!r}: too few to bound it."
    note = (
        f"{describe_intervals(source)}{few if unbounded and not source.study.is_recorded else ''}"
    )
    return build_table(title, keys, rows, cells, note, max_rows=MAX_ROWS * len(times))


def first_variant_comparison_table(source: Results) -> Table:
    """Return the difference of each variant from the first under the same conditions, by draw."""
    keys, yards = source.study.keys_shown, source.success_measures
    table = source.distinct_rows([*keys, *REQUIRED_COLUMNS, *success_columns(source.study)])
    condition_keys = [key for key in keys if is_condition_key(key)]
    first, rows = compare_with_first_group(table, keys, condition_keys)
    compared = [
        dimension for dimension in source.study.dimensions if first.keys() & dimension.keys()
    ]
    swept = [
        (key, values)
        for dimension in compared
        for key, values in dimension.items()
        if is_condition_key(key)
    ]
    mixed = [key for key, values in swept if any(column != values[0] for column in values)]
    times = partial(format_difference, digits=0, sides=("it", "the first"))
    columns = [
        *(
            _StatisticColumn(
                f"ok: {y.description} (% points)", f"{y.rate_column}_difference", format_percent
            )
            for y in yards
        ),
        *(
            _StatisticColumn(
                f"time to {y.description}, median (s)",
                f"{y.settle_column}_median_difference",
                times,
            )
            for y in yards
        ),
        _StatisticColumn(
            "distance from its bias floor (arcmin)",
            "phi_u_error_arcmin_difference",
            format_estimate,
        ),
    ]
    shared = "from the same start times" if source.study.is_recorded else "on the same noise"
    same = "" if mixed or not condition_keys else f" with the same {' and '.join(condition_keys)}"
    pairs = describe_intervals(source, "pairs of runs of a draw", "Difference")
    reference_only = (
        " The first variant is a reference only: variants also differ from it in"
        f" {' and '.join(mixed)}, the conditions of a run."
        if mixed
        else ""
    )
    return build_table(
        f"Against {describe_point(first)}{same}, {shared}",
        keys,
        rows,
        [(column.header, column.format_cell) for column in columns],
        f"{pairs} Distance: that of the window mean of phi_u.{reference_only}",
    )


def _all_tables(source: Results) -> Iterator[Block]:
    """Yield the tables of all variants, or of each key, which pools the others."""
    study = source.study
    held_out = "" if study.is_recorded else describe_held_out(SweepOutcome.from_source(source))
    if held_out:
        yield f"{held_out[0].upper()}{held_out[1:]} (each half of the draws chooses for the other)."
    start, end = study.study.window_s
    keys = study.keys_shown
    title = f"Heading error from {'the reference' if study.is_recorded else 'true north'}, arcmin"
    note = (
        f"{describe_intervals(source)} 'never': did not settle. Signed mean: over {start:g} to"
        f" {end:g} s."
    )
    if study.n_variants <= MAX_ROWS:
        yield heading_error_table(source, keys, title)
        yield statistics_table(source, keys, "Every variant", note=note)
        yield from _drawn_key_tables(source, keys)
        if study.n_variants > 1 and source.draws > 1:
            yield first_variant_comparison_table(source)
        return
    yield f"{study.n_variants:,} variants: each table has one key and pools the others."
    yield from (heading_error_table(source, [key], f"{title}, by {key}") for key in keys)
    yield from (statistics_table(source, [key], f"By {key}", note=note) for key in keys)
    yield from _drawn_key_tables(source, keys)


def _drawn_key_tables(source: Results, keys: Sequence[str]) -> Iterator[Table]:
    """The statistics of bins of each drawn number, of every variant if these are few."""
    for key, (binned_source, medians) in bin_drawn_keys(source).items():
        few = len(medians) * source.study.n_variants <= MAX_ROWS
        note = "" if few or not keys else " All variants together."
        note = f"{key}: {BINS_NOTE} {describe_intervals(source)}{note}"
        yield statistics_table(
            binned_source, [key, *(keys if few else ())], f"Over {key}, drawn", note=note
        )


def _curve_figures(source: Results) -> Iterator[Block]:
    """Misalignment, or attitude, over time: the first few variants."""
    if not source.has_curves:
        return
    keys = source.study.keys_shown
    floor = () if source.study.is_recorded else ("floor_arcmin",)  # a record's biases are unknown
    table = source.distinct_rows([*keys, "run_id", "reset_times_s", *floor])
    runs = select_runs_by_line(table, keys)
    curves = source.read_curves(run for ids in runs.values() for run in ids)
    if curves.num_rows == 0:
        return
    count = max(map(len, runs.values()))
    caption = f"Mean of {count} runs" if count > 1 else "One run each"
    if left := sum(1 for _ in analysis.group_rows(table.select(keys), keys)) - len(runs):
        caption += f" (the first {len(runs)} variants; {left} more are not drawn)"
    has_sigma = np.isfinite(analysis.numeric_column(curves, "sigma_e_arcmin")).any()
    note = "; shading: 95 % of them" if count > 1 else ""
    note += "; dashed: the filter's own 1 sigma" if has_sigma else ""
    if not np.isfinite(analysis.numeric_column(curves, "phi_e_arcmin")).any():
        yield Picture("attitude", f"{caption}{note}.", plots.plot_curves(curves, table, by=keys))
        return
    if np.isfinite(analysis.numeric_column(curves, "phi_u_arcmin")).any():
        figure = plots.plot_curves(curves, table, by=keys)
        caption_heading = caption.replace("Mean", "Rms", 1)
        yield Picture("misalignment", f"{caption_heading}{note}.", figure)
    figure = plots.plot_curves(curves, table, by=keys, level=True)
    yield Picture("misalignment_level", f"{caption}{note}.", figure)
