"""Searches that score points of the search space: grid, Sobol points, and covariance analysis.

The points are the cases of a study whose draws are the tuning draws. If reset times are tuned, the
first point is the reset schedule by the law (`law_point`). A grid and Sobol points are swept into
an ordinary results directory. The search by covariance analysis needs no noise: it scores points by
errors that are sampled from linear covariance analysis (`engine.covariance`), goes on from the best
of some Sobol points with an evolution strategy (CMA-ES, Hansen and Ostermeier 2001), and runs the
best few on the tuning draws.
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
from sinsjax.execution.run import ProgressCallback, RunProgress, run_in_memory, run_job
from sinsjax.execution.tasks import Job
from sinsjax.methods.registry import METHODS
from sinsjax.study import sampling, search_space
from sinsjax.study.keys import TomlTable
from sinsjax.study.load import study_from_dict, study_to_tables
from sinsjax.study.resolved import Dimension
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.study.sweep import TIMES, sweep_dimensions
from sinsjax.tuning import objective
from sinsjax.tuning.history import Evaluation, SearchResult
from sinsjax.tuning.law_point import law_point

Watch = Callable[[str], AbstractContextManager[ProgressCallback | None]]
"""(name of a search) -> context with its progress callback, if any."""

_SEEDS = 2**63


class SearchSession(NamedTuple):
    """Settings for running the searches of a tuning run.

    Attributes:
        job: prepared job of the tuning run.
        watch: gives the progress callback for the name of a search.
        stop: event that ends the tuning run.
    """

    job: Job
    watch: Watch
    stop: threading.Event

    @property
    def directory(self) -> Path:
        """Directory of the tuning run."""
        assert self.job.directory is not None
        return self.job.directory

    def run(self, study: Study, name: str) -> Path:
        """Run a study without curves into a subdirectory; return its path."""
        with self.watch(name) as on_progress:
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


def grid_design(space: SearchSpace, points: int) -> Design:
    """Return all points of a grid including the ends, the last variable fastest.

    Args:
        space: search space of the study.
        points: number of points per variable.
    """
    places = np.linspace(0.0, 1.0, points)

    def draw_points(_: int, count: int) -> NDArray:
        return np.array(list(product(places, repeat=count))).reshape(-1, count)

    return _design(space, draw_points)


def sobol_design(space: SearchSpace, counts: Sequence[int], seed: np.random.SeedSequence) -> Design:
    """Return scrambled Sobol points.

    Args:
        space: search space of the study.
        counts: number of points for each combination.
        seed: seed of the scrambling.
    """
    from scipy.stats import qmc  # late: it takes a second, and few studies need it

    seeds = seed.spawn(len(counts))

    def draw_points(number: int, count: int) -> NDArray:
        engine = qmc.Sobol(count, rng=np.random.Generator(np.random.PCG64(seeds[number])))
        # A single point first, because scipy warns if the first call is not for 2^m points.
        return np.concatenate([engine.random(1), engine.random(counts[number] - 1)])

    return _design(space, draw_points)


def _design(space: SearchSpace, draw_points: Callable[[int, int], NDArray]) -> Design:
    """Return the design with the points of every combination.

    Args:
        space: search space of the study.
        draw_points: (number of a combination, number p of its variables) -> (n, p) points.
    """
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
    """Return a design that begins with the points of the law's reset schedules.

    Args:
        study: study with [tune].
        design: points of a search.
    """
    points = {number: law_point(study, number) for number in np.unique(design.candidate).tolist()}
    found = {number: box for number, box in points.items() if box is not None}
    candidate = np.array([*found, *design.candidate], design.candidate.dtype)
    return Design(candidate, np.array([*found.values(), *design.box]))


def search_seed(study: Study, name: str) -> np.random.SeedSequence:
    """Return the seed of a search, from the study's seed and the name of the search."""
    return np.random.SeedSequence(study.seed, spawn_key=tuple(name.encode()))


# Scores of points


def evaluate_design(
    study: Study, name: str, design: Design, session: SearchSession
) -> SearchResult:
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
    tune, space = study.tune, SearchSpace.from_study(study)
    assert tune is not None
    values = np.array(space.to_values(design.box.T)).T if space.variables else design.box
    points = [
        space.make_point(list(np.nan_to_num(row)), space.combinations[candidate])
        for row, candidate in zip(values, design.candidate, strict=True)
    ]
    names = objective.summary_columns(tune, study)

    def run_cases(derived: Study) -> NDArray:
        table = results.read_summary(session.run(derived, name), names)
        return objective.run_values(tune, derived, table)

    scored = score_points(study, name, points, run_cases)
    case_cost = total_steps(scored.derived) // len(scored.derived.cases)
    costs = case_cost * (np.maximum.accumulate(scored.cases[:, 0]) + 1)
    return SearchResult(
        name,
        [
            Evaluation(number, int(candidate), list(row), score, int(so_far))
            for number, (candidate, row, score, so_far) in enumerate(
                zip(design.candidate, values, scored.scores, costs, strict=True)
            )
        ],
    )


class PointScores(NamedTuple):
    """Scores of some points.

    Attributes:
        scores: the objective of each point.
        derived: study of the runs, each distinct point being a case.
        cases: (points, phases) number of the case of each point and shift.
    """

    scores: list[float]
    derived: Study
    cases: NDArray


def score_points(
    study: Study,
    name: str,
    points: Sequence[TomlTable],
    run_cases: Callable[[Study], NDArray],
    phases: int = 1,
) -> PointScores:
    """Score some points; equal ones are run once.

    Args:
        study: study with [tune].
        name: name of the search.
        points: points with the same keys.
        run_cases: gives the values of a study's runs, as `objective.run_values`.
        phases: number of shifts of a point's resets over the feedback interval, see `shift_resets`;
            its score is the objective over all of them.
    """
    assert study.tune is not None
    cases: dict[str, TomlTable] = {}
    case_of: dict[tuple[Any, ...], int] = {}
    numbers = np.empty((len(points), phases), int)
    for number, point in enumerate(points):
        for phase in range(phases):
            case = shift_resets(study, point, phase / phases)
            numbers[number, phase] = case_of.setdefault(tuple(case.values()), len(cases))
            if numbers[number, phase] == len(cases):
                cases[f"{name} {number}" + (f" phase {phase}" if phase else "")] = case
    derived = derive_study(study, cases, name=f"{study.name}_{name}")
    values = run_cases(derived)
    by_case = values.reshape(len(cases), -1, values.shape[-1])
    scores = [
        objective.score(study.tune, by_case[row].reshape(-1, values.shape[-1])) for row in numbers
    ]
    return PointScores(scores, derived, numbers)


def shift_resets(study: Study, point: TomlTable, share: float) -> TomlTable:
    """Return a point with later resets, by a share of the feedback interval, on whole samples."""
    times = point.get(TIMES)
    if not times or not share:
        return point
    intervals = [value or 0.0 for value in study.values("feedback_interval_s")]
    interval = point.get("feedback_interval_s", max(intervals))
    rate = study.study.rate_hz
    return point | {TIMES: tuple(round((t + share * interval) * rate) / rate for t in times)}


def point_values(study: Study, derived: Study, table: pa.Table) -> NDArray:
    """Return the values of all runs for the objective, (points, variants, draws).

    Args:
        study: study with [tune].
        derived: study of the runs, whose cases are the points.
        table: `objective.summary_columns` of its summary.
    """
    assert study.tune is not None
    values = objective.run_values(study.tune, derived, table)
    return values.reshape(len(derived.cases), -1, values.shape[-1])


def total_steps(study: Study) -> int:
    """Return the total number of steps of a study's runs."""
    records = study.lengths.compute(lambda span: span.records, int)
    return int(records.sum()) * study.record_every * study.n_draws


def estimate_steps(study: Study) -> float:
    """Return the cost of `objective.estimate_values` with the dearest method, in plain steps."""
    runs = max(METHODS[name].estimate_runs for name in study.methods)
    return runs * total_steps(study) / study.n_draws


def unused_seed(study: Study) -> int:
    """Return a seed whose draws neither tune a study with [tune] nor evaluate it."""
    return (study.seed + 2) % _SEEDS


def derive_study(
    study: Study, points: Mapping[str, TomlTable], *, name: str, evaluation: bool = False
) -> Study:
    """Return the study of some points on the tuning draws, or on those for evaluation.

    Args:
        study: study with [tune]; its own axes are swept at every point.
        points: points with the same keys, by the label of their case.
        name: name of the new study.
        evaluation: whether to use the evaluation draws: those of another seed, or the other start
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
        starts = study.record.start_s[1 if evaluation else 0 :: 2]
        tables["record"] = tables["record"] | {"start_s": starts}
    else:
        seed = (study.seed + evaluation) % _SEEDS
        draws = tune.evaluation_draws if evaluation else tune.tune_draws
        tables["study"] |= {"seed": seed, "draws": draws}
    if study.drawn:
        count = len(tables["record"]["start_s"]) if study.record else tables["study"]["draws"]
        tables["drawn"] = sampling.truncate_drawn_table(study.drawn, count)
    axis = {key: values for key, values in _study_cases(study).items() if key != "case"}
    if axis:  # the labels are now those of the points
        tables["axes"] = tables.get("axes", {}) | {_unused_axis_name(study): axis}
    tables["cases"] = [{"case": label} | point for label, point in points.items()]
    return study_from_dict(tables, name)


def _study_cases(study: Study) -> Dimension:
    return sweep_dimensions(study.cases, [], {})[0] if study.cases else {}


def _unused_axis_name(study: Study) -> str:
    """Return a name for the table of axes that a study's cases become."""
    name = "cases"
    while name in study.zips:
        name += "_"
    return name


# Search by covariance analysis


COVARIANCE = "covariance"
"""Name of the search by covariance analysis."""

GENERATION, FIRST_SIGMA, FINALISTS = 8, 0.2, 3
"""Points of a generation; standard deviation of the first one, all ranges being one long; best
points that are run on the tuning draws."""


def search_by_covariance(
    study: Study, *, on_progress: ProgressCallback | None = None
) -> SearchResult:
    """Search with the objective of covariance analysis.

    Args:
        study: study with [tune], simulated.
        on_progress: called with the progress after every generation.

    Returns:
        All evaluations; those by covariance analysis are marked as estimates.
    """
    return _CovarianceSearch(study, on_progress).run()


class _CovarianceSearch:
    """A search by covariance analysis. Resets stay hard."""

    def __init__(self, study: Study, on_progress: ProgressCallback | None) -> None:
        assert study.tune is not None
        self._study, self._tune, self._space = study, study.tune, SearchSpace.from_study(study)
        self._on_progress = on_progress or (lambda progress: None)
        self._evaluations: list[Evaluation] = []
        self._cost = 0.0
        tune, combinations = self._tune, len(self._space.combinations)
        self._total = (
            tune.evolution_screen * combinations + tune.evolution_steps * GENERATION + FINALISTS
        )

    def run(self) -> SearchResult:
        """Run the search; return all evaluations in order."""
        tune, space = self._tune, self._space
        counts = [tune.evolution_screen] * len(space.combinations)
        design = sobol_design(space, counts, search_seed(self._study, COVARIANCE))
        design = add_law_points(self._study, design)
        self._total += len(design.box) - sum(counts)
        for candidate in range(len(space.combinations)):
            self._estimate(design.box[design.candidate == candidate], candidate)
        first = min(self._evaluations, key=lambda evaluation: evaluation.objective)
        if used := space.used_variables(space.combinations[first.candidate]):
            self._evolve(first, used)
        self._run_finalists()
        return SearchResult(COVARIANCE, self._evaluations)

    def _evolve(self, first: Evaluation, used: list[int]) -> None:
        """Estimate the generations that start from the best point."""
        import cma  # late: it takes a second, and only this search needs it

        values = [1.0 if np.isnan(value) else value for value in first.values]
        box = np.asarray(self._space.to_box(values))
        seed = int(search_seed(self._study, "evolution").generate_state(1)[0]) or 1
        settings = {
            **{"bounds": [0.0, 1.0], "popsize": GENERATION, "seed": seed},
            **{"verbose": -9, "CMA_stds": np.ones(max(2, len(used)))},
        }
        # CMA-ES needs two variables: one without effect is added to a single one.
        start = np.append(box[used], 0.5) if len(used) == 1 else box[used]
        strategy = cma.CMAEvolutionStrategy(start, FIRST_SIGMA, settings)
        for _ in range(self._tune.evolution_steps):
            generation = np.asarray(strategy.ask())
            points = np.full((len(generation), len(self._space.variables)), np.nan)
            points[:, used] = generation[:, : len(used)]
            strategy.tell(list(generation), self._estimate(points, first.candidate))

    def _estimate(self, box: NDArray, candidate: int) -> list[float]:
        """Estimate the objective at some box points of a combination."""
        combination = self._space.combinations[candidate]
        values = [self._space.to_values(np.nan_to_num(row)) for row in box]
        scored = self._score(
            [self._space.make_point(row, combination) for row in values],
            lambda derived: objective.estimate_values(self._tune, derived),
        )
        for row, point, score in zip(box, values, scored.scores, strict=True):
            self._cost += estimate_steps(scored.derived) / len(box)
            known = [np.nan if np.isnan(a) else v for a, v in zip(row, point, strict=True)]
            step, so_far = len(self._evaluations), int(self._cost)
            self._evaluations.append(
                Evaluation(step, candidate, known, score, so_far, estimated=True)
            )
        self._report()
        return scored.scores

    def _run_finalists(self) -> None:
        """Run the best on the tuning draws, with the shifts that they were estimated with."""
        best: dict[tuple[Any, ...], tuple[Evaluation, TomlTable]] = {}
        for evaluation in sorted(self._evaluations, key=lambda e: e.objective):
            combination = self._space.combinations[evaluation.candidate]
            point = self._space.make_point(list(np.nan_to_num(evaluation.values)), combination)
            best.setdefault(tuple(point.values()), (evaluation, point))
        finalists, points = zip(*list(best.values())[:FINALISTS], strict=True)

        def run_cases(derived: Study) -> NDArray:
            table = run_in_memory(Job(derived, curves=False))["summary"]
            return objective.run_values(self._tune, derived, table)

        scored = self._score(points, run_cases)
        for finalist, score in zip(finalists, scored.scores, strict=True):
            self._cost += total_steps(scored.derived) / len(points)
            step, so_far = len(self._evaluations), int(self._cost)
            self._evaluations.append(
                finalist._replace(step=step, objective=score, cost=so_far, estimated=False)
            )
        self._report()

    def _score(
        self, points: Sequence[TomlTable], run_cases: Callable[[Study], NDArray]
    ) -> PointScores:
        phases = self._tune.feedback_phases
        return score_points(self._study, COVARIANCE, points, run_cases, phases)

    def _report(self) -> None:
        self._on_progress(RunProgress(len(self._evaluations), self._total, 0, 0, "points"))
