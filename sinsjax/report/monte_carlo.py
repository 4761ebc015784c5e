"""The report of any study: its verdict, its figures, and statistics of its variants."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sinsjax import analysis
from sinsjax.analysis import format_estimate
from sinsjax.analysis.labels import (
    describe_point,
    format_heading_error,
    format_percent,
    format_time_difference,
    format_value,
)
from sinsjax.analysis.summaries import REQUIRED_COLUMNS
from sinsjax.columns import report_time_columns
from sinsjax.execution.results import Results
from sinsjax.report.attitude import final_attitude_and_sigma_table
from sinsjax.report.document import MAX_ROWS, Report, Table
from sinsjax.report.figures import describe_intervals, draw_figures
from sinsjax.report.verdict import build_short_report, find_outcome
from sinsjax.study.keys import is_condition_key
from sinsjax.study.study import Study
from sinsjax.study.success import success_columns, success_criteria, success_measures

_END = "phi_u_arcmin"
_SECONDS = partial(format_estimate, digits=0)


class _Column(NamedTuple):
    """A column of a table: its header, its statistic, and how that is written."""

    header: str
    name: str
    format: Callable[[Any], str]
    needs_floor: bool = False


def build_report(
    source: Results, *, with_tables: bool = True, warnings_shown: bool = False
) -> Report:
    """The verdict and the figures of a study, and all tables if they are wanted.

    ``warnings_shown`` means that the user has seen the study's warnings.
    """
    study, outcome = source.study, find_outcome(source)
    tables, notes, keys = [], [], study.keys_shown
    if with_tables and (study.is_recorded or outcome is None):
        tables.append(final_attitude_and_sigma_table(source))
    if with_tables and outcome:
        parts: list[Sequence[str]] = [keys]
        if study.n_variants > MAX_ROWS:
            parts = [[key] for key in keys]
            text = f"{study.n_variants:,} variants: each table has one key and pools the others."
            notes.append(text)
        tables += [heading_error_table(source, part) for part in parts]
        tables += [statistics_table(source, part) for part in parts]
        if 1 < study.n_variants <= MAX_ROWS and source.draws > 1:
            tables.append(paired_difference_table(source))
        if text := outcome.held_out_settling_and_agreement[0]:
            end = "(each half of the draws chooses for the other)"
            notes.append(f"{text[0].upper()}{text[1:]} {end}.")
    return build_short_report(source, outcome, warnings_shown=warnings_shown)._replace(
        tables=tables,
        pictures=[*draw_figures(source, outcome)],
        notes=notes,
        footer=f"{study.name}: {study.n_variants:,} × {source.draws:,} runs",
    )


def describe_success_criterion(study: Study) -> str:
    """Describe *settled* and *ok* in a study, in one paragraph."""
    rule = success_criteria(study)
    ends_s = np.array([s.records for s in study.distinct_spans]) * study.study.record_interval_s
    dwell_s = rule.dwell(ends_s)
    last = " to ".join(f"{s:g}" for s in sorted({dwell_s.min(), dwell_s.max()}))
    there = "is there" if last == "0" else f"has been there for {last} s"
    aim = "true north" if rule.from_truth else "its bias floor (not of true north)"
    aim = "the reference's heading" if study.is_recorded else aim
    return (
        f"Settled: the heading stays within {rule.band_arcmin:g} arcmin (or the band given) of"
        f" {aim} from then to the end of the run; ok: it {there} at the end,"
        f" and the level errors end within {rule.level_band_arcmin:g} arcmin. Bias floor: the"
        " heading error caused by a run's own constant sensor biases."
    )


def _lay_out(
    title: str,
    keys: Sequence[str],
    groups: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]],
    columns: Sequence[_Column],
    note: str,
) -> Table:
    """A table of statistics, one row per group of runs; a method may have no bias floor."""
    rows = []
    for key, found in groups:
        without = found.get("no_floor") == found["n"]
        cells = [
            "no bias floor" if without and one.needs_floor else one.format(found[one.name])
            for one in columns
        ]
        rows.append([*map(format_value, key.values()), *cells])
    return Table(title, [*keys, *(one.header for one in columns)], rows, note).shortened()


def _by(source: Results, keys: Sequence[str]) -> str:
    return "" if list(keys) == list(source.study.keys_shown) else f", by {' and '.join(keys)}"


def statistics_table(source: Results, keys: Sequence[str]) -> Table:
    """Return success, settling time and heading error of the runs that share some keys."""
    study, measures = source.study, source.success_measures
    columns = [_Column("runs", "n", str)]
    for y in dict.fromkeys([*measures, *success_measures(study)]):
        header = f"ok: {y.description} (%)"
        columns.append(_Column(header, y.rate_column, format_percent, not y.truth))
    for y in measures:
        header, name = f"time to {y.description}, median (s)", f"{y.settle_column}_median"
        columns.append(_Column(header, name, _SECONDS, not y.truth))
    aim = "the reference" if study.is_recorded else "its bias floor"
    drift = f"signed mean from {aim} (arcmin)"
    columns += [
        _Column("heading error at the end, rms (arcmin)", f"{_END}_rms", format_heading_error),
        _Column(drift, "phi_u_from_floor_arcmin_mean", format_estimate, True),
    ]
    table = source.rows_of_distinct_runs([*keys, *REQUIRED_COLUMNS, *success_columns(study)])
    names = [column.name for column in columns[1:]]
    groups = analysis.estimate_groups(table, keys, names).groups
    start, end = study.study.window_s
    note = f"{describe_intervals(source)} Signed mean: over {start:g} to {end:g} s."
    title = f"Every variant{_by(source, keys)}"
    return _lay_out(title, keys, groups, columns, note)


def heading_error_table(source: Results, keys: Sequence[str]) -> Table:
    """Return the heading errors from the truth, at each report time and at the end, as a table."""
    times = {
        report_time_columns(t)[0].name: f"{t:g} s" for t in source.study.study.report_times_s or ()
    }
    times[_END] = "the end"
    table = source.rows_of_distinct_runs([*keys, *REQUIRED_COLUMNS, *times])
    names = [f"{column}_{end}" for column in times for end in ("rms", "abs_q90")]
    groups = analysis.estimate_groups(table, keys, names).groups
    rows = [
        [
            *(*map(format_value, key.values()), f"{found['n']}", time),
            *(format_heading_error(found[f"{column}_{end}"]) for end in ("rms", "abs_q90")),
        ]
        for key, found in groups
        for column, time in times.items()
    ]
    aim = "the reference" if source.study.is_recorded else "true north"
    title = f"Heading error from {aim}, arcmin{_by(source, keys)}"
    header = [*keys, "runs", "at", "rms", "90 % of the runs below"]
    found = Table(title, header, rows, describe_intervals(source))
    return found.shortened(MAX_ROWS * len(times))


def paired_difference_table(source: Results) -> Table:
    """Return the difference of each variant from the first under the same conditions, by draw.

    The first variant of all is the reference if the options of the conditions differ.
    """
    keys, measures = source.study.keys_shown, source.success_measures
    table = source.rows_of_distinct_runs([*keys, *REQUIRED_COLUMNS, *success_columns(source.study)])
    conditions = [key for key in keys if is_condition_key(key)]
    options = [key for key in keys if key not in conditions]
    parts = [rows for _, rows in analysis.group_rows(table, conditions)]
    if not options or any(_first(rows, options) != _first(table, options) for rows in parts):
        parts, options = [table], list(keys)
    columns = [
        _Column(f"ok: {y.description} (% points)", f"{y.rate_column}_difference", format_percent)
        for y in measures
    ]
    for y in measures:
        header, name = f"time to {y.description}, median (s)", f"{y.settle_column}_median"
        columns.append(_Column(header, f"{name}_difference", format_time_difference))
    header = "distance from its bias floor (arcmin)"
    columns.append(_Column(header, "phi_u_error_arcmin_difference", format_estimate))
    groups = [
        group
        for part in parts
        for group in analysis.compare_with_baseline(part, keys, _first(part, keys)).groups
    ]
    note = describe_intervals(source, "Difference", "pairs of runs of a draw")
    note += " Distance: that of the window mean of phi_u."
    title = f"Against {describe_point(_first(table, options))}, on the same noise"
    return _lay_out(title, keys, groups, columns, note)


def _first(rows: Any, keys: Sequence[str]) -> dict[str, Any]:
    return {key: rows[key][0].as_py() for key in keys}
