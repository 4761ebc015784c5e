"""A complete tuning run: best points, and their objective on draws that did not tune."""

import math
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sinsjax.analysis import Estimate, format_estimate, share
from sinsjax.analysis.estimates import bootstrap_interval
from sinsjax.errors import InputError
from sinsjax.execution.results import Results
from sinsjax.messages import format_facts
from sinsjax.study.changes import copy_tables
from sinsjax.study.keys import TomlTable
from sinsjax.study.load import fingerprint, load_study
from sinsjax.study.schema import TuneSection
from sinsjax.study.search_space import SearchSpace, Variable
from sinsjax.study.study import Study
from sinsjax.study.success import success_measures
from sinsjax.tuning import history, objective, search
from sinsjax.tuning.history import EVALUATION, TUNED, Evaluation
from sinsjax.tuning.search import GRADIENT, LAW, require_tune

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


class TuningResults:
    """Results of a tuning run, read from its directory.

    Attributes:
        directory: directory of the tuning run.
        study: the study with the best point and without [tune], as in ``tuned.toml``. Its seed is
            new, so that its draws neither tuned nor evaluated.

    Raises:
        InputError: it is not complete, cannot be read, or has changed since.

    Examples:
        >>> changes = {"study.rate_hz": 10.0, "tune.searches": ["grid"], "tune.grid_points": 2}
        >>> changes |= {"tune.tune_draws": 2, "tune.evaluation_draws": 4}
        >>> tuned = sinsjax.tune(sinsjax.load_study("tune_condition5", changes), "tuned")
        >>> tuned.best
        {'reset_times_s': [2.0, 20.0]}
        >>> tuned.study.n_variants, tuned.score.n
        (1, 4)
    """

    def __init__(self, directory: str | Path) -> None:
        """Read a tuning run: its searches, and the results of their evaluation.

        The cases of the evaluated study are the candidates: the best point of each search, the
        baseline and, where resets are tuned, the law's schedule.
        """
        self.directory = directory = Path(directory)
        self.search_study = history.load_tuned_study(directory)
        if not (directory / TUNED).exists():  # which is written last
            remedy = "`sinsjax tune --resume` continues it"
            raise InputError(f"{directory}: holds a tuning run that is not complete ({remedy})")
        self._space = SearchSpace.from_study(self.search_study)
        searches = history.read_searches(directory, self._space)
        self.searches = {result.search: result for result in searches}
        self.evaluation = Results.read(directory / EVALUATION)
        self.evaluation.directory = directory  # the one that reports name
        self.study = load_study(directory / TUNED)
        best = search.make_tuned_study(self.search_study, self.best)
        if fingerprint(self.study) != fingerprint(best):
            remedy = "move it away: `sinsjax tune --resume` writes it again"
            raise InputError(f"{directory / TUNED}: has changed since the tuning ({remedy})")

    @cached_property
    def best(self) -> TomlTable:
        """The best point on the tuning draws: values by key, in the units of the file."""
        return copy_tables(self.searches[self.best_search].point(self._space))

    @property
    def search(self) -> str:
        """The search that found the best point."""
        return SEARCH_LABELS[self.best_search]

    @property
    def objective(self) -> str:
        """The minimised quantity, with its unit."""
        return objective_label(self.search_study)

    @property
    def score(self) -> Estimate:
        """The objective of the best point on the evaluation draws, with its 95 % interval."""
        return self.score_of(self.best_search)

    @property
    def baseline(self) -> Estimate:
        """The objective of the baseline on the same draws, with its 95 % interval."""
        return self.score_of("baseline")

    @property
    def law(self) -> Estimate | None:
        """The objective of the reset schedule by the law on the same draws; None without one."""
        return self.score_of(LAW) if LAW in self.case_numbers else None

    def __repr__(self) -> str:
        """Return five short lines: objective, best point, its score, the baseline's, place."""
        from sinsjax.plots.labels import format_setting, format_value  # plots import Matplotlib

        point = ", ".join(format_setting(key, format_value(v)) for key, v in self.best.items())
        score, baseline = map(format_estimate, (self.score, self.baseline))
        facts = {
            "objective": self.objective,
            "best": f"{point} ({self.search})",
            "score": f"{score}; baseline {baseline}",
            "stored": f"in {self.directory}",
        }
        return format_facts(f"Tuning of {self.search_study.name}", facts)

    # --- for reports ----------------------------------------------------------------------------

    @property
    def tune(self) -> TuneSection:
        """The section [tune]."""
        return require_tune(self.search_study)

    @property
    def best_search(self) -> str:
        """The candidate with the best objective on the tuning draws, which is in tuned.toml."""
        return min(self.searches, key=lambda name: self.searches[name].best.objective)

    @property
    def rival(self) -> str:
        """The candidate that all others are compared with: the grid's, if there is one."""
        names = ("grid", *self.searches, "baseline")
        return next(name for name in names if name in self.case_numbers)

    @cached_property
    def case_numbers(self) -> dict[str, int]:
        """Number of the case of each candidate; equal candidates share one."""
        labels = [case["case"] for case in self.evaluation.study.cases]
        return {name: i for i, label in enumerate(labels) for name in label.split(", ")}

    def case(self, name: str) -> TomlTable:
        """Return the keys and values of a candidate, with the label of its case."""
        return self.evaluation.study.cases[self.case_numbers[name]]

    @cached_property
    def run_values(self) -> NDArray:
        """(cases, variants, draws) values of the runs for the objective, on the unused draws."""
        return self._run_values(self.search_study)

    def _run_values(self, study: Study) -> NDArray:
        table = self.evaluation.rows(objective.summary_columns(require_tune(study), study))
        return search.point_values(study, self.evaluation.study, table)

    @cached_property
    def unsettled(self) -> NDArray | None:
        """(cases, variants, draws) whether runs never settle, if the objective is a time."""
        if not self.tune.objective.startswith("settle_"):
            return None
        return self._run_values(self.search_study.replace({"tune.objective": "failure_rate"})) > 0

    def settled_share(self, name: str) -> Estimate | None:
        """Return the share of a candidate's runs on the unused draws that settle.

        None if the objective is no settling time.
        """
        if self.unsettled is None:
            return None
        settled = ~self.unsettled[self.case_numbers[name]]
        draws = np.arange(settled.shape[1]) * (not self.search_study.is_recorded)
        return share(settled.ravel(), np.tile(draws, len(settled)))

    @property
    def values_on_bounds(self) -> dict[str, list[tuple[Variable, float]]]:
        """Variables at an end of their range in each search's best point, with their values."""
        space, on_bounds = self._space, {}
        for name, result in self.searches.items():
            used = space.used_variables(space.combinations[result.best.candidate])
            point = [(space.variables[i], float(result.best.values[i])) for i in used]
            on_bounds[name] = [
                (v, x) for v, x in point if not _AT_BOUND < v.position(x) < 1 - _AT_BOUND
            ]
        return on_bounds

    def descents(self, number: int) -> list[tuple[NDArray, NDArray]]:
        """Return points, (n, p), and objective of each descent of a combination of candidates."""
        result = self.searches.get(GRADIENT)
        descents: dict[int | None, list[Evaluation]] = {}
        for step in result.evaluations if result else ():
            if step.candidate == number and step.sharpness is not None:
                descents.setdefault(step.start, []).append(step)
        return [
            (np.array([step.values for step in steps]), np.array([s.objective for s in steps]))
            for steps in descents.values()
        ]

    def score_of(self, name: str) -> Estimate:
        """Return the objective of a candidate on the unused draws."""
        return self._estimate(lambda pick: self._score(name, pick))

    def difference(self, name: str, other: str | None = None) -> Estimate:
        """Return the objective less that of another candidate, or of the rival, on equal draws."""
        other = other or self.rival
        return self._estimate(lambda pick: self._score(name, pick) - self._score(other, pick))

    def _score(self, name: str, draws: NDArray) -> float:
        return objective.score(self.tune, self.run_values[self.case_numbers[name]][:, draws])

    def _estimate(self, score: Callable[[NDArray], float]) -> Estimate:
        """Return a score with its bootstrap interval over the draws; none on a record."""
        every, low, high = np.arange(self.run_values.shape[2]), math.nan, math.nan
        if not self.search_study.is_recorded:
            low, high = bootstrap_interval(
                lambda picks: np.array([score(pick) for pick in picks]), every
            )
        return Estimate(score(every), low, high, len(every))


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
