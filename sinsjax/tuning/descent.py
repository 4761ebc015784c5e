"""Gradient search: several descents in parallel lanes, differentiated in forward mode.

Descents start at the best of some points, and the edge of the band is soft; it sharpens from step
to step. Where no reset is moved and covariance analysis holds, that is what points are looked at
and descended by: without noise. Otherwise each step uses the next few draws, and resets that are
moved are smooth windows, which sharpen too. The final points are scored like any other point, with
hard resets on all tuning draws.
"""

from collections.abc import Sequence

import numpy as np
import optax
from numpy.typing import NDArray

from sinsjax.execution import run
from sinsjax.execution.run import ProgressCallback, RunProgress
from sinsjax.records.reference import StoredRecord
from sinsjax.study.keys import TomlTable
from sinsjax.study.schema import TuneSection
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.tuning import estimates, objective, search
from sinsjax.tuning.history import Evaluation, Found
from sinsjax.tuning.relaxation import Relaxation
from sinsjax.tuning.slopes import Slope, Softness

NAME = "gradient"


def descend(
    study: Study, stored: StoredRecord | None = None, *, tell: ProgressCallback | None = None
) -> Found:
    """Tune a study by gradient, for every combination of its candidates.

    Args:
        study: study with [tune].
        stored: the record of a recorded study.
        tell: called with the progress, in runs, after every step.

    Returns:
        Every step of every descent with its relaxed objective, and the final points with their
        unrelaxed objective on all tuning draws.

    Raises:
        InputError: a variable has no gradient, or the record does not fit.
    """
    looks: list[Evaluation] = []
    for number in range(len(SearchSpace.from_study(study).combinations)):
        looks += _Descents(study, stored, number, looks[-1].cost if looks else 0).looks(tell)
    return Found(NAME, looks)


class _Descents:
    """The descents of one combination of candidates."""

    def __init__(self, study: Study, stored: StoredRecord | None, number: int, cost: int) -> None:
        assert study.tune is not None
        self._study, self._stored, self._number, self._cost = study, stored, number, cost
        self._tune, self._space = study.tune, SearchSpace.from_study(study)
        relaxation = Relaxation(study, self._space, self._space.combinations[number])
        self._samples = estimates.SAMPLES if relaxation.by_covariance else 0
        self._moves_resets = relaxation.moves_resets

    def looks(self, tell: ProgressCallback | None) -> list[Evaluation]:
        """Run the descents; gives all evaluations in order."""
        tune, steps = self._tune, self._tune.descent_steps
        if not self._space.used_variables(self._space.combinations[self._number]):
            return self._scored(np.empty((1, 0)), [])
        slope = Slope(
            self._study,
            self._stored,
            self._number,
            starts=tune.descent_starts,
            draws=tune.descent_draws,
            samples=self._samples,
        )
        box = self._begin(slope)
        adam = optax.adam(optax.cosine_decay_schedule(tune.descent_rate, steps, alpha=0.1))
        state = adam.init(box)
        looks: list[Evaluation] = []
        for step in range(steps):
            draws = (step * slope.draws + np.arange(slope.draws)) % slope.n_draws
            softness = _softness(tune, step)
            score, gradient = slope(box, draws, softness)
            self._cost += slope.cost
            window_s = softness.window_s if self._moves_resets else None
            told = window_s, softness.sharpness, self._samples > 0
            looks += [
                Evaluation(step, self._number, values, float(one), self._cost, start, *told)
                for start, (values, one) in enumerate(
                    zip(self._values(box, slope.used), score, strict=True)
                )
            ]
            if tell is not None:
                done, total = ((n * tune.descent_starts * slope.draws) for n in (step + 1, steps))
                tell(RunProgress(done, total, 0, 0))
            moves, state = adam.update(np.nan_to_num(gradient, posinf=0.0, neginf=0.0), state)
            box = np.asarray(optax.projections.projection_box(box + moves, 0.0, 1.0))
        return [*looks, *self._scored(box, slope.used)]

    def _begin(self, slope: Slope) -> NDArray:
        """(starts, p) initial positions of the descents: the best of some, roughly judged."""
        count = max(self._tune.descent_screen, self._tune.descent_starts)
        counts = [count] * len(self._space.combinations)
        design = search.sobol(self._space, counts, search.seed_of(self._study, NAME))
        box = design.box[design.candidate == self._number][:, slope.used]
        if count == self._tune.descent_starts:
            return box
        values = self._values(box, slope.used)
        scores = self._estimated(values) if self._samples else self._hard(values, slope.draws)
        return box[np.argsort(scores, kind="stable")[: self._tune.descent_starts]]

    def _scored(self, box: NDArray, used: Sequence[int]) -> list[Evaluation]:
        """Evaluate the final points of the descents on all tuning draws."""
        values = self._values(box, used)
        scores = self._hard(values, None)
        step = self._tune.descent_steps
        return [
            Evaluation(step, self._number, own, float(score), self._cost, start)
            for start, (own, score) in enumerate(zip(values, scores, strict=True))
        ]

    def _values(self, box: NDArray, used: Sequence[int]) -> list[list[float]]:
        """Values of all variables at positions of the used ones; NaN for the others."""
        whole = np.full((len(box), len(self._space.variables)), np.nan)
        whole[:, used] = box
        return [self._space.to_values(row) for row in whole]

    def _hard(self, values: Sequence[Sequence[float]], draws: int | None) -> NDArray:
        """The objective at some points with hard resets, on the first tuning draws or all."""
        study = self._study
        if draws is not None and not study.is_recorded:
            study = study.model_copy(
                update={"tune": self._tune.model_copy(update={"tune_draws": draws})}
            )
        scores, taken, each = search.scored(
            study,
            NAME,
            self._points(values),
            lambda one: run.run(one, self._stored, curves=False).summary,
        )
        self._cost += len(set(taken)) * each
        return np.array(scores)

    def _estimated(self, values: Sequence[Sequence[float]]) -> NDArray:
        """The objective at some points by covariance analysis."""
        points = {str(number): point for number, point in enumerate(self._points(values))}
        derived = search.derive(self._study, points, name=f"{self._study.name}_{NAME}")
        found = estimates.values(derived, self._tune)
        self._cost += round(estimates.steps(derived))
        by_point = found.reshape(len(points), -1, found.shape[-1])
        return np.array([objective.score(self._tune, own) for own in by_point])

    def _points(self, values: Sequence[Sequence[float]]) -> list[TomlTable]:
        combination = self._space.combinations[self._number]
        return [self._space.make_point(list(np.nan_to_num(own)), combination) for own in values]


def _softness(tune: TuneSection, step: int) -> Softness:
    """Degree of relaxation of a step, geometrically from the first to the last."""
    way = step / max(tune.descent_steps - 1, 1)
    ends = (tune.relaxed_window_s, tune.relaxed_sharpness)
    return Softness(*(first * (last / first) ** way for first, last in ends))
