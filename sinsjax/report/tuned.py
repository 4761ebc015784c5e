"""A tuning: what its searches found, judged on draws that tuned nothing, and how they did."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from sinsjax.analysis import NO_INTERVAL, Estimate, format_estimate
from sinsjax.errors import InputError
from sinsjax.execution.source import Source
from sinsjax.report import tuned_figures
from sinsjax.report.base import Chapter, Report, Table, value_text
from sinsjax.study.search_space import Variable
from sinsjax.study.success import yardsticks
from sinsjax.study.tuned_keys import TIMES
from sinsjax.tuning import objective
from sinsjax.tuning.carry_out import EVALUATION, GRADIENT
from sinsjax.tuning.results import Tuning, words

NEAR_S = 1.0
"""Resets closer than this are told as a double one, s."""

_CLOSE = (
    f"Resets less than {NEAR_S:g} s apart are joined by *and*: a double reset, whose effect need"
    " not be that of one."
)
_MILLION = 1e6


def read(directory: Path) -> Source:
    """Opens a tuning: the results of its judging, with the directory of all of it.

    Raises:
        InputError: it is not complete, or cannot be read.
    """
    if not (directory / EVALUATION / "summary").is_dir():
        raise InputError(
            f"{directory}: holds a tuning that is not complete (`sinsjax tune --resume` goes on"
            " with it)"
        )
    judged = Source.read(directory / EVALUATION)
    assert judged.draws  # of which none is missing, or that is told
    return replace(judged, directory=directory, table=judged.summary)


def report(source: Source) -> Report:
    """The candidates on the unused draws, and how the searches came to them.

    Raises:
        InputError: a file of the tuning cannot be read.
    """
    tuning = Tuning.of(source)
    pictures = [*tuned_figures.landscape(tuning), tuned_figures.course(tuning)]
    variants = tuning.runs.shape[1]
    each = f" × {variants} variants" if variants > 1 else ""
    return Report(
        _headline(tuning),
        [
            Chapter("What was found", [_candidates(tuning)]),
            Chapter("How it was found", pictures),
        ],
        f"{tuning.study.name}: {_drawn(tuning)}{each} a point",
    )


def _drawn(tuning: Tuning) -> str:
    """The draws that tuned, in words."""
    if record := tuning.study.record:
        return f"{len(record.start_s[::2])} start times"
    return f"{tuning.tune.tune_draws} draws"


def _headline(tuning: Tuning) -> list[str]:
    tune, best = tuning.tune, tuning.best
    unit = "start times" if tuning.study.is_recorded else "draws"
    judged = yardsticks(tuning.study, tune.objective_band_arcmin)[0]
    name, across = words(tuning.study)[0], {"mean": "mean", "worst": "worst"}[tune.objective_across]
    over = f", {across} over {tuning.runs.shape[1]} variants" if tuning.runs.shape[1] > 1 else ""
    lines = [
        f"Tuned on {_drawn(tuning)}, judged on {tuning.runs.shape[2]} others by the {name}{over}:"
        f" {tuning.study.name}.",
        f"The best on the tuning {unit}, which is in `tuned.toml`, is that of the search"
        f" '{best}': {_said(tuning, tuning.score(best))} on the others, the baseline"
        f" {_said(tuning, tuning.score('baseline'))}.",
    ]
    looks = [
        look.objective
        for found in tuning.found.values()
        for look in found.looks
        if look.sharpness is None
    ]
    if min(looks) >= objective.failing(tune, tuning.study):
        lines.append(
            "Every point fails: no run of any point looked at keeps its heading"
            f" {judged.words}, so that the objective is the same everywhere and what is called the"
            " best is any of them. Widen `objective_band_arcmin`, lengthen the runs"
            + (", or judge from the limit (`judged_from`)." if judged.truth else ".")
        )
    if GRADIENT in tuning.found and tuning.rival != GRADIENT:
        difference = tuning.difference(GRADIENT)
        share = tuning.found[GRADIENT].cost / tuning.found[tuning.rival].cost
        verdict = (
            "better than"
            if difference.high < 0
            else "worse than"
            if difference.low > 0
            else "not told apart from"
        )
        lines.append(
            f"The gradient is {verdict} the best of '{tuning.rival}' (difference"
            f" {_said(tuning, difference)}), at {_percent(share)} of its cost."
        )
    return [*lines, _at_bounds(tuning)]


def _at_bounds(tuning: Tuning) -> str:
    """Which values of which candidate stand at the end of their range, in a sentence."""
    found = [
        f"{variable.name} = {value_text(value)} of '{name}'"
        for name, there in tuning.on_bounds.items()
        for variable, value in there
    ]
    if not found:
        return "No tuned value stands at the end of the range that was searched."
    return (
        "At the end of the range that was searched, so that a better value may lie beyond it:"
        f" {'; '.join(found)}."
    )


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
    rival = tuning.rival
    paid = tuning.found[rival].cost if rival in tuning.found else None
    keys = [key for key in tuning.judged.cases[0] if key != "case"]
    bounds = tuning.on_bounds
    rows = []
    for name, place in tuning.places.items():
        case = tuning.judged.cases[place]
        found = tuning.found.get(name)
        rows.append(
            [
                name,
                _said(tuning, tuning.score(name)),
                "-" if name == rival else _said(tuning, tuning.difference(name)),
                f"{found.cost / _MILLION:,.4g}" if found else "-",
                _percent(found.cost / paid) if found and paid else "-",
                *(_value(case[key], bounds.get(name, ()), key) for key in keys),
            ]
        )
    header = [
        "candidate",
        words(tuning.study)[0],
        f"less that of '{rival}'",
        "cost (10^6 steps)",
        f"of that of '{rival}'",
        *keys,
    ]
    recorded = tuning.study.is_recorded
    note = (
        "On draws that tuned nothing, the same for all."
        f" {NO_INTERVAL if recorded else 'Number [95 % interval by the bootstrap over them].'}"
        " Cost: simulated steps of the search, those of its derivatives included."
        f" *Bound*: the value stands at the end of the range that was searched. {_CLOSE}"
    )
    return Table("Candidates on the unused draws", header, rows, note)
