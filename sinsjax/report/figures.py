"""The figures of a study: curves over time, maps, curves along an axis, and consistency."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow.compute as pc

from sinsjax import analysis, plots
from sinsjax.analysis.labels import FEW_DRAWS, axis_label
from sinsjax.analysis.summaries import REQUIRED_COLUMNS
from sinsjax.execution.results import Results
from sinsjax.messages import format_count
from sinsjax.methods.filters.keys import estimates_biases
from sinsjax.plots.comparison import MAX_LINES
from sinsjax.plots.consistency import NEES_COLUMNS, SHARE_COLUMNS
from sinsjax.plots.curves import select_runs_by_line
from sinsjax.plots.maps import MAX_PANELS
from sinsjax.report.attitude import heading_filters
from sinsjax.report.document import MIN_DRAWS_FOR_INTERVALS, Picture
from sinsjax.report.verdict import SweepOutcome
from sinsjax.study.schema import BIAS_KEYS
from sinsjax.study.success import SuccessMeasure, success_columns


def draw_figures(source: Results, outcome: SweepOutcome | None) -> Iterator[Picture]:
    """Yield the figures of a study; without a truth only the curves.

    With two swept numbers or more there are maps over the first two in the order of the study, a
    panel for each point of all other keys; with one, or else the first key with lists, such as
    reset times, curves with intervals.
    """
    yield from _curves_over_time(source)
    if outcome is None:
        return
    numeric, listed = [], []
    for (key, *more), values in source.study.axes_shown.items():
        if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
            numeric.append(key)
        elif not more and all(isinstance(v, tuple) for v in values):
            listed.append(key)
    axes = numeric[:2] or listed[:1]
    others = [key for key in source.study.keys_shown if key not in axes]
    if len(axes) == 2:
        for criterion in source.success_measures:
            yield from _settling_and_success_maps(outcome, criterion, axes, others)
    elif axes:
        yield _curves_along_axis(outcome, axes[0], others)
    yield from _filter_consistency_picture(source)


def describe_intervals(source: Results, quantity: str = "Number", of: str = "draws") -> str:
    """Describe the brackets of a table or a figure, or why there are none."""
    if source.study.is_recorded:
        return "No intervals: all runs are on one record and share its sensor biases."
    note = f"{quantity} [95 % interval over the {of}]; {FEW_DRAWS!r}: too few to bound it."
    if source.draws < MIN_DRAWS_FOR_INTERVALS:
        note += f" With fewer than {MIN_DRAWS_FOR_INTERVALS} draws, intervals of the means of"
        note += " skewed values are too narrow."
    return note


def _curves_over_time(source: Results) -> Iterator[Picture]:
    """Misalignment, or attitude, over time: the first few variants."""
    keys = source.study.keys_shown
    floor = () if source.study.is_recorded else ("floor_arcmin",)  # a record's biases are unknown
    table = source.rows_of_distinct_runs([*keys, "run_id", "reset_times_s", *floor])
    runs = select_runs_by_line(table, keys)
    curves = source.read_curves(run for ids in runs.values() for run in ids)
    if curves.num_rows == 0:
        return
    count = max(map(len, runs.values()))
    caption = f"{count} runs per line; shading: 95 % of them" if count > 1 else "One run per line"
    if left := _count_points(table, keys) - len(runs):
        caption += f"; {left} more variants are not drawn"

    def has(column: str) -> bool:
        return bool(np.isfinite(analysis.numeric_column(curves, column)).any())

    caption += "; dashed: the filter's own 1 sigma." if has("sigma_e_arcmin") else "."
    has_truth = has("phi_e_arcmin")
    if has("phi_u_arcmin") or not has_truth:
        name = "misalignment" if has_truth else "attitude"
        yield Picture(name, caption, plots.plot_curves(curves, table, by=keys))
    if has_truth:
        figure = plots.plot_curves(curves, table, by=keys, level=True)
        yield Picture("misalignment_level", caption, figure)


def _count_points(table: Any, keys: Sequence[str]) -> int:
    return sum(1 for _ in analysis.group_rows(table.select(keys), keys))


def _settling_and_success_maps(
    outcome: SweepOutcome, criterion: SuccessMeasure, axes: Sequence[str], by: Sequence[str]
) -> Iterator[Picture]:
    """Yield the maps by a criterion of success, which frame the option that the verdict names."""
    source = outcome.source
    settle, ok = criterion.settle_column, criterion.ok_column
    shares = np.isfinite(replace(outcome, criterion=criterion).time_s).mean(axis=-1)
    if (shares < 0.5).all():
        return  # every cell would be grey
    table = source.rows([*by, *axes, settle, ok, "draw_id", "start_s"])
    # A run that ends without success settles never, as in the verdict.
    settle_s = pc.if_else(table[ok], table[settle], None)
    table = table.set_column(table.column_names.index(settle), settle, settle_s)
    draws, panels = format_count(source.draws, "draw"), _count_points(table, by)
    end = f". The first {MAX_PANELS} of {panels} panels." if panels > MAX_PANELS else "."
    captions = {
        settle: f"Median time over {draws} until the heading stays {criterion.description}; grey"
        f" where at least half of the runs never do{end}"
    }
    if not np.isin(shares, (0.0, 1.0)).all():  # else the times show the same
        captions[ok] = f"Share of {draws} ok, {criterion.plural_description}{end}"
    keys = [key for axis in outcome.option_axes for key in axis]
    best = {key: source.study.values(key)[outcome.best_variant] for key in keys}
    style: Any = {"by": by, "best": best, "title": _title(outcome)}
    for column, caption in captions.items():
        name = "settling_time" if column == settle else "success_rate"
        name += criterion.figure_suffix(source.success_measures[0])
        yield Picture(name, caption, plots.plot_map(table, axes[0], axes[1], column, **style))


def _title(outcome: SweepOutcome) -> str:
    """Return the option that the verdict names, or nothing without a choice."""
    best, options = outcome.best, outcome.options
    return f"Best: {options[best]} ({outcome.format_settling(best, 's')})" * (len(options) > 1)


def _curves_along_axis(outcome: SweepOutcome, axis: str, by: Sequence[str]) -> Picture:
    """The settling time, the share of successes and the heading error along a key."""
    source, measure = outcome.source, outcome.criterion
    titles = {
        f"{measure.settle_column}_median": f"median time (s) to {measure.description}",
        measure.rate_column: f"share of runs that are ok, {measure.plural_description} (%)",
        "phi_u_arcmin_rms": "heading error at the end, rms (arcmin)",
    }
    table = source.rows([*by, axis, *success_columns(source.study), *REQUIRED_COLUMNS])
    text = describe_intervals(source, quantity="Estimate")
    if (lines := _count_points(table, by)) > MAX_LINES:
        text += f" {lines - MAX_LINES} more lines are not drawn."
    title = _title(outcome) or f"Over {axis_label(axis)}"
    figure = plots.plot_compare(table, axis, by=by, statistics=titles, title=title)
    return Picture("along_axis", text, figure)


def _filter_consistency_picture(source: Results) -> Iterator[Picture]:
    """NEES and P against the true error, of the heading from the bias floor if P excludes biases.

    One line per variant; of many variants, one line per value of the first key that has few.
    """
    study = source.study
    by: Sequence[str] = study.keys_shown
    if study.n_variants > MAX_LINES:
        few = (keys for keys, values in study.axes_shown.items() if len(values) <= MAX_LINES)
        by = next(few, ())
    columns = (*NEES_COLUMNS, *SHARE_COLUMNS.values(), "draw_id", "start_s")
    table = source.rows_of_distinct_runs((*by, *columns))
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
    if source.study.is_recorded or any(map(estimates_biases, heading_filters(source))):
        return False
    given = (value for key in BIAS_KEYS for value in source.study.values(key))
    return bool({*BIAS_KEYS} & {*source.study.drawn_keys}) or any(map(np.any, given))
