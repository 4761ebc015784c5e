"""Numbers of the page on resets that set themselves."""

import math

import numpy as np

from sinsjax.analysis import Estimate, format_estimate
from sinsjax.analysis.formats import format_percent
from sinsjax.analysis.grids import median_over_draws
from sinsjax.execution.source import Source
from sinsjax.report.base import Picture, Table
from sinsjax.report.study_page import Page, Sources

from ..common.grids import grid_of, shared
from ..common.words import share
from .cells import Class, ratio_maps
from .scores import NONE, PAPER, SETTLE, WITHIN, Policy, Scores

SHORT = (0.01, 1.0)  # s, feedback intervals
TRUTH = "settle_10_truth_s"
FIXED = "the paper's four"

_Q_WORDS = {"per_step": "as printed", "psd": "as a density", "per_sample": "of a sample"}
_CLASSES = (
    Class(0.9, "up to 0.9 (faster)", "#d6e9f8"),
    Class(WITHIN, f"up to {WITHIN:g} (as fast)", "#f7f7f7"),
    Class(1.5, "up to 1.5", "#fde0a8"),
    Class(3.0, "up to 3", "#f0a030"),
    Class(math.inf, "beyond", "#b34a00", dark=True),
)
"""From faster to slower: pale blue, white, and ever darker orange."""


def page(sources: Sources) -> Page:
    """Triggers against the best single reset of each cell, and the winner on the record."""
    source = sources["adaptive_resets"]
    scores = Scores(source)
    return Page.merge(
        Page({"study": {"runs": f"{source.runs:,}", "draws": scores.grid.draws}}),
        _simulated(scores, source.sample_size_text),
        _recorded(sources["car_adaptive"]),
    )


def _cells(count: Estimate) -> str:
    """A number of cells with its interval."""
    return f"{format_estimate(count, digits=0)} of {count.n}"


def _answer(scores: Scores, best: Policy, footer: str) -> Picture:
    """No reset and the best trigger over all cells."""
    axes = scores.grid.axes
    shape = len(axes["q"]) * len(axes["feedback"]), len(scores.starts)
    panels = [
        (f"{policy.words}: {_cells(scores.within(policy))}", scores.ratios(policy))
        for policy in (NONE, best)
    ]
    figure = ratio_maps(
        [(title, ratios.reshape(shape).T) for title, ratios in panels],
        _CLASSES,
        "Settling time over that of the best single reset, from the limit",
        rows=[start.name for start in scores.starts],
        columns=[f"Q {_Q_WORDS[q]}, {f:g} s" for q in axes["q"] for f in axes["feedback"]],
        side="initial misalignment (deg)",
        only="only it settles",
    )
    caption = (
        f"Ratios of median times over {scores.grid.draws} Monte Carlo runs until the heading stays"
        " within 10 arcmin of its limit. A column is an interpretation of Q and a feedback"
        f" interval. In the titles: cells as fast (ratio up to {WITHIN:g}) [certainly, possibly]."
        " A tie, where neither settles half of its runs, stands as 1.00."
    )
    return Picture("answer", caption, figure, footer)


def _ties(scores: Scores) -> str:
    """How many ties stand behind the numbers of cells, where there are any."""
    policies = [*scores.by_trigger.values(), NONE, PAPER]
    ties = {policy.words: scores.ties(policy) for policy in policies}
    return ", ".join(f"{count} of *{name}*" for name, count in ties.items() if count) or "none"


def _expected(scores: Scores) -> Table:
    """What each policy gives: cells, worst cell, false alarms."""
    triggers = sorted(scores.by_trigger.values(), key=lambda one: -scores.within(one).value)
    rows = []
    for policy in (*triggers, NONE, PAPER):
        worst = float(scores.ratios(policy).max())
        rows.append(
            [
                policy.words,
                f"{policy.threshold:g}" if policy.trigger != "none" else "-",
                _cells(scores.within(policy)),
                "never settles" if math.isinf(worst) else f"{worst:.2f}",
                format_percent(shared(np.isfinite(scores.runs(policy)))),
                format_percent(scores.alarms(policy)),
            ]
        )
    header = ["resets by", "threshold", "cells as fast as the best single reset", "worst ratio"]
    note = (
        f"*As fast*: median settling time at most {WITHIN:g} times that of the best single reset."
        " Each trigger with its best threshold, in units of its own score. *Three fixed* are those"
        " of paper 1, at 50, 100 and 150 s, healthy or not: nearly all runs settle, most of them"
        " later than with one reset at the right time. Number [95 % interval]; of a number of"
        " cells: [certainly as fast, possibly as fast], with the whole or with a part of the"
        " interval of their ratio. Ties, where neither settles half of its runs, count as fast:"
        f" {_ties(scores)}."
    )
    return Table("What to expect", [*header, "settled (%)", "false alarms (%)"], rows, note)


def _simulated(scores: Scores, footer: str) -> Page:
    best = scores.best(scores.triggered)
    halves = [scores.best(scores.triggered, slice(half, None, 2)) for half in range(2)]
    others = [one for one in scores.by_trigger.values() if one.trigger != best.trigger]
    rival = scores.best(others)
    ratios, (low, high) = scores.ratios(best), scores.intervals(best)
    worst = int(np.argmax(ratios))
    _, worst_feedback, worst_start = scores.cells[worst]
    worst_ratio = Estimate(float(ratios[worst]), low[worst], high[worst], scores.grid.draws)
    short = [scores.within(best, feedback) for feedback in SHORT]
    alarms = [scores.alarms(best, feedback) for feedback in SHORT]
    healthy = scores.grid.at(SETTLE, policy=best, start=scores.healthy, feedback=[*SHORT])
    slow, slow_alarms = scores.within(best, 10.0), scores.alarms(best, 10.0)
    values = {
        "best": {
            "name": best.words,
            "threshold": f"{best.threshold:g}",
            "pause": f"{best.refractory_s:g}",
            "until": f"{best.until_s:g}",
            "most": best.most,
            "within": _cells(scores.within(best)),
            "short": f"{sum(one.value for one in short):.0f} of {sum(one.n for one in short)}",
            "certain": f"{sum(one.low for one in short):.0f}",
            "ties": scores.ties(best),
            "healthy": healthy.size,
            "slow": _cells(slow),
            "slow_alarms": share(slow_alarms),
            "worst": format_estimate(worst_ratio, digits=2),
            "worst_at": f"{worst_start.name} deg, feedback every {worst_feedback:g} s",
            "sooner": int((high < 1).sum()),
            "only": int((ratios == 0).sum()),
        },
        "rival": {
            "name": rival.words,
            "within": _cells(scores.within(rival)),
            "alarms": share(scores.alarms(rival)),
        },
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
        "tests of innovations need thresholds far below those of chi-square": all(
            scores.by_trigger[name].threshold < 0.1 for name in ("nis", "innovation")
        ),
        "the next best raises far more false alarms": (
            scores.alarms(rival).value > 3 * scores.alarms(best).value
        ),
    }
    tables, figures = {"expected": _expected(scores)}, {"answer": _answer(scores, best, footer)}
    return Page(values, tables, figures, claims)


def _recorded(source: Source) -> Page:
    """The winning trigger on the recorded car, beside fixed resets."""
    grid = grid_of(source, (TRUTH,), case="case", yaw="phi_u0_deg")
    cases = ("linearisation", FIXED, "no reset")
    worst = [grid.at(TRUTH, case=case, yaw=grid.axes["yaw"][-1]) for case in cases]
    own, fixed = (float(median_over_draws(settle_s)) for settle_s in worst[:2])
    values = {"car": {"time": f"{own:.0f} s", "fixed": f"{fixed:.0f} s"}}
    claims = {
        "on the record the trigger settles every start, sooner than the paper's four": (
            np.isfinite(grid.at(TRUTH, case="linearisation")).all()
            and own < fixed
            and np.isinf(worst[-1]).all()
        )
    }
    return Page(values, claims=claims)
