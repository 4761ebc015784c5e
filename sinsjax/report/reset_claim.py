"""Where paper 1's claim holds: resets cure the large misalignment, as precisely as a small one."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate, format_difference, format_estimate
from sinsjax.plots import COLOURS, Scale
from sinsjax.plots.kinds import Kind, kind_maps
from sinsjax.report.base import Block, Picture, Table, Text, percent, value_text, yardstick
from sinsjax.report.reset_best import held_out
from sinsjax.report.reset_grid import (
    LEVEL,
    NONE,
    PAPER_SCHEDULE,
    READING_CELLS,
    YAW,
    Answer,
    Grid,
    against,
    point_name,
)

KINDS = (
    Kind("o", "settles without reset", "#dcdcdc"),
    Kind("+", "cured by the three, by one too", COLOURS[5]),
    Kind("3", "cured by the three, not by one", COLOURS[0], dark=True),
    Kind("~", "settled, precision not shown", COLOURS[4]),
    Kind("x", "not settled by the three", COLOURS[1], dark=True),
)
"""What the paper's claim comes to at a point, all but the first where it fails without reset."""

NOT_NEEDED, ONE_TOO, SEVERAL, COARSE, NOT_CURED = range(len(KINDS))
_HOLDS = (ONE_TOO, SEVERAL)


class Claim(NamedTuple):
    """The paper's claim at a point, by its parts.

    Attributes:
        at: places of its reading, level and yaw.
        none: share of the draws that settle without reset.
        three: share that settles with the paper's schedule.
        one: share that settles with the best single reset, held out.
        apart: window mean of phi_u with the paper's schedule minus that of the smallest
            misalignment without reset, on the same noise, arcmin.
        later_s: median settling time with the paper's schedule minus that of the smallest
            misalignment without reset, on the same noise.
        kind: place in `KINDS`.
    """

    at: tuple[int, int, int]
    none: Estimate
    three: Estimate
    one: Estimate
    apart: Estimate
    later_s: Estimate
    kind: int


def claims(grid: Grid, readings: Sequence[int]) -> list[Claim]:
    """The claim at every misalignment of some readings."""
    return [
        _claim(grid, (reading, level, yaw))
        for reading in readings
        for level, yaw in np.ndindex(grid.settle_s.shape[1:3])
    ]


def _claim(grid: Grid, at: tuple[int, int, int]) -> Claim:
    without, three = (grid.schedule(schedule) for schedule in (NONE, PAPER_SCHEDULE))
    settle, small = grid.settle_s[at], (at[0], 0, 0, without)
    shares = _settled(settle[without]), _settled(settle[three])
    one = held_out(settle, grid.with_count(1, 1)).settled
    apart = analysis.difference(grid.yaw_mean[*at, three], grid.yaw_mean[small])
    return Claim(
        at,
        *shares,
        one,
        apart,
        later_s=analysis.quantile_difference(settle[three], grid.settle_s[small]),
        kind=_kind(grid, (*shares, one), apart),
    )


def _settled(settle_s: NDArray) -> Estimate:
    return analysis.proportion(int(np.isfinite(settle_s).sum()), settle_s.size)


def _kind(grid: Grid, shares: Sequence[Estimate], apart: Estimate) -> int:
    """Place in `KINDS`, from the shares without reset, with the three, with the best one."""
    meaning = grid.study.statements
    none, three, one = (share.value >= meaning.converges_share for share in shares)
    if none:
        return NOT_NEEDED
    if not three:
        return NOT_CURED
    limit = meaning.as_precise_arcmin
    if not (-limit < apart.low and apart.high < limit and apart.n == grid.draws):
        return COARSE
    return ONE_TOO if one else SEVERAL


def answer(grid: Grid) -> Answer:
    """Question 4."""
    found = claims(grid, grid.measured)
    blocks: list[Block] = [
        Text(_words(grid)),
        _at_condition_5(grid, found),
        _picture(grid, found),
        _counts(grid, found),
    ]
    return Answer(_headline(grid, found), "Where does the paper's claim hold?", blocks)


def _headline(grid: Grid, found: Sequence[Claim]) -> str:
    paper = [c for c in found if c.at[1:] == grid.paper_point]
    holding = [grid.readings[c.at[0]].name for c in paper if c.kind in _HOLDS]
    here = next(c for c in paper if c.at[0] == grid.paper_reading)
    counts = Counter(c.kind for c in found)
    return (
        f"Where does the paper's claim hold? At {point_name(grid, here.at)} under"
        f" {len(holding)} of {len(paper)} readings ({'; '.join(holding) or 'none'}). Over"
        f" {len(found)} points of misalignment and reading {counts[NOT_NEEDED]} settle without"
        f" reset; of the others the paper's three cure {counts[ONE_TOO] + counts[SEVERAL]}, and at"
        f" {counts[ONE_TOO]} of these one does too. It is no claim on speed: at the paper's point,"
        f" {grid.readings[here.at[0]].name}, the heading with the three"
        f" {against(here.later_s, 'that of the smallest misalignment without reset')}."
    )


def _words(grid: Grid) -> str:
    meaning, small = grid.study.statements, point_name(grid, (0, 0, 0))
    start, end = grid.study.study.window_s
    return (
        "The paper: the standard filter fails with large misalignment; reset several times before"
        " the steady process it fulfils the alignment, as precise as with small misalignment. Here"
        f" *fails*: less than {meaning.converges_share:g} of the draws settle; *cure*: at least"
        f" {meaning.converges_share:g} settle with resets at {value_text(list(PAPER_SCHEDULE))} s,"
        f" and the mean of phi_u over {start:g} to {end:g} s is, interval included, within"
        f" {meaning.as_precise_arcmin:g} arcmin of that of the smallest misalignment, {small},"
        " without reset, same reading and noise."
    )


def _at_condition_5(grid: Grid, found: Sequence[Claim]) -> Table:
    rows = [
        [
            *grid.readings[c.at[0]].cells[1:],
            *(percent(share) for share in (c.none, c.three, c.one)),
            format_estimate(c.apart, digits=2),
            format_difference(c.later_s, digits=0, sides=("with the three", "the smallest")),
            KINDS[c.kind].name,
        ]
        for c in found
        if c.at[1:] == grid.paper_point
    ]
    header = [
        *READING_CELLS[1:],
        "ok without (%)",
        "ok with the three (%)",
        "ok with the best one (%)",
        "phi_u from the smallest's (arcmin)",
        "settles later than the smallest by (s)",
        "so",
    ]
    note = (
        f"Number [95 % interval over {grid.draws} draws]. Measured force. *From*, *later*: with the"
        " three, paired on the same noise."
    )
    here = (grid.paper_reading, *grid.paper_point)
    return Table(f"The paper's {point_name(grid, here)}", header, rows, note)


def _picture(grid: Grid, found: Sequence[Claim]) -> Picture:
    kinds = np.empty(grid.settle_s.shape[:3], dtype=int)
    for c in found:
        kinds[c.at] = c.kind
    readings = [grid.readings[i] for i in grid.measured]
    panels = [
        (f"{r.q}, {r.feedback_s:g} s", kinds[i])
        for i, r in zip(grid.measured, readings, strict=True)
    ]
    return Picture(
        "claim",
        "What the paper's three resets do at each misalignment, by reading of Q and feedback"
        f" interval, {grid.draws} draws, measured force. All but the first kind fail without reset;"
        f" *one*: the best single reset. {yardstick(grid.study)}",
        kind_maps(
            panels,
            KINDS,
            "Where do the paper's three resets help? By Q and feedback",
            rows=Scale(LEVEL, grid.levels),
            columns=Scale(YAW, grid.yaws),
            across=len({r.feedback_s for r in readings}),
        ),
    )


def _counts(grid: Grid, found: Sequence[Claim]) -> Table:
    rows = []
    for i in grid.measured:
        here = Counter(c.kind for c in found if c.at[0] == i)
        rows.append([*grid.readings[i].cells[1:], *(str(here[kind]) for kind in range(len(KINDS)))])
    header = [*READING_CELLS[1:], *(kind.name for kind in KINDS)]
    return Table(f"At how many of {grid.n_points} misalignments", header, rows)
