"""Numbers of the page on how many resets to make, and when."""

from typing import Any

import numpy as np

from sinsjax import analysis
from sinsjax.report.folder import Page, Sources
from sinsjax.report.grids import Grid, median, pooled_mean, shared
from sinsjax.report.words import apart, degrees, listed, seconds, share

from . import claim, figures, tables
from .grid import (
    CONVERGES,
    FEEDBACK_S,
    GRAVITY,
    LEVEL,
    MEASURED,
    NONE,
    PAPER,
    PRINTED,
    SETTLE,
    THREE,
    TWO,
    YAW,
    Contest,
    contests,
    failed_by_level_and_yaw,
    layout,
    named,
    schedules,
)

SHORT, SLOW = [0.01, 1.0], 10.0  # s, feedback intervals


def page(sources: Sources) -> Page:
    """How many resets, when, what governs failure, where the paper's claim holds."""
    source = sources["reset_cycle_study"]
    grid, run_s = layout(source), source.study.run_s
    found, judged = contests(grid), claim.judge(grid)
    parts: list[tuple[dict[str, Any], dict[str, bool]]] = [
        _answer(grid, run_s),
        _counts(grid, found, found[PRINTED, FEEDBACK_S, LEVEL, YAW]),
        _single(grid),
        _failure(grid),
        _paper(judged),
    ]
    values, claims = ({k: v for part in parts for k, v in part[i].items()} for i in (0, 1))
    values["study"] = {
        "runs": f"{source.runs:,}",
        "draws": str(grid.draws),
        "run_s": f"{run_s:g} s",
        "schedules": str(len(grid.axes["schedule"])),
    }
    return Page(
        values,
        {
            "settings": tables.settings(grid, PRINTED, run_s),
            "other_readings": tables.other_readings(grid, run_s),
            "counts": tables.counts(grid, found),
            "points": tables.points(grid, found),
            "singles": tables.singles(grid),
            "failures": tables.failures(grid),
            "paper": tables.paper(grid, judged),
        },
        {
            "answer": figures.answer(grid, run_s),
            "single": figures.single(grid, run_s),
            "failure": figures.failure(grid),
            "claim": figures.claim(grid, judged),
        },
        claims,
    )


def _answer(grid: Grid, run_s: float) -> tuple[dict[str, Any], dict[str, bool]]:
    short = {"force": MEASURED, "feedback": SHORT}
    two, without = (grid.at(SETTLE, q=PRINTED, schedule=one, **short) for one in (TWO, NONE))
    gravity = grid.at(SETTLE, force=GRAVITY, q=PRINTED, feedback=SHORT, schedule=NONE)
    singles = grid.at(SETTLE, q=PRINTED, schedule=schedules(grid, 1, 1), **short)
    late = grid.at(SETTLE, force=MEASURED, schedule=THREE)
    slow = grid.at(SETTLE, force=MEASURED, q=PRINTED, feedback=SLOW, schedule=TWO)
    slowest = two.reshape(-1, grid.draws)[np.argmax(median(two))]
    level, yaw = grid.axes["level"][-1], grid.axes["yaw"][-1]
    values = {
        "worst": degrees(level, level, yaw),
        "two": {
            "name": named(TWO).removeprefix("two "),
            "mean": seconds(pooled_mean(np.minimum(two, run_s))),
            "slowest": seconds(analysis.quantile(slowest)),
        },
        "without": {"failed": share(shared(np.isinf(without)))},
        "gravity": {"mean": seconds(pooled_mean(np.minimum(gravity, run_s)))},
        "slow": {
            "failed": share(shared(np.isinf(slow))),
            "late": named(THREE),
            "mean": seconds(pooled_mean(np.minimum(late[0, -1], run_s))),
        },
    }
    claims = {
        "two resets settle every misalignment with feedback up to 1 s": all(
            np.isfinite(grid.at(SETTLE, q=q, schedule=TWO, **short)).all() for q in grid.axes["q"]
        ),
        "with gravity in A(t) every misalignment settles without reset, feedback up to 1 s": bool(
            np.isfinite(grid.at(SETTLE, force=GRAVITY, feedback=SHORT, schedule=NONE)).all()
        ),
        "three late resets settle every misalignment under every reading and feedback": bool(
            np.isfinite(late).all()
        ),
        "with feedback every 10 s two resets do not settle every misalignment": bool(
            np.isinf(slow).any()
        ),
        "with feedback every second no single time of one reset settles every misalignment": not (
            np.isfinite(singles[1]).all(axis=(0, 1, 3)).any()
        ),
        "with gravity it takes somewhat longer than with two resets": bool(
            np.minimum(gravity, run_s).mean() > np.minimum(two, run_s).mean()
        ),
    }
    return values, claims


def _counts(
    grid: Grid, found: dict[Any, Contest], here: Contest
) -> tuple[dict[str, Any], dict[str, bool]]:
    more = [c for c in found.values() if c.saved_s.high < 0]
    one = [c for c in found.values() if c.saved_s.low > 0]
    chance = sum(c.by_chance for c in found.values())
    far = {
        yaw: sum(c.saved_s.high < 0 for key, c in found.items() if key[3] == yaw)
        for yaw in grid.axes["yaw"]
    }
    near, large = grid.axes["yaw"][0], grid.axes["yaw"][-1]
    values = {
        "contest": {
            "points": str(len(found)),
            "more": str(len(more)),
            "one": str(len(one)),
            "only": str(sum(c.only_more for c in more)),
            "chance": f"{chance:.1f}",
            "here": apart(here.saved_s),
            "at_small_yaw": str(far[near]),
            "at_large_yaw": str(far[large]),
            "of_a_yaw": str(len(found) // len(far)),
            "small_yaw": degrees(near),
            "large_yaw": degrees(large),
        }
    }
    claims = {
        "more than one is often better, and one is often better": (
            min(len(more), len(one)) > 4 * chance
        ),
        "more is better at large heading errors, one at small ones": far[large] > 3 * far[near],
        "at the paper's point no difference is shown": here.saved_s.low <= 0 <= here.saved_s.high,
    }
    return values, claims


def _single(grid: Grid) -> tuple[dict[str, Any], dict[str, bool]]:
    times = schedules(grid, 1, 1)
    runs = grid.at(SETTLE, force=MEASURED, schedule=times)
    settles = np.isfinite(runs).mean(axis=-1) >= CONVERGES
    here = grid.at(
        SETTLE,
        force=MEASURED,
        q=PRINTED,
        feedback=FEEDBACK_S,
        level=LEVEL,
        yaw=YAW,
        schedule=times,
    )
    points = settles[..., 0].size
    enough, first, last = (
        int(s.sum()) for s in (settles.any(axis=-1), settles[..., 0], settles[..., -1])
    )
    values = {
        "single": {
            "first_at": f"{times[0][0]:g} s",
            "last_at": f"{times[-1][0]:g} s",
            "first": seconds(analysis.quantile(here[0])),
            "last": seconds(analysis.quantile(here[-1])),
            "enough": str(enough),
            "with_first": str(first),
            "with_last": str(last),
            "points": str(points),
            "times": listed([f"{time:g}" for (time,) in times]),
        }
    }
    claims = {
        "at the paper's point one reset settles whenever it comes, the sooner the better": bool(
            np.isfinite(here).all() and np.argmin(median(here)) == 0
        ),
        "one reset at the right time is nearly always enough": enough > 0.9 * points,
    }
    return values, claims


def _failure(grid: Grid) -> tuple[dict[str, Any], dict[str, bool]]:
    failed = {
        force: np.isinf(grid.at(SETTLE, force=force, schedule=NONE))
        for force in (MEASURED, GRAVITY)
    }
    here = np.isinf(grid.at(SETTLE, force=MEASURED, schedule=NONE, q=PRINTED, feedback=FEEDBACK_S))
    parts = failed_by_level_and_yaw(here)
    names = ("by_level", "by_yaw", "by_both")
    everywhere, ablated = (shared(failed[force]) for force in (MEASURED, GRAVITY))
    values = {
        "failure": {
            "measured": share(everywhere),
            "gravity": share(ablated),
            "here": share(shared(here)),
            "level_alone": share(shared(here[:, :1])),
            "yaw_alone": share(shared(here[:1])),
            **{name: f"{100 * one.value:.0f} %" for name, one in zip(names, parts, strict=True)},
        }
    }
    claims = {
        "gravity in A(t) prevents most failures": ablated.high < everywhere.low / 2,
        "level explains more of failure than yaw at the paper's reading": (
            parts[0].value > parts[1].value
        ),
        "with gravity only feedback every 10 s fails": bool(
            not failed[GRAVITY][:, :2].any() and failed[GRAVITY][:, 2].any()
        ),
    }
    return values, claims


def _paper(judged: list[claim.Claim]) -> tuple[dict[str, Any], dict[str, bool]]:
    here = [c for c in judged if (c.level, c.yaw) == (LEVEL, YAW)]
    holding = [c for c in here if c.kind in claim.CURED]
    kinds = [c.kind for c in judged]
    cured = sum(kind in claim.CURED for kind in kinds)
    one = next(c for c in here if (c.q, c.feedback) == (PRINTED, FEEDBACK_S))
    values = {
        "paper": {
            "point": degrees(LEVEL, LEVEL, YAW),
            "times": named(PAPER).removeprefix("three "),
            "holds": str(len(holding)),
            "readings": str(len(here)),
            "not_needed": str(kinds.count(claim.NOT_NEEDED)),
            "points": str(len(judged)),
            "cured": str(cured),
            "one_too": str(kinds.count(claim.ONE_TOO)),
            "later": apart(one.later_s),
            "small": degrees(*claim.SMALLEST),
        }
    }
    claims = {
        "at the paper's point its three resets cure, under the reading of its statements": (
            one.kind in claim.CURED
        ),
        "where the three cure, one reset nearly always does too": (
            kinds.count(claim.ONE_TOO) > 0.9 * cured
        ),
        "with the three it settles later than a small misalignment": one.later_s.low > 0,
    }
    return values, claims
