"""The report of a tuning: its candidates, evaluated on unused draws, and its searches."""

from collections.abc import Iterator, Sequence

import numpy as np

from sinsjax.analysis import UNKNOWN, Estimate, format_estimate
from sinsjax.analysis.labels import axis_label, format_percent, format_setting, format_value
from sinsjax.messages import format_count
from sinsjax.plots.maps import Points, draw_landscape
from sinsjax.report.document import Fact, Picture, Report, Table, caution
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.success import success_measures
from sinsjax.study.sweep import TIMES
from sinsjax.tuning import objective
from sinsjax.tuning.history import Evaluation
from sinsjax.tuning.results import (
    SEARCH_LABELS,
    TuningResults,
    describe_objective,
    objective_label,
)
from sinsjax.tuning.search import LAW


def build_report(tuning: TuningResults) -> Report:
    """Return the candidates on the unused draws, and how the searches found them."""
    study, variants = tuning.search_study, tuning.run_values.shape[1]
    *others, last = (SEARCH_LABELS.get(name, name) for name in tuning.searches)
    searches = f"{', '.join(others)} and {last}" if others else last
    variants_text = f" × {variants} variants" if variants > 1 else ""
    return Report(
        f"{study.name}: tuned by {searches}",
        [*_answer_facts(tuning), *map(caution, _doubts(tuning))],
        _ranked_candidates_against_baseline(tuning),
        [_candidate_table(tuning)],
        [*_landscape(tuning)],
        footer=f"{study.name}: {_describe_tuning_draws(tuning)}{variants_text} a point",
    )


def _describe_tuning_draws(tuning: TuningResults) -> str:
    if record := tuning.search_study.record:
        return f"{len(record.start_s[::2])} start times"
    return f"{tuning.tune.tune_draws} Monte Carlo runs"


def _answer_facts(tuning: TuningResults) -> Iterator[Fact]:
    """The best point, its gain over the start on unused draws, and why it is in ``tuned.toml``."""
    study, best, searches = tuning.search_study, tuning.best_search, tuning.searches
    yield Fact("Best", _describe_candidate(tuning, best))
    gain = f"{_format(tuning, tuning.score_of(best))}, {_describe_gain(tuning, 'baseline')}"
    unit = "unused start time" if study.is_recorded else "unused draw"
    yield Fact("Gain", f"{gain} than the start, on {format_count(tuning.score.n, unit)}")
    shares = [tuning.settled_share(name) for name in (best, "baseline")]
    if any(found and found.value < 1 for found in shares):
        ours, start = (format_percent(found) if found else "" for found in shares)
        yield Fact("Settled", f"{ours} % of the runs, start {start} %; the others count whole")
    if LAW in tuning.case_numbers:
        text = f"{_describe_gain(tuning, LAW)} than the law ({_describe_candidate(tuning, LAW)})"
        same = tuning.case_numbers[LAW] == tuning.case_numbers[best]
        yield Fact("Law", "the best point is the law's schedule" if same else text)
    variants = tuning.run_values.shape[1]
    across = f", {tuning.tune.objective_across} over {variants} variants" if variants > 1 else ""
    yield Fact("Measure", describe_objective(study)[0] + across)
    count = format_count(sum(len(one.evaluations) for one in searches.values()), "evaluation")
    why = f"in tuned.toml: best of {count} on {_describe_tuning_draws(tuning)}"
    yield Fact("Why", f"{why} ({SEARCH_LABELS.get(best, best)})")


def _describe_gain(tuning: TuningResults, other: str) -> str:
    """The best point less another candidate as a gain: ``3.2 [2.1, 4.3] s better``."""
    gain = tuning.difference(tuning.best_search, other)
    if gain.value > 0:
        return f"{_format(tuning, gain)} worse"
    size = Estimate(0 - gain.value, 0 - gain.high, 0 - gain.low, gain.n)
    return f"{_format(tuning, size)} better"


def _describe_candidate(tuning: TuningResults, name: str) -> str:
    """The values of a candidate in words."""
    return ", ".join(format_setting(k, v) for k, v in tuning.case(name).items() if k != "case")


def _doubts(tuning: TuningResults) -> Iterator[str]:
    """Yield why the best point may mislead."""
    study = tuning.search_study
    evaluations = [e for result in tuning.searches.values() for e in result.evaluations]
    least = min(e.objective for e in evaluations if e.sharpness is None)
    if least >= objective.failure_score(tuning.tune, study):
        judged = success_measures(study, tuning.tune.objective_band_arcmin)[0]
        yield (
            f"every point fails: no run of any point keeps its heading {judged.description}, so the"
            " objective is the same everywhere. Widen `objective_band_arcmin`, lengthen the runs,"
            " or judge from the bias floor (`judged_from`)"
        )
    elif not study.is_recorded and not tuning.difference(tuning.best_search, "baseline").high < 0:
        yield "not significantly better than the start"
    if study.is_recorded:
        yield "no intervals, since all runs are on one record"
    on_bounds = tuning.values_on_bounds.get(tuning.best_search, ())
    if ends := ", ".join(f"{v.name} = {format_value(value)}" for v, value in on_bounds):
        yield f"{ends}: at the end of the range, a better value may lie beyond"


def _ranked_candidates_against_baseline(tuning: TuningResults) -> Table:
    """The candidates by their objective, the best first."""
    rows = []
    for name in sorted(tuning.case_numbers, key=lambda name: tuning.score_of(name).value):
        label, difference = "start", "-"
        if name != "baseline":
            label = SEARCH_LABELS.get(name, name)
            difference = _format(tuning, tuning.difference(name, "baseline"))
        rows.append([label, _format(tuning, tuning.score_of(name)), difference])
    return Table("Candidates", ["candidate", "unused draws", "less the start"], rows)


def _candidate_table(tuning: TuningResults) -> Table:
    """The candidates by their objective, cost and values."""
    rival, searches = tuning.rival, tuning.searches
    keys = [key for key in tuning.evaluation.study.cases[0] if key != "case"]
    settled = [] if tuning.unsettled is None else ["settled (%)"]
    header = [
        *("candidate", describe_objective(tuning.search_study)[0], "on the tuning draws", *settled),
        *(f"less that of '{rival}'", "cost (10^6 steps)", f"of that of '{rival}'", *keys),
    ]
    rows = []
    for name in tuning.case_numbers:
        tuned, cost, percent = "-", "-", "-"
        if result := searches.get(name):
            tuned = _format(tuning, UNKNOWN._replace(value=result.best.objective))
            cost = f"{result.cost / 1e6:,.4g}"
        if result and rival in searches:
            share = 100 * result.cost / searches[rival].cost
            percent = f"{share:,.{0 if share >= 100 else 1}f} %"
        found = tuning.settled_share(name)
        difference = "-" if name == rival else _format(tuning, tuning.difference(name))
        row = [name, _format(tuning, tuning.score_of(name)), tuned]
        row += [format_percent(found)] if found else []
        case = tuning.case(name)
        rows.append([*row, difference, cost, percent, *(format_value(case[key]) for key in keys)])
    note = "Of draws that tuned nothing, the same for all [95 % interval by the bootstrap over"
    note += " them]. Cost: simulated steps of the search, with those of its derivatives."
    return Table("Candidates on the unused draws", header, rows, note)


def _format(tuning: TuningResults, estimate: Estimate) -> str:
    """An objective as text."""
    digits = {"final_error": 2, "failure_rate": 3}.get(tuning.tune.objective, 1)
    return format_estimate(estimate, describe_objective(tuning.search_study)[1], digits)


def _landscape(tuning: TuningResults) -> Iterator[Picture]:
    """Yield the descents over the points of a search, for the best combination of candidates."""
    space = SearchSpace.from_study(tuning.search_study)
    number = tuning.searches[tuning.best_search].best.candidate
    combination = space.combinations[number]
    used = space.used_variables(combination)
    if not used:
        return

    def points_of(label: str, evaluations: Sequence[Evaluation]) -> Points:
        values = np.array([e.values for e in evaluations])[:, used]
        return Points(label, values, np.array([e.objective for e in evaluations]))

    name = next(name for name in ("grid", *tuning.searches) if name in tuning.searches)
    evaluations = [e for e in tuning.searches[name].evaluations if e.candidate == number]
    if name == "grid":  # without the law's schedule, which is not on the grid
        evaluations = evaluations[-(tuning.tune.grid_points ** len(used)) :]
    points = points_of(objective_label(tuning.search_study), evaluations)
    ways = [
        Points("descents, from the open circles", values[:, used], found)
        for values, found in tuning.descents(number)
    ]
    marked = [
        points_of(f"best of {SEARCH_LABELS[search]}", [result.best])
        for search, result in tuning.searches.items()
        if result.best.candidate == number
    ]
    for other in (other for other in (LAW, "baseline") if other in tuning.case_numbers):
        if (values := space.values_of_case(tuning.case(other), combination)) is not None:
            marked.append(Points(SEARCH_LABELS[other], np.array([values]), np.array([np.nan])))
    caption = f"Points of the search {name!r} with their objective on the tuning draws"
    caption += "; lines: the descents, of the relaxed objective" if ways else ""
    if len(space.combinations) > 1:
        chosen = ", ".join(f"{key} = {format_value(v)}" for key, v in combination.items())
        caption += f". All with {chosen}, the values of the best candidate"
    variables = {}
    for variable in (space.variables[i] for i in used):
        key, entry = variable.key, variable.entry
        label, bracket, unit = axis_label(key).partition(" (")
        if entry is not None:
            label = f"reset {entry + 1} at" if key == TIMES else f"{label}, number {entry + 1}"
        variables[f"{label}{bracket}{unit}"] = variable.log
    title = f"Best: {_describe_candidate(tuning, tuning.best_search)}"
    figure = draw_landscape(variables, points, ways, marked, title)
    yield Picture("descent", f"{caption}.", figure)
