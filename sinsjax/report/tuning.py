"""The report of a tuning: its candidates, evaluated on unused draws, and its searches."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from sinsjax.analysis import NO_INTERVAL, UNKNOWN, Estimate, format_estimate
from sinsjax.analysis.formats import format_percent
from sinsjax.messages import format_count
from sinsjax.plots.labels import format_setting, format_value
from sinsjax.report import tuning_figures
from sinsjax.report.base import Fact, Report, Table
from sinsjax.study.search_space import Variable
from sinsjax.study.success import success_measures
from sinsjax.study.sweep import TIMES
from sinsjax.tuning import objective
from sinsjax.tuning.results import SEARCH_LABELS, Tuning, describe_objective
from sinsjax.tuning.run_tuning import GRADIENT, LAW

DOUBLE_RESET_S = 1.0
"""Resets closer than this are printed as a double reset, s."""


def build_report(tuning: Tuning) -> Report:
    """Return the candidates on the unused draws, and how the searches found them."""
    pictures = tuning_figures.landscape_pictures(tuning)
    variants = tuning.run_values.shape[1]
    variants_text = f" × {variants} variants" if variants > 1 else ""
    return Report(
        f"{tuning.search_study.name}: tuned by"
        f" {_join_with_and([SEARCH_LABELS.get(name, name) for name in tuning.searches])}",
        _tuning_facts(tuning),
        _candidate_summary_table(tuning),
        [_candidate_table(tuning), *pictures],
        f"{tuning.search_study.name}: {_describe_tuning_draws(tuning)}{variants_text} a point",
    )


def _describe_tuning_draws(tuning: Tuning) -> str:
    """The draws that tuned, in words."""
    if record := tuning.search_study.record:
        return f"{len(record.start_s[::2])} start times"
    return f"{tuning.tune.tune_draws} Monte Carlo runs"


def _tuning_facts(tuning: Tuning) -> list[Fact]:
    """The best point, its gain over the start on unused draws, and why it is in ``tuned.toml``."""
    study, best = tuning.search_study, tuning.best
    count = sum(len(result.evaluations) for result in tuning.searches.values())
    unit = "start time" if study.is_recorded else "draw"
    name, in_unit = describe_objective(study)[0], partial(_format_objective, tuning)
    fresh = format_count(tuning.run_values.shape[2], f"unused {unit}")
    gain = tuning.difference(best, "baseline")
    return [
        Fact("Best", _describe_candidate(tuning, best)),
        Fact(
            "Gain",
            f"{in_unit(tuning.score(best))}, {_describe_gain(tuning, gain)} than the start,"
            f" on {fresh}",
        ),
        *_settled_fact(tuning),
        *_law_fact(tuning),
        Fact("Measure", name + _describe_aggregation(tuning)),
        Fact(
            "Why",
            f"in tuned.toml: best of {format_count(count, 'evaluation')} on"
            f" {_describe_tuning_draws(tuning)} ({SEARCH_LABELS.get(best, best)})",
        ),
        *_gradient_fact(tuning),
        *_caution_facts(tuning, gain),
    ]


def _describe_gain(tuning: Tuning, gain: Estimate) -> str:
    """Return a difference of two candidates as a gain: ``3.2 [2.1, 4.3] s better``."""
    verb = "worse" if gain.value > 0 else "better"
    size = gain if gain.value > 0 else Estimate(0 - gain.value, 0 - gain.high, 0 - gain.low, gain.n)
    return f"{_format_objective(tuning, size)} {verb}"


def _settled_fact(tuning: Tuning) -> Iterator[Fact]:
    """The shares of runs that settle, at the best point and at the start, if some never do."""
    shares = [tuning.settled_share(name) for name in (tuning.best, "baseline")]
    best, start = (format_percent(found) if found else "" for found in shares)
    if any(found and found.value < 1 for found in shares):
        lengths_s = np.unique(tuning.study.spans_s[:, 0])
        length = f"{lengths_s[0]:g} s" if len(lengths_s) == 1 else "the length of the run"
        text = f"{best} % of the runs, start {start} %; never counts as {length}"
        yield Fact("Settled", text)


def _law_fact(tuning: Tuning) -> Iterator[Fact]:
    """The best point compared with the reset schedule by the law, on unused draws."""
    if LAW in tuning.case_numbers:
        what = _describe_candidate(tuning, LAW)
        if tuning.case_numbers[LAW] == tuning.case_numbers[tuning.best]:
            yield Fact("Law", "the best point is the law's schedule")
        else:
            gain = _describe_gain(tuning, tuning.difference(tuning.best, LAW))
            yield Fact("Law", f"{gain} than the law of resets ({what})")


def _describe_candidate(tuning: Tuning, name: str) -> str:
    """The values of a candidate in words."""
    bounds = tuning.values_on_bounds.get(name, ())
    case = tuning.study.cases[tuning.case_numbers[name]]
    return ", ".join(
        format_setting(key, _format_candidate_value(value, bounds, key))
        for key, value in case.items()
        if key != "case"
    )


def _describe_aggregation(tuning: Tuning) -> str:
    variants = tuning.run_values.shape[1]
    across = tuning.tune.objective_across
    return f", {across} over {variants} variants" if variants > 1 else ""


def _join_with_and(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def _gradient_fact(tuning: Tuning) -> Iterator[Fact]:
    """The gradient compared with the best of the other searches."""
    if GRADIENT in tuning.searches and tuning.rival != GRADIENT:
        difference = tuning.difference(GRADIENT)
        lower = "better than" if difference.high < 0 else "not significantly different from"
        verdict = "worse than" if difference.low > 0 else lower
        share = _format_percent(tuning.searches[GRADIENT].cost / tuning.searches[tuning.rival].cost)
        text = (
            f"{verdict} the {SEARCH_LABELS.get(tuning.rival, tuning.rival)}, at {share} of its cost"
        )
        yield Fact("Gradient", text)


def _caution_facts(tuning: Tuning, gain: Estimate) -> Iterator[Fact]:
    """Yield why the best point may mislead."""
    scores = [
        evaluation.objective
        for result in tuning.searches.values()
        for evaluation in result.evaluations
        if evaluation.sharpness is None
    ]
    if min(scores) >= objective.failure_score(tuning.tune, tuning.search_study):
        judged = success_measures(tuning.search_study, tuning.tune.objective_band_arcmin)[0]
        text = (
            f"every point fails: no run of any point keeps its heading {judged.description}, so the"
            " objective is the same everywhere. Widen `objective_band_arcmin`, lengthen the runs"
        )
        text += ", or judge from the bias floor (`judged_from`)" if judged.truth else ""
        yield Fact("Caution", text, True)
    elif not gain.high < 0 and not tuning.search_study.is_recorded:
        yield Fact("Caution", "not significantly better than the start", True)
    if tuning.search_study.is_recorded:
        yield Fact("Caution", "no intervals, since all runs are on one record", True)
    ends = [
        f"{v.name} = {format_value(value)}"
        for v, value in tuning.values_on_bounds.get(tuning.best, ())
    ]
    if ends:
        text = f"{', '.join(ends)}: at the end of the range, a better value may lie beyond"
        yield Fact("Caution", text, True)


def _candidate_summary_table(tuning: Tuning) -> Table:
    """The candidates by their objective."""
    rows = []
    for name in sorted(tuning.case_numbers, key=lambda name: tuning.score(name).value):
        difference = (
            "-"
            if name == "baseline"
            else _format_objective(tuning, tuning.difference(name, "baseline"))
        )
        label = "start" if name == "baseline" else SEARCH_LABELS.get(name, name)
        rows.append([label, _format_objective(tuning, tuning.score(name)), difference])
    return Table("Candidates", ["candidate", "unused draws", "less the start"], rows)


def _format_candidate_value(value: Any, bounds: Sequence[tuple[Variable, float]], key: str) -> str:
    """Return a candidate's value of a key: bounds are marked, close resets joined."""
    numbers = value if isinstance(value, list | tuple) else [value]
    ends = [end for v, end in bounds if v.key == key]  # by value, since times were sorted
    words = [
        format_value(x)
        + (" (bound)" if any(math.isclose(x, e, rel_tol=0.01) for e in ends) else "")
        for x in numbers
    ]
    if not words:
        return format_value(value)
    text = words[0]
    for before, after, word in zip(numbers, numbers[1:], words[1:], strict=False):
        near = key == TIMES and after - before < DOUBLE_RESET_S
        text += f"{' and' if near else ','} {word}"
    return text


def _format_percent(share: float) -> str:
    return f"{100 * share:,.{0 if share >= 1 else 1}f} %"


def _format_objective(tuning: Tuning, estimate: Estimate) -> str:
    digits = {"final_error": 2, "failure_rate": 3}.get(tuning.tune.objective, 1)
    return format_estimate(estimate, describe_objective(tuning.search_study)[1], digits)


def _candidate_table(tuning: Tuning) -> Table:
    rival, bounds = tuning.rival, tuning.values_on_bounds
    costs = {name: result.cost for name, result in tuning.searches.items()}

    def difference_to_rival(name: str) -> str:
        return "-" if name == rival else _format_objective(tuning, tuning.difference(name))

    def share(name: str) -> str:
        known = name in costs and costs.get(rival)
        return _format_percent(costs[name] / costs[rival]) if known else "-"

    def cell(key: str, name: str) -> str:
        value = tuning.study.cases[tuning.case_numbers[name]][key]
        return _format_candidate_value(value, bounds.get(name, ()), key)

    def tuning_score(name: str) -> str:
        score = tuning.tuning_score(name)
        return "-" if score is None else _format_objective(tuning, UNKNOWN._replace(value=score))

    def settled(name: str) -> str:
        found = tuning.settled_share(name)
        return format_percent(found) if found else "-"

    cells: list[tuple[str, Callable[[str], str]]] = [
        (
            describe_objective(tuning.search_study)[0],
            lambda name: _format_objective(tuning, tuning.score(name)),
        ),
        ("on the tuning draws", tuning_score),
        *([("settled (%)", settled)] if tuning.unsettled is not None else []),
        (f"less that of '{rival}'", difference_to_rival),
        ("cost (10^6 steps)", lambda name: f"{costs[name] / 1e6:,.4g}" if name in costs else "-"),
        (f"of that of '{rival}'", share),
        *((key, partial(cell, key)) for key in tuning.study.cases[0] if key != "case"),
    ]
    rows = [
        [name, *(format_cell(name) for _, format_cell in cells)] for name in tuning.case_numbers
    ]
    recorded = tuning.search_study.is_recorded
    note = (
        "On draws that tuned nothing, the same for all; 'on the tuning draws': the score that the"
        " search minimised."
        f" {NO_INTERVAL if recorded else 'Number [95 % interval by the bootstrap over them].'}"
        " Cost: simulated steps of the search, those of its derivatives included."
        " 'Bound': the value stands at the end of the range that was searched."
        f" Resets less than {DOUBLE_RESET_S:g} s apart are joined by 'and': a double reset, whose"
        " effect need not be that of one."
    )
    header = ["candidate", *(name for name, _ in cells)]
    return Table("Candidates on the unused draws", header, rows, note)
