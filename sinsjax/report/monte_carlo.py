"""The report of any study: its verdict, its figures, and statistics of its variants."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sinsjax import analysis
from sinsjax.analysis import format_estimate
from sinsjax.analysis.formats import format_heading_error, format_percent, format_time_difference
from sinsjax.analysis.summaries import REQUIRED_COLUMNS
from sinsjax.columns import report_time_columns
from sinsjax.execution.results import Results
from sinsjax.methods.registry import METHODS
from sinsjax.plots.labels import describe_point, format_value
from sinsjax.report.attitude import (
    attitude_cautions,
    attitude_facts,
    attitude_table,
    last_attitude_table,
)
from sinsjax.report.base import MAX_ROWS, Block, Report, Table, describe_intervals
from sinsjax.report.figures import draw_figures
from sinsjax.report.verdict import (
    SweepOutcome,
    answer_facts,
    caution_facts,
    condition_table,
    fit_cautions,
    program_facts,
    study_title,
    warning_facts,
)
from sinsjax.study.keys import is_condition_key
from sinsjax.study.success import success_columns, success_measures

_END = "phi_u_arcmin"
_SECONDS = partial(format_estimate, digits=0)


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
    outcome = _find_outcome(source)
    blocks: list[Block] = [*draw_figures(source, outcome)]
    if with_tables and (source.study.is_recorded or outcome is None):
        blocks.append(attitude_table(source))
    if with_tables and outcome:
        blocks += _all_tables(source, outcome)
    return _state_verdict(source, outcome, warnings_shown=warnings_shown)._replace(blocks=blocks)


def _find_outcome(source: Results) -> SweepOutcome | None:
    """The outcome of a sweep; None if no run has a truth."""
    heading = analysis.numeric_column(source.rows([_END]), _END)
    return SweepOutcome.from_source(source) if np.isfinite(heading).any() else None


def build_verdict(source: Results, *, warnings_shown: bool = False) -> Report:
    """Return the report without its figures and tables.

    It states the best option if a truth is known, and the attitude on a record, without a truth or
    without a heading.

    Args:
        source: the results.
        warnings_shown: whether the user has seen the study's warnings.
    """
    return _state_verdict(source, _find_outcome(source), warnings_shown=warnings_shown)


def _state_verdict(
    source: Results, outcome: SweepOutcome | None, *, warnings_shown: bool
) -> Report:
    study = source.study
    finds_heading = any(METHODS[name].finds_heading for name in study.methods)
    band, doubts = warning_facts(source, warnings_shown=warnings_shown)
    doubts += fit_cautions(source)
    if outcome and finds_heading and not study.is_recorded:
        facts = [*band, *program_facts(outcome), *answer_facts(outcome)]
        facts += [*doubts, *caution_facts(outcome)]
        return Report(study_title(source), facts, condition_table(outcome))
    table = last_attitude_table(source) if source.runs > 1 else None
    variant, judged = None, []
    if outcome and finds_heading and study.n_variants > 1:
        variant, table = outcome.best_variant, condition_table(outcome)
        judged = [*answer_facts(outcome), *caution_facts(outcome)]
    doubts += attitude_cautions(source)
    return Report(study_title(source), [*attitude_facts(source, variant), *judged, *doubts], table)


def _all_tables(source: Results, outcome: SweepOutcome) -> Iterator[Block]:
    """Yield the tables of all variants, or of each key, which pools the others."""
    study, keys = source.study, source.study.keys_shown
    if held_out := outcome.held_out[0]:
        yield f"{held_out[0].upper()}{held_out[1:]} (each half of the draws chooses for the other)."
    if study.n_variants <= MAX_ROWS:
        yield heading_error_table(source, keys)
        yield statistics_table(source, keys)
        if study.n_variants > 1 and source.draws > 1:
            yield comparison_table(source)
        return
    yield f"{study.n_variants:,} variants: each table has one key and pools the others."
    yield from (heading_error_table(source, [key]) for key in keys)
    yield from (statistics_table(source, [key]) for key in keys)


class _Column(NamedTuple):
    """A column of a table: its header, its statistic and how that is written."""

    header: str
    name: str
    format: Callable[[Any], str]
    needs_floor: bool = False

    def cell(self, found: Mapping[str, Any]) -> str:
        """The statistic of a group of runs as text."""
        if self.needs_floor and found["no_floor"] == found["n"]:
            return "no bias floor"
        return self.format(found[self.name])


def _lay_out(
    title: str,
    keys: Sequence[str],
    groups: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]],
    columns: Sequence[_Column],
    note: str,
) -> Table:
    """A table of statistics, one row per group of runs."""
    rows = [
        [*map(format_value, key.values()), *(column.cell(found) for column in columns)]
        for key, found in groups
    ]
    return Table(title, [*keys, *(column.header for column in columns)], rows, note).shortened()


def _describe_keys(source: Results, keys: Sequence[str]) -> str:
    return "" if list(keys) == list(source.study.keys_shown) else f", by {' and '.join(keys)}"


def statistics_table(source: Results, keys: Sequence[str]) -> Table:
    """Return success, settling time and heading error of each group of runs that share some keys.

    There are columns for each criterion of success; a method may have no bias floor.
    """
    measures, columns = source.success_measures, []
    for y in (*measures, *(y for y in success_measures(source.study) if y not in measures)):
        header = f"ok: {y.description} (%)"
        columns.append(_Column(header, y.rate_column, format_percent, not y.truth))
    for y in measures:
        header, name = f"time to {y.description}, median (s)", f"{y.settle_column}_median"
        columns.append(_Column(header, name, _SECONDS, not y.truth))
    header = f"signed mean from {'the reference' if source.study.is_recorded else 'its bias floor'}"
    drift = _Column(f"{header} (arcmin)", "phi_u_from_floor_arcmin_mean", format_estimate, True)
    header = "heading error at the end, rms (arcmin)"
    columns += [_Column(header, f"{_END}_rms", format_heading_error), drift]
    table = source.distinct_rows([*keys, *REQUIRED_COLUMNS, *success_columns(source.study)])
    groups = analysis.estimate_groups(table, keys, [column.name for column in columns]).groups
    start, end = source.study.study.window_s
    note = f"{describe_intervals(source)} Signed mean: over {start:g} to {end:g} s."
    title = f"Every variant{_describe_keys(source, keys)}"
    return _lay_out(title, keys, groups, [_Column("runs", "n", str), *columns], note)


def heading_error_table(source: Results, keys: Sequence[str]) -> Table:
    """Return the heading errors from the truth, at each report time and at the end, as a table."""
    times = {
        report_time_columns(t)[0].name: f"{t:g} s" for t in source.study.study.report_times_s or ()
    }
    times[_END] = "the end"
    table = source.distinct_rows([*keys, *REQUIRED_COLUMNS, *times])
    names = [f"{column}_{end}" for column in times for end in ("rms", "abs_q90")]
    rows = [
        [
            *map(format_value, key.values()),
            f"{found['n']}",
            time,
            format_heading_error(found[f"{column}_rms"]),
            format_heading_error(found[f"{column}_abs_q90"]),
        ]
        for key, found in analysis.estimate_groups(table, keys, names).groups
        for column, time in times.items()
    ]
    aim = "the reference" if source.study.is_recorded else "true north"
    title = f"Heading error from {aim}, arcmin{_describe_keys(source, keys)}"
    header = [*keys, "runs", "at", "rms", "90 % of the runs below"]
    found = Table(title, header, rows, describe_intervals(source))
    return found.shortened(MAX_ROWS * len(times))


def comparison_table(source: Results) -> Table:
    """Return the difference of each variant from the first under the same conditions, by draw.

    The first variant of all is the reference if the options of the conditions differ.
    """
    keys, measures = source.study.keys_shown, source.success_measures
    table = source.distinct_rows([*keys, *REQUIRED_COLUMNS, *success_columns(source.study)])
    conditions = [key for key in keys if is_condition_key(key)]
    options = [key for key in keys if key not in conditions]
    first_of = partial(_first_point, keys=options)
    parts = [rows for _, rows in analysis.group_rows(table, conditions)]
    if not options or any(first_of(rows) != first_of(table) for rows in parts):
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
        for group in analysis.compare_with_baseline(part, keys, _first_point(part, keys)).groups
    ]
    note = describe_intervals(source, "Difference", "pairs of runs of a draw")
    note += " Distance: that of the window mean of phi_u."
    title = f"Against {describe_point(_first_point(table, options))}, on the same noise"
    return _lay_out(title, keys, groups, columns, note)


def _first_point(rows: Any, keys: Sequence[str]) -> dict[str, Any]:
    return {key: rows[key][0].as_py() for key in keys}
