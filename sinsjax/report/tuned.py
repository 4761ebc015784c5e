"""A tuning: what its searches found, judged on draws that tuned nothing, and how they did."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from sinsjax.analysis import NO_INTERVAL, Estimate, format_estimate
from sinsjax.execution.source import Source
from sinsjax.plots.words import value_text
from sinsjax.report import tuned_figures
from sinsjax.report.base import Block, Report, Table
from sinsjax.report.markup import template
from sinsjax.study.search_space import Variable
from sinsjax.study.success import yardsticks
from sinsjax.study.sweep import TIMES
from sinsjax.tuning import objective
from sinsjax.tuning.results import Tuning, words
from sinsjax.tuning.run_tuning import GRADIENT

NEAR_S = 1.0
"""Resets closer than this are told as a double one, s."""


def report(source: Source) -> Report:
    """The candidates on the unused draws, and how the searches came to them.

    Raises:
        InputError: a file of the tuning cannot be read.
    """
    tuning = Tuning.of(source)
    pictures = [*tuned_figures.landscape(tuning), tuned_figures.course(tuning)]
    variants = tuning.runs.shape[1]
    each = f" × {variants} variants" if variants > 1 else ""
    parts: dict[str, Sequence[Block]] = {
        "What was found": [_candidates(tuning)],
        "How it was found": pictures,
    }
    rests_on = f"{tuning.study.name}: {_drawn(tuning)}{each} a point"
    return Report.of(_headline(tuning), parts, rests_on)


def _drawn(tuning: Tuning) -> str:
    """The draws that tuned, in words."""
    if record := tuning.study.record:
        return f"{len(record.start_s[::2])} start times"
    return f"{tuning.tune.tune_draws} Monte Carlo runs"


def _headline(tuning: Tuning) -> list[str]:
    tune, rival = tuning.tune, tuning.rival
    looks = [
        look.objective
        for found in tuning.found.values()
        for look in found.looks
        if look.sharpness is None
    ]
    gradient = {}
    if GRADIENT in tuning.found and rival != GRADIENT:
        apart = tuning.difference(GRADIENT)
        lower = "better than" if apart.high < 0 else "not told apart from"
        gradient = {
            "verdict": "worse than" if apart.low > 0 else lower,
            "difference": _said(tuning, apart),
            "share": _percent(tuning.found[GRADIENT].cost / tuning.found[rival].cost),
        }
    text = template("tuned.md.j2").render(
        study=tuning.study.name,
        drawn=_drawn(tuning),
        others=tuning.runs.shape[2],
        variants=tuning.runs.shape[1],
        unit="start times" if tuning.study.is_recorded else "draws",
        name=words(tuning.study)[0],
        across=tune.objective_across,
        best=tuning.best,
        score=_said(tuning, tuning.score(tuning.best)),
        baseline=_said(tuning, tuning.score("baseline")),
        fails=min(looks) >= objective.failing(tune, tuning.study),
        judged=yardsticks(tuning.study, tune.objective_band_arcmin)[0],
        gradient=gradient,
        rival=rival,
        bounds=[
            f"{variable.name} = {value_text(value)} of '{name}'"
            for name, there in tuning.on_bounds.items()
            for variable, value in there
        ],
    )
    return text.splitlines()


def _value(value: Any, bounds: Sequence[tuple[Variable, float]], key: str) -> str:
    """A candidate's value of a key: what stands on a bound is marked, near resets are joined."""
    numbers = value if isinstance(value, list | tuple) else [value]
    ends = [end for v, end in bounds if v.key == key]  # times were put in order: told by value
    words = [
        value_text(x) + (" (bound)" if any(math.isclose(x, e, rel_tol=0.01) for e in ends) else "")
        for x in numbers
    ]
    if not words:
        return value_text(value)
    text = words[0]
    for before, after, word in zip(numbers, numbers[1:], words[1:], strict=False):
        near = key == TIMES and after - before < NEAR_S
        text += f"{' and' if near else ','} {word}"
    return text


def _percent(share: float) -> str:
    return f"{100 * share:,.{0 if share >= 1 else 1}f} %"


def _said(tuning: Tuning, estimate: Estimate) -> str:
    digits = {"final_error": 2, "failure_rate": 3}.get(tuning.tune.objective, 1)
    return format_estimate(estimate, words(tuning.study)[1], digits)


def _candidates(tuning: Tuning) -> Table:
    rival, bounds = tuning.rival, tuning.on_bounds
    costs = {name: found.cost for name, found in tuning.found.items()}

    def lessened(name: str) -> str:
        return "-" if name == rival else _said(tuning, tuning.difference(name))

    def share(name: str) -> str:
        known = name in costs and costs.get(rival)
        return _percent(costs[name] / costs[rival]) if known else "-"

    def cell(key: str, name: str) -> str:
        value = tuning.judged.cases[tuning.places[name]][key]
        return _value(value, bounds.get(name, ()), key)

    cells: list[tuple[str, Callable[[str], str]]] = [
        (words(tuning.study)[0], lambda name: _said(tuning, tuning.score(name))),
        (f"less that of '{rival}'", lessened),
        ("cost (10^6 steps)", lambda name: f"{costs[name] / 1e6:,.4g}" if name in costs else "-"),
        (f"of that of '{rival}'", share),
        *((key, partial(cell, key)) for key in tuning.judged.cases[0] if key != "case"),
    ]
    rows = [[name, *(tell(name) for _, tell in cells)] for name in tuning.places]
    recorded = tuning.study.is_recorded
    note = (
        "On draws that tuned nothing, the same for all."
        f" {NO_INTERVAL if recorded else 'Number [95 % interval by the bootstrap over them].'}"
        " Cost: simulated steps of the search, those of its derivatives included."
        " *Bound*: the value stands at the end of the range that was searched."
        f" Resets less than {NEAR_S:g} s apart are joined by *and*: a double reset, whose effect"
        " need not be that of one."
    )
    header = ["candidate", *(name for name, _ in cells)]
    return Table("Candidates on the unused draws", header, rows, note)
