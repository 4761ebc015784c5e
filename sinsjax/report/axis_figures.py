"""Figures over a study's swept and drawn numbers: heat maps, and curves with intervals."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.analysis.grids import Grid, median_over_draws
from sinsjax.analysis.summaries import REQUIRED_COLUMNS
from sinsjax.execution.results import Results
from sinsjax.messages import format_count
from sinsjax.plots.comparison import MAX_LINES, build_comparison_panels, has_significant_effect
from sinsjax.plots.maps import MAX_PANELS
from sinsjax.report.base import Block, Picture, describe_intervals
from sinsjax.report.verdict import SweepOutcome
from sinsjax.study.schema import NUMBERS_DRAWN
from sinsjax.study.study import Study
from sinsjax.study.success import SuccessMeasure, success_columns

BINS_NOTE = "the median of each bin, of about as many draws."
_MAX_BINS = 8
_MIN_DRAWS_PER_BIN = 10  # the interval of fewer draws is too wide to be of use
_DIGITS = 3  # significant ones of a bin's name


def figure_axes(study: Study) -> tuple[dict[str, tuple[Any, ...]], list[str]]:
    """The axes of the study's figures with their values, and all other swept keys.

    They are the first two swept numbers, or else the first key with lists, such as reset times.
    """
    numeric, listed = {}, {}
    for (key, *more), values in study.axes_shown.items():
        if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
            numeric[key] = tuple(map(float, values))
        elif not more and all(isinstance(v, tuple) for v in values):
            listed[key] = values
    axes = dict([*numeric.items()][:2] or [*listed.items()][:1])
    return axes, [key for key in study.keys_shown if key not in axes]


def build_axis_figures(source: Results) -> list[Block]:
    """Return the figures over the swept numbers and the drawn numbers.

    With two numeric axes or more, heat maps over the first two in the order of the study, a panel
    for each point of all other keys; with one, or one whose values are lists, curves with
    intervals; with none, nothing. Then curves over each drawn number.
    """
    axes, line_keys = figure_axes(source.study)
    blocks: list[Block] = []
    if len(axes) == 2:
        for criterion in source.success_measures:
            blocks += _heat_maps(source, criterion, list(axes), line_keys)
    else:
        for axis in axes:
            blocks += _curves_along_axis(source, "along_axis", axis, line_keys)
    insignificant = []
    for key, (binned_source, _) in bin_drawn_keys(source).items():
        note, keys = f" {key}: {BINS_NOTE}", source.study.keys_shown
        drawn = [*_curves_along_axis(binned_source, f"over_{key}", key, keys, note)]
        insignificant += [] if drawn else [key]
        blocks += drawn
    if insignificant:
        blocks.append(f"No figure over {', '.join(insignificant)}: no effect beyond the intervals.")
    return blocks


def repeated_variants_note(source: Results) -> Iterator[str]:
    """Yield a note on how tables count duplicate variants, if there are any."""
    if keys := source.study.idle_keys():
        variants, kept = source.study.n_variants, len({*source.study.duplicate_of})
        yield (
            f"{variants - kept:,} of the {variants:,} variants repeat another one, because"
            f" {' and '.join(keys)} {'has' if len(keys) == 1 else 'have'} no effect there. All"
            f" numbers here count repeated variants once: {source.runs * kept // variants:,} of"
            f" {source.runs:,} runs. The Parquet files contain all."
        )


def _heat_maps(
    source: Results, criterion: SuccessMeasure, axes: Sequence[str], by: Sequence[str]
) -> Iterator[Picture]:
    """Yield the maps by one criterion of success, without those that show nothing.

    They are over the first two swept numbers, a panel for each point of all other keys; the option
    that the verdict names by this criterion is framed.
    """
    settle, ok = criterion.settle_column, criterion.ok_column
    table = source.rows([*by, *axes, settle, ok, "draw_id", "start_s"])
    # A run that ends without success settles never, as in the verdict.
    settle_s = pc.if_else(table[ok], table[settle], None)
    table = table.set_column(table.column_names.index(settle), settle, settle_s)
    grid = Grid.from_table(table, by, *((axis,) for axis in axes))
    median_s = median_over_draws(np.nan_to_num(grid.column(settle), nan=np.inf)[:MAX_PANELS])
    if not np.isfinite(median_s).any():
        return
    outcome = replace(SweepOutcome.from_source(source), criterion=criterion)
    best = {
        key: source.study.values(key)[outcome.best_variant]
        for keys in outcome.choices.option_axes
        for key in keys
    }
    name = outcome.choices.options[outcome.best]
    title = f"Best: {name} ({outcome.format_settling(outcome.best, 's')})" if best else ""
    mark = ""
    if len(grid.rows) > MAX_PANELS:
        mark = f" The first {MAX_PANELS} of {len(grid.rows)} panels."
    captions = {
        "settling_time": f"Median time over {format_count(source.draws, 'draw')} until the heading"
        f" stays {criterion.description}; grey where at least half of the runs never do."
    }
    shares = grid.column(ok)[:MAX_PANELS].mean(axis=-1)
    if not np.isin(shares, (0.0, 1.0)).all():  # else the times show the same
        captions["success_rate"] = (
            f"Share of {format_count(source.draws, 'draw')} ok, {criterion.plural_description}."
        )
    for figure_name, caption in captions.items():
        column = settle if figure_name == "settling_time" else ok
        figure = plots.plot_map(table, axes[0], axes[1], column, by=by, best=best, title=title)
        end = criterion.figure_suffix(source.success_measures[0])
        yield Picture(f"{figure_name}{end}", f"{caption}{mark}", figure)


def _curves_along_axis(
    source: Results, name: str, axis: str, line_keys: Sequence[str], note: str = ""
) -> Iterator[Picture]:
    """Yield the curves along a key; along a drawn one, which has a note, only if it acts."""
    measure = source.success_measures[0]
    titles = {
        f"{measure.settle_column}_median": f"median time (s) to {measure.description}",
        measure.rate_column: f"share of runs that are ok, {measure.plural_description} (%)",
        "phi_u_arcmin_rms": "heading error at the end, rms (arcmin)",
    }
    table = source.rows([*line_keys, axis, *success_columns(source.study), *REQUIRED_COLUMNS])
    values, panels = build_comparison_panels(table, axis, line_keys, titles)
    if note and not has_significant_effect(panels):
        return
    text = (
        "How soon their heading enters the band for good, how many runs are ok, and how large the"
        f" heading error is. {describe_intervals(source, quantity='Estimate')}"
    )
    lines = sum(1 for _ in analysis.group_rows(table.select(line_keys), line_keys))
    if lines > MAX_LINES:
        text += f" {lines - MAX_LINES} more lines are not drawn."
    yield Picture(name, text + note, plots.draw_along_axis(axis, values, panels))


def bin_drawn_keys(source: Results) -> dict[str, tuple[Results, tuple[float, ...]]]:
    """Return the runs of each drawn number of a study in bins of about as many draws.

    Returns:
        By key: the runs with the median of their bin as the value of the key, draws in that order
        and only the columns that statistics need; and these medians, ascending. No key of which
        there are too few draws for two bins.
    """
    study, found = source.study, {}
    count = min(_MAX_BINS, source.draws // _MIN_DRAWS_PER_BIN)
    columns = ["run_id", "variant_id", *study.keys_shown, *REQUIRED_COLUMNS]
    columns += success_columns(study)
    for key in study.drawn_keys if count > 1 else ():
        if NUMBERS_DRAWN[key] > 1:
            continue
        table = source.rows([key, *columns])
        medians = bin_medians(analysis.numeric_column(table, key), count)
        table = table.set_column(table.column_names.index(key), key, pa.array(medians))
        table = table.sort_by([(key, "ascending"), ("run_id", "ascending")])
        bins = tuple(map(float, np.unique(medians)))
        if len(bins) > 1:
            found[key] = Results(study, None, tables={"summary": table}), bins
    return found


def bin_medians(values: NDArray, n_bins: int) -> NDArray:
    """Return the median of the bin of each value; few distinct values are bins of their own.

    Args:
        values: (n,) finite ones.
        n_bins: number of bins, of about as many values each.
    """
    if len(np.unique(values)) <= n_bins:
        return values
    edges = np.quantile(values, np.arange(1, n_bins) / n_bins)
    number = np.searchsorted(edges, values, side="right")
    medians = np.array([np.median(values[number == n]) for n in range(n_bins)])
    return np.array([float(f"{median:.{_DIGITS}g}") for median in medians])[number]
