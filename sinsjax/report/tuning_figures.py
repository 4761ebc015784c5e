"""The figure of a tuning: descents over the evaluated points."""

import numpy as np

from sinsjax import plots
from sinsjax.plots.descents import Points, VariableAxis, draw_descents
from sinsjax.plots.labels import format_value
from sinsjax.report.base import Picture
from sinsjax.study.search_space import SearchSpace, Variable
from sinsjax.study.sweep import TIMES
from sinsjax.tuning.law_point import LAW
from sinsjax.tuning.results import SEARCH_LABELS, TuningResults, objective_label


def landscape_pictures(tuning: TuningResults) -> list[Picture]:
    """Return the descents over the points of a search, for the best combination of candidates."""
    space = SearchSpace.from_study(tuning.search_study)
    number = tuning.searches[tuning.best_search].best.candidate
    combination = space.combinations[number]
    used = space.used_variables(combination)
    if not used:
        return []
    name = next(name for name in ("grid", *tuning.searches) if name in tuning.searches)
    evaluations = [e for e in tuning.searches[name].evaluations if e.candidate == number]
    points = tuning.tune.grid_points
    if name == "grid":  # without the law's schedule, which is not on the grid
        evaluations = evaluations[-(points ** len(used)) :]
    variables = [_variable_axis(space.variables[i]) for i in used]
    seen = Points(
        objective_label(tuning.search_study),
        np.array([e.values for e in evaluations])[:, used],
        np.array([e.objective for e in evaluations]),
    )
    ways = [
        Points("descents, from the open circles", values[:, used], found)
        for values, found in tuning.descents(number)
    ]
    spots = _best_points(tuning, number, used)
    for other in (name for name in (LAW, "baseline") if name in tuning.case_numbers):
        case = tuning.case(other)
        if (values := space.locate(case, combination)) is not None:
            spots.append(Points(SEARCH_LABELS[other], np.array([values]), np.array([np.nan])))
    chosen = ", ".join(f"{key} = {format_value(v)}" for key, v in combination.items())
    caption = f"Points of the search {name!r}, coloured by their objective on the tuning draws"
    if len(used) == 1:
        caption = f"Objective of the points of the search {name!r} on the tuning draws"
    caption += "; lines: the descents, of the relaxed objective" if ways else ""
    if len(space.combinations) > 1:
        caption += f". All with {chosen}, the values of the best candidate"
    best = np.array(tuning.searches[tuning.best_search].best.values)[used]
    words = ", ".join(map(_format_value, variables, best))
    figure = draw_descents(
        variables,
        seen,
        ways,
        spots,
        f"Best: {words}",
    )
    return [Picture("descent", f"{caption}.", figure)]


def _variable_axis(variable: Variable) -> VariableAxis:
    name, bracket, unit = plots.axis_label(variable.key).partition(" (")
    if variable.entry is not None and variable.key == TIMES:
        name = f"reset {variable.entry + 1} at"
    elif variable.entry is not None:
        name = f"{name}, number {variable.entry + 1}"
    return VariableAxis(f"{name}{bracket}{unit}", variable.log)


def _format_value(variable: VariableAxis, value: float) -> str:
    """A value of a variable in words: ``reset 1 at 3.31 s``."""
    name, _, unit = variable.name.partition(" (")
    return f"{name} {value:.3g} {unit.rstrip(')')}".rstrip()


def _best_points(tuning: TuningResults, candidate: int, variables: list[int]) -> list[Points]:
    """The best point of each search that has the combination."""
    return [
        Points(
            f"best of {SEARCH_LABELS[name]}",
            np.array([result.best.values])[:, variables],
            np.array([result.best.objective]),
        )
        for name, result in tuning.searches.items()
        if result.best.candidate == candidate
    ]
