"""Times of resets from a list, tried in one filter at one latitude: 184,320 runs."""

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.analysis.formats import format_degrees
from sinsjax.analysis.grids import median_over_draws
from sinsjax.execution.source import Source
from sinsjax.report.base import Table
from sinsjax.report.study_page import Page, Sources

from ..common.grids import Grid, grid_of, held_out, least_mean, shared, soonest
from ..common.settling import mean_time, median_time, settled
from ..common.words import apart, share

Schedule = tuple[float, ...]

NONE: Schedule = ()
TWO: Schedule = (10.0, 60.0)
THREE: Schedule = (25.0, 125.0, 225.0)
PAPER: Schedule = (50.0, 100.0, 150.0)  # paper 1, section 3.3.2
MEASURED, GRAVITY = "measured", "gravity"
PRINTED = {"force": MEASURED, "q": "per_step"}  # Q as printed: most of paper 1's statements
HERE = PRINTED | {"feedback": 1.0}
POINT = HERE | {"level": 5.0, "yaw": 30.0}  # its condition 5
SETTLE = "settle_10_s"
CONVERGES = 0.95
"""Share of the draws from which a setting is said to settle."""
SHORT, SLOW = [0.01, 1.0], 10.0  # s, feedback intervals


def page(sources: Sources) -> Page:
    """How many resets, when, and what makes the filter fail without."""
    source = sources["reset_cycle_study"]
    grid = layout(source)
    return Page.merge(
        Page({"study": {"runs": f"{source.runs:,}", "draws": grid.draws}}),
        _answer(source, grid),
        _counts(grid),
        _single(grid),
        _phase(sources["reset_phase"]),
        _failure(grid),
    )


def _answer(source: Source, grid: Grid) -> Page:
    run_s = source.study.run_s
    short = PRINTED | {"feedback": SHORT}
    two, without = (grid.at(SETTLE, schedule=times, **short) for times in (TWO, NONE))
    gravity = grid.at(SETTLE, schedule=NONE, **short | {"force": GRAVITY})
    singles = grid.at(SETTLE, schedule=schedules(grid, 1, 1), **HERE)
    late = grid.at(SETTLE, force=MEASURED, schedule=THREE)
    slow = grid.at(SETTLE, schedule=TWO, feedback=SLOW, **PRINTED)
    slowest = two.reshape(-1, grid.draws)[np.argmax(median_over_draws(two))]
    level, yaw = grid.axes["level"][-1], grid.axes["yaw"][-1]
    values = {
        "worst": format_degrees(level, level, yaw),
        "two": {
            "name": named(TWO).removeprefix("two "),
            "mean": mean_time(two, run_s),
            "slowest": median_time(slowest),
        },
        "without": {"failed": share(shared(np.isinf(without)))},
        "gravity": {"mean": mean_time(gravity, run_s)},
        "slow": {
            "failed": share(shared(np.isinf(slow))),
            "late": named(THREE),
            "mean": mean_time(late[0, -1], run_s),
        },
    }
    claims = {
        "two resets settle every misalignment with feedback up to 1 s": (
            np.isfinite(grid.at(SETTLE, force=MEASURED, feedback=SHORT, schedule=TWO)).all()
        ),
        "with gravity in A(t) every misalignment settles without reset, feedback up to 1 s": (
            np.isfinite(grid.at(SETTLE, force=GRAVITY, feedback=SHORT, schedule=NONE)).all()
        ),
        "three late resets settle every misalignment under every reading and feedback": (
            np.isfinite(late).all()
        ),
        "with feedback every second no single time of one reset settles every misalignment": not (
            np.isfinite(singles).all(axis=(0, 1, 3)).any()
        ),
    }
    return Page(values, {"settings": _settings(grid, run_s)}, claims=claims)


def _settings(grid: Grid, run_s: float) -> Table:
    """What to set and what to expect, over all misalignments."""
    intervals = grid.axes["feedback"]

    def row(name: str, force: str, times: tuple[float, ...]) -> list[str]:
        runs = grid.at(SETTLE, schedule=times, **PRINTED | {"force": force})
        return [name, *(f"{settled(r)}, {mean_time(r, run_s)}" for r in runs)]

    rows = [
        row("no reset", MEASURED, NONE),
        ["one, at its best time", *(_best_one(grid, feedback, run_s) for feedback in intervals)],
        *(row(named(times), MEASURED, times) for times in (TWO, THREE, PAPER)),
        row("no reset, gravity in A(t)", GRAVITY, NONE),
    ]
    header = ["resets", *(f"feedback every {feedback:g} s" for feedback in intervals)]
    note = (
        f"Settled share and mean time ({run_s:g} s for never) of"
        f" {len(grid.axes['level']) * len(grid.axes['yaw'])} misalignments with {grid.draws} runs"
        " each; one half of the runs chose the single reset's time for the other."
    )
    return Table("All misalignments, Q as printed", header, rows, note)


def _best_one(grid: Grid, feedback: float, run_s: float) -> str:
    times = schedules(grid, 1, 1)
    runs = grid.at(SETTLE, feedback=feedback, schedule=times, **PRINTED)
    choice = held_out(np.minimum(runs, run_s).mean(axis=(0, 1)), least_mean)
    settled = np.take_along_axis(np.isfinite(runs), choice.places[None, None, None], axis=2)
    name = choice.named([f"{time:g} s" for (time,) in times])
    mean = format_estimate(analysis.mean(choice.values), "s", 0)
    return f"{share(shared(settled))}, {mean} ({name})"


def _counts(grid: Grid) -> Page:
    """The best single reset against the best of more: settling times (q, ..., yaw, draws)."""
    one, more = (
        held_out(grid.at(SETTLE, force=MEASURED, schedule=times), soonest).values
        for times in (schedules(grid, 1, 1), schedules(grid, 2))
    )
    pairs = list(zip(*(runs.reshape(-1, runs.shape[-1]) for runs in (more, one)), strict=True))
    saved = [analysis.quantile_difference(*pair) for pair in pairs]
    chance = sum(analysis.permutation_false_positive_rate(*pair) for pair in pairs)
    sooner = np.reshape([by.high < 0 for by in saved], one.shape[:-1])
    by_one = sum(by.low > 0 for by in saved)
    only = sooner & np.isinf(median_over_draws(one)) & np.isfinite(median_over_draws(more))
    near, *_, large = sooner.sum(axis=(0, 1, 2))
    at = tuple(grid.axes[name].index(POINT[name]) for name in ("q", "feedback", "level", "yaw"))
    here = analysis.quantile_difference(more[at], one[at])
    values = {
        "points": sooner.size,
        "more": sooner.sum(),
        "one": by_one,
        "only": only.sum(),
        "chance": f"{chance:.1f}",
        "at_small_yaw": near,
        "at_large_yaw": large,
        "of_a_yaw": sooner[..., 0].size,
        "here": apart(here),
    }
    claims = {
        "more than one is often better, and one is often better": (
            min(sooner.sum(), by_one) > 4 * chance
        ),
        "more is better at large heading errors, one at small ones": large > 3 * near,
        "at the paper's point no difference is shown": here.low <= 0 <= here.high,
    }
    return Page({"contest": values}, claims=claims)


def _single(grid: Grid) -> Page:
    times = schedules(grid, 1, 1)
    settles = converges(grid.at(SETTLE, force=MEASURED, schedule=times))
    here = grid.at(SETTLE, schedule=times, **POINT)
    enough, points = int(settles.any(axis=-1).sum()), settles[..., 0].size
    values = {
        "first": median_time(here[0]),
        "last": median_time(here[-1]),
        "enough": enough,
        "with_first": settles[..., 0].sum(),
        "with_last": settles[..., -1].sum(),
        "points": points,
    }
    claims = {
        "at the paper's point one reset settles whenever it comes, the sooner the better": (
            np.isfinite(here).all() and np.argmin(median_over_draws(here)) == 0
        ),
        "one reset at the right time is nearly always enough": enough > 0.9 * points,
    }
    return Page({"single": values}, claims=claims)


def _failure(grid: Grid) -> Page:
    measured, gravity = (
        np.isinf(grid.at(SETTLE, force=force, schedule=NONE)) for force in (MEASURED, GRAVITY)
    )
    everywhere, ablated = shared(measured), shared(gravity)
    values = {"failure": {"measured": share(everywhere), "gravity": share(ablated)}}
    claims = {
        "gravity in A(t) prevents most failures": (
            ablated.value < everywhere.value / 2 and ablated.high < everywhere.low
        ),
        "with gravity only feedback every 10 s fails": (
            not gravity[:, :2].any() and gravity[:, 2].any()
        ),
    }
    return Page(values, claims=claims)


def _phase(source: Source) -> Page:
    """Two resets 50 s apart, at any phase of a feedback interval."""
    grid, run_s = layout(source), source.study.run_s
    between, before, on = ((first, first + 50.0) for first in (17.5, 19.9, 20.0))

    def later(feedback: float, one: Schedule, other: Schedule) -> Estimate:
        pair = (grid.at(SETTLE, feedback=feedback, schedule=times) for times in (one, other))
        means = (np.minimum(settle_s, run_s).mean(axis=(0, 1, 2, 3)) for settle_s in pair)
        return analysis.mean_difference(*means)

    found = {
        "on": later(SLOW, on, between),
        "before": later(SLOW, before, between),
        "often": later(SHORT[-1], before, on),
    }
    best = grid.at(SETTLE, feedback=SLOW, schedule=between)
    told = {name: apart(one) for name, one in found.items()}
    values = {"phase": {"between": mean_time(best, run_s), "settled": settled(best)} | told}
    claims = {
        "just before or with a feedback is a bad time for a reset": all(
            one.low > 0 for one in found.values()
        )
    }
    return Page(values, claims=claims)


def layout(source: Source) -> Grid:
    """Every run by force in A(t), reading of Q, feedback interval, level, yaw, schedule, draw."""
    study = source.study
    return grid_of(
        source,
        (SETTLE,),
        force="specific_force",
        q="q_reading",
        feedback="feedback_interval_s",
        level="phi_e0_deg",
        yaw="phi_u0_deg",
        schedule=[tuple(times) for times in study.reset_times()],
    )


def schedules(grid: Grid, least: int, most: int = 99) -> list[Schedule]:
    """The schedules with some number of resets."""
    return [times for times in grid.axes["schedule"] if least <= len(times) <= most]


def named(times: Schedule) -> str:
    """A schedule in words: ``none``, ``one at 50 s``, ``two at 10 and 60 s``."""
    words = ("none", "one", "two", "three", "four", "five")
    if len(times) < 2:
        return f"one at {times[0]:g} s" if times else "none"
    *first, last = (f"{time:g}" for time in times)
    return f"{words[len(times)]} at {', '.join(first)} and {last} s"


def converges(settle_s: NDArray) -> NDArray:
    """Whether enough of the draws (..., draws) settle."""
    return np.isfinite(settle_s).mean(axis=-1) >= CONVERGES
