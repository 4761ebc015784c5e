"""Numbers of the page on how many resets to make, and when."""

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.report.base import Source, Table
from sinsjax.report.folder import Page, Sources
from sinsjax.report.grids import Grid, held_out, least_mean, median, pooled_mean, shared, soonest
from sinsjax.report.output import counted
from sinsjax.report.words import apart, arcmin, degrees, seconds, share

from . import figures
from .grid import (
    GRAVITY,
    HEADING,
    HERE,
    MEASURED,
    NONE,
    PAPER,
    POINT,
    PRINTED,
    SETTLE,
    SMALL,
    THREE,
    TWO,
    Schedule,
    converges,
    layout,
    named,
    schedules,
)

SHORT, SLOW = [0.01, 1.0], 10.0  # s, feedback intervals


def page(sources: Sources) -> Page:
    """How many resets, when, what governs failure, where the paper's claim holds."""
    source = sources["reset_cycle_study"]
    grid, run_s = layout(source), source.study.run_s
    one, more = (
        held_out(grid.at(SETTLE, force=MEASURED, schedule=times), soonest).values
        for times in (schedules(grid, 1, 1), schedules(grid, 2))
    )
    made = Page.joined(
        Page({"study": {"runs": f"{source.runs:,}", "draws": str(grid.draws)}}),
        _answer(grid, run_s),
        _counts(one, more),
        _single(grid, run_s),
        _phase(sources["reset_phase"]),
        _failure(grid),
        _paper(grid, one, more),
    )
    shown = {name: one._replace(rests_on=counted(source)) for name, one in made.figures.items()}
    return made._replace(figures=shown)


def _mean(settle_s: NDArray, run_s: float) -> str:
    """Mean settling time, with the whole run for one that never settles."""
    return seconds(pooled_mean(np.minimum(settle_s, run_s)))


def _answer(grid: Grid, run_s: float) -> Page:
    short = PRINTED | {"feedback": SHORT}
    two, without = (grid.at(SETTLE, schedule=times, **short) for times in (TWO, NONE))
    gravity = grid.at(SETTLE, schedule=NONE, **short | {"force": GRAVITY})
    singles = grid.at(SETTLE, schedule=schedules(grid, 1, 1), **HERE)
    late = grid.at(SETTLE, force=MEASURED, schedule=THREE)
    slow = grid.at(SETTLE, schedule=TWO, feedback=SLOW, **PRINTED)
    slowest = two.reshape(-1, grid.draws)[np.argmax(median(two))]
    level, yaw = grid.axes["level"][-1], grid.axes["yaw"][-1]
    values = {
        "worst": degrees(level, level, yaw),
        "two": {
            "name": named(TWO).removeprefix("two "),
            "mean": _mean(two, run_s),
            "slowest": seconds(analysis.quantile(slowest)),
        },
        "without": {"failed": share(shared(np.isinf(without)))},
        "gravity": {"mean": _mean(gravity, run_s)},
        "slow": {
            "failed": share(shared(np.isinf(slow))),
            "late": named(THREE),
            "mean": _mean(late[0, -1], run_s),
        },
    }
    claims = {
        "two resets settle every misalignment with feedback up to 1 s": bool(
            np.isfinite(grid.at(SETTLE, force=MEASURED, feedback=SHORT, schedule=TWO)).all()
        ),
        "with gravity in A(t) every misalignment settles without reset, feedback up to 1 s": bool(
            np.isfinite(grid.at(SETTLE, force=GRAVITY, feedback=SHORT, schedule=NONE)).all()
        ),
        "three late resets settle every misalignment under every reading and feedback": bool(
            np.isfinite(late).all()
        ),
        "with feedback every second no single time of one reset settles every misalignment": not (
            np.isfinite(singles).all(axis=(0, 1, 3)).any()
        ),
    }
    shown = {"settings": _settings(grid, run_s)}, {"answer": figures.answer(grid, run_s)}
    return Page(values, *shown, claims)


def _settings(grid: Grid, run_s: float) -> Table:
    """What to set and what to expect, over all misalignments."""
    intervals = grid.axes["feedback"]

    def row(name: str, force: str, times: tuple[float, ...]) -> list[str]:
        runs = grid.at(SETTLE, schedule=times, **PRINTED | {"force": force})
        settled = (f"{100 * np.isfinite(one).mean():.0f} %" for one in runs)
        means = (_mean(one, run_s) for one in runs)
        return [name, *map(", ".join, zip(settled, means, strict=True))]

    rows = [
        row("no reset", MEASURED, NONE),
        ["one, at its best time", *(_best_one(grid, feedback, run_s) for feedback in intervals)],
        *(row(named(times), MEASURED, times) for times in (TWO, THREE, PAPER)),
        row("no reset, gravity in A(t)", GRAVITY, NONE),
    ]
    header = ["resets", *(f"feedback every {feedback:g} s" for feedback in intervals)]
    note = (
        f"Share that settles, and mean settling time with {run_s:g} s for a run that never does;"
        f" all {len(grid.axes['level']) * len(grid.axes['yaw'])} misalignments, [95 % interval over"
        f" the {grid.draws} draws]. One time of the single reset serves all misalignments; it is"
        " chosen on one half of the draws and judged on the other."
    )
    return Table("All misalignments, Q as printed", header, rows, note)


def _best_one(grid: Grid, feedback: float, run_s: float) -> str:
    times = schedules(grid, 1, 1)
    runs = grid.at(SETTLE, feedback=feedback, schedule=times, **PRINTED)
    choice = held_out(np.minimum(runs, run_s).mean(axis=(0, 1)), least_mean)
    settled = np.take_along_axis(np.isfinite(runs), choice.places[None, None, None], axis=2)
    name = choice.named([f"{time:g} s" for (time,) in times])
    mean = format_estimate(analysis.mean(choice.values), "s", 0)
    return f"{100 * settled.mean():.0f} %, {mean} ({name})"


def _counts(one: NDArray, more: NDArray) -> Page:
    """The best single reset against the best of more: settling times (q, ..., yaw, draws)."""
    pairs = list(zip(*(runs.reshape(-1, runs.shape[-1]) for runs in (more, one)), strict=True))
    saved = [analysis.quantile_difference(*pair) for pair in pairs]
    chance = sum(analysis.chance_apart(*pair) for pair in pairs)
    sooner = np.reshape([by.high < 0 for by in saved], one.shape[:-1])
    by_one = sum(by.low > 0 for by in saved)
    only = sooner & np.isinf(median(one)) & np.isfinite(median(more))
    near, *_, large = sooner.sum(axis=(0, 1, 2))
    values = {
        "contest": {
            "points": str(sooner.size),
            "more": str(sooner.sum()),
            "one": str(by_one),
            "only": str(only.sum()),
            "chance": f"{chance:.1f}",
            "at_small_yaw": str(near),
            "at_large_yaw": str(large),
            "of_a_yaw": str(sooner[..., 0].size),
        }
    }
    claims = {
        "more than one is often better, and one is often better": (
            min(sooner.sum(), by_one) > 4 * chance
        ),
        "more is better at large heading errors, one at small ones": large > 3 * near,
    }
    return Page(values, claims=claims)


def _single(grid: Grid, run_s: float) -> Page:
    times = schedules(grid, 1, 1)
    settles = converges(grid.at(SETTLE, force=MEASURED, schedule=times))
    here = grid.at(SETTLE, schedule=times, **POINT)
    enough, points = int(settles.any(axis=-1).sum()), settles[..., 0].size
    values = {
        "single": {
            "first": seconds(analysis.quantile(here[0])),
            "last": seconds(analysis.quantile(here[-1])),
            "enough": str(enough),
            "with_first": str(settles[..., 0].sum()),
            "with_last": str(settles[..., -1].sum()),
            "points": str(points),
        }
    }
    claims = {
        "at the paper's point one reset settles whenever it comes, the sooner the better": bool(
            np.isfinite(here).all() and np.argmin(median(here)) == 0
        ),
        "one reset at the right time is nearly always enough": enough > 0.9 * points,
    }
    return Page(values, figures={"single": figures.single(grid, run_s)}, claims=claims)


def _failure(grid: Grid) -> Page:
    measured, gravity = (
        np.isinf(grid.at(SETTLE, force=force, schedule=NONE)) for force in (MEASURED, GRAVITY)
    )
    here = np.isinf(grid.at(SETTLE, schedule=NONE, **HERE))
    everywhere, ablated = shared(measured), shared(gravity)
    level, yaw = measured[:, :, :, 0].mean(axis=2), measured[:, :, 0].mean(axis=2)
    values = {
        "failure": {
            "measured": share(everywhere),
            "gravity": share(ablated),
            "level_alone": share(shared(here[:, :1])),
            "yaw_alone": share(shared(here[:1])),
        }
    }
    claims = {
        "gravity in A(t) prevents most failures": ablated.high < everywhere.low / 2,
        "feedback every second: level errors alone fail more; every 0.01 s: heading errors": bool(
            (level[0, 1] > yaw[0, 1]).all() and (level[0, 0] < yaw[0, 0]).all()
        ),
        "with gravity only feedback every 10 s fails": bool(
            not gravity[:, :2].any() and gravity[:, 2].any()
        ),
    }
    return Page(values, figures={"failure": figures.failure(grid)}, claims=claims)


def _phase(source: Source) -> Page:
    """Two resets 50 s apart, at any phase of a feedback interval."""
    grid, run_s = layout(source), source.study.run_s
    between, before, on = ((first, first + 50.0) for first in (17.5, 19.9, 20.0))

    def later(feedback: float, one: Schedule, other: Schedule) -> Estimate:
        pair = (grid.at(SETTLE, feedback=feedback, schedule=times) for times in (one, other))
        means = (np.minimum(settle_s, run_s).mean(axis=(0, 1, 2, 3)) for settle_s in pair)
        return analysis.difference(*means)

    found = {
        "on": later(SLOW, on, between),
        "before": later(SLOW, before, between),
        "often": later(SHORT[-1], before, on),
    }
    best = grid.at(SETTLE, feedback=SLOW, schedule=between)
    values = {
        "phase": {
            "between": _mean(best, run_s),
            "settled": share(shared(np.isfinite(best))),
            **{name: apart(one) for name, one in found.items()},
        }
    }
    claims = {
        "just before or with a feedback is a bad time for a reset": all(
            one.low > 0 for one in found.values()
        )
    }
    return Page(values, claims=claims)


def _paper(grid: Grid, one: NDArray, more: NDArray) -> Page:
    """Where three resets cure; with the best single reset, and with more, on unused draws."""
    none, three = (
        converges(grid.at(SETTLE, force=MEASURED, schedule=times)) for times in (NONE, PAPER)
    )
    cured, one_too = ~none & three, ~none & three & converges(one)
    at = tuple(grid.axes[name].index(POINT[name]) for name in ("q", "feedback", "level", "yaw"))
    small, large = HERE | SMALL, POINT | {"schedule": PAPER}
    later = analysis.quantile_difference(grid.at(SETTLE, **large), grid.at(SETTLE, **small))
    off = analysis.difference(grid.at(HEADING, **large), grid.at(HEADING, **small))
    apart_here = analysis.quantile_difference(more[at], one[at])
    values = {
        "paper": {
            "holds": str(cured[..., *at[2:]].sum()),
            "readings": str(cured[..., *at[2:]].size),
            "not_needed": str(none.sum()),
            "cured": str(cured.sum()),
            "one_too": str(one_too.sum()),
            "later": apart(later),
            "off": arcmin(off),
            "more": apart(apart_here),
        }
    }
    claims = {
        "at the paper's point its three resets cure, within 1 arcmin": bool(
            cured[at] and -1 < off.low and off.high < 1
        ),
        "where the three cure, one reset mostly does too": one_too.sum() > 0.75 * cured.sum(),
        "with the three it settles later than a small misalignment": later.low > 0,
        "at the paper's point no difference is shown": apart_here.low <= 0 <= apart_here.high,
    }
    return Page(values, claims=claims)
