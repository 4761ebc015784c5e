"""Numbers of the page on resets that set themselves."""

from typing import Any

import numpy as np

from sinsjax.analysis import format_estimate
from sinsjax.report.folder import Page, Sources
from sinsjax.report.words import share

from . import car, figures, tables
from .scores import HEALTHY_LEVEL_DEG, HEALTHY_YAW_DEG, NONE, PAPER, Policy, Scores

SHORT = (0.01, 1.0)  # s, feedback intervals
NAMES = {0.0: "(0, 0, 0)", 30.0: "(5, 5, 30)", 120.0: "(20, 20, 120)"}
FIXED = "the paper's four"


def page(sources: Sources) -> Page:
    """Triggers against the best single reset of each cell, and the winner on the record."""
    source = sources["adaptive_resets"]
    scores, on_record = Scores(source), car.OnRecord.of(sources["car_adaptive"])
    best = scores.best(scores.triggered)
    values, claims = _simulated(scores, best)
    values |= {
        "study": {
            "runs": f"{source.runs:,}",
            "policies": str(len(scores.policies)),
            "draws": str(scores.grid.draws),
            "run_s": f"{source.study.run_s:g} s",
            "bias": f"{max(start.bias for start in scores.starts):g} deg/h",
            "cells": str(len(scores.cells)),
            "starts": str(len(scores.starts)),
        }
    }
    recorded, more = _recorded(on_record)
    return Page(
        values | recorded,
        {
            "expected": tables.expected(scores),
            "by_feedback": tables.by_feedback(scores, best),
            "settings": tables.settings(scores),
            "by_cell": tables.by_cell(scores, best),
            "car": car.table(on_record, NAMES),
        },
        {
            "answer": figures.answer(scores, best),
            "triggers": figures.triggers(scores, best),
            "car": car.figure(on_record, NAMES),
        },
        claims | more,
    )


def _simulated(scores: Scores, best: Policy) -> tuple[dict[str, Any], dict[str, bool]]:
    halves = [scores.best(scores.triggered, slice(half, None, 2)) for half in range(2)]
    others = [one for one in scores.by_trigger.values() if one.trigger != best.trigger]
    rival = scores.best(others)
    ratios, high = scores.ratios(best), scores.intervals(best)[1]
    worst = scores.cells[int(np.argmax(ratios))]
    tests = {name: scores.acts_in_need(_highest(scores, name)) for name in ("nis", "innovation")}
    short = [scores.within(best, feedback) for feedback in SHORT]
    alarms = [scores.alarms(best, feedback).false for feedback in SHORT]
    slow, slow_alarms = scores.within(best, 10.0), scores.alarms(best, 10.0).false
    values = {
        "best": {
            "name": best.words,
            "threshold": f"{best.threshold:g}",
            "pause": f"{best.refractory_s:g}",
            "until": f"{best.until_s:g}",
            "most": str(best.most),
            "within": tables.cells(scores.within(best)),
            "short": f"{sum(one.value for one in short):.0f} of {sum(one.n for one in short)}",
            "slow": tables.cells(slow),
            "slow_alarms": share(slow_alarms),
            "worst": format_estimate(_with_ends(scores, best, int(np.argmax(ratios))), digits=2),
            "worst_at": f"{worst[2].name} deg, feedback every {worst[1]:g} s",
            "sooner": str(int((high < 1).sum())),
            "only": str(int((ratios == 0).sum())),
        },
        "rival": {
            "name": rival.words,
            "within": tables.cells(scores.within(rival)),
            "alarms": share(scores.alarms(rival).false),
        },
        "fixed": {
            "without": tables.cells(scores.within(NONE)),
            "paper": tables.cells(scores.within(PAPER)),
        },
        "tests": {name: share(one) for name, one in tests.items()},
        "healthy": f"{HEALTHY_LEVEL_DEG:g} deg of level and {HEALTHY_YAW_DEG:g} deg of heading",
    }
    claims = {
        "the linearisation trigger is the best, on either half of the draws": (
            best.trigger == "linearisation" and all(half == best for half in halves)
        ),
        "with feedback up to 1 s it is as fast in every cell, without a false alarm": (
            all(one.value == one.n for one in short) and all(one.value == 0 for one in alarms)
        ),
        "with feedback every 10 s it misses some cells and raises false alarms": (
            slow.value < slow.n and slow_alarms.low > 0
        ),
        "it is often sooner than any single reset": int((high < 1).sum()) > len(ratios) / 4,
        "the next best raises far more false alarms": (
            scores.alarms(rival).false.value > 3 * scores.alarms(best).false.value
        ),
        "tests of innovations miss most runs in need": all(
            one.high < 0.5 for one in tests.values()
        ),
        "fixed schedules reach a third of the cells": all(
            scores.within(one).value < scores.within(best).value / 2 for one in (NONE, PAPER)
        ),
    }
    return values, claims


def _with_ends(scores: Scores, policy: Policy, cell: int) -> Any:
    low, high = scores.intervals(policy)[:, cell]
    count = scores.within(policy)
    return count._replace(value=float(scores.ratios(policy)[cell]), low=low, high=high)


def _highest(scores: Scores, trigger: str) -> Policy:
    """The policy of a trigger with the highest threshold: the chi-square test."""
    own = [policy for policy in scores.triggered if policy.trigger == trigger]
    return max(own, key=lambda policy: policy.threshold)


def _recorded(on_record: car.OnRecord) -> tuple[dict[str, Any], dict[str, bool]]:
    large = on_record.yaws[-1]
    times = {case: on_record.time_s(case, large) for case in on_record.cases}
    own = times["linearisation"]
    values = {
        "car": {
            "starts": str(on_record.grid.draws),
            "time": f"{own:.0f} s",
            "fixed": f"{times[FIXED]:.0f} s",
            "settled": f"{100 * on_record.settled('linearisation', large):.0f} %",
            "without": f"{100 * on_record.settled('no reset', large):.0f} %",
        }
    }
    claims = {
        "on the record the trigger settles every start, sooner than the paper's four": (
            all(on_record.settled("linearisation", yaw) == 1.0 for yaw in on_record.yaws)
            and own < times[FIXED]
        ),
    }
    return values, claims
