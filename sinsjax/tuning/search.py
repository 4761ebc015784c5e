"""Searches that score points of the search space: a grid and Sobol points.

The points are the cases of a study whose draws are the tuning draws. If reset times are tuned, the
first point is the reset schedule by the law (`reset_law_schedule_in_unit_box`) for the study's
largest initial heading error and the objective's band. Both are swept into a results directory.
"""

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.execution import results
from sinsjax.execution.prepare import make_subjob
from sinsjax.execution.run import ProgressCallback, run_job
from sinsjax.execution.tasks import Job
from sinsjax.methods.filters.keys import SCHEDULE_KEYS
from sinsjax.methods.reset_law import NoSchedule, schedule_with
from sinsjax.study import search_space
from sinsjax.study.keys import TomlTable
from sinsjax.study.load import study_from_dict, with_point
from sinsjax.study.reset_plan import iter_filters
from sinsjax.study.reset_schedules import reset_problem
from sinsjax.study.schema import TuneSection
from sinsjax.study.search_space import SearchSpace, effective_values
from sinsjax.study.study import Study, study_to_tables
from sinsjax.study.sweep import COUNT, TIMES, Sweep
from sinsjax.study.values import truncate_drawn_table
from sinsjax.tuning import objective
from sinsjax.tuning.history import Evaluation, SearchPoint, SearchResult
from sinsjax.units import ARCMIN, DEG

ShowProgress = Callable[[str], AbstractContextManager[ProgressCallback | None]]
"""(name of a search) -> context with its progress callback, if any."""

DESIGNS, GRADIENT = ("grid", "sobol"), "gradient"
"""Names of the searches."""

LAW = "law"
"""Name of the reset schedule by the law among the evaluated points."""

_SEEDS = 2**63


def require_tune(study: Study) -> TuneSection:
    """Return the [tune] section of a study; an `InputError` if there is none."""
    if study.tune is None:
        raise InputError(f"{study.name}: has no [tune] section (`sinsjax init tune` writes one)")
    return study.tune


class SearchSession(NamedTuple):
    """Settings for running the searches of a tuning run."""

    job: Job  # prepared job of the tuning run
    show_progress: ShowProgress  # gives the progress callback for the name of a search
    stop: threading.Event  # event that ends the tuning run

    @property
    def directory(self) -> Path:
        """Directory of the tuning run."""
        assert self.job.directory is not None
        return self.job.directory

    def run(self, study: Study, name: str) -> Path:
        """Run a study without curves into a subdirectory; return its path."""
        with self.show_progress(name) as on_progress:
            run_job(make_subjob(self.job, study, name), on_progress=on_progress, stop=self.stop)
        return self.directory / name


def sobol_box_points(study: Study, search_name: str, combination: int, count: int) -> NDArray:
    """Return scrambled Sobol points, 0 to 1, for the combination of that number; (count, p).

    The study's seed and the name of the search determine them; more do not change the first.
    """
    from scipy.stats import qmc  # late: it takes a second, and few studies need it

    space = SearchSpace.from_study(study)
    seed = np.random.SeedSequence(study.seed, spawn_key=(*search_name.encode(), combination))
    used = len(space.used_variables(space.combinations[combination]))
    engine = qmc.Sobol(used, rng=np.random.Generator(np.random.PCG64(seed)))
    # A single point first, because scipy warns if the first call is not for 2^m points.
    return np.concatenate([engine.random(1), engine.random(count - 1)])


def points_at(space: SearchSpace, number: int, box_points: Iterable[Any]) -> list[SearchPoint]:
    """Return points of a combination of candidates by the positions of its variables, 0 to 1."""
    points, used = [], space.used_variables(space.combinations[number])
    for box_point in box_points:
        whole = np.full(len(space.variables), np.nan)
        whole[used] = box_point
        points.append(SearchPoint(number, space.to_values(whole)))
    return points


def grid_or_sobol_points(study: Study, search_name: str) -> list[SearchPoint]:
    """Return the points of a grid or of Sobol points, after those of the law's reset schedules.

    Each combination of candidates has them all; of a grid the last variable is the fastest.
    """
    tune, space = require_tune(study), SearchSpace.from_study(study)
    laws, points = list[SearchPoint](), list[SearchPoint]()
    for number, combination in enumerate(space.combinations):
        if (law := reset_law_schedule_in_unit_box(study, number)) is not None:
            laws += points_at(space, number, [law])
        used = len(space.used_variables(combination))
        box_points: Any = product(np.linspace(0.0, 1.0, tune.grid_points), repeat=used)
        if search_name != "grid" and used:
            box_points = sobol_box_points(study, search_name, number, tune.sobol_points)
        points += points_at(space, number, box_points)
    return laws + points


def search_points(study: Study, name: str, session: SearchSession) -> SearchResult:
    """Evaluate the points of a search on the tuning draws, in a directory with its name."""
    columns = objective.summary_columns(require_tune(study), study)
    points = grid_or_sobol_points(study, name)
    scored = score_points(
        study,
        name,
        points,
        lambda derived: results.read_summary(session.run(derived, name), columns),
    )
    rows = zip(points, scored.scores, scored.costs, strict=True)
    found = [Evaluation(i, *point, score, cost) for i, (point, score, cost) in enumerate(rows)]
    return SearchResult(name, found)


class PointScores(NamedTuple):
    """The objective of each point, and the steps so far; equal points cost nothing."""

    scores: list[float]
    costs: list[int]


def score_points(
    study: Study,
    name: str,
    points: Sequence[SearchPoint],
    run_cases: Callable[[Study], pa.Table],
) -> PointScores:
    """Score the points of a search; each distinct one is a case of a study.

    ``run_cases`` runs a study and gives its summary, with `objective.summary_columns`.
    """
    space = SearchSpace.from_study(study)
    keys = [point.keys(space) for point in points]
    case_of: dict[tuple[Any, ...], int] = {}
    numbers = [case_of.setdefault(tuple(one.values()), len(case_of)) for one in keys]
    first = [numbers.index(case) for case in range(len(case_of))]
    cases = {f"{name} {number}": keys[number] for number in first}
    derived = derive_study(study, cases, name=f"{study.name}_{name}")
    by_case = point_values(study, derived, run_cases(derived))
    scores = [objective.score(require_tune(study), by_case[number]) for number in numbers]
    costs = total_steps(derived) // len(cases) * (np.maximum.accumulate(numbers) + 1)
    return PointScores(scores, costs.tolist())


def point_values(study: Study, derived: Study, table: pa.Table) -> NDArray:
    """Return the values of all runs for the objective, (points, variants, draws).

    The points are the cases of the derived study, and the table has `objective.summary_columns`.
    """
    values = objective.run_values(require_tune(study), derived, table)
    return values.reshape(len(derived.cases), -1, values.shape[-1])


def total_steps(study: Study) -> int:
    """Return the total number of steps of a study's runs."""
    records = study.lengths.compute(lambda span: span.records, int)
    return int(records.sum()) * study.record_every * study.n_draws


def make_tuned_study(study: Study, point: TomlTable) -> Study:
    """Return the study of ``tuned.toml``: with a point, on draws not used so far."""
    tuned = with_point(study, point)
    if study.is_recorded:
        return tuned
    return tuned.replace({"study.seed": (study.seed + 2) % _SEEDS})


def derive_study(
    study: Study, points: Mapping[str, TomlTable], *, name: str, evaluation: bool = False
) -> Study:
    """Return the study of some points on the tuning draws, or on those for evaluation.

    It has another name and no [tune]; the points, by the label of their case, have the same keys
    and are its outermost dimension, and its own axes are swept at each. Draws for evaluation are
    those of another seed, or the other start times of a record.
    """
    tune, keys = require_tune(study), next(iter(points.values()))
    tables = search_space.remove_tune_and_keys(study_to_tables(study), list(keys))
    tables["study"] = tables["study"] | {"name": name, "curves": False}
    if study.record:
        starts = study.record.start_s[1 if evaluation else 0 :: 2]
        tables["record"] = tables["record"] | {"start_s": starts}
    else:
        seed = (study.seed + evaluation) % _SEEDS
        draws = tune.evaluation_draws if evaluation else tune.tune_draws
        tables["study"] |= {"seed": seed, "draws": draws}
    if study.drawn:
        count = len(tables["record"]["start_s"]) if study.record else tables["study"]["draws"]
        tables["drawn"] = truncate_drawn_table(study.drawn, count)
    cases = Sweep(cases=study.cases).dimensions[0] if study.cases else {}
    if axis := {key: values for key, values in cases.items() if key != "case"}:
        zipped = "cases"  # without their labels, which are now those of the points
        while zipped in study.zips:
            zipped += "_"
        tables["axes"] = tables.get("axes", {}) | {zipped: axis}
    tables["cases"] = [{"case": label} | point for label, point in points.items()]
    return study_from_dict(tables, name)


# The reset schedule by the law

_FIRST, _CYCLE, _HEADING = "reset_first_s", "reset_cycle_s", "phi_u0_deg"


def reset_law_schedule_in_unit_box(study: Study, combination_number: int = 0) -> NDArray | None:
    """Return the reset schedule by the law as positions of the variables, 0 to 1, clipped; (p,).

    They are those that a combination of candidates uses. It has as many resets as the combination
    has times, or as are counted. If filters or places differ, it is the schedule of the slowest.
    None if no variable is one of a schedule, or the law has none.
    """
    assert study.tune is not None
    space = SearchSpace.from_study(study)
    combination = space.combinations[combination_number]
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
