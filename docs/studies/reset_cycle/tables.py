"""Tables of the page on how many resets to make, and when."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import format_difference, format_estimate
from sinsjax.report.base import Table, percent
from sinsjax.report.grids import Grid, held_out, least_mean, pooled_mean, shared

from .claim import Claim
from .figures import KINDS
from .grid import (
    CONVERGES,
    GRAVITY,
    LEVEL,
    MEASURED,
    NONE,
    PAPER,
    PRINTED,
    QS,
    SETTLE,
    THREE,
    TWO,
    YAW,
    Contest,
    failed_by_level_and_yaw,
    named,
    schedules,
)

_INTERVAL = "Number [95 % interval over the draws]."


def settings(grid: Grid, q: str, run_s: float, *, folded: bool = False) -> Table:
    """What to set and what to expect, over all misalignments."""
    settings_ = [
        ("no reset", MEASURED, NONE),
        *((named(times), MEASURED, times) for times in (TWO, THREE, PAPER)),
        ("no reset, gravity in A(t)", GRAVITY, NONE),
    ]
    rows = [
        [
            name,
            *(
                _expected(grid.at(SETTLE, force=force, q=q, feedback=f, schedule=times), run_s)
                for f in grid.axes["feedback"]
            ),
        ]
        for name, force, times in settings_
    ]
    one = ["one, at its best time", *(_best_one(grid, q, f, run_s) for f in grid.axes["feedback"])]
    rows.insert(1, one)
    header = ["resets", *(f"feedback every {f:g} s" for f in grid.axes["feedback"])]
    note = (
        f"Share that settles, and mean settling time with {run_s:g} s for a run that never does;"
        f" all {len(grid.axes['level']) * len(grid.axes['yaw'])} misalignments, [95 % interval over"
        f" the {grid.draws} draws]. The time of the one reset is chosen for all misalignments"
        " together, on draws that do not tell it."
    )
    return Table(f"All misalignments, {QS[q]}", header, rows, note, folded)


def _expected(settle_s: NDArray, run_s: float) -> str:
    settled = shared(np.isfinite(settle_s))
    mean = pooled_mean(np.minimum(settle_s, run_s))
    return f"{100 * settled.value:.0f} %, {format_estimate(mean, 's', 0)}"


def _best_one(grid: Grid, q: str, feedback: float, run_s: float) -> str:
    times = schedules(grid, 1, 1)
    runs = grid.at(SETTLE, force=MEASURED, q=q, feedback=feedback, schedule=times)
    mean_s = np.minimum(runs, run_s).mean(axis=(0, 1))
    choice = held_out(mean_s, least_mean)
    settled = np.take_along_axis(np.isfinite(runs), choice.places[None, None, None], axis=2)
    name = choice.named([f"{time:g} s" for (time,) in times])
    mean = format_estimate(analysis.mean(choice.values), "s", 0)
    return f"{100 * settled.mean():.0f} %, {mean} ({name})"


def other_readings(grid: Grid, run_s: float) -> Table:
    """The same for the other readings of Q."""
    found = [settings(grid, q, run_s) for q in grid.axes["q"] if q != PRINTED]
    names = [QS[q] for q in grid.axes["q"] if q != PRINTED]
    rows = [[n, *row] for n, table in zip(names, found, strict=True) for row in table.rows]
    header = ["reading", *found[0].header]
    return Table("The same for other readings of Q", header, rows, found[0].note, folded=True)


def counts(grid: Grid, found: dict[Any, Contest]) -> Table:
    """At how many misalignments more than one reset is better, by reading."""
    rows = []
    for q in grid.axes["q"]:
        for feedback in grid.axes["feedback"]:
            here = [c for key, c in found.items() if key[:2] == (q, feedback)]
            more, one = (
                sum(side)
                for side in zip(
                    *((c.saved_s.high < 0, c.saved_s.low > 0) for c in here), strict=True
                )
            )
            numbers = (more, one, len(here) - more - one, sum(c.only_more for c in here))
            rows.append([QS[q], f"{feedback:g}", *map(str, numbers)])
    header = ["reading", "feedback (s)", "more is sooner", "one is sooner", "no difference shown"]
    note = (
        "A difference is shown where the 95 % interval of that of the median settling times lies to"
        " one side of 0. *Only more settles*: half of the draws or more, with one fewer."
    )
    title = f"Of {len(grid.axes['level']) * len(grid.axes['yaw'])} misalignments, by reading"
    return Table(title, [*header, "only more settles"], rows, note, folded=True)


def points(grid: Grid, found: dict[Any, Contest]) -> Table:
    """The best single reset and the best of more at each misalignment, Q as printed."""
    ones, mores = ([named(t) for t in schedules(grid, *n)] for n in ((1, 1), (2,)))
    rows = []
    for (q, feedback, level, yaw), contest in found.items():
        if q != PRINTED:
            continue
        rows.append(
            [
                f"{feedback:g}",
                f"{level:g}",
                f"{yaw:g}",
                contest.one.named(ones),
                format_estimate(analysis.quantile(contest.one.values), digits=0),
                contest.more.named(mores),
                format_estimate(analysis.quantile(contest.more.values), digits=0),
                format_difference(contest.saved_s, digits=0, sides=("more", "one")),
            ]
        )
    header = ["feedback (s)", "level (deg)", "heading (deg)", "one", "median (s)", "more"]
    note = f"{_INTERVAL} Two schedules: each half of the draws chose its own for the other half."
    return Table(
        "Every misalignment, Q as printed",
        [*header, "median (s)", "more less one (s)"],
        rows,
        note,
        folded=True,
    )


def singles(grid: Grid) -> Table:
    """At how many points each time of a single reset is the soonest, by heading error."""
    times = schedules(grid, 1, 1)
    runs = grid.at(SETTLE, force=MEASURED, schedule=times)
    settles = np.isfinite(runs).mean(axis=-1) >= CONVERGES
    rows = []
    for place, yaw in enumerate(grid.axes["yaw"]):
        here = settles[:, :, :, place]
        rows.append(
            [
                f"{yaw:g} deg",
                *(str(int(here[..., i].sum())) for i in range(len(times))),
                str(int(here.any(axis=-1).sum())),
                str(here[..., 0].size),
            ]
        )
    header = ["heading error", *(f"{time:g} s" for (time,) in times), "any of them", "points"]
    note = f"Points of reading, feedback and level. *Enough*: {100 * CONVERGES:g} % settle."
    return Table("At how many points one reset at a time is enough", header, rows, note)


def failures(grid: Grid) -> Table:
    """Runs that never settle without reset, and what that varies with."""
    rows = []
    for q in grid.axes["q"]:
        for feedback in grid.axes["feedback"]:
            measured, gravity = (
                np.isinf(grid.at(SETTLE, force=force, q=q, feedback=feedback, schedule=NONE))
                for force in (MEASURED, GRAVITY)
            )
            parts = failed_by_level_and_yaw(measured)
            rows.append(
                [
                    QS[q],
                    f"{feedback:g}",
                    percent(shared(measured)),
                    *(f"{100 * part.value:.0f}" for part in parts),
                    percent(shared(gravity)),
                ]
            )
    header = ["reading", "feedback (s)", "measured force: never settle (%)", "by level (%)"]
    note = (
        f"{_INTERVAL} *By*: the share of the variance of failure over the misalignments of this"
        " study that comes from level, from heading, or from both together."
    )
    return Table(
        "Runs that never settle without reset",
        [*header, "by heading (%)", "by both (%)", "gravity: never settle (%)"],
        rows,
        note,
        folded=True,
    )


def paper(grid: Grid, judged: list[Claim]) -> Table:
    """The paper's point under every reading."""
    rows = [
        [
            QS[c.q],
            f"{c.feedback:g}",
            *(percent(one) for one in (c.none, c.three, c.one)),
            format_estimate(c.off, digits=2),
            format_difference(c.later_s, digits=0, sides=("with the three", "the small one")),
            KINDS[c.kind].name,
        ]
        for c in judged
        if (c.level, c.yaw) == (LEVEL, YAW)
    ]
    header = ["reading", "feedback (s)", "none (%)", "the three (%)", "best one (%)"]
    header += ["heading off a small one's by (arcmin)", "later by (s)", "so"]
    note = f"{_INTERVAL} Shares that settle. *Off*, *later*: with the three, on the same noise."
    return Table("The paper's point", header, rows, note, folded=True)
