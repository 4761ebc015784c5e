"""Tables and figures over a study's swept numbers: heat maps, and curves with intervals."""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sinsjax import analysis, plots
from sinsjax.analysis.grids import split_into_panels
from sinsjax.analysis.summaries import REQUIRED_COLUMNS
from sinsjax.execution.results import Results
from sinsjax.messages import format_count
from sinsjax.plots.comparison import build_comparison_panels, has_significant_effect
from sinsjax.plots.maps import MAX_PANELS
from sinsjax.report.base import Block, Picture, describe_intervals
from sinsjax.report.grouping import BINS_NOTE, bin_drawn_keys, describe_undrawn_lines
from sinsjax.study.keys import is_condition_key, is_method_setting
from sinsjax.study.study import Study
from sinsjax.study.success import FLOOR_COLUMNS, SuccessMeasure, success_columns

_NOT_CONVERGED = "not converged"
_FLAG = "flagged"


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
    blocks: list[Block]
    if len(axes) == 2:
        blocks = [
            block for yard in source.success_measures for block in _heat_map_figures(source, yard)
        ]
    else:
        blocks = [
            figure for axis in axes if (figure := _axis_curve_figure(source, axis, line_keys))
        ]
    insignificant = []
    for key, (binned_source, _) in bin_drawn_keys(source).items():
        drawn = _axis_curve_figure(
            binned_source, key, source.study.keys_shown, only_if_significant=True
        )
        if drawn is None:
            insignificant.append(key)
            continue
        blocks.append(
            drawn._replace(name=f"over_{key}", caption=f"{drawn.caption} {key}: {BINS_NOTE}")
        )
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


def _heat_map_figures(source: Results, criterion: SuccessMeasure) -> Iterator[Block]:
    """Yield the maps by one criterion of success, without those that show nothing.

    They are over the first two swept numbers, a panel for each point of all other keys.
    """
    (row_key, column_key), by = figure_axes(source.study)
    columns = (criterion.settle_column, criterion.ok_column, *FLOOR_COLUMNS, "draw_id", "start_s")
    times = [name for name in ("reset_times_s",) if "reset_count" in (row_key, column_key)]
    table = source.rows([*by, row_key, column_key, *columns, *times])
    # A run that ends without success settles never, as in the verdict.
    settle_s = pc.if_else(table[criterion.ok_column], table[criterion.settle_column], None)
    place = table.column_names.index(criterion.settle_column)
    table = table.set_column(place, table.field(place), settle_s)
    _, panels = split_into_panels(table, row_key, column_key, by)
    numbers = partial(analysis.numeric_column, table)
    cells = [
        one.cell_outcomes(
            criterion.ok_column,
            criterion.settle_column,
            criterion.outside_floor_band(one.column_values),
        )
        for one in panels[:MAX_PANELS]
    ]
    if not any((np.isfinite(one.median_s) & ~one.not_converged).any() for one in cells):
        return  # no cell is within the band, or cells only pass through it
    off_floor = np.where(
        numbers(criterion.ok_column) > 0, criterion.outside_floor_band(numbers), np.nan
    )
    mark = (
        f" Cross-hatched: most of the runs that are ok end more than {criterion.band_arcmin:g}'"
        " from their bias floors, and their errors happen to be small."
        if np.any([one.not_converged for one in cells])
        else ""
    )
    if len(panels) > MAX_PANELS:
        mark += f" The first {MAX_PANELS} of {len(panels)} panels."
    end = criterion.figure_suffix(source.success_measures[0])

    def draw(name: str, caption: str, column: str) -> Picture:
        """Draw a map; cells are hatched in which most runs are off their bias floor."""
        figure = plots.plot_map(
            table.append_column(_FLAG, pa.array(off_floor)),
            row_key,
            column_key,
            column,
            by=by,
            pooled=[key for key in by if is_condition_key(key)],
            hatched=_FLAG,
            hatch_name=_NOT_CONVERGED,
        )
        return Picture(f"{name}{end}", f"{caption}{mark}", figure)

    yield draw(
        "settling_time",
        f"Median time over {format_count(source.draws, 'draw')} until the heading stays"
        f" {criterion.description}; grey where at least half of the runs never do.",
        criterion.settle_column,
    )
    shares = np.array([one.success_share for one in cells])
    if not np.isin(shares, (0.0, 1.0)).all():  # else the settling times show the same
        yield draw(
            "success_rate",
            f"Share of {format_count(source.draws, 'draw')} ok, {criterion.plural_description}.",
            criterion.ok_column,
        )


def _axis_curve_figure(
    source: Results, axis: str, line_keys: Sequence[str], *, only_if_significant: bool = False
) -> Picture | None:
    titles = {
        f"{y.settle_column}_median": f"median time (s) to {y.description}"
        for y in source.success_measures
    }
    titles |= {
        y.rate_column: f"share of runs that are ok, {y.plural_description} (%)"
        for y in source.success_measures
    }
    titles["phi_u_arcmin_rms"] = "heading error at the end, rms (arcmin)"
    table = source.rows([*line_keys, axis, *success_columns(source.study), *REQUIRED_COLUMNS])
    values, panels = build_comparison_panels(table, axis, line_keys, titles)
    if only_if_significant and not has_significant_effect(panels):
        return None
    left = "; ".join(words for words in titles.values() if words not in panels)
    return Picture(
        "along_axis",
        "How soon their heading enters the band for good, how many runs are ok, and how large the"
        f" heading error is. {describe_intervals(source, quantity='Estimate')}"
        f"{describe_undrawn_lines(table, line_keys)}"
        + (f" Left out, since it shows nothing more: {left}." if left else ""),
        plots.draw_along_axis(axis, values, panels, condition=not is_method_setting(axis)),
    )
