"""A complete tuning run as reports read it: best points and their objective on unused draws."""

import math
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sinsjax.analysis import Estimate, share
from sinsjax.analysis.estimates import bootstrap_interval
from sinsjax.errors import InputError
from sinsjax.execution.results import Results
from sinsjax.messages import to_one_line
from sinsjax.study.identity import describe_differences, fingerprint
from sinsjax.study.load import load_study
from sinsjax.study.schema import TuneSection
from sinsjax.study.search_space import SearchSpace, Variable
from sinsjax.study.study import Study
from sinsjax.study.success import success_measures
from sinsjax.tuning import history, objective, search
from sinsjax.tuning.history import Evaluation, SearchResult, load_tuned_study
from sinsjax.tuning.run_tuning import (
    EVALUATION,
    GRADIENT,
    LAW,
    TUNED,
    make_tuned_study,
    require_tune,
)

SEARCH_LABELS = {
    "grid": "grid",
    GRADIENT: "gradient",
    "baseline": "baseline",
    "sobol": "Sobol points",
    "equal cost": "Sobol points at the gradient's cost",  # in directories of version 1.0
    LAW: "law of resets",
}
"""Names of searches, of the baseline and of the law's reset schedule, in words."""

_AT_BOUND = 5e-3
"""A value within this share of its range is on the bound: descents stop short of it."""


class Tuning(Results):
    """A complete tuning run: the results of its evaluation on unused draws, and its searches.

    The cases of the study of these results are the candidates: the best point of each search, the
    baseline and, where resets are tuned, the law's schedule.

    Attributes:
        search_study: study with [tune].
        searches: result of each search, by its name.
        tuned: the study with the best point and without [tune], as in ``tuned.toml``.
    """

    search_study: Study
    searches: dict[str, SearchResult]
    tuned: Study

    @classmethod
    def read(cls, directory: str | Path, *, whole_draws: bool = False) -> "Tuning":
        """Read a tuning run.

        Args:
            directory: directory of the tuning run.
            whole_draws: has no effect, since an unfinished evaluation is refused.

        Raises:
            InputError: it is not complete, cannot be read, or ``study.toml`` or ``tuned.toml`` has
                changed since.
        """
        directory = Path(directory)
        if not (directory / EVALUATION / "summary").is_dir() or not (directory / TUNED).exists():
            raise _incomplete_error(directory)
        tuning = super().read(directory / EVALUATION)
        assert isinstance(tuning, cls) and tuning.draws  # checks that no run is missing
        tuning.directory, study = directory, load_tuned_study(directory)
        space = SearchSpace.from_study(study)
        searches = history.read_searches(directory, space)
        tuning.search_study = study
        tuning.searches = {result.search.replace("_", " "): result for result in searches}
        if not searches or tuning.case_numbers.keys() - {"baseline", LAW, *tuning.searches}:
            raise _incomplete_error(directory)  # the evaluation is that of an earlier tuning run
        tuning.tuned = load_study(directory / TUNED)
        best = make_tuned_study(study, tuning.searches[tuning.best].point(space))
        if fingerprint(tuning.tuned) != fingerprint(best):
            named = ("in the tuning", "in the file")
            differing = to_one_line("; ".join(describe_differences(best, tuning.tuned, named)))
            raise InputError(
                f"{directory / TUNED}: has changed since the tuning: {differing} (move it away:"
                " `sinsjax tune --resume` writes it again)"
            )
        return tuning

    @property
    def tune(self) -> TuneSection:
        """The section [tune]."""
        return require_tune(self.search_study)

    @cached_property
    def case_numbers(self) -> dict[str, int]:
        """Number of the case of each candidate; equal candidates share one."""
        labels = [case["case"] for case in self.study.cases]
        return {name: i for i, label in enumerate(labels) for name in label.split(", ")}

    @cached_property
    def run_values(self) -> NDArray:
        """(cases, variants, draws) values of the runs for the objective, on the unused draws."""
        table = self.rows(objective.summary_columns(self.tune, self.search_study))
        return search.point_values(self.search_study, self.study, table)

    @cached_property
    def unsettled(self) -> NDArray | None:
        """(cases, variants, draws) whether runs never settle, if the objective is a time."""
        if not self.tune.objective.startswith("settle_"):
            return None
        never = self.tune.model_copy(update={"objective": "failure_rate"})
        study = self.search_study.model_copy(update={"tune": never})
        table = self.rows(objective.summary_columns(never, study))
        return search.point_values(study, self.study, table) > 0

    def settled_share(self, name: str) -> Estimate | None:
        """Return the share of a candidate's runs on the unused draws that settle.

        None if the objective is no settling time.
        """
        if self.unsettled is None:
            return None
        settled = ~self.unsettled[self.case_numbers[name]]
        draws = np.zeros if self.search_study.is_recorded else np.arange
        clusters = np.tile(draws(settled.shape[1]).astype(int), len(settled))
        return share(settled.ravel(), clusters)

    def tuning_score(self, name: str) -> float | None:
        """Return the objective of a search's best point on the tuning draws; None for others."""
        return self.searches[name].best.objective if name in self.searches else None

    @property
    def values_on_bounds(self) -> dict[str, list[tuple[Variable, float]]]:
        """Variables at an end of their range in each search's best point, with their values."""
        space = SearchSpace.from_study(self.search_study)
        on_bounds = {}
        for name, result in self.searches.items():
            best = result.best
            used = space.used_variables(space.combinations[best.candidate])
            point = [(space.variables[i], float(best.values[i])) for i in used]
            on_bounds[name] = [
                (v, x) for v, x in point if not _AT_BOUND < v.position(x) < 1 - _AT_BOUND
            ]
        return on_bounds

    @property
    def rival(self) -> str:
        """The candidate that all others are compared with: the grid's, if there is one."""
        names = ("grid", *self.searches, "baseline")
        return next(name for name in names if name in self.case_numbers)

    @property
    def best(self) -> str:
        """The candidate with the best objective on the tuning draws, which is in tuned.toml."""
        return min(self.searches, key=lambda name: self.searches[name].best.objective)

    def descents(self, number: int) -> list[tuple[NDArray, NDArray]]:
        """Return points, (n, p), and objective of each descent of a combination of candidates."""
        result = self.searches.get(GRADIENT)
        descents: dict[int | None, list[Evaluation]] = {}
        for step in result.relaxed_evaluations if result else ():
            if step.candidate == number:
                descents.setdefault(step.start, []).append(step)
        return [
            (np.array([step.values for step in steps]), np.array([s.objective for s in steps]))
            for steps in descents.values()
        ]

    def score(self, name: str) -> Estimate:
        """Return the objective of a candidate on the unused draws."""
        runs = self.run_values[self.case_numbers[name]]
        return self._estimate(lambda pick: objective.score(self.tune, runs[:, pick]), runs.shape[1])

    def difference(self, name: str, other: str | None = None) -> Estimate:
        """Return the objective less that of another candidate, or of the rival, on equal draws."""
        names = (name, other or self.rival)
        runs, other_runs = (self.run_values[self.case_numbers[candidate]] for candidate in names)
        return self._estimate(
            lambda pick: (
                objective.score(self.tune, runs[:, pick])
                - objective.score(self.tune, other_runs[:, pick])
            ),
            runs.shape[1],
        )

    def _estimate(self, score: Callable[[NDArray], float], draws: int) -> Estimate:
        """Return a score with its bootstrap interval over the draws; none on a record."""
        every = np.arange(draws)
        if self.search_study.is_recorded:
            return Estimate(score(every), math.nan, math.nan, draws)
        low, high = bootstrap_interval(
            lambda picks: np.array([score(pick) for pick in picks]), every
        )
        return Estimate(score(every), low, high, draws)


def _incomplete_error(directory: Path) -> InputError:
    remedy = "`sinsjax tune --resume` continues it"
    return InputError(f"{directory}: holds a tuning run that is not complete ({remedy})")


def describe_objective(study: Study) -> tuple[str, str]:
    """Return the objective of a study with [tune] in words, and its unit."""
    tune = require_tune(study)
    success = success_measures(study, tune.objective_band_arcmin)[0]
    about = "" if success.truth else ", from its bias floor"
    return {
        "settle_mean": (f"mean time until the heading stays {success.description}", "s"),
        "settle_quantile": (
            f"{100 * tune.objective_quantile:g} % quantile of the time until the heading stays"
            f" {success.description}",
            "s",
        ),
        "final_error": (f"root mean square heading error at the end{about}", "arcmin"),
        "failure_rate": (f"share that never stays {success.description}", ""),
    }[tune.objective]


def objective_label(study: Study) -> str:
    """Return the objective as an axis label."""
    name, unit = describe_objective(study)
    return f"{name} ({unit})" if unit else name
