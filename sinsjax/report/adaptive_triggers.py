"""How the triggers work, and what they see of the need of a reset."""

import inspect
from collections.abc import Iterator

from sinsjax.alignment.triggers.scores import TRIGGERS
from sinsjax.report.adaptive_scores import Scores
from sinsjax.report.adaptive_tables import LESS, cells_within
from sinsjax.report.base import Block, Section, Table, Text, percent

_TESTS = ("innovation", "nis")
_BELIEF = (
    "The filter believes velocity to be measured far worse than it is, so its innovations lie far"
    " inside what it expects even where heading is tens of degrees off."
)
_SEES = {
    "innovation": "Large errors show where the threshold is far below that of a chi-square test;"
    " small ones stay below it.",
    "nis": "As the windowed one, without its sum.",
    "whiteness": "Velocity is corrected slowly, so innovations are correlated in healthy runs too.",
    "tilt_drift": "That level or heading is being corrected, not whether on false grounds: it acts"
    " in healthy runs too, and again and again while a large yaw error is worked off.",
    "levelled": "Says when a reset would do good, not whether it is needed.",
    "strong_tracking": "Fades where innovations exceed what is believed, which they hardly do.",
    "linearisation": "Needs no innovation: it carries a second covariance, that of a base at rest,"
    " for which the horizontal specific force shows nothing of heading, and holds against that what"
    " the filter believes of heading.",
    "fading": "Forgets in healthy runs as in wrong ones, and never ends.",
}
"""What a trigger sees, and what it misses."""


def section(scores: Scores) -> Section:
    """What each trigger's score is, how often it acts where it should, and what it misses."""
    return Section(
        "How do the triggers work, and what do they see?",
        [Text(" ".join(_words(scores))), *_tables(scores)],
    )


def _words(scores: Scores) -> Iterator[str]:
    cells = scores.cells
    yield (
        "After each update a trigger gives a score; where it exceeds the threshold, P is set to P0,"
        " but not within the refractory time after the start or a reset, nor after the time of the"
        " last one, nor more often than allowed. Two rivals do not reset: they multiply P."
    )
    tests = [place for place in cells.triggered if cells.policies[place].trigger in _TESTS]
    thresholds = {place: cells.policies[place].threshold or 0.0 for place in tests}
    highest = {
        str(cells.policies[place].trigger): place
        for place in sorted(tests, key=lambda place: thresholds[place])
    }
    if highest:
        told = ", ".join(
            f"`{name}` at {thresholds[place]:g} in {percent(scores.acts_in_need(place))} %"
            for name, place in highest.items()
        )
        yield (
            "Tests of innovations see little: of the runs in need of a reset, with the highest"
            f" threshold here, they call for one: {told}. {_BELIEF}"
        )


def _tables(scores: Scores) -> Iterator[Block]:
    cells = scores.cells
    rows = []
    for name, place in scores.by_trigger.items():
        policy, trigger = cells.policies[place], TRIGGERS[name]
        told = inspect.getdoc(trigger.look or trigger.fade) or ""
        rows.append(
            [
                name,
                told.split("\n")[0].rstrip("."),
                f"{policy.threshold:g}",
                cells_within(scores.within(place)),
                percent(scores.acts_in_need(place)),
                percent(scores.alarms(place).acts),
                _SEES[name],
            ]
        )
    header = [
        "trigger",
        "score",
        "best threshold",
        f"cells within {LESS}",
        "acts in need (%)",
        "acts in healthy runs (%)",
        "what it sees",
    ]
    note = "Number [95 % interval]. *Best*, *acts* and *in need*: as in the table of policies."
    yield Table("The triggers, each with its best threshold", header, rows, note)
