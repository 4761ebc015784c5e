"""The figures of a tuning: descents over what a search has seen, and best against cost."""

import numpy as np

from sinsjax import plots
from sinsjax.plots.descents import CostCurve, Landscape, Side, Spot, Way, best_by_cost, descent
from sinsjax.plots.words import value_text
from sinsjax.report.base import Picture
from sinsjax.report.markup import said
from sinsjax.study.search_space import SearchSpace, Variable
from sinsjax.study.sweep import TIMES
from sinsjax.tuning.results import MARKER_ORDER, SEARCH_LABELS, Tuning, objective_label


def landscape(tuning: Tuning) -> list[Picture]:
    """The descents over what a search has seen, for the best combination of candidates."""
    space = SearchSpace.from_study(tuning.study)
    number = tuning.searches[tuning.best].best.candidate
    combination = space.combinations[number]
    used = space.used_variables(combination)
    if not used:
        return []
    name = next(name for name in ("grid", *tuning.searches) if name in tuning.searches)
    evaluations = [e for e in tuning.searches[name].evaluations if e.candidate == number]
    points = tuning.tune.grid_points
    seen = Landscape(
        [_side(space.variables[i]) for i in used],
        np.array([e.values for e in evaluations])[:, used],
        np.array([e.objective for e in evaluations]),
        (points,) * len(used) if name == "grid" else None,
        objective_label(tuning.study),
    )
    ways = [Way(values[:, used], found) for values, found in tuning.descents(number)]
    spots = _spots(tuning, number, used)
    case = tuning.evaluation_study.cases[tuning.case_numbers["baseline"]]
    if (values := space.locate(case, combination)) is not None:
        spots.insert(0, Spot("baseline", np.array(values), None, MARKER_ORDER.index("baseline")))
    chosen = ", ".join(f"{key} = {value_text(v)}" for key, v in combination.items())
    caption = said(
        "landscape",
        search=name,
        is_line=len(used) == 1,
        has_ways=bool(ways),
        chosen=chosen if len(space.combinations) > 1 else "",
    )
    best = tuning.searches[tuning.best].best
    point = zip((_side(space.variables[i]) for i in used), np.array(best.values)[used], strict=True)
    words = ", ".join(_value_of(side, value) for side, value in point)
    figure = descent(seen, ways, spots, f"Best: {words}")
    return [Picture("descent", caption, figure)]


def _side(variable: Variable) -> Side:
    name, bracket, unit = plots.label(variable.key).partition(" (")
    if variable.entry is not None and variable.key == TIMES:
        name = f"reset {variable.entry + 1} at"
    elif variable.entry is not None:
        name = f"{name}, number {variable.entry + 1}"
    return Side(f"{name}{bracket}{unit}", variable.low, variable.high, variable.log)


def _value_of(side: Side, value: float) -> str:
    """A value of a variable in words: ``reset 1 at 3.31 s``."""
    name, _, unit = side.name.partition(" (")
    return f"{name} {value:.3g} {unit.rstrip(')')}".rstrip()


def _spots(tuning: Tuning, number: int, used: list[int]) -> list[Spot]:
    """The best point of each search that has the combination."""
    named = ((name, result.best) for name, result in tuning.searches.items())
    return [
        Spot(
            f"best of {SEARCH_LABELS[n]}",
            np.array(one.values)[used],
            one.objective,
            MARKER_ORDER.index(n),
        )
        for n, one in named
        if one.candidate == number
    ]


def course(tuning: Tuning) -> list[Picture]:
    """The best objective of each search against what it had cost by then, to compare searches."""
    if len(tuning.searches) < 2:
        return []
    searches = []
    for name, result in tuning.searches.items():
        cost, best, relaxed = result.best_by_cost
        ending = (result.cost, result.best.objective) if relaxed else None
        searches.append(CostCurve(SEARCH_LABELS[name], cost, best, relaxed, ending))
    caption = said("course", relaxed=any(one.relaxed for one in searches))
    title = f"The best point is of the search: {SEARCH_LABELS[tuning.best]}"
    return [
        Picture("history", caption, best_by_cost(searches, objective_label(tuning.study), title))
    ]
