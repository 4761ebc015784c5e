"""Whether more than one reset is ever better than one: the best of each against the other."""

from collections.abc import Iterator, Sequence

import numpy as np

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_difference, format_estimate
from sinsjax.plots import Scale, Shown
from sinsjax.report.base import Block, Picture, Table, Text, percent, value_text, yardstick
from sinsjax.report.reset_best import Contest, Pick, contests, held_out_for_all
from sinsjax.report.reset_grid import (
    BAND_ARCMIN,
    FORCES,
    LEVEL,
    NONE,
    READING_CELLS,
    YAW,
    Answer,
    Grid,
    against,
    median,
    point_name,
    shared,
)


def answer(grid: Grid) -> Answer:
    """Question 1, with the figures of what no, one and more resets give."""
    found = contests(grid, range(len(grid.readings)))
    measured = [c for c in found if c.at[0] in grid.measured]
    blocks: list[Block] = [
        Text(_method(grid)),
        *_pictures(grid, found),
        _counts(grid, found),
        _for_all(grid),
        _points(grid, measured),
    ]
    return Answer(_headline(grid, measured), "Is more than one reset ever better than one?", blocks)


def _headline(grid: Grid, found: Sequence[Contest]) -> str:
    told = [c.better for c in found]
    only = sum(c.only_more for c in found if c.better == "more")
    at = (grid.paper_reading, *grid.paper_point)
    here = next(c for c in found if c.at == at)
    return (
        f"Is more than one reset better than one? With the measured force the best of more than one"
        f" settles sooner than the best single reset at {told.count('more')} of {len(found)} points"
        f" of misalignment and reading, of which at {only} most draws never settle with one;"
        f" the single one is sooner at {told.count('one')}, and no difference is shown at the rest."
        f" By chance it would be {_by_chance(found):.1f} each way. At the"
        f" paper's {point_name(grid, at)}, {grid.readings[at[0]].name}, it"
        f" {against(here.saved_s, 'the best single reset')}."
    )


def _by_chance(found: Sequence[Contest]) -> float:
    """At how many points an interval would lie to one given side of 0 if nothing differed."""
    return sum(contest.by_chance for contest in found)


def _method(grid: Grid) -> str:
    ones, mores = len(grid.with_count(1, 1)), len(grid.with_count(2))
    return (
        f"At every misalignment and reading the best of {ones} schedules with one reset stands"
        f" against the best of {mores} with more. The best is where most draws settle to"
        f" {BAND_ARCMIN} arcmin, then where the median settling time is least. A choice told by the"
        " draws that made it would flatter the longer list, so each"
        f" half of the {grid.draws} draws chooses, and the other half tells; differences are paired"
        " on the same noise. A run that never settles counts as one that takes for ever."
    )


def _pictures(grid: Grid, found: Sequence[Contest]) -> Iterator[Picture]:
    shape = (len(grid.levels), len(grid.yaws))
    picked = {c.at: (c.one.median.value, c.more.median.value) for c in found}
    none = median(grid.settle_s[:, :, :, grid.schedule(NONE)])
    for q in dict.fromkeys(r.q for r in grid.readings):
        panels = []
        for feedback in dict.fromkeys(r.feedback_s for r in grid.readings if r.q == q):
            here, there = (grid.reading(f, q, feedback) for f in FORCES)
            best = np.array([picked[here, *at] for at in np.ndindex(shape)]).reshape(*shape, 2)
            panels += [
                (f"none, {feedback:g} s", none[here]),
                (f"one, {feedback:g} s", best[..., 0]),
                (f"more, {feedback:g} s", best[..., 1]),
                (f"none, gravity, {feedback:g} s", none[there]),
            ]
        yield Picture(
            f"settling_{q}",
            f"Median settling time to {BAND_ARCMIN} arcmin over {grid.draws} draws, Q `{q}`:"
            " without reset, with the best single one, with the best of more, and without reset"
            " where A(t) has gravity instead of the measured force; a line for each feedback"
            " interval. Hatched: at least half of the draws never settle."
            f" {yardstick(grid.study)}",
            plots.heat_maps(
                panels,
                f"How long does the heading take? Resets and feedback interval, Q {q}",
                Shown("median settling time (s)", 0.0, grid.study.run_s, reverse=True),
                rows=Scale(LEVEL, grid.levels),
                columns=Scale(YAW, grid.yaws),
                across=4,
            ),
        )


def _counts(grid: Grid, found: Sequence[Contest]) -> Table:
    rows = []
    for i, reading in enumerate(grid.readings):
        here = [c for c in found if c.at[0] == i]
        told = [c.better for c in here]
        most = min(here, key=lambda c: c.saved_s.value if np.isfinite(c.saved_s.value) else np.inf)
        gain = most if np.isfinite(most.saved_s.value) else None
        rows.append(
            [
                *reading.cells,
                *(str(told.count(word)) for word in ("more", "one", "", "neither")),
                str(sum(c.only_more for c in here)),
                format_difference(gain.saved_s, digits=0) if gain else "-",
                point_name(grid, gain.at) if gain else "-",
            ]
        )
    header = [
        *READING_CELLS,
        "more is better",
        "one is better",
        "no difference shown",
        "neither settles",
        "only more settles",
        "more minus one, least (s)",
        "at",
    ]
    return Table(
        f"At how many of {grid.n_points} misalignments, by reading",
        header,
        rows,
        "*Better*: the 95 % interval of the difference of the median settling times lies to one"
        f" side of 0; by chance that would be so at {_by_chance(found) / len(grid.readings):.1f}"
        " points of a row, each way, counted with the two swapped in draws picked at random."
        " *Only more settles*: half of the draws or more, where fewer settle with one;"
        " counted as better too if the interval says so. *Least*: the finite difference most in"
        " favour of more resets, picked, so its interval is too hopeful; all differences are in the"
        " folded table.",
    )


def _for_all(grid: Grid) -> Table:
    rows = []
    ones, mores = grid.with_count(1, 1), grid.with_count(2)
    for i in grid.measured:
        picks = [
            held_out_for_all(grid.settle_s[i], places, grid.study.run_s) for places in (ones, mores)
        ]
        cells = [
            cell
            for pick in picks
            for cell in (
                pick.name(grid),
                percent(_settled_share(grid, i, pick)),
                format_estimate(analysis.mean(pick.settle_s), digits=0),
            )
        ]
        apart = analysis.difference(picks[1].settle_s, picks[0].settle_s)
        rows.append([*grid.readings[i].cells[1:], *cells, format_estimate(apart, digits=0)])
    kinds = [
        f"{kind}: {what}"
        for kind in ("one", "more")
        for what in ("schedule", "settled (%)", "mean (s)")
    ]
    return Table(
        "One schedule for all misalignments",
        [*READING_CELLS[1:], *kinds, "more minus one (s)"],
        rows,
        "Measured force. The schedule with the least mean settling time over all misalignments, a"
        f" run that never settles counted as {grid.study.run_s:g} s; chosen by one half of the"
        " draws and told by the other, both named where they differ. Intervals over the noise, the"
        " misalignments being given: where no draw differs, that of a mean has no width.",
    )


def _settled_share(grid: Grid, reading: int, pick: Pick) -> Estimate:
    """Share of the misalignments that settle."""
    settled = np.isfinite(grid.settle_s[reading])
    return shared(np.take_along_axis(settled, pick.places[None, None, None], axis=2))


def _points(grid: Grid, found: Sequence[Contest]) -> Table:
    rows = []
    for contest in found:
        reading, level, yaw = contest.at
        none = grid.settle_s[*contest.at, grid.schedule(NONE)]
        cells = [
            cell
            for pick in (contest.one, contest.more)
            for cell in (
                pick.name(grid),
                percent(pick.settled),
                format_estimate(pick.median, digits=0),
            )
        ]
        rows.append(
            [
                *grid.readings[reading].cells[1:],
                value_text(grid.levels[level]),
                value_text(grid.yaws[yaw]),
                format_estimate(analysis.quantile(none), digits=0),
                *cells,
                format_difference(contest.saved_s, digits=0, sides=("more", "one")),
                contest.better or "-",
            ]
        )
    kinds = [
        f"{kind}: {what}"
        for kind in ("one", "more")
        for what in ("schedule", "settled (%)", "median (s)")
    ]
    header = [
        *READING_CELLS[1:],
        "level (deg)",
        "yaw (deg)",
        "none: median (s)",
        *kinds,
        "more minus one (s)",
        "better",
    ]
    note = "Number [95 % interval]. Measured force; two schedules: each half chose its own."
    return Table("Every misalignment and reading", header, rows, note, folded=True)
