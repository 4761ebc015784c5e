"""Tables and figures over a study's swept numbers: heat maps, and curves with intervals."""

from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.analysis.grids import panels_of
from sinsjax.analysis.summaries import NEEDED
from sinsjax.execution.source import Source
from sinsjax.messages import counted
from sinsjax.plots.maps import MOST_PANELS
from sinsjax.plots.spreads import acts, compare_panels
from sinsjax.report.base import Block, Picture, Text, intervals
from sinsjax.report.groupings import BINS, binned, lines_left
from sinsjax.report.markup import said
from sinsjax.study.keys import is_condition_key, is_method_setting
from sinsjax.study.success import FLOOR_COLUMNS, SuccessMeasure, success_columns

_NOT_CONVERGED = "not converged"
_FLAG = "flagged"


def over_axes(source: Source) -> list[Block]:
    """What the swept numbers decide.

    With two numeric axes or more, heat maps over the first two as the study writes them, a panel
    for each point of all other keys; with one, or one whose values are lists, curves with
    intervals; with none, nothing. Then curves over each drawn number.
    """
    shown, others = source.study.figure_axes
    found: list[Block]
    if len(shown) == 2:
        found = [block for yard in source.success_measures for block in _heat_maps(source, yard)]
    else:
        found = [one for axis in shown if (one := _along_axis(source, axis, others))]
    idle = []
    for key, (own, _) in binned(source).items():
        drawn = _along_axis(own, key, source.study.keys_shown, only_if_it_acts=True)
        if drawn is None:
            idle.append(key)
            continue
        found.append(drawn._replace(name=f"over_{key}", caption=f"{drawn.caption} {key}: {BINS}"))
    if idle:
        found.append(Text(f"No figure over {', '.join(idle)}: no effect beyond the intervals."))
    return found


def repeats(source: Source) -> Iterator[Text]:
    """How tables count runs that equal others, if there are any."""
    if keys := source.study.idle_keys():
        variants, kept = source.study.n_variants, len({*source.study.duplicate_of})
        yield Text(said("repeats", source=source, variants=variants, kept=kept, keys=keys))


class Maps:
    """Heat maps over the first two swept numbers, a panel for each point of all other keys.

    Attributes:
        axes: the two numbers with their values, rows first.
        panels: all of them.
    """

    def __init__(self, source: Source, columns: Sequence[str]) -> None:
        axes, self._by = source.study.figure_axes
        down, across = axes
        self._keys = (down, across)
        times = [name for name in ("reset_times_s",) if "reset_count" in axes]
        self._table = source.rows([*self._by, *axes, *columns, *times])
        self.axes, self.panels = panels_of(self._table, down, across, self._by)
        self._repeats = (source.study.duplicate_of != np.arange(source.study.n_variants)).any()

    def draw(
        self, name: str, caption: str, value: str, flag: NDArray | None = None, meaning: str = ""
    ) -> Picture:
        """The figure of a column; cells are hatched in which most runs have a flag, (runs,)."""
        if len(self.panels) > MOST_PANELS:
            caption += f" The first {MOST_PANELS} of {len(self.panels)} panels."
        if self._repeats:
            caption += " Cells that share a number have the same runs: there a key does not act."
        table = self._table
        if flag is not None:
            table = table.append_column(_FLAG, pa.array(flag))
        figure = plots.plot_map(
            table,
            self._keys[0],
            self._keys[1],
            value,
            by=self._by,
            pooled=[key for key in self._by if is_condition_key(key)],
            hatched=_FLAG if flag is not None else "",
            hatch_name=meaning,
        )
        return Picture(name, f"{caption} Framed: the best of each panel.", figure)

    def of(self, column: str) -> NDArray:
        """A column of all runs as numbers, (runs,); null is NaN."""
        return analysis.numbers(self._table, column)


def _heat_maps(source: Source, yard: SuccessMeasure) -> Iterator[Block]:
    """The maps from one yardstick, and only those that show something."""
    maps = Maps(source, (yard.settle_column, yard.ok_column, *FLOOR_COLUMNS, "draw_id", "start_s"))
    shown = maps.panels[: 2 * MOST_PANELS]
    every = [
        one.cells(yard.ok_column, yard.settle_column, yard.outside_floor_band(one.of))
        for one in shown
    ]
    cells, end = every[:MOST_PANELS], yard.figure_suffix(source.success_measures[0])
    if not any((np.isfinite(one.median_s) & ~one.not_converged).any() for one in cells):
        return  # no cell is within the band, or those that are only pass through it
    off = np.where(maps.of(yard.ok_column) > 0, yard.outside_floor_band(maps.of), np.nan)
    hatched = np.any([one.not_converged for one in cells])
    mark = f" Cross-hatched: {said('not_converged', yard=yard)}" if hatched else ""
    yield maps.draw(
        f"settling_time{end}",
        f"Median time over {counted(source.draws, 'draw')} until the heading stays"
        f" {yard.description}; grey where at least half of the runs never do.{mark}",
        yard.settle_column,
        off,
        _NOT_CONVERGED,
    )
    shares = np.array([one.share for one in cells])
    if not np.isin(shares, (0.0, 1.0)).all():  # else the settling times say it all
        yield maps.draw(
            f"success_rate{end}",
            f"Share of {counted(source.draws, 'draw')} ok, {yard.plural_description}.{mark}",
            yard.ok_column,
            off,
            _NOT_CONVERGED,
        )


def _along_axis(
    source: Source, axis: str, others: Sequence[str], *, only_if_it_acts: bool = False
) -> Picture | None:
    shown = {
        f"{y.settle_column}_median": f"median time (s) to {y.description}"
        for y in source.success_measures
    }
    shown |= {
        y.rate_column: f"share of runs that are ok, {y.plural_description} (%)"
        for y in source.success_measures
    }
    shown["phi_u_arcmin_rms"] = "heading error at the end, rms (arcmin)"
    table = source.rows([*others, axis, *success_columns(source.study), *NEEDED])
    values, panels = compare_panels(table, axis, others, shown)
    if only_if_it_acts and not acts(panels):
        return None
    left = "; ".join(words for words in shown.values() if words not in panels)
    return Picture(
        "along_axis",
        "How soon their heading enters the band for good, how many runs are ok, and how large the"
        f" heading error is. {intervals(source, what='Estimate')}{lines_left(table, others)}"
        + (f" Left out, since it shows nothing more: {left}." if left else ""),
        plots.along_axis(axis, values, panels, condition=not is_method_setting(axis)),
    )
