"""Searches that score points of the search space: a grid and Sobol points.

The points are the cases of a study whose draws are the tuning draws. If reset times are tuned, the
first point is the reset schedule by the law (`law_point`). A grid and Sobol points are swept into
an ordinary results directory.
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

from sinsjax.execution import results
from sinsjax.execution.prepare import make_subjob
from sinsjax.execution.run import ProgressCallback, run_job
from sinsjax.execution.tasks import Job
from sinsjax.study import sampling, search_space
from sinsjax.study.keys import TomlTable
from sinsjax.study.load import study_from_dict
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study, study_to_tables
from sinsjax.study.sweep import Sweep
from sinsjax.tuning import objective
from sinsjax.tuning.history import Evaluation, SearchResult
from sinsjax.tuning.law_point import law_point

ShowProgress = Callable[[str], AbstractContextManager[ProgressCallback | None]]
"""(name of a search) -> context with its progress callback, if any."""

_SEEDS = 2**63


class SearchSession(NamedTuple):
    """Settings for running the searches of a tuning run.

    Attributes:
        job: prepared job of the tuning run.
        show_progress: gives the progress callback for the name of a search.
        stop: event that ends the tuning run.
    """

    job: Job
    show_progress: ShowProgress
    stop: threading.Event

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


# Designs


class Design(NamedTuple):
    """The points of a search.

    Attributes:
        candidate: (n,) number of each point's combination of candidates.
        box: (n, p) positions of the variables in their ranges, 0 to 1; NaN for unused variables.
    """

    candidate: NDArray
    box: NDArray


def grid_design(study: Study, points: int) -> Design:
    """Return the grid with so many points per variable, ends included, the last one fastest."""
    places = np.linspace(0.0, 1.0, points)

    def draw_points(_: int, count: int) -> NDArray:
        return np.array(list(product(places, repeat=count))).reshape(-1, count)

    return _design(study, draw_points)


def sobol_design(study: Study, name: str, points: int) -> Design:
    """Return so many scrambled Sobol points per combination of candidates.

    The study's seed and the name of the search determine them; more do not change the first.
    """
    from scipy.stats import qmc  # late: it takes a second, and few studies need it

    seed = np.random.SeedSequence(study.seed, spawn_key=tuple(name.encode()))
    seeds = seed.spawn(len(SearchSpace.from_study(study).combinations))

    def draw_points(number: int, count: int) -> NDArray:
        engine = qmc.Sobol(count, rng=np.random.Generator(np.random.PCG64(seeds[number])))
        # A single point first, because scipy warns if the first call is not for 2^m points.
        return np.concatenate([engine.random(1), engine.random(points - 1)])

    return _design(study, draw_points)


def _design(study: Study, draw_points: Callable[[int, int], NDArray]) -> Design:
    """Return the design of points drawn by (combination, number p of variables) -> (n, p)."""
    space = SearchSpace.from_study(study)
    candidates, boxes = [], []
    for number, combination in enumerate(space.combinations):
        used = space.used_variables(combination)
        points = draw_points(number, len(used)) if used else np.empty((1, 0))
        box = np.full((len(points), len(space.variables)), np.nan)
        box[:, used] = points
        boxes.append(box)
        candidates.append(np.full(len(points), number))
    return Design(np.concatenate(candidates), np.concatenate(boxes))


def add_law_points(study: Study, design: Design) -> Design:
    """Return a design that begins with the points of the law's reset schedules."""
    points = {number: law_point(study, number) for number in np.unique(design.candidate).tolist()}
    found = {number: box for number, box in points.items() if box is not None}
    candidate = np.array([*found, *design.candidate], design.candidate.dtype)
    return Design(candidate, np.array([*found.values(), *design.box]))


# Scores of points


def evaluate_design(
    study: Study, name: str, design: Design, session: SearchSession
) -> SearchResult:
    """Evaluate the points of a design on the tuning draws, in a directory with the search's name.

    Raises:
        InputError: the directory cannot be used, or the record does not fit.
        StudyInterrupted: the session was stopped.
    """
    assert study.tune is not None
    space, names = SearchSpace.from_study(study), objective.summary_columns(study.tune, study)
    values, candidates = [space.to_values(box) for box in design.box], design.candidate.tolist()
    scored = score_points(
        study,
        name,
        candidates,
        values,
        lambda derived: results.read_summary(session.run(derived, name), names),
    )
    rows = zip(candidates, values, scored.scores, scored.costs, strict=True)
    return SearchResult(name, [Evaluation(number, *row) for number, row in enumerate(rows)])


class PointScores(NamedTuple):
    """The objective of each point, and the steps so far; equal points cost nothing."""

    scores: list[float]
    costs: list[int]


def score_points(
    study: Study,
    name: str,
    candidates: Iterable[int],
    values: Iterable[Sequence[float]],
    run_cases: Callable[[Study], pa.Table],
) -> PointScores:
    """Score some points; each distinct one is a case of a study.

    Args:
        study: study with [tune].
        name: name of the search.
        candidates: number of the combination of candidates of each point.
        values: values of the variables of each point; NaN for unused variables.
        run_cases: runs a study; gives its summary, with `objective.summary_columns`.
    """
    assert study.tune is not None
    space = SearchSpace.from_study(study)
    cases: dict[str, TomlTable] = {}
    case_of: dict[tuple[Any, ...], int] = {}
    numbers: list[int] = []
    for candidate, row in zip(candidates, values, strict=True):
        point = space.make_point(list(np.nan_to_num(row)), space.combinations[candidate])
        number = case_of.setdefault(tuple(point.values()), len(cases))
        if number == len(cases):
            cases[f"{name} {len(numbers)}"] = point
        numbers.append(number)
    derived = derive_study(study, cases, name=f"{study.name}_{name}")
    by_case = point_values(study, derived, run_cases(derived))
    scores = [objective.score(study.tune, by_case[number]) for number in numbers]
    costs = total_steps(derived) // len(cases) * (np.maximum.accumulate(numbers) + 1)
    return PointScores(scores, costs.tolist())


def point_values(study: Study, derived: Study, table: pa.Table) -> NDArray:
    """Return the values of all runs for the objective, (points, variants, draws).

    The points are the cases of the derived study, and the table has `objective.summary_columns`.
    """
    assert study.tune is not None
    values = objective.run_values(study.tune, derived, table)
    return values.reshape(len(derived.cases), -1, values.shape[-1])


def total_steps(study: Study) -> int:
    """Return the total number of steps of a study's runs."""
    records = study.lengths.compute(lambda span: span.records, int)
    return int(records.sum()) * study.record_every * study.n_draws


def unused_seed(study: Study) -> int:
    """Return a seed whose draws neither tune a study with [tune] nor evaluate it."""
    return (study.seed + 2) % _SEEDS


def derive_study(
    study: Study, points: Mapping[str, TomlTable], *, name: str, evaluation: bool = False
) -> Study:
    """Return the study of some points on the tuning draws, or on those for evaluation.

    It has no [tune]; the points are its outermost dimension, and its own axes are swept at each.
    Draws for evaluation are those of another seed, or the other start times of a record.

    Args:
        study: study with [tune].
        points: points with the same keys, by the label of their case.
        name: name of the new study.
        evaluation: whether to use the evaluation draws.
    """
    tune = study.tune
    assert tune is not None
    keys = next(iter(points.values()))
    tables = search_space.remove_keys(study_to_tables(study), list(keys))
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
        tables["drawn"] = sampling.truncate_drawn_table(study.drawn, count)
    cases = Sweep(cases=study.cases).dimensions[0] if study.cases else {}
    if axis := {key: values for key, values in cases.items() if key != "case"}:
        zipped = "cases"  # without their labels, which are now those of the points
        while zipped in study.zips:
            zipped += "_"
        tables["axes"] = tables.get("axes", {}) | {zipped: axis}
    tables["cases"] = [{"case": label} | point for label, point in points.items()]
    return study_from_dict(tables, name)
