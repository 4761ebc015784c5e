"""The report of any study: its verdict, its figures, and statistics of its variants."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sinsjax import analysis
from sinsjax.analysis import format_estimate
from sinsjax.analysis.formats import format_heading_error, format_percent
from sinsjax.analysis.summaries import REQUIRED_COLUMNS
from sinsjax.columns import report_time_columns
from sinsjax.execution.results import Results
from sinsjax.methods.registry import METHODS
from sinsjax.plots.labels import format_value
from sinsjax.report.attitude import attitude_cautions, attitude_facts, last_attitude_table
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
    outcome = _find_outcome(source)
    blocks: list[Block] = [*draw_figures(source, outcome)]
    if with_tables and outcome:
        blocks += _all_tables(source, outcome)
    return build_verdict(source, warnings_shown=warnings_shown)._replace(blocks=blocks)


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
    study, outcome = source.study, _find_outcome(source)
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
    """Yield the table of all variants, or one for each key, which pools the others."""
    study, keys = source.study, source.study.keys_shown
    if held_out := outcome.held_out[0]:
        yield f"{held_out[0].upper()}{held_out[1:]} (each half of the draws chooses for the other)."
    if study.n_variants <= MAX_ROWS:
        yield statistics_table(source, keys)
        return
    yield f"{study.n_variants:,} variants: each table has one key and pools the others."
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


def statistics_table(source: Results, keys: Sequence[str]) -> Table:
    """Return success, settling time and heading error of each group of runs that share some keys.

    There are columns for each criterion of success; a method may have no bias floor.
    """
    study, measures = source.study, source.success_measures
    times = {report_time_columns(t)[0].name: f"{t:g} s" for t in study.study.report_times_s or ()}
    times[_END] = "the end"
    columns = [_Column("runs", "n", str)]
    for y in (*measures, *(y for y in success_measures(study) if y not in measures)):
        header = f"ok: {y.description} (%)"
        columns.append(_Column(header, y.rate_column, format_percent, not y.truth))
    for y in measures:
        header, name = f"time to {y.description}, median (s)", f"{y.settle_column}_median"
        columns.append(_Column(header, name, partial(format_estimate, digits=0), not y.truth))
    for name, time in times.items():
        header = f"heading error at {time}, rms (arcmin)"
        columns.append(_Column(header, f"{name}_rms", format_heading_error))
    header = f"signed mean from {'the reference' if study.is_recorded else 'its bias floor'}"
    name = "phi_u_from_floor_arcmin_mean"
    columns.append(_Column(f"{header} (arcmin)", name, format_estimate, True))
    table = source.distinct_rows([*keys, *REQUIRED_COLUMNS, *success_columns(study), *times])
    groups = analysis.estimate_groups(table, keys, [one.name for one in columns[1:]]).groups
    rows = [
        [*map(format_value, key.values()), *(column.cell(found) for column in columns)]
        for key, found in groups
    ]
    start, end = study.study.window_s
    note = f"{describe_intervals(source)} Signed mean: over {start:g} to {end:g} s."
    by = "" if list(keys) == list(study.keys_shown) else f", by {' and '.join(keys)}"
    headers = [*keys, *(column.header for column in columns)]
    return Table(f"Every variant{by}", headers, rows, note).shortened()
