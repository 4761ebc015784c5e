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
from .ratios import PolicyRatios, draw_ratios
from .scores import NONE, PAPER, SETTLE, WITHIN, Policy, Scores

SHORT = (0.01, 1.0)  # s, feedback intervals
TRUTH = "settle_10_truth_s"
FIXED = "the paper's four"

_Q_WORDS = {"per_step": "as printed", "psd": "as a density", "per_sample": "of a sample"}


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
    """Median and worst ratio of every policy."""
    rows = []
    for policy in _listed(scores):
        ratios = scores.ratios(policy)
        median = float(np.quantile(ratios, 0.5, method="inverted_cdf"))  # of an infinite one too
        rows.append(PolicyRatios(policy.words, median, float(ratios.max())))
    worst = float(scores.ratios(best).max())
    title = (
        f"The {best.words} trigger is never far behind:\n"
        f"at worst {worst:.1f} times the time of the best single reset"
    )
    caption = (
        f"Ratios of median settling times over {scores.grid.draws} runs, {len(scores.cells)} cells."
        " Never: less than half of the worst cell's runs settle."
    )
    return Picture("answer", caption, draw_ratios(rows, title, WITHIN), footer)


def _listed(scores: Scores) -> list[Policy]:
    """Return every policy at its best threshold, most cells as fast first."""
    triggers = sorted(scores.by_trigger.values(), key=lambda one: -scores.within(one).value)
    return [*triggers, NONE, PAPER]


def _every_cell(scores: Scores) -> Table:
    """Ratio of every policy in every cell."""
    policies = _listed(scores)
    ratios = np.stack([scores.ratios(policy) for policy in policies], axis=1)
    rows = [
        [_Q_WORDS[q], f"{feedback:g}", start.name, *map(_cell, cells)]
        for (q, feedback, start), cells in zip(scores.cells, ratios, strict=True)
    ]
    header = ["Q", "feedback (s)", "misalignment (deg)", *(policy.words for policy in policies)]
    return Table("Ratio in every cell", header, rows, folded=True)


def _cell(ratio: float) -> str:
    """Return a ratio of medians, or which of the two never settles half of the runs."""
    return "never" if math.isinf(ratio) else f"{ratio:.2f}" if ratio else "only it settles"


def _expected(scores: Scores) -> dict[str, Table]:
    """Cells and false alarms of each policy; with thresholds, settled runs and ties in a file."""
    header = ("resets by", f"cells as fast, of {len(scores.cells)}", "false alarms (%)")
    more = ("threshold, in units of its score", "settled (%)", "ties")
    rows = []
    for policy in _listed(scores):
        found = format_estimate(scores.within(policy), digits=0)
        threshold = f"{policy.threshold:g}" if policy.trigger != "none" else ""
        settled = format_percent(shared(np.isfinite(scores.runs(policy))))
        alarms = format_percent(scores.alarms(policy))
        ties = str(scores.ties(policy))
        rows.append([policy.words, found, alarms, threshold, settled, ties])
    note = (
        f"*As fast*: median settling time at most {WITHIN:g} times that of the best single reset"
        " [certainly, possibly: the whole or a part of its 95 % interval], or a tie: neither"
        " settles half of its runs. *Three fixed*: paper 1's, at 50, 100 and 150 s."
    )
    shown = [row[: len(header)] for row in rows]
    title = "The same with thresholds, settled runs and ties"
    return {
        "expected": Table("What to expect", header, shown, note),
        "policies": Table(title, [*header, *more], rows, folded=True),
    }


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
            "short": f"{sum(one.value for one in short):.0f} of {sum(one.n for one in short)}",
            "certain": f"{sum(one.low for one in short):.0f}",
            "healthy": healthy.size,
            "slow": _cells(slow),
            "slow_alarms": share(slow_alarms),
            "worst": format_estimate(worst_ratio, digits=2),
            "worst_at": f"{worst_start.name} deg, feedback every {worst_feedback:g} s",
            "sooner": int((high < 1).sum()),
            "only": int((ratios == 0).sum()),
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
    tables, figures = (
        {**_expected(scores), "cells": _every_cell(scores)},
        {"answer": _answer(scores, best, footer)},
    )
    return Page(values, tables, figures, claims)


def _recorded(source: Source) -> Page:
    """The winning trigger on the recorded car, compared with fixed resets."""
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
