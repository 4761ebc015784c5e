"""The report of a tuning: its candidates, evaluated on unused draws, and its searches."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from sinsjax.analysis import UNKNOWN, Estimate, format_estimate
from sinsjax.analysis.formats import format_percent
from sinsjax.messages import format_count
from sinsjax.plots.labels import format_setting, format_value
from sinsjax.report import tuning_figures
from sinsjax.report.base import NO_INTERVAL, Fact, Report, Table, build_table, caution
from sinsjax.study.search_space import Variable
from sinsjax.study.success import success_measures
from sinsjax.study.sweep import TIMES
from sinsjax.tuning import objective
from sinsjax.tuning.law_point import LAW
from sinsjax.tuning.results import SEARCH_LABELS, TuningResults, describe_objective
from sinsjax.tuning.search import GRADIENT

DOUBLE_RESET_S = 1.0
"""Resets closer than this are printed as a double reset, s."""


def build_report(tuning: TuningResults) -> Report:
    """Return the candidates on the unused draws, and how the searches found them."""
    study, variants = tuning.search_study, tuning.run_values.shape[1]
    *others, last = (SEARCH_LABELS.get(name, name) for name in tuning.searches)
    searches = f"{', '.join(others)} and {last}" if others else last
    variants_text = f" × {variants} variants" if variants > 1 else ""
    pictures = tuning_figures.landscape_pictures(tuning)
    return Report(
        f"{study.name}: tuned by {searches}",
        [*_answer_facts(tuning), *_caution_facts(tuning)],
        _summary_table(tuning),
        [_candidate_table(tuning), *pictures],
        f"{study.name}: {_describe_tuning_draws(tuning)}{variants_text} a point",
    )


def _describe_tuning_draws(tuning: TuningResults) -> str:
    """The draws that tuned, in words."""
    if record := tuning.search_study.record:
        return f"{len(record.start_s[::2])} start times"
    return f"{tuning.tune.tune_draws} Monte Carlo runs"


def _answer_facts(tuning: TuningResults) -> Iterator[Fact]:
    """The best point, its gain over the start on unused draws, and why it is in ``tuned.toml``."""
    study, best, searches = tuning.search_study, tuning.best_search, tuning.searches
    unit = "start time" if study.is_recorded else "draw"
    yield Fact("Best", _describe_candidate(tuning, best))
    gain = f"{_format(tuning, tuning.score_of(best))}, {_describe_gain(tuning, 'baseline')}"
    fresh = format_count(tuning.run_values.shape[2], f"unused {unit}")
    yield Fact("Gain", f"{gain} than the start, on {fresh}")
    shares = [tuning.settled_share(name) for name in (best, "baseline")]
    if any(found and found.value < 1 for found in shares):
        ours, start = (format_percent(found) if found else "" for found in shares)
        lengths_s = np.unique(tuning.evaluation.study.spans_s[:, 0])
        length = f"{lengths_s[0]:g} s" if len(lengths_s) == 1 else "the length of the run"
        text = f"{ours} % of the runs, start {start} %; never counts as {length}"
        yield Fact("Settled", text)
    if LAW in tuning.case_numbers:
        text = f"{_describe_gain(tuning, LAW)} than the law of resets"
        text += f" ({_describe_candidate(tuning, LAW)})"
        same = tuning.case_numbers[LAW] == tuning.case_numbers[best]
        yield Fact("Law", "the best point is the law's schedule" if same else text)
    variants = tuning.run_values.shape[1]
    across = f", {tuning.tune.objective_across} over {variants} variants" if variants > 1 else ""
    yield Fact("Measure", describe_objective(study)[0] + across)
    count = format_count(sum(len(one.evaluations) for one in searches.values()), "evaluation")
    why = f"in tuned.toml: best of {count} on {_describe_tuning_draws(tuning)}"
    yield Fact("Why", f"{why} ({SEARCH_LABELS.get(best, best)})")
    rival = tuning.rival
    if GRADIENT in searches and rival != GRADIENT:
        difference = tuning.difference(GRADIENT)
        lower = "better than" if difference.high < 0 else "not significantly different from"
        verdict = "worse than" if difference.low > 0 else lower
        cost = _format_percent(searches[GRADIENT].cost / searches[rival].cost)
        text = f"{verdict} the {SEARCH_LABELS.get(rival, rival)}, at {cost} of its cost"
        yield Fact("Gradient", text)


def _describe_gain(tuning: TuningResults, other: str) -> str:
    """The best point less another candidate as a gain: ``3.2 [2.1, 4.3] s better``."""
    gain = tuning.difference(tuning.best_search, other)
    if gain.value > 0:
        return f"{_format(tuning, gain)} worse"
    size = Estimate(0 - gain.value, 0 - gain.high, 0 - gain.low, gain.n)
    return f"{_format(tuning, size)} better"


def _describe_candidate(tuning: TuningResults, name: str) -> str:
    """The values of a candidate in words."""
    case = tuning.case(name)
    return ", ".join(
        format_setting(key, _format_value(tuning, name, key)) for key in case if key != "case"
    )


def _caution_facts(tuning: TuningResults) -> Iterator[Fact]:
    """Yield why the best point may mislead."""
    study, texts = tuning.search_study, []
    scores = [
        evaluation.objective
        for result in tuning.searches.values()
        for evaluation in result.evaluations
        if evaluation.sharpness is None
    ]
    if min(scores) >= objective.failure_score(tuning.tune, study):
        judged = success_measures(study, tuning.tune.objective_band_arcmin)[0]
        text = (
            f"every point fails: no run of any point keeps its heading {judged.description}, so the"
            " objective is the same everywhere. Widen `objective_band_arcmin`, lengthen the runs"
        )
        from_floor = ", or judge from the bias floor (`judged_from`)" if judged.truth else ""
        texts.append(text + from_floor)
    elif not study.is_recorded and not tuning.difference(tuning.best_search, "baseline").high < 0:
        texts.append("not significantly better than the start")
    if study.is_recorded:
        texts.append("no intervals, since all runs are on one record")
    on_bounds = tuning.values_on_bounds.get(tuning.best_search, ())
    if ends := ", ".join(f"{v.name} = {format_value(value)}" for v, value in on_bounds):
        texts.append(f"{ends}: at the end of the range, a better value may lie beyond")
    yield from map(caution, texts)


def _summary_table(tuning: TuningResults) -> Table:
    """The candidates by their objective."""
    rows = []
    for name in sorted(tuning.case_numbers, key=lambda name: tuning.score_of(name).value):
        is_start = name == "baseline"
        difference = "-" if is_start else _format(tuning, tuning.difference(name, "baseline"))
        label = "start" if is_start else SEARCH_LABELS.get(name, name)
        rows.append([label, _format(tuning, tuning.score_of(name)), difference])
    return Table("Candidates", ["candidate", "unused draws", "less the start"], rows)


def _candidate_table(tuning: TuningResults) -> Table:
    """The candidates by their objective, cost and values."""
    rival = tuning.rival
    costs = {name: result.cost for name, result in tuning.searches.items()}

    def less_rival(name: str) -> str:
        return "-" if name == rival else _format(tuning, tuning.difference(name))

    def cost_share(name: str) -> str:
        known = name in costs and costs.get(rival)
        return _format_percent(costs[name] / costs[rival]) if known else "-"

    def tuning_score(name: str) -> str:
        if name not in tuning.searches:
            return "-"
        score = tuning.searches[name].best.objective
        return _format(tuning, UNKNOWN._replace(value=score))

    def settled(name: str) -> str:
        found = tuning.settled_share(name)
        return format_percent(found) if found else "-"

    cells: list[tuple[str, Callable[[str], str]]] = [
        (
            describe_objective(tuning.search_study)[0],
            lambda name: _format(tuning, tuning.score_of(name)),
        ),
        ("on the tuning draws", tuning_score),
        *([("settled (%)", settled)] if tuning.unsettled is not None else []),
        (f"less that of '{rival}'", less_rival),
        ("cost (10^6 steps)", lambda name: f"{costs[name] / 1e6:,.4g}" if name in costs else "-"),
        (f"of that of '{rival}'", cost_share),
        *(
            (key, partial(_format_value, tuning, key=key))
            for key in tuning.evaluation.study.cases[0]
            if key != "case"
        ),
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
    groups = [({"candidate": name}, name) for name in tuning.case_numbers]
    return build_table("Candidates on the unused draws", ["candidate"], groups, cells, note)


def _format_value(tuning: TuningResults, name: str, key: str) -> str:
    """Return a candidate's value of a key: bounds are marked, close resets joined."""
    value = tuning.case(name)[key]
    bounds: Sequence[tuple[Variable, float]] = tuning.values_on_bounds.get(name, ())
    ends = [end for v, end in bounds if v.key == key]  # by value, since times were sorted
    numbers: Sequence[Any] = value if isinstance(value, list | tuple) else [value]
    text, before = "", None
    for number in numbers:
        if before is not None:
            text += " and " if key == TIMES and number - before < DOUBLE_RESET_S else ", "
        text += format_value(number)
        text += " (bound)" if any(math.isclose(number, e, rel_tol=0.01) for e in ends) else ""
        before = number
    return text or format_value(value)


def _format_percent(share: float) -> str:
    return f"{100 * share:,.{0 if share >= 1 else 1}f} %"


def _format(tuning: TuningResults, estimate: Estimate) -> str:
    """An objective as text."""
    digits = {"final_error": 2, "failure_rate": 3}.get(tuning.tune.objective, 1)
    return format_estimate(estimate, describe_objective(tuning.search_study)[1], digits)
