"""Search by the covariance of the true error: noise-free runs stand for all draws.

Sobol points are looked at first; from the best of them an evolution strategy goes on (CMA-ES,
Hansen and Ostermeier 2001). Resets stay hard. What a point is worth is the objective of errors that
are sampled from linear covariance analysis (`engine.covariance`); the best few are then run on the
tuning draws, by which they are judged as those of other searches are.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax.execution.run import ProgressCallback, RunProgress, run_in_memory
from sinsjax.execution.tasks import Job
from sinsjax.study.keys import TomlTable
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.study.sweep import TIMES
from sinsjax.tuning import estimates, objective, search
from sinsjax.tuning.history import Evaluation, Found

NAME = "covariance"

POINTS, SPREAD, FINALISTS = 8, 0.2, 3
"""Points of a generation; standard deviation of the first one, all ranges being one long; best
points that are run on the tuning draws."""


def evolve(study: Study, *, tell: ProgressCallback | None = None) -> Found:
    """Search with the objective of covariance analysis.

    Args:
        study: study with [tune], simulated.
        tell: called with the progress after every generation.

    Returns:
        All evaluations; those by covariance analysis are marked as estimates.
    """
    return _Evolution(study, tell).carry_out()


class _Evolution:
    """A search under way."""

    def __init__(self, study: Study, tell: ProgressCallback | None) -> None:
        assert study.tune is not None
        self._study, self._tune, self._space = study, study.tune, SearchSpace.from_study(study)
        self._tell = tell or (lambda progress: None)
        self._looks: list[Evaluation] = []
        self._cost = 0.0
        tune, combinations = self._tune, len(self._space.combinations)
        self._total = (
            tune.evolution_screen * combinations + tune.evolution_steps * POINTS + FINALISTS
        )

    def carry_out(self) -> Found:
        tune, space = self._tune, self._space
        counts = [tune.evolution_screen] * len(space.combinations)
        design = search.sobol(space, counts, search.seed_of(self._study, NAME))
        for block in np.array_split(np.arange(len(design.candidate)), len(space.combinations)):
            self._look(design.box[block], int(design.candidate[block[0]]))
        first = min(self._looks, key=lambda look: look.objective)
        if used := space.used_variables(space.combinations[first.candidate]):
            for box in self._generations(first, used):
                self._look(box, first.candidate)
        self._judge()
        return Found(NAME, self._looks)

    def _generations(self, first: Evaluation, used: list[int]) -> Iterator[NDArray]:
        """Box points of each generation, (points, variables)."""
        import cma  # late: it takes a second, and only this search needs it

        tune = self._tune
        values = [1.0 if np.isnan(value) else value for value in first.values]
        box = np.asarray(self._space.to_box(values))
        seed = int(search.seed_of(self._study, "evolution").generate_state(1)[0]) or 1
        settings = {
            **{"bounds": [0.0, 1.0], "popsize": POINTS, "seed": seed},
            **{"verbose": -9, "CMA_stds": np.ones(max(2, len(used)))},
        }
        # It has no strategy of one variable: a second one without effect goes with it.
        start = np.append(box[used], 0.5) if len(used) == 1 else box[used]
        strategy = cma.CMAEvolutionStrategy(start, SPREAD, settings)
        for _ in range(tune.evolution_steps):
            asked = np.asarray(strategy.ask())
            points = np.full((len(asked), len(self._space.variables)), np.nan)
            points[:, used] = asked[:, : len(used)]
            yield points
            strategy.tell(list(asked), [look.objective for look in self._looks[-len(asked) :]])

    def _look(self, box: NDArray, candidate: int) -> None:
        """Estimate the objective at some box points of a combination."""
        values = [self._space.to_values(np.nan_to_num(row)) for row in box]
        combination = self._space.combinations[candidate]
        points = [self._space.make_point(row, combination) for row in values]
        scores, steps = self._estimated(points)
        for row, at, score in zip(box, values, scores, strict=True):
            self._cost += steps
            found = [np.nan if np.isnan(a) else v for a, v in zip(row, at, strict=True)]
            number = len(self._looks)
            look = Evaluation(number, candidate, found, score, int(self._cost), estimated=True)
            self._looks.append(look)
        self._tell(RunProgress(len(self._looks), self._total, 0, 0, "points"))

    def _estimated(self, points: Sequence[TomlTable]) -> tuple[list[float], float]:
        """The objective of points by covariance analysis, and the steps that one costs."""
        derived, cases = self._derived(points)
        scores = self._scores(derived, cases, estimates.values(derived, self._tune))
        return scores, estimates.steps(derived) / len(points)

    def _judge(self) -> None:
        """Run the best on the tuning draws, with the shifts that they were estimated with."""
        best: dict[tuple[Any, ...], tuple[Evaluation, TomlTable]] = {}
        for look in sorted(self._looks, key=lambda look: look.objective):
            combination = self._space.combinations[look.candidate]
            point = self._space.make_point(list(np.nan_to_num(look.values)), combination)
            best.setdefault(tuple(point.values()), (look, point))
        looks, points = zip(*list(best.values())[:FINALISTS], strict=True)
        derived, cases = self._derived(points)
        found = search.run_values(
            self._study, derived, run_in_memory(Job(derived, curves=False))["summary"]
        )
        scores = self._scores(derived, cases, found)
        for look, score in zip(looks, scores, strict=True):
            self._cost += search.cost(derived) / len(points)
            self._looks.append(
                look._replace(
                    step=len(self._looks), objective=score, cost=int(self._cost), estimated=False
                )
            )
        self._tell(RunProgress(len(self._looks), self._total, 0, 0, "points"))

    def _derived(self, points: Sequence[TomlTable]) -> tuple[Study, NDArray]:
        """The study of points with all shifts, equal ones once, and (points, shifts) its cases."""
        phases = self._tune.feedback_phases
        cases: dict[tuple[Any, ...], TomlTable] = {}
        places: dict[tuple[Any, ...], int] = {}
        of_points = []
        for point in points:
            shifts = [shifted(self._study, point, phase / phases) for phase in range(phases)]
            cases |= {tuple(one.values()): one for one in shifts}
            of_points.append(
                [places.setdefault(tuple(one.values()), len(places)) for one in shifts]
            )
        labelled = {str(number): point for number, point in enumerate(cases.values())}
        name = f"{self._study.name}_{NAME}"
        return search.derive(self._study, labelled, name=name), np.array(of_points)

    def _scores(self, derived: Study, cases: NDArray, values: NDArray) -> list[float]:
        """The objective of each point over its shifts and the study's variants."""
        by_case = values.reshape(len(derived.cases), -1, values.shape[-1])
        return [
            objective.score(self._tune, by_case[own].reshape(-1, values.shape[-1])) for own in cases
        ]


def shifted(study: Study, point: TomlTable, share: float) -> TomlTable:
    """A point whose resets come later by a share of the feedback interval, on whole samples."""
    times = point.get(TIMES)
    if not times or not share:
        return point
    of_study = [value or 0.0 for value in study.values("feedback_interval_s")]
    interval = point.get("feedback_interval_s", max(of_study))
    rate = study.study.rate_hz
    return point | {TIMES: tuple(round((t + share * interval) * rate) / rate for t in times)}
