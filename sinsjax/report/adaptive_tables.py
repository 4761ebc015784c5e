"""Tables of reset policies against the best single reset of each cell."""

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate, format_difference, format_estimate
from sinsjax.report.adaptive_scores import (
    FEW_ALARMS,
    LATER_S,
    LATER_SHARE,
    WITHIN,
    Alarms,
    At,
    Scores,
)
from sinsjax.report.base import Table, percent
from sinsjax.report.reset_grid import BAND_ARCMIN, NONE, PAPER_SCHEDULE, draws_of, shared

LESS = f"{100 * (WITHIN - 1):.0f} %"
"""How far beyond the oracle a policy may be."""

_INTERVAL = (
    "Number [95 % interval]; of a number of cells: how many lie within with their whole interval,"
    " and how many with a part of it. Runs of one noise are not independent: intervals of shares"
    " and pooled medians count draws."
)
_ALARM = (
    "*False alarm*: a healthy run that was reset and settles later than without, on the same noise,"
    f" by more than {100 * LATER_SHARE:g} % or {LATER_S:g} s, of all healthy runs."
)


def counted(share: Estimate) -> str:
    """A share with its count, in percent, such as ``3 of 96, 3.1 [1.1, 8.8] %``."""
    count = round(share.value * share.n)
    value, low, high = (100 * x for x in share[:3])
    text = format_estimate(Estimate(value, low, high, share.n), digits=1)
    return f"{count} of {share.n}, {text} %"


def cells_within(count: Estimate) -> str:
    """A number of cells with its interval."""
    return f"{format_estimate(count, digits=0)} of {count.n}"


def cell_name(scores: Scores, at: At) -> str:
    """A cell in words."""
    cells = scores.cells
    return f"{cells.tunings[at[0]].name}, {cells.starts[at[1]].name} deg"


def ratio_text(ratio: Estimate) -> str:
    """A ratio to the oracle with its interval."""
    if ratio.value == 0:
        return "only it settles"
    return format_estimate(ratio, digits=2)


def is_reached(within: Estimate, alarms: Alarms) -> bool:
    """Whether every cell is within, and false alarms are few."""
    return within.value == within.n and alarms.false.value < FEW_ALARMS


def by_feedback(scores: Scores) -> Table:
    """The best trigger at each feedback interval: cells, alarms, and whether that is the goal."""
    cells, best = scores.cells, scores.choice.place
    none = cells.policy(NONE)
    rows = []
    for feedback in (*cells.feedbacks, None):
        within = scores.within(best, feedback)
        kinds = [scores.alarms(best, biased=b, feedback_s=feedback) for b in (False, True, None)]
        starts = [*cells.healthy(biased=False), *cells.healthy(biased=True)]
        at = np.ix_(cells.tuned(feedback), starts)
        healthy = [cells.settle_s[:, :, i][at] for i in (none, best)]
        medians = [
            format_estimate(analysis.quantile(s.ravel(), cluster=draws_of(s)), digits=0)
            for s in healthy
        ]
        rows.append(
            [
                "all" if feedback is None else f"{feedback:g}",
                cells_within(within),
                *(counted(alarms.false) for alarms in kinds),
                counted(kinds[-1].both),
                *medians,
                "yes" if is_reached(within, kinds[-1]) else "no",
            ]
        )
    header = [
        "feedback (s)",
        f"cells within {LESS}",
        "false alarms, no gyro bias",
        "false alarms, gyro bias",
        "false alarms, both",
        "later by both limits",
        "healthy, none: median (s)",
        "healthy, trigger: median (s)",
        "goal reached",
    ]
    title = f"{cells.policies[best].name} by feedback interval"
    note = (
        f"{_INTERVAL} {_ALARM} *Goal reached*: by the numbers themselves, without their intervals."
    )
    return Table(title, header, rows, note)


def beyond(scores: Scores) -> Table:
    """The cells in which the best trigger is not within reach of the oracle, and by how much."""
    best = scores.choice.place
    name = scores.cells.policies[best].name
    rows = []
    for number in np.argsort(-scores.ratios[:, best], kind="stable"):
        if scores.ratios[number, best] > WITHIN:
            at = scores.at[number]
            pick, runs = scores.oracle[at], scores.cells.settle_s[*at, best]
            later = analysis.quantile_difference(runs, pick.settle_s)
            rows.append(
                [
                    *_cell(scores, at),
                    format_estimate(pick.median, digits=0),
                    format_estimate(analysis.quantile(runs), digits=0),
                    ratio_text(scores.ratio(at, best)),
                    format_difference(later, digits=0, sides=(name, "the oracle")),
                ]
            )
    header = [
        *_CELL,
        "oracle: median (s)",
        f"{name}: median (s)",
        "ratio",
        "later by (s)",
    ]
    note = "Number [95 % interval]; ratio and difference on the same noise, resampled by draw."
    return Table(f"Cells in which {name} is not within {LESS} of the oracle", header, rows, note)


def policies(scores: Scores) -> Table:
    """All policies but the single resets, and the oracle that they make up."""
    cells = scores.cells
    places = [cells.policy(NONE), cells.policy(PAPER_SCHEDULE), *cells.triggered]
    rows = [_oracle(scores), *(_policy(scores, place) for place in places)]
    header = [
        "policy",
        "its numbers",
        f"cells within {LESS}",
        "worst ratio",
        "in",
        "settled (%)",
        "resets, median",
        "acts in need (%)",
        "acts in healthy runs (%)",
        "false alarms, no gyro bias",
        "false alarms, gyro bias",
        "later by both limits, all",
    ]
    note = (
        f"{_INTERVAL} *Settled*: of the runs of all cells, within {BAND_ARCMIN} arcmin to the end."
        f" *Acts*: resets at least once; what fades always does. *In need*: the"
        f" {len(scores.in_need())} cells in which the median without reset is beyond {LESS} of the"
        f" oracle's. {_ALARM}"
    )
    return Table("Every policy", header, rows, note)


def _oracle(scores: Scores) -> list[str]:
    settled = shared(np.isfinite([scores.oracle[at].settle_s for at in scores.at]))
    n = scores.cells.n_cells
    return ["oracle", "best single", f"{n} of {n}", "1", "-", percent(settled), "1", *["-"] * 5]


def _policy(scores: Scores, place: int) -> list[str]:
    cells = scores.cells
    policy, worst = cells.policies[place], scores.worst(place)
    resets = [cells.count[*at, place] for at in scores.at]
    fixed = policy.trigger is None
    count = len(policy.times) if fixed else float(np.median(resets))
    without, biased, both = (scores.alarms(place, biased=b) for b in (False, True, None))
    return [
        policy.name,
        policy.settings or "-",
        cells_within(scores.within(place)),
        ratio_text(scores.ratio(worst, place)),
        cell_name(scores, worst),
        percent(scores.settled(place)),
        "-" if policy.fades else f"{count:g}",
        percent(scores.acts_in_need(place)),
        percent(both.acts),
        counted(without.false),
        counted(biased.false),
        counted(both.both),
    ]


_CELL = ("Q reading", "feedback (s)", "start (deg)")


def _cell(scores: Scores, at: At) -> list[str]:
    """The first cells of a row about a cell."""
    tuning, start = scores.cells.tunings[at[0]], scores.cells.starts[at[1]]
    return [tuning.q, f"{tuning.feedback_s:g}", start.name]


def by_cell(scores: Scores) -> Table:
    """Every cell: the oracle, no reset, the paper's three, and what the best trigger did."""
    cells, best = scores.cells, scores.choice.place
    rows = []
    for at in scores.at:
        pick = scores.oracle[at]
        times = [f"{cells.policies[i].times[0]:g}" for i in dict.fromkeys(pick.places)]
        settling = [
            cells.settle_s[*at, place]
            for place in (cells.policy(NONE), cells.policy(PAPER_SCHEDULE), best)
        ]
        count = cells.count[*at, best]
        rows.append(
            [
                *_cell(scores, at),
                " / ".join(times),
                format_estimate(pick.median, digits=0),
                *(format_estimate(analysis.quantile(runs), digits=0) for runs in settling),
                ratio_text(scores.ratio(at, best)),
                _spread(count),
                _when(cells.first_s[*at, best]),
                _when(cells.last_s[*at, best]),
            ]
        )
    name = cells.policies[best].name
    header = [
        *_CELL,
        "oracle: reset at (s)",
        "oracle: median (s)",
        "none: median (s)",
        "paper's three: median (s)",
        f"{name}: median (s)",
        "ratio to the oracle",
        "resets (least to most)",
        "first (s)",
        "last (s)",
    ]
    note = (
        f"Number [95 % interval over {cells.draws} draws]. *Reset at*: both times where the halves"
        " chose different ones. *Resets*, *first*, *last*: medians, the times over the runs that"
        " had one."
    )
    return Table("Every cell", header, rows, note, folded=True)


def _spread(count: NDArray) -> str:
    return f"{np.median(count):g} ({count.min():g} to {count.max():g})"


def _when(times_s: NDArray) -> str:
    known = times_s[np.isfinite(times_s)]
    return f"{analysis.quantile(known).value:.1f}" if known.size else "-"
