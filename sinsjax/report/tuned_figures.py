"""The figures of a tuning: descents over what a search has seen, and best against cost."""

import numpy as np

from sinsjax import plots
from sinsjax.plots.descents import CostCurve, Landscape, Side, Spot, Way, best_by_cost, descent
from sinsjax.report.base import Picture, value_text
from sinsjax.study.search_space import SearchSpace, Variable
from sinsjax.study.tuned_keys import TIMES
from sinsjax.tuning.carry_out import COVARIANCE, GRADIENT
from sinsjax.tuning.results import Tuning, axis

_LOOKS = ("grid", GRADIENT, "baseline", "sobol", "equal cost", "random", COVARIANCE)  # by marker


def landscape(tuning: Tuning) -> list[Picture]:
    """The descents over what a search has seen, for the best combination of candidates."""
    space = SearchSpace.of(tuning.study)
    number = tuning.found[tuning.best].best.candidate
    combination = space.combinations[number]
    used = space.used(combination)
    if not used:
        return []
    name = next(name for name in ("grid", *tuning.found) if name in tuning.found)
    looks = [look for look in tuning.found[name].looks if look.candidate == number]
    points = tuning.tune.grid_points
    seen = Landscape(
        [_side(space.variables[i]) for i in used],
        np.array([look.values for look in looks])[:, used],
        np.array([look.objective for look in looks]),
        (points,) * len(used) if name == "grid" else None,
        axis(tuning.study),
    )
    ways = _ways(tuning, number, used)
    spots = [*_baseline_spot(tuning, space, number), *_spots(tuning, number, used)]
    told = f"Points of the search '{name}', coloured by their objective on the tuning draws"
    if len(used) == 1:
        told = f"Objective of the points of the search '{name}' on the tuning draws"
    if ways:
        told += "; lines: the descents, of the relaxed objective"
    if len(space.combinations) > 1:
        chosen = ", ".join(f"{key} = {value_text(v)}" for key, v in combination.items())
        told += f". All with {chosen}, as the best candidate has"
    figure = descent(seen, ways, spots, "Where the searches looked, and the best of each")
    return [Picture("descent", f"{told}.", figure)]


def _side(variable: Variable) -> Side:
    name, bracket, unit = plots.label(variable.key).partition(" (")
    if variable.entry is not None and variable.key == TIMES:
        name = f"reset {variable.entry + 1} at"
    elif variable.entry is not None:
        name = f"{name}, number {variable.entry + 1}"
    return Side(f"{name}{bracket}{unit}", variable.low, variable.high, variable.log)


def _ways(tuning: Tuning, number: int, used: list[int]) -> list[Way]:
    if GRADIENT not in tuning.found:
        return []
    looks = [
        look
        for look in tuning.found[GRADIENT].looks
        if look.window_s is not None and look.candidate == number
    ]
    return [
        Way(
            np.array([look.values for look in looks if look.start == start])[:, used],
            np.array([look.objective for look in looks if look.start == start]),
        )
        for start in dict.fromkeys(look.start for look in looks)
    ]


def _spots(tuning: Tuning, number: int, used: list[int]) -> list[Spot]:
    """The best point of each search that has the combination."""
    return [
        Spot(
            f"best of {name}",
            np.array(found.best.values)[used],
            found.best.objective,
            _LOOKS.index(name),
        )
        for name, found in tuning.found.items()
        if found.best.candidate == number
    ]


def _baseline_spot(tuning: Tuning, space: SearchSpace, number: int) -> list[Spot]:
    """The baseline, where it is a point of the combination and lies in all ranges."""
    case = tuning.judged.cases[tuning.places["baseline"]]
    combination = space.combinations[number]
    if any(case[key] != value for key, value in combination.items() if key in case):
        return []
    used = [space.variables[i] for i in space.used(combination)]
    values = []
    for variable in used:
        value = case[variable.key]
        if variable.entry is not None:
            entries = [v.entry for v in used if v.key == variable.key]
            if len(value) != len(entries):
                return []
            value = value[entries.index(variable.entry)]
        if not variable.low <= value <= variable.high:
            return []
        values.append(value)
    return [Spot("baseline", np.array(values), None, _LOOKS.index("baseline"))]


def course(tuning: Tuning) -> Picture:
    """The best objective of each search against what it had cost by then."""
    searches = []
    for name, found in tuning.found.items():
        relaxed = [look for look in found.looks if look.window_s is not None]
        if not relaxed:
            estimated = [look for look in found.looks if look.estimated]
            looks = estimated or found.looks
            cost = np.array([look.cost for look in looks])
            best = np.minimum.accumulate([look.objective for look in looks])
            ending = (found.cost, found.best.objective) if estimated else None
            searches.append(CostCurve(name, cost, best, bool(estimated), ending))
            continue
        steps = list(dict.fromkeys(look.step for look in relaxed))
        own = [[look for look in relaxed if look.step == step] for step in steps]
        cost = np.array([max(look.cost for look in looks) for looks in own])
        best = np.array([min(look.objective for look in looks) for looks in own])
        searches.append(CostCurve(name, cost, best, True, (found.cost, found.best.objective)))
    told = "Best objective on the tuning draws against cost (steps of simulation)"
    if any(one.relaxed for one in searches):
        told += (
            "; dashed: the best of all descents at each step, relaxed, on the draws of the step, or"
            " the best so far by covariance analysis"
        )
    figure = best_by_cost(
        searches, axis(tuning.study), "Best so far against what the search had cost"
    )
    return Picture("history", f"{told}.", figure)
