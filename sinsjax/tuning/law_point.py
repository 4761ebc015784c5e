"""The point of a search space that has the reset schedule by the law; every search evaluates it.

The law gets what the tuning is for: the largest initial heading error of the study, and the band of
the objective. Variables that are not of the schedule have their values of the baseline.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.methods.filters.keys import SCHEDULE_KEYS
from sinsjax.methods.reset_law import NoSchedule, schedule_with
from sinsjax.study.keys import TomlTable
from sinsjax.study.load import with_point
from sinsjax.study.reset_plan import iter_filters
from sinsjax.study.reset_schedules import reset_problem
from sinsjax.study.search_space import SearchSpace, effective_values
from sinsjax.study.study import Study
from sinsjax.study.sweep import COUNT, TIMES
from sinsjax.units import ARCMIN, DEG

LAW = "law"
"""Name of the reset schedule by the law among the evaluated points."""

_FIRST, _CYCLE, _HEADING = "reset_first_s", "reset_cycle_s", "phi_u0_deg"


def law_point(study: Study, number: int = 0) -> NDArray | None:
    """Return the reset schedule by the law as positions of the variables, 0 to 1, clipped; (p,).

    They are those that a combination of candidates uses. It has as many resets as the combination
    has times, or as are counted. If filters or places differ, it is the schedule of the slowest.
    None if no variable is one of a schedule, or the law has none.
    """
    assert study.tune is not None
    space = SearchSpace.from_study(study)
    combination = space.combinations[number]
    used = space.used_variables(combination)
    keys = {space.variables[i].key for i in used}
    if keys.isdisjoint(SCHEDULE_KEYS):
        return None
    baseline = with_point(study, study.tune.baseline)
    values = space.to_values([0.5] * len(space.variables))
    _set_values(space, values, effective_values(baseline, keys.difference(SCHEDULE_KEYS)))
    try:
        point = with_point(study, space.make_point(values, combination))
        _set_values(space, values, _schedule_by_law(study, point, combination))
    except (InputError, NoSchedule):
        return None
    return np.array(space.to_box(values))[used]


def _set_values(space: SearchSpace, values: list[float], by_key: TomlTable) -> None:
    """Set the values of the variables of some keys, clipped to their ranges."""
    for number, variable in enumerate(space.variables):
        if variable.key in by_key:
            entries = np.atleast_1d(by_key[variable.key])
            if (entry := variable.entry or 0) < len(entries):
                values[number] = float(np.clip(entries[entry], variable.low, variable.high))


def _schedule_by_law(study: Study, point: Study, combination: TomlTable) -> TomlTable:
    """Return the values of the keys of schedules by the law, from a point with any schedule.

    Raises:
        InputError: no method has the law, or a key that it needs is drawn or missing.
        NoSchedule: the law has no schedule, or a key of it is swept.
    """
    assert study.tune is not None
    keys, band = study.tune.variables, study.tune.objective_band_arcmin * ARCMIN
    times = keys.get(TIMES)
    if isinstance(times, tuple):
        resets = min(len(times), combination.get(COUNT, len(times)))
    else:
        resets = _only_value(point, COUNT) or 0
    if not resets:
        raise NoSchedule("no reset is counted")
    bound_deg = _largest_heading_deg(study)
    bounds = {} if bound_deg is None else {"heading_bound_deg": bound_deg}
    schedules = [
        schedule_with(reset_problem(study.rate_hz, v), v["heading_bound_deg"] * DEG, band, resets)
        for _, v in iter_filters(point, **bounds)
    ]
    times_s = max(schedules, key=lambda found: found.settling_s).times_s
    if resets > 1 and (_FIRST in keys or _only_value(point, _FIRST) is not None):
        cycle_s = (times_s[-1] - times_s[0]) / (resets - 1)
    else:  # the first reset is after a cycle
        cycle_s = times_s[-1] / resets
    return {TIMES: times_s, _FIRST: times_s[0], _CYCLE: cycle_s}


def _largest_heading_deg(study: Study) -> float | None:
    """Return the largest initial heading error of a study, deg; None if it is not known."""
    if study.is_recorded or study.coarse_stages or _HEADING in study.drawn_keys:
        return None
    return max(abs(point[_HEADING]) for point in study.combinations(_HEADING))


def _only_value(study: Study, key: str) -> Any:
    first, *rest = study.combinations(key)
    if rest:
        raise NoSchedule(f"{key} is swept")
    return first[key]
