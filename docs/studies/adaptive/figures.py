"""Figures of the page on resets that set themselves."""

import math

from sinsjax.plots.cells import Class, ratio_maps
from sinsjax.report.base import Picture

from .scores import NONE, PAPER, Q_WORDS, WITHIN, Policy, Scores

_CLASSES = (
    Class(0.9, "up to 0.9 (faster)", "#d6e9f8"),
    Class(WITHIN, f"up to {WITHIN:g} (as fast)", "#f7f7f7"),
    Class(1.5, "up to 1.5", "#fde0a8"),
    Class(3.0, "up to 3", "#f0a030"),
    Class(math.inf, "beyond", "#b34a00", dark=True),
)
"""From faster to slower: pale blue, white, and ever darker orange."""


def answer(scores: Scores, best: Policy) -> Picture:
    """No reset, the paper's three and the best trigger over all cells."""
    return _maps(scores, "answer", {"no reset": NONE, "three fixed": PAPER, best.name: best})


def triggers(scores: Scores, best: Policy) -> Picture:
    """Every other trigger at its best threshold."""
    rest = {one.name: one for one in scores.by_trigger.values() if one != best}
    return _maps(scores, "triggers", rest)


def _maps(scores: Scores, name: str, policies: dict[str, Policy]) -> Picture:
    axes = scores.grid.axes
    shape = len(axes["q"]) * len(axes["feedback"]), len(scores.starts)
    panels = []
    for label, policy in policies.items():
        count = scores.within(policy)
        panels.append(
            (f"{label}: {count.value:.0f} of {count.n}", scores.ratios(policy).reshape(shape).T)
        )
    figure = ratio_maps(
        panels,
        _CLASSES,
        "Settling time over that of the best single reset",
        rows=[start.name for start in scores.starts],
        columns=[f"{Q_WORDS[q]}, {f:g} s" for q in axes["q"] for f in axes["feedback"]],
        side="initial misalignment (deg)",
        only="only it settles",
        across=4,
    )
    caption = (
        f"Ratio of the median times, over {scores.grid.draws} draws, until the heading stays within"
        " 10 arcmin of its limit. Columns: reading of Q and feedback interval. In"
        f" the titles: cells with a ratio of at most {WITHIN:g}."
    )
    return Picture(name, caption, figure, scores.footer)
