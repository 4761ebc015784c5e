"""A complete tuning as reports read it: what was found, and its objective on the unused draws."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sinsjax.analysis import Estimate
from sinsjax.analysis.estimates import bootstrap_interval
from sinsjax.errors import InputError
from sinsjax.execution.source import Source
from sinsjax.study.schema import TuneSection
from sinsjax.study.search_space import SearchSpace, Variable
from sinsjax.study.study import Study
from sinsjax.study.success import yardsticks
from sinsjax.tuning import history, objective, search
from sinsjax.tuning.history import Evaluation, Found
from sinsjax.tuning.run_tuning import (
    COVARIANCE,
    EVALUATION,
    GRADIENT,
    require_tune,
)
from sinsjax.tuning.stored import load_tuned_study

SEARCHES = {
    "grid": "grid",
    GRADIENT: "gradient",
    "baseline": "baseline",
    "sobol": "Sobol points",
    "equal cost": "Sobol points at the gradient's cost",
    "random": "random points",
    COVARIANCE: "covariance analysis",
}
"""In words."""

LOOKS = list(SEARCHES)
"""In the order of their markers."""

_AT_BOUND = 5e-3
"""A value within this share of its range is on the bound: descents stop short of it."""


def read(directory: Path) -> Source:
    """Opens a tuning: the results of its judging, with the directory of all of it.

    Raises:
        InputError: it is not complete, or cannot be read.
    """
    if not (directory / EVALUATION / "summary").is_dir():
        raise _incomplete(directory)
    judged = Source.read(directory / EVALUATION)
    assert judged.draws  # of which none is missing, or that is told
    return replace(judged, directory=directory, table=judged.summary)


def _incomplete(directory: Path) -> InputError:
    remedy = "`sinsjax tune --resume` continues it"
    return InputError(f"{directory}: holds a tuning run that is not complete ({remedy})")


@dataclass(frozen=True)
class Tuning:
    """A complete tuning.

    Attributes:
        study: with [tune].
        judged: the study of the judging, whose cases are what was found.
        source: of its results.
        found: by search.
    """

    study: Study
    judged: Study
    source: Source
    found: dict[str, Found]

    @classmethod
    def of(cls, source: Source) -> "Tuning":
        """Read a completed tuning run.

        Raises:
            InputError: a search is missing: the evaluation is that of an earlier tuning run.
        """
        study = load_tuned_study(source.directory)
        found = history.read(source.directory, SearchSpace.from_study(study))
        by_name = {one.search.replace("_", " "): one for one in found}
        tuning = cls(study, source.study, source, by_name)
        if not by_name or tuning.places.keys() - {"baseline", *by_name}:
            raise _incomplete(source.directory)
        return tuning

    @property
    def tune(self) -> TuneSection:
        """The section [tune]."""
        return require_tune(self.study)

    @cached_property
    def places(self) -> dict[str, int]:
        """Number of the case of each candidate: one may be that of several."""
        labels = [case["case"] for case in self.judged.cases]
        return {name: i for i, label in enumerate(labels) for name in label.split(", ")}

    @cached_property
    def runs(self) -> NDArray:
        """(cases, variants, draws) numbers that the objective is made of, on the unused draws."""
        table = self.source.rows(objective.columns_of(self.tune, self.study))
        return search.run_values(self.study, self.judged, table)

    @property
    def on_bounds(self) -> dict[str, list[tuple[Variable, float]]]:
        """By search, what its best point has at an end of its range, and the value there."""
        space = SearchSpace.from_study(self.study)
        found = {}
        for name, search_ in self.found.items():
            best = search_.best
            used = space.used(space.combinations[best.candidate])
            here = [(space.variables[i], float(best.values[i])) for i in used]
            found[name] = [(v, x) for v, x in here if not _AT_BOUND < v.place(x) < 1 - _AT_BOUND]
        return found

    @property
    def rival(self) -> str:
        """The candidate that all others are compared with: the grid's, if there is one."""
        return next(name for name in ("grid", *self.found, "baseline") if name in self.places)

    @property
    def best(self) -> str:
        """The candidate with the best objective on the tuning draws, which is in tuned.toml."""
        return min(self.found, key=lambda name: self.found[name].best.objective)

    def descents(self, number: int) -> list[tuple[NDArray, NDArray]]:
        """Points, (n, p), and objective of each descent of a combination of candidates."""
        found = self.found.get(GRADIENT)
        steps: dict[int | None, list[Evaluation]] = {}
        for step in found.relaxed if found else ():
            if step.candidate == number:
                steps.setdefault(step.start, []).append(step)
        return [
            (np.array([one.values for one in some]), np.array([one.objective for one in some]))
            for some in steps.values()
        ]

    def score(self, name: str) -> Estimate:
        """The objective of a candidate on the unused draws."""
        runs = self.runs[self.places[name]]
        return self._estimate(lambda pick: objective.score(self.tune, runs[:, pick]), runs.shape[1])

    def difference(self, name: str, less: str | None = None) -> Estimate:
        """The objective of a candidate less that of another, or of the rival, on the same draws."""
        own, other = (self.runs[self.places[one]] for one in (name, less or self.rival))
        return self._estimate(
            lambda pick: (
                objective.score(self.tune, own[:, pick])
                - objective.score(self.tune, other[:, pick])
            ),
            own.shape[1],
        )

    def _estimate(self, score: Callable[[NDArray], float], draws: int) -> Estimate:
        """A number of some draws, with a bootstrap interval over them; none on a record."""
        every = np.arange(draws)
        if self.study.is_recorded:
            return Estimate(score(every), math.nan, math.nan, draws)
        low, high = bootstrap_interval(
            lambda picks: np.array([score(pick) for pick in picks]), every
        )
        return Estimate(score(every), low, high, draws)


def words(study: Study) -> tuple[str, str]:
    """The objective of a study with [tune] in words, and its unit."""
    tune = require_tune(study)
    judged = yardsticks(study, tune.objective_band_arcmin)[0]
    about = "" if judged.truth else ", from its bias floor"
    return {
        "settle_mean": (f"mean time until the heading stays {judged.words}", "s"),
        "settle_quantile": (
            f"{100 * tune.objective_quantile:g} % quantile of the time until the heading stays"
            f" {judged.words}",
            "s",
        ),
        "final_error": (f"root mean square heading error at the end{about}", "arcmin"),
        "failure_rate": (f"share that never stays {judged.words}", ""),
    }[tune.objective]


def axis(study: Study) -> str:
    """The objective as an axis label."""
    name, unit = words(study)
    return f"{name} ({unit})" if unit else name
