"""Tables of the page on resets that set themselves."""

import numpy as np

from sinsjax import analysis
from sinsjax.analysis import Estimate, format_difference, format_estimate
from sinsjax.report.base import Table, percent
from sinsjax.report.grids import shared

from .scores import NONE, PAPER, Q_WORDS, WITHIN, Policy, Scores

_CELLS = "Of a number of cells: how many lie within with their whole interval, and with a part."


def cells(count: Estimate) -> str:
    """A number of cells with its interval."""
    return f"{format_estimate(count, digits=0)} of {count.n}"


def _ratio(value: float) -> str:
    return "never settles" if np.isinf(value) else f"{value:.2f}"


def expected(scores: Scores) -> Table:
    """What each policy gives: cells, worst cell, false alarms."""
    rows = []
    fixed = {"no reset": NONE, "three at 50, 100 and 150 s": PAPER}
    named = {one.words: one for one in scores.by_trigger.values()}
    order = sorted(named, key=lambda name: -scores.within(named[name]).value)
    for name, policy in {**{name: named[name] for name in order}, **fixed}.items():
        rows.append(
            [
                name,
                f"{policy.threshold:g}" if policy.trigger != "none" else "-",
                cells(scores.within(policy)),
                _ratio(float(scores.ratios(policy).max())),
                percent(shared(np.isfinite(scores.runs(policy)))),
                percent(scores.alarms(policy).false),
            ]
        )
    header = ["resets by", "threshold", "cells as fast as the best single reset", "worst ratio"]
    note = (
        f"*As fast*: median settling time at most {WITHIN:g} times that of the best single reset."
        f" Each trigger with its best threshold. Number [95 % interval]. {_CELLS}"
    )
    return Table("What to expect", [*header, "settled (%)", "false alarms (%)"], rows, note)


def by_feedback(scores: Scores, best: Policy) -> Table:
    """The best trigger at each feedback interval."""
    rows = []
    for feedback in (*scores.grid.axes["feedback"], None):
        alarms = scores.alarms(best, feedback)
        rows.append(
            [
                "all" if feedback is None else f"{feedback:g} s",
                cells(scores.within(best, feedback)),
                percent(alarms.false),
                percent(alarms.acts),
            ]
        )
    header = ["feedback every", "cells as fast", "false alarms (%)", "resets in healthy runs (%)"]
    return Table(f"The {best.words} trigger at {best.threshold:g}", header, rows, _CELLS)


def settings(scores: Scores) -> Table:
    """Every trigger and threshold."""
    rows = [
        [
            policy.words,
            *(f"{x:g}" for x in (policy.threshold, policy.window_s, policy.refractory_s)),
            f"{policy.until_s:g}",
            f"{policy.most}",
            cells(scores.within(policy)),
            _ratio(float(scores.ratios(policy).max())),
            percent(scores.acts_in_need(policy)),
            percent(scores.alarms(policy).false),
        ]
        for policy in scores.triggered
    ]
    header = ["trigger", "threshold", "window (s)", "pause (s)", "until (s)", "most"]
    return Table(
        "Every trigger and threshold",
        [*header, "cells as fast", "worst ratio", "resets where needed (%)", "false alarms (%)"],
        rows,
        f"*Needed*: cells that are slower than the best single reset without any. {_CELLS}",
        folded=True,
    )


def by_cell(scores: Scores, best: Policy) -> Table:
    """Every cell: the best single reset, none, and the best trigger."""
    names = [f"{policy.times[0]:g}" for policy in scores.singles]
    none, runs, ratios = scores.runs(NONE), scores.runs(best), scores.ratios(best)
    rows = []
    for number, (q, feedback, start) in enumerate(scores.cells):
        choice = scores.best_single[number]
        apart = analysis.quantile_difference(runs[number], choice.values)
        rows.append(
            [
                Q_WORDS[q],
                f"{feedback:g}",
                start.name,
                choice.named(names),
                *(
                    format_estimate(analysis.quantile(one), digits=0)
                    for one in (choice.values, none[number], runs[number])
                ),
                "only it settles" if ratios[number] == 0 else f"{ratios[number]:.2f}",
                format_difference(apart, digits=0, sides=("the trigger", "the single reset")),
            ]
        )
    header = ["Q", "feedback (s)", "start (deg)", "best single at (s)", "median (s)"]
    header += ["no reset: median (s)", f"{best.name}: median (s)", "ratio", "later by (s)"]
    note = "Number [95 % interval over the draws]; two times: each half of the draws chose its own."
    return Table("Every cell", header, rows, note, folded=True)
