"""The figures of a study: curves over time, maps, curves along an axis, and consistency."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow.compute as pc

from sinsjax import analysis, plots
from sinsjax.analysis.summaries import REQUIRED_COLUMNS
from sinsjax.execution.results import Results
from sinsjax.messages import format_count
from sinsjax.methods.filters.keys import estimates_biases
from sinsjax.methods.registry import METHODS
from sinsjax.plots.comparison import MAX_LINES, build_comparison_panels
from sinsjax.plots.consistency import NEES_COLUMNS, SHARE_COLUMNS
from sinsjax.plots.curves import select_runs_by_line
from sinsjax.plots.maps import MAX_PANELS
from sinsjax.report.base import Picture, describe_intervals
from sinsjax.report.verdict import SweepOutcome
from sinsjax.study.schema import BIAS_KEYS
from sinsjax.study.study import Study
from sinsjax.study.success import success_columns


def draw_figures(source: Results, outcome: SweepOutcome | None) -> Iterator[Picture]:
    """Yield the figures of a study; without a truth only the curves.

    With two swept numbers or more there are maps over the first two in the order of the study, a
    panel for each point of all other keys; with one, or one whose values are lists, curves with
    intervals.
    """
    yield from _curves_over_time(source)
    if outcome is None:
        return
    axes, others = figure_axes(source.study)
    if len(axes) == 2:
        for criterion in source.success_measures:
            yield from _maps(replace(outcome, criterion=criterion), axes, others)
    elif axes:
        yield _curves_along_axis(outcome, axes[0], others)
    yield from _consistency(source)


def figure_axes(study: Study) -> tuple[list[str], list[str]]:
    """The axes of the study's figures, and all other swept keys.

    They are the first two swept numbers, or else the first key with lists, such as reset times.
    """
    numeric, listed = [], []
    for (key, *more), values in study.axes_shown.items():
        if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
            numeric.append(key)
        elif not more and all(isinstance(v, tuple) for v in values):
            listed.append(key)
    axes = numeric[:2] or listed[:1]
    return axes, [key for key in study.keys_shown if key not in axes]


def _curves_over_time(source: Results) -> Iterator[Picture]:
    """Misalignment, or attitude, over time: the first few variants."""
    keys = source.study.keys_shown
    floor = () if source.study.is_recorded else ("floor_arcmin",)  # a record's biases are unknown
    table = source.distinct_rows([*keys, "run_id", "reset_times_s", *floor])
    runs = select_runs_by_line(table, keys)
    curves = source.read_curves(run for ids in runs.values() for run in ids)
    if curves.num_rows == 0:
        return
    count = max(map(len, runs.values()))
    caption = f"{count} runs per line; shading: 95 % of them" if count > 1 else "One run per line"
    if left := sum(1 for _ in analysis.group_rows(table.select(keys), keys)) - len(runs):
        caption += f"; {left} more variants are not drawn"

    def has(column: str) -> bool:
        return bool(np.isfinite(analysis.numeric_column(curves, column)).any())

    caption += "; dashed: the filter's own 1 sigma." if has("sigma_e_arcmin") else "."
    if not has("phi_e_arcmin"):
        yield Picture("attitude", caption, plots.plot_curves(curves, table, by=keys))
        return
    if has("phi_u_arcmin"):
        yield Picture("misalignment", caption, plots.plot_curves(curves, table, by=keys))
    figure = plots.plot_curves(curves, table, by=keys, level=True)
    yield Picture("misalignment_level", caption, figure)


def _maps(outcome: SweepOutcome, axes: Sequence[str], by: Sequence[str]) -> Iterator[Picture]:
    """Yield the maps by a criterion of success, titled by its best option."""
    source, criterion = outcome.source, outcome.criterion
    settle, ok = criterion.settle_column, criterion.ok_column
    shares = np.isfinite(outcome.time_s).mean(axis=-1)
    if (shares < 0.5).all():
        return  # every cell would be grey
    table = source.rows([*by, *axes, settle, ok, "draw_id", "start_s"])
    # A run that ends without success settles never, as in the verdict.
    settle_s = pc.if_else(table[ok], table[settle], None)
    table = table.set_column(table.column_names.index(settle), settle, settle_s)
    draws = format_count(source.draws, "draw")
    panels = sum(1 for _ in analysis.group_rows(table.select(by), by))
    end = f". The first {MAX_PANELS} of {panels} panels." if panels > MAX_PANELS else "."
    captions = {
        settle: f"Median time over {draws} until the heading stays {criterion.description}; grey"
        f" where at least half of the runs never do{end}"
    }
    if not np.isin(shares, (0.0, 1.0)).all():  # else the times show the same
        captions[ok] = f"Share of {draws} ok, {criterion.plural_description}{end}"
    title, study = _title(outcome), source.study
    keys = [key for axis in outcome.choices.option_axes for key in axis]
    best = {key: study.values(key)[outcome.best_variant] for key in keys}
    for column, caption in captions.items():
        figure = plots.plot_map(table, axes[0], axes[1], column, by=by, best=best, title=title)
        name = "settling_time" if column == settle else "success_rate"
        suffix = criterion.figure_suffix(source.success_measures[0])
        yield Picture(f"{name}{suffix}", caption, figure)


def _title(outcome: SweepOutcome) -> str:
    """Return the option that the verdict names, or nothing without a choice."""
    best, options = outcome.best, outcome.choices.options
    return f"Best: {options[best]} ({outcome.format_settling(best, 's')})" * (len(options) > 1)


def _curves_along_axis(outcome: SweepOutcome, axis: str, line_keys: Sequence[str]) -> Picture:
    """The settling time, the share of successes and the heading error along a key."""
    source, measure = outcome.source, outcome.criterion
    titles = {
        f"{measure.settle_column}_median": f"median time (s) to {measure.description}",
        measure.rate_column: f"share of runs that are ok, {measure.plural_description} (%)",
        "phi_u_arcmin_rms": "heading error at the end, rms (arcmin)",
    }
    table = source.rows([*line_keys, axis, *success_columns(source.study), *REQUIRED_COLUMNS])
    values, panels = build_comparison_panels(table, axis, line_keys, titles)
    text = describe_intervals(source, quantity="Estimate")
    lines = sum(1 for _ in analysis.group_rows(table.select(line_keys), line_keys))
    if lines > MAX_LINES:
        text += f" {lines - MAX_LINES} more lines are not drawn."
    title = _title(outcome) or f"Over {plots.axis_label(axis)}"
    return Picture("along_axis", text, plots.draw_along_axis(axis, values, panels, title=title))


def _consistency(source: Results) -> Iterator[Picture]:
    """NEES and P against the true error, of the heading from the bias floor if P excludes biases.

    One line per variant; of many variants, one line per value of the first key that has few.
    """
    study = source.study
    by: Sequence[str] = study.keys_shown
    if study.n_variants > MAX_LINES:
        few = (keys for keys, values in study.axes_shown.items() if len(values) <= MAX_LINES)
        by = next(few, ())
    columns = (*NEES_COLUMNS, *SHARE_COLUMNS.values(), "draw_id", "start_s")
    table = source.distinct_rows((*by, *columns))
    from_floor = excludes_biases(source)
    if not np.isfinite(analysis.numeric_column(table, NEES_COLUMNS[from_floor])).any():
        return
    error = "heading error from the bias floor" if from_floor else "attitude error"
    text = (
        f"Left: NEES, the squared {error} at the end in units of the filter's own covariance; a"
        " consistent filter follows the dashed line, an overconfident one lies right of it. Right:"
        " mean share of records, with its 95 % interval, in which the filter's heading variance"
        " exceeds the squared heading error; a consistent filter has 68 % (dashed), a too cautious"
        " one more."
    )
    if from_floor:
        text += " The filter has no states for constant sensor biases, so P excludes their floor."
    yield Picture("consistency", text, plots.plot_belief(table, by=by, from_floor=from_floor))


def excludes_biases(source: Results) -> bool:
    """Return whether the sensors have constant biases and no filter has states for them."""
    methods: list[Any] = [METHODS[name] for name in source.study.methods]
    filters = [method for method in methods if method.has_covariance and method.finds_heading]
    if source.study.is_recorded or any(map(estimates_biases, filters)):
        return False
    given = (value for key in BIAS_KEYS for value in source.study.values(key))
    return bool({*BIAS_KEYS} & {*source.study.drawn_keys}) or any(map(np.any, given))
