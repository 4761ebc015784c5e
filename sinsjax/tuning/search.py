"""Searches without a gradient: sweeps over points of the search space.

Each search is a study whose cases are the points and whose draws are the tuning draws, with an
ordinary results directory.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
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
from sinsjax.study.load import study_from_dict, study_to_tables
from sinsjax.study.resolved import Dimension
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.study.sweep import sweep_dimensions
from sinsjax.tuning import objective
from sinsjax.tuning.history import Evaluation, Found

_SEEDS = 2**63


class SearchSession(NamedTuple):
    """Settings for running the searches of a tuning run.

    Attributes:
        job: prepared job of the tuning run.
        watch: gives the progress callback for the name of a search.
        stop: event that ends the tuning run.
    """

    job: Job
    watch: Callable[[str], AbstractContextManager[ProgressCallback | None]]
    stop: threading.Event

    @property
    def directory(self) -> Path:
        """Directory of the tuning run."""
        assert self.job.directory is not None
        return self.job.directory

    def run(self, study: Study, name: str) -> Path:
        """Run a study without curves into a subdirectory; gives its path."""
        with self.watch(name) as tell:
            run_job(make_subjob(self.job, study, name), on_progress=tell, stop=self.stop)
        return self.directory / name


class Design(NamedTuple):
    """The points of a search.

    Attributes:
        candidate: (n,) number of each point's combination of candidates.
        box: (n, p) positions of the variables in their ranges, 0 to 1; NaN for unused variables.
    """

    candidate: NDArray
    box: NDArray


def grid(space: SearchSpace, points: int) -> Design:
    """All points of a grid including the ends, the last variable fastest.

    Args:
        space: search space of the study.
        points: number of points per variable.
    """
    places = np.linspace(0.0, 1.0, points)

    def own(_: int, count: int) -> NDArray:
        return np.array(list(product(places, repeat=count))).reshape(-1, count)

    return _design(space, own)


def sobol(space: SearchSpace, counts: Sequence[int], seed: np.random.SeedSequence) -> Design:
    """Scrambled Sobol points.

    Args:
        space: search space of the study.
        counts: number of points for each combination.
        seed: seed of the scrambling.
    """
    # It takes a second to import, and few studies need it.
    from scipy.stats import qmc

    seeds = seed.spawn(len(counts))

    def own(number: int, count: int) -> NDArray:
        engine = qmc.Sobol(count, rng=np.random.Generator(np.random.PCG64(seeds[number])))
        # A single point first, because scipy warns if the first call is not for 2^m points.
        return np.concatenate([engine.random(1), engine.random(counts[number] - 1)])

    return _design(space, own)


def random(space: SearchSpace, counts: Sequence[int], seed: np.random.SeedSequence) -> Design:
    """Independent random points; arguments as for `sobol`."""
    seeds = seed.spawn(len(counts))

    def own(number: int, count: int) -> NDArray:
        return np.random.Generator(np.random.PCG64(seeds[number])).random((counts[number], count))

    return _design(space, own)


def _design(space: SearchSpace, own: Callable[[int, int], NDArray]) -> Design:
    """A design from a function that gives a combination's points by its number and dimension."""
    candidates, boxes = [], []
    for number, combination in enumerate(space.combinations):
        used = space.used_variables(combination)
        points = own(number, len(used)) if used else np.empty((1, 0))
        box = np.full((len(points), len(space.variables)), np.nan)
        box[:, used] = points
        boxes.append(box)
        candidates.append(np.full(len(points), number))
    return Design(np.concatenate(candidates), np.concatenate(boxes))


def seed_of(study: Study, name: str) -> np.random.SeedSequence:
    """The seed of a search, from the study's seed and the name of the search."""
    return np.random.SeedSequence(study.seed, spawn_key=tuple(name.encode()))


def evaluate(study: Study, name: str, design: Design, session: SearchSession) -> Found:
    """Evaluate the points of a design on the tuning draws.

    Args:
        study: study with [tune].
        name: name of the search and of its results directory.
        design: points; those with equal keys are run once.
        session: settings.

    Raises:
        InputError: the directory cannot be used, or the record does not fit.
        StudyInterrupted: the session was stopped.
    """
    assert study.tune is not None
    space = SearchSpace.from_study(study)
    values = np.array(space.to_values(design.box.T)).T if space.variables else design.box
    points = [
        space.make_point(list(np.nan_to_num(row)), space.combinations[candidate])
        for row, candidate in zip(values, design.candidate, strict=True)
    ]
    names = objective.columns_of(study.tune, study)
    scores, taken, each = scored(
        study,
        name,
        points,
        lambda derived: results.read_summary(session.run(derived, name), names),
    )
    paid = np.maximum.accumulate(taken) + 1
    return Found(
        name,
        [
            Evaluation(number, int(design.candidate[number]), list(row), score, int(n) * each)
            for number, (row, score, n) in enumerate(zip(values, scores, paid, strict=True))
        ],
    )


def scored(
    study: Study, name: str, points: Sequence[TomlTable], run: Callable[[Study], pa.Table]
) -> tuple[list[float], list[int], int]:
    """The objective at some points; those with equal values are run once.

    Args:
        study: study with [tune].
        name: name of the search.
        points: points with the same keys.
        run: gives the summary of a study with at least `objective.columns_of`.

    Returns:
        The objective of each point, the number of its case, and the steps of one case.
    """
    assert study.tune is not None
    cases: dict[str, TomlTable] = {}
    case_of: dict[tuple[Any, ...], int] = {}
    for number, point in enumerate(points):
        if case_of.setdefault(tuple(point.values()), len(cases)) == len(cases):
            cases[f"{name} {number}"] = point
    derived = derive(study, cases, name=f"{study.name}_{name}")
    found = run_values(study, derived, run(derived))
    by_case = [objective.score(study.tune, own) for own in found]
    taken = [case_of[tuple(point.values())] for point in points]
    return [by_case[case] for case in taken], taken, cost(derived) // len(cases)


def run_values(study: Study, derived: Study, table: pa.Table) -> NDArray:
    """The values of all runs for the objective, (points, variants, draws).

    Args:
        study: study with [tune].
        derived: study of the runs, whose cases are the points.
        table: `objective.columns_of` its summary.
    """
    assert study.tune is not None
    found = objective.values(study.tune, derived, table)
    return found.reshape(len(derived.cases), -1, found.shape[-1])


def cost(study: Study) -> int:
    """Total number of steps of a study's runs."""
    records = study.lengths.each(lambda span: span.records, int)
    return int(records.sum()) * study.record_every * study.n_draws


def derive(
    study: Study, points: Mapping[str, TomlTable], *, name: str, judging: bool = False
) -> Study:
    """The study of some points on the tuning draws, or on those for evaluation.

    Args:
        study: study with [tune]; its own axes are swept at every point.
        points: points with the same keys, by the label of their case.
        name: name of the new study.
        judging: whether to use the evaluation draws: those of another seed, or the other start
            times of a record.

    Returns:
        A study without [tune], with the points as its outermost dimension.
    """
    tune = study.tune
    assert tune is not None
    keys = next(iter(points.values()))
    tables = search_space.remove_keys(study_to_tables(study), list(keys))
    tables["study"] = tables["study"] | {"name": name, "curves": False}
    if study.record:
        starts = study.record.start_s[1 if judging else 0 :: 2]
        tables["record"] = tables["record"] | {"start_s": starts}
    else:
        seed = (study.seed + judging) % _SEEDS
        draws = tune.evaluation_draws if judging else tune.tune_draws
        tables["study"] |= {"seed": seed, "draws": draws}
    if study.drawn:
        count = len(tables["record"]["start_s"]) if study.record else tables["study"]["draws"]
        tables["drawn"] = sampling.truncate_drawn_table(study.drawn, count)
    own = {key: values for key, values in _own_cases(study).items() if key != "case"}
    if own:  # the labels are now those of the points
        tables["axes"] = tables.get("axes", {}) | {_free_name(study): own}
    tables["cases"] = [{"case": label} | point for label, point in points.items()]
    return study_from_dict(tables, name)


def _own_cases(study: Study) -> Dimension:
    return sweep_dimensions(study.cases, [], {})[0] if study.cases else {}


def _free_name(study: Study) -> str:
    """A name for the table of axes that a study's cases become."""
    name = "cases"
    while name in study.zips:
        name += "_"
    return name
