"""Tables and figures over a study's swept numbers: heat maps, and curves with intervals."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.analysis.grids import Panel
from sinsjax.analysis.summaries import NEEDED, estimate_of
from sinsjax.execution.source import Source
from sinsjax.messages import counted
from sinsjax.plots import Shown
from sinsjax.plots.words import name_of, value_text
from sinsjax.report.base import Block, Picture, Text, intervals
from sinsjax.report.groupings import BINS, binned, lines_of
from sinsjax.report.markup import said
from sinsjax.study.success import FLOOR_COLUMNS, Yardstick, judged_columns

MOST_PANELS = 12
_NOT_CONVERGED = "not converged"


def over_axes(source: Source) -> list[Block]:
    """What the swept numbers decide.

    With two numeric axes or more, heat maps over the first two as the study writes them, a panel
    for each point of all other keys; with one, or one whose values are lists, curves with
    intervals; with none, nothing. Then curves over each drawn number.
    """
    shown, others = source.study.figure_axes
    found: list[Block]
    if len(shown) == 2:
        found = [block for yard in source.yardsticks for block in _heat_maps(source, yard)]
    else:
        found = [_along_axis(source, *axis, others) for axis in shown.items()]
    for key, (own, medians) in binned(source).items():
        drawn = _along_axis(own, key, medians, source.study.keys_shown)
        found.append(drawn._replace(name=f"over_{key}", caption=f"{drawn.caption} {key}: {BINS}"))
    return found


def repeats(source: Source) -> Iterator[Text]:
    """How tables count runs that equal others, if there are any."""
    if keys := source.study.idle_keys():
        variants, kept = source.study.n_variants, len({*source.study.duplicate_of})
        yield Text(said("repeats", source=source, variants=variants, kept=kept, keys=keys))


class Maps:
    """Heat maps over the first two swept numbers, a panel for each point of all other keys.

    Attributes:
        axes: the two numbers, rows first.
        panels: all of them.
        drawn: those that have room, in whole lines: one for each value of the other keys but the
            last, if it is short enough.
    """

    def __init__(self, source: Source, columns: Sequence[str]) -> None:
        self.axes, others = source.study.figure_axes
        shape = tuple(map(len, self.axes.values()))
        table = source.rows([*others, *columns, "variant_id"])
        self.panels = [Panel(*group, shape) for group in analysis.groups(table, others)]
        lines = {value_text(panel.point[others[-1]]) for panel in self.panels} if others else [""]
        self._across = len(lines)
        self.drawn = self.panels[: MOST_PANELS // self._across * self._across or MOST_PANELS]
        self._first = source.study.duplicate_of

    def draw(
        self,
        name: str,
        caption: str,
        values: Sequence[NDArray],
        title: str,
        shown: Shown,
        hatched: Sequence[NDArray] = (),
    ) -> Picture:
        """The figure of numbers (rows, columns) of each panel; hatched where not converged."""
        if len(self.drawn) < len(self.panels):
            caption += f" The first {len(self.drawn)} of {len(self.panels)} panels."
        alike = [self._first[panel.of("variant_id")[0].astype(int)] for panel in self.drawn]
        rows, columns = (plots.Scale(key, points) for key, points in self.axes.items())
        figure = plots.heat_maps(
            [(name_of(panel.point), own) for panel, own in zip(self.drawn, values, strict=True)],
            title,
            shown,
            rows=rows,
            columns=columns,
            across=self._across,
            marks=plots.Marks(alike, hatched, _NOT_CONVERGED),
        )
        if any(len(np.unique(one)) < one.size for one in alike):
            caption += " Cells that share a number have the same runs: there a key does not act."
        return Picture(name, caption, figure)


def _heat_maps(source: Source, yard: Yardstick) -> Iterator[Block]:
    """The maps from one yardstick."""
    maps = Maps(source, (yard.settle, yard.ok, *FLOOR_COLUMNS, "draw_id", "start_s"))
    shown = maps.panels[: 2 * MOST_PANELS]
    every = [one.cells(yard.ok, yard.settle, yard.off_floor(one.of)) for one in shown]
    cells, end = every[: len(maps.drawn)], yard.end(source.yardsticks[0])
    hatched = [one.not_converged for one in cells]
    mark = f" Cross-hatched: {said('not_converged', yard=yard)}" if np.any(hatched) else ""
    medians = [one.median_s for one in cells]
    longest_s = np.ma.masked_invalid(medians).compressed().max(initial=1.0)
    yield maps.draw(
        f"settling_time{end}",
        f"Median time over {counted(source.draws, 'draw')} until the heading stays {yard.words};"
        f" grey where at least half of the runs never do.{mark}",
        medians,
        f"How long until the heading stays {yard.words}?",
        Shown("median settling time (s)", 0.0, float(longest_s), reverse=True),
        hatched,
    )
    shares = [100 * one.share for one in cells]
    if plots.differ(shares):
        yield maps.draw(
            f"success_rate{end}",
            f"Share of {counted(source.draws, 'draw')} ok, {yard.of_several}.{mark}",
            shares,
            f"How many runs are ok, {yard.of_several}?",
            Shown("runs that are ok (%)", 0.0, 100.0),
            hatched,
        )


def _along_axis(source: Source, axis: str, values: Sequence[Any], others: Sequence[str]) -> Picture:
    shown = {y.rate: f"share of runs that are ok, {y.of_several}" for y in source.yardsticks}
    shown |= {f"{y.settle}_median": f"median time (s) to {y.words}" for y in source.yardsticks}
    shown["phi_u_arcmin_rms"] = "heading error at the end, rms (arcmin)"
    shown["phi_u_from_floor_arcmin_mean"] = "signed mean of phi_u from its bias floor (arcmin)"
    needed = (*others, axis, *judged_columns(source.study), *NEEDED)
    lines, left = lines_of(source.rows(needed), others)
    found = {
        name: analysis.summarise(rows, [axis], list(shown)).to_pylist()
        for name, rows in lines.items()
    }
    panels = {
        words: {name: [estimate_of(row, statistic) for row in rows] for name, rows in found.items()}
        for statistic, words in shown.items()
    }
    told = {words: panel for words, panel in panels.items() if plots.tells(panel)}
    if empty := "; ".join(words for words in panels if words not in told):
        left += f" Empty, and left out: {empty}."
    return Picture(
        "along_axis",
        "How many runs are ok, when their heading has entered the band for good, and how large the"
        f" heading error is. {intervals(source, what='Estimate')}{left}",
        plots.along_axis(axis, values, told, title=f"What {axis} decides"),
    )
