"""The report of any study: statistics of its variants, curves, and figures over its axes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_difference, format_estimate
from sinsjax.analysis.formats import format_heading_error, format_percent
from sinsjax.analysis.summaries import REQUIRED_COLUMNS
from sinsjax.columns import report_time_columns
from sinsjax.execution.results import Results
from sinsjax.methods.registry import METHODS
from sinsjax.plots.curves import select_runs_by_line
from sinsjax.plots.labels import describe_point
from sinsjax.report.attitude import attitude_table, attitude_verdict
from sinsjax.report.axis_figures import (
    BINS_NOTE,
    bin_drawn_keys,
    build_axis_figures,
    repeated_variants_note,
)
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
from sinsjax.report.verdict import SweepOutcome, sweep_verdict
from sinsjax.study.keys import is_condition_key
from sinsjax.study.success import success_columns, success_measures

_END = "phi_u_arcmin"
_FAILED_ARCMIN = 180 * 60.0


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
    yaw = analysis.numeric_column(source.rows([_END]), _END)
    has_truth = bool(np.isfinite(yaw).any())
    finds_heading = any(METHODS[name].finds_heading for name in source.study.methods)
    outcome = SweepOutcome.from_source(source) if has_truth else None
    blocks: list[Block] = [*_curve_figures(source)]
    if outcome:
        blocks += [*build_axis_figures(source), *consistency_blocks(source)]
    if needs_attitude := source.study.is_recorded or not outcome:
        blocks += [attitude_table(source)] if with_tables else []
    if with_tables and outcome:
        blocks += [*repeated_variants_note(source), *_all_tables(source, outcome)]
    if needs_attitude or not finds_heading or outcome is None:
        verdict = attitude_verdict(source, outcome, warnings_shown=warnings_shown)
    else:
        verdict = sweep_verdict(source, outcome, warnings_shown=warnings_shown)
    facts = [*verdict.facts, *covariance_cautions(source)]
    first = next((place for place, fact in enumerate(facts) if not fact.is_caution), len(facts))
    facts[first:first] = _program_facts(outcome) if outcome else ()
    return verdict._replace(facts=facts, blocks=blocks)


def _program_facts(outcome: SweepOutcome) -> Iterator[Fact]:
    """Yield the mean heading error of each program outside sinsjax, and that of the best method.

    A run without a result counts 180 deg. The best is that of all draws.
    """
    choices, external = outcome.choices, outcome.source.study.study.external or ()
    methods = np.array(outcome.source.study.values("method"))[choices.variants[:, 0]]
    errors = [np.abs(outcome.flat(_END, option)) for option in range(len(methods))]
    errors = [np.where(np.isnan(error), _FAILED_ARCMIN, error) for error in errors]
    means = [np.inf if m in external else e.mean() for m, e in zip(methods, errors, strict=True)]
    best = int(np.argmin(means))
    for program in (option for option, mean in enumerate(means) if np.isinf(mean)):
        own = analysis.mean(errors[program], outcome.clusters, limits=(0.0, _FAILED_ARCMIN))
        text = f"{methods[program]}: mean heading error {format_heading_error(own)}'"
        larger, smaller, word = errors[program], errors[best], "more"
        if own.value < means[best]:
            larger, smaller, word = smaller, larger, "less"
        difference = analysis.mean_difference(larger, smaller, outcome.clusters)
        text += f", on the same draws {format_heading_error(difference)}' {word} than that of"
        text += f" {choices.options[best]}, the best of sinsjax"
        yield Fact("Program", text)


def statistics_table(source: Results, keys: Sequence[str], title: str, *, note: str = "") -> Table:
    """Return the statistics of each group of runs that share some keys, as a table.

    Columns are success, settling time and heading error, by each criterion.
    """
    measures, seconds = source.success_measures, partial(format_estimate, digits=0)
    missing = [one for one in success_measures(source.study) if one not in measures]
    aim = "the reference" if source.study.is_recorded else "its bias floor"
    cells = [("runs", lambda found: f"{found['n'].value}")]
    names = [one.rate_column for one in measures]
    for one in measures:
        cell = _cell(one.rate_column, format_percent, needs_floor=not one.truth)
        cells.append((f"ok: {one.description} (%)", cell))
    for one in missing:
        cells.append((f"ok: {one.description} (%)", lambda _: "no bias floor"))
    for one in measures:
        names.append(f"{one.settle_column}_median")
        cell = _cell(names[-1], seconds, needs_floor=not one.truth)
        cells.append((f"time to {one.description}, median (s)", cell))
    names += [f"{_END}_rms", "phi_u_from_floor_arcmin_mean"]
    cells += [
        ("heading error at the end, rms (arcmin)", _cell(names[-2], format_heading_error)),
        (f"signed mean from {aim} (arcmin)", _cell(names[-1], format_estimate, needs_floor=True)),
    ]
    table = source.distinct_rows([*keys, *REQUIRED_COLUMNS, *success_columns(source.study)])
    return build_table(
        title, keys, analysis.estimate_groups(table, keys, names).groups, cells, note
    )


def _cell(
    name: str, format_value: Callable[[Estimate], str], *, needs_floor: bool = False
) -> Callable[[Mapping[str, Estimate]], str]:
    """A function that returns a statistic of a group as text."""

    def format_cell(found: Mapping[str, Estimate]) -> str:
        if needs_floor and found["no_floor"].value == found["n"].value:
            return "no bias floor"
        return format_value(found[name])

    return format_cell


def heading_error_table(source: Results, keys: Sequence[str], title: str) -> Table:
    """Return the heading errors from the truth, at each report time and at the end, as a table."""
    times = {
        report_time_columns(t)[0].name: f"{t:g} s" for t in source.study.study.report_times_s or ()
    }
    times[_END] = "the end"
    table = source.distinct_rows([*keys, *REQUIRED_COLUMNS, *times])
    names = [f"{column}_{end}" for column in times for end in ("rms", "abs_q90")]
    groups = [
        (key, (found["n"].value, at, found[f"{column}_rms"], found[f"{column}_abs_q90"]))
        for key, found in analysis.estimate_groups(table, keys, names).groups
        for column, at in times.items()
    ]
    cells: list[tuple[str, Callable[[Any], str]]] = [
        ("runs", lambda found: f"{found[0]}"),
        ("at", lambda found: found[1]),
        ("rms", lambda found: format_heading_error(found[2])),
        ("90 % of the runs below", lambda found: format_heading_error(found[3])),
    ]
    note = describe_intervals(source)
    enough = source.draws >= MIN_DRAWS_FOR_INTERVALS and not source.study.is_recorded
    if enough and any(np.isnan(found[3].high) for _, found in groups):
        note += f" {analysis.FEW_DRAWS!r}: too few to bound it."
    return build_table(title, keys, groups, cells, note, max_rows=MAX_ROWS * len(times))


def first_variant_comparison_table(source: Results) -> Table:
    """Return the difference of each variant from the first under the same conditions, by draw.

    The first variant of all is the reference if not all conditions have the same first option.
    """
    keys, measures = source.study.keys_shown, source.success_measures
    table = source.distinct_rows([*keys, *REQUIRED_COLUMNS, *success_columns(source.study)])
    condition_keys = [key for key in keys if is_condition_key(key)]
    option_keys = [key for key in keys if key not in condition_keys]

    def first_of(rows: pa.Table, by: Sequence[str]) -> dict[str, Any]:
        return {key: rows[key][0].as_py() for key in by}

    parts, first = [rows for _, rows in analysis.group_rows(table, condition_keys)], {}
    if option_keys:
        first = first_of(table, option_keys)
    if not first or any(first_of(rows, option_keys) != first for rows in parts):
        parts, first = [table], first_of(table, keys)
    groups = [
        group
        for rows in parts
        for group in analysis.compare_with_baseline(rows, keys, first_of(rows, keys)).groups
    ]
    mixed = [
        key
        for dimension in source.study.dimensions
        if first.keys() & dimension.keys()
        for key, values in dimension.items()
        if is_condition_key(key) and any(value != values[0] for value in values)
    ]
    times = partial(format_difference, digits=0, sides=("it", "the first"))
    distance = _cell("phi_u_error_arcmin_difference", format_estimate)
    cells = [
        *(
            (
                f"ok: {y.description} (% points)",
                _cell(f"{y.rate_column}_difference", format_percent),
            )
            for y in measures
        ),
        *(
            (
                f"time to {y.description}, median (s)",
                _cell(f"{y.settle_column}_median_difference", times),
            )
            for y in measures
        ),
        ("distance from its bias floor (arcmin)", distance),
    ]
    shared = "from the same start times" if source.study.is_recorded else "on the same noise"
    same = "" if mixed or not condition_keys else f" with the same {' and '.join(condition_keys)}"
    note = describe_intervals(source, "pairs of runs of a draw", "Difference")
    note += " Distance: that of the window mean of phi_u."
    if mixed:
        note += " The first variant is a reference only: variants also differ from it in"
        note += f" {' and '.join(mixed)}, the conditions of a run."
    title = f"Against {describe_point(first)}{same}, {shared}"
    return build_table(title, keys, groups, cells, note)


def _all_tables(source: Results, outcome: SweepOutcome) -> Iterator[Block]:
    """Yield the tables of all variants, or of each key, which pools the others."""
    study, keys = source.study, source.study.keys_shown
    held_out = "" if study.is_recorded else outcome.held_out[0]
    if held_out:
        yield f"{held_out[0].upper()}{held_out[1:]} (each half of the draws chooses for the other)."
    start, end = study.study.window_s
    title = f"Heading error from {'the reference' if study.is_recorded else 'true north'}, arcmin"
    note = (
        f"{describe_intervals(source)} 'never': did not settle. Signed mean: over {start:g} to"
        f" {end:g} s."
    )
    if few := study.n_variants <= MAX_ROWS:
        yield heading_error_table(source, keys, title)
        yield statistics_table(source, keys, "Every variant", note=note)
    else:
        yield f"{study.n_variants:,} variants: each table has one key and pools the others."
        yield from (heading_error_table(source, [key], f"{title}, by {key}") for key in keys)
        yield from (statistics_table(source, [key], f"By {key}", note=note) for key in keys)
    for key, (binned_source, medians) in bin_drawn_keys(source).items():
        each = len(medians) * study.n_variants <= MAX_ROWS
        pooled = "" if each or not keys else " All variants together."
        text = f"{key}: {BINS_NOTE} {describe_intervals(source)}{pooled}"
        by = [key, *(keys if each else ())]
        yield statistics_table(binned_source, by, f"Over {key}, drawn", note=text)
    if few and study.n_variants > 1 and source.draws > 1:
        yield first_variant_comparison_table(source)


def _curve_figures(source: Results) -> Iterator[Block]:
    """Misalignment, or attitude, over time: the first few variants."""
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
    caption = caption.replace("Mean", "Rms", 1)
    if np.isfinite(analysis.numeric_column(curves, "phi_u_arcmin")).any():
        figure = plots.plot_curves(curves, table, by=keys)
        yield Picture("misalignment", f"{caption}{note}.", figure)
    figure = plots.plot_curves(curves, table, by=keys, level=True)
    yield Picture("misalignment_level", f"{caption}{note}.", figure)
