"""When a reset must come: success and settling against the time of the only or first reset."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.plots import Scale, Shown
from sinsjax.report.base import Block, Picture, Table, percent, value_text, yardstick
from sinsjax.report.reset_grid import (
    BAND_ARCMIN,
    LEVEL,
    NONE,
    PAPER_READING,
    READING_CELLS,
    Answer,
    Grid,
    median,
    point_name,
    schedule_name,
)

_MOST_SCHEDULES = 8


class Single(NamedTuple):
    """A single reset at a point, over all times of it.

    Attributes:
        at: places of its reading, level and yaw.
        none: share of the draws that settle without it.
        works: times with which at least the share that *converges* means settle, s.
        fastest: the time with which most draws settle, and settle first, s.
        fastest_s: settling time with it.
        latest_s: settling time with the latest time of the study.
    """

    at: tuple[int, int, int]
    none: Estimate
    works: tuple[float, ...]
    fastest: float
    fastest_s: Estimate
    latest_s: Estimate


def answer(grid: Grid) -> Answer:
    """Question 2."""
    found = singles(grid)
    here = [one for one in found if one.at[0] == grid.paper_reading]
    others = [one for one in found if one.at[0] != grid.paper_reading]
    blocks: list[Block] = [
        _picture(grid),
        _windows(grid, here, f"A single reset, {PAPER_READING.name}"),
        _by_misalignment(grid, found),
        _schedules(grid),
    ]
    if others:
        blocks.append(_windows(grid, others, "A single reset, all other readings", folded=True))
    return Answer(_headline(grid, found), "When must the reset come?", blocks)


def singles(grid: Grid) -> list[Single]:
    """A single reset at every misalignment and reading with the measured force."""
    places = grid.with_count(1, 1)
    times = [grid.schedules[i][0] for i in places]
    least = grid.study.statements.converges_share
    found = []
    for reading in grid.measured:
        for level, yaw in np.ndindex(grid.settle_s.shape[1:3]):
            runs = grid.settle_s[reading, level, yaw]
            settle = runs[places]
            share = np.isfinite(settle).mean(axis=-1)
            fastest = int(np.lexsort((median(settle), -share))[0])
            without = np.isfinite(runs[grid.schedule(NONE)])
            found.append(
                Single(
                    at=(reading, level, yaw),
                    none=analysis.proportion(int(without.sum()), grid.draws),
                    works=tuple(t for t, s in zip(times, share, strict=True) if s >= least),
                    fastest=times[fastest],
                    fastest_s=analysis.quantile(settle[fastest]),
                    latest_s=analysis.quantile(settle[-1]),
                )
            )
    return found


def _headline(grid: Grid, found: Sequence[Single]) -> str:
    at = (grid.paper_reading, *grid.paper_point)
    here = next(one for one in found if one.at == at)
    singly = grid.with_count(1, 1)
    first, last = (grid.schedules[singly[end]][0] for end in (0, -1))
    counts = [
        sum(condition(one.works) for one in found)
        for condition in (bool, lambda w: first in w, lambda w: last in w)
    ]
    return (
        f"When must it come? With a single reset at {point_name(grid, at)},"
        f" {PAPER_READING.name}, the heading {_works(here)}; soonest with one at"
        f" {here.fastest:g} s, {format_estimate(here.fastest_s, 's', 0)}"
        f"{_on_bound(here.fastest, first, last)}; at {last:g} s it is"
        f" {format_estimate(here.latest_s, 's', 0)}. Over {len(found)} points of misalignment and"
        f" reading one reset is enough at {counts[0]}: at {first:g} s it is at {counts[1]}, at"
        f" {last:g} s at {counts[2]}."
    )


def _on_bound(time: float, first: float, last: float) -> str:
    """Says so where the best time is the first or last of those tried, so that it is no optimum."""
    words = {first: ("earliest", "earlier"), last: ("latest", "later")}
    if time not in words:
        return ""
    end, beyond = words[time]
    return f" ({time:g} s is the {end} time tried: one still {beyond} may be better)"


def _works(one: Single) -> str:
    """In words, from when to when a single reset settles."""
    if not one.works:
        return "does not settle, whenever it comes"
    times = ", ".join(f"{time:g}" for time in one.works)
    return f"settles if it comes at {times} s"


def _picture(grid: Grid) -> Picture:
    places = grid.with_count(1, 1)
    readings = [i for i in grid.measured if grid.readings[i].q == PAPER_READING.q]
    panels = [
        (
            f"yaw {yaw:g} deg, {grid.readings[i].feedback_s:g} s",
            median(grid.settle_s[i, :, j][:, places]),
        )
        for i in readings
        for j, yaw in enumerate(grid.yaws)
    ]
    return Picture(
        "single_reset",
        f"Median settling time to {BAND_ARCMIN} arcmin over {grid.draws} draws against the time of"
        f" the only reset, Q `{PAPER_READING.q}`, measured force; a column for each yaw error, a"
        " line for each feedback interval. Hatched: at least half of the draws never settle."
        f" {yardstick(grid.study)}",
        plots.heat_maps(
            panels,
            f"When must a single reset come? By yaw and feedback interval, Q {PAPER_READING.q}",
            Shown("median settling time (s)", 0.0, grid.study.run_s, reverse=True),
            rows=Scale(LEVEL, grid.levels),
            columns=Scale("time of the reset_s", [grid.schedules[i][0] for i in places]),
            across=len(grid.yaws),
        ),
    )


def _windows(grid: Grid, found: Sequence[Single], title: str, *, folded: bool = False) -> Table:
    rows = []
    for one in found:
        reading, level, yaw = one.at
        rows.append(
            [
                *grid.readings[reading].cells[1:],
                value_text(grid.levels[level]),
                value_text(grid.yaws[yaw]),
                percent(one.none),
                ", ".join(map(value_text, one.works)) or "never",
                value_text(one.fastest) if np.isfinite(one.fastest_s.value) else "-",
                format_estimate(one.fastest_s, digits=0),
                format_estimate(one.latest_s, digits=0),
            ]
        )
    first, last = (grid.schedules[grid.with_count(1, 1)[end]][0] for end in (0, -1))
    header = [
        *READING_CELLS[1:],
        "level (deg)",
        "yaw (deg)",
        "ok without (%)",
        "settles with one at (s)",
        "soonest with one at (s)",
        "median then (s)",
        f"median with one at {last:g} s (s)",
    ]
    least = grid.study.statements.converges_share
    note = (
        f"Number [95 % interval over {grid.draws} draws]. *Settles*: at least {least:g} of the"
        " draws. *Soonest* is picked among the times on the same draws, which flatters it a"
        f" little; at {first:g} and {last:g} s it stands at an end of the times tried, and a better"
        " time may lie beyond."
    )
    return Table(title, header, rows, note, folded)


def _by_misalignment(grid: Grid, found: Sequence[Single]) -> Table:
    times = [grid.schedules[i][0] for i in grid.with_count(1, 1)]
    settling = [one for one in found if np.isfinite(one.fastest_s.value)]
    rows = []
    for name, axis, values in (("level", 1, grid.levels), ("yaw", 2, grid.yaws)):
        for place, value in enumerate(values):
            here = Counter(one.fastest for one in settling if one.at[axis] == place)
            points = sum(one.at[axis] == place for one in found)
            cells = [*(str(here[time]) for time in times), str(points - here.total())]
            rows.append([f"{name} {value:g} deg", *cells])
    return Table(
        "At how many points each time of a single reset is the soonest to settle",
        ["", *(f"{time:g} s" for time in times), "none settles"],
        rows,
        "Points of reading and misalignment, measured force. *None settles*: with no time of the"
        " reset do half of the draws settle.",
    )


def _schedules(grid: Grid) -> Table:
    places = grid.with_count(2)
    counts: Counter[int] = Counter()
    for at in np.ndindex(grid.settle_s.shape[:3]):
        settle = grid.settle_s[at][places]
        if at[0] in grid.measured and np.isfinite(median(settle)).any():
            failed = np.isinf(settle).sum(axis=-1)
            counts[places[int(np.lexsort((median(settle), failed))[0])]] += 1
    rows = [
        [schedule_name(grid.schedules[i]), str(n)] for i, n in counts.most_common(_MOST_SCHEDULES)
    ]
    return Table(
        "The schedules of more than one reset that are most often the best",
        ["resets", "points"],
        rows,
        f"Of {counts.total()} points of reading and misalignment at which any of the {len(places)}"
        " schedules settles, measured force.",
    )
