"""A program against the best method of sinsjax on the same draws, with 95 % intervals.

Errors are magnitudes of the heading error from the truth at the end of a run; one without a result
counts as 180 deg. Which method and settings are best is decided by one half of the draws and judged
by the other, since a choice would look too good on the runs that made it. One choice serves all
conditions, unless some have settings that others lack: then each condition has its own.
"""

from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy import special

from sinsjax import analysis
from sinsjax.analysis import Estimate, format_estimate, mean_difference, proportion_difference
from sinsjax.analysis.estimates import TAIL
from sinsjax.analysis.tables import numeric_column
from sinsjax.arena.runs import conditions_of
from sinsjax.messages import format_count
from sinsjax.methods.registry import external_names
from sinsjax.plots.labels import describe_point
from sinsjax.study.study import Study
from sinsjax.study.success import success_measures

FAILED_ARCMIN = 180 * 60.0
"""Heading error that a run without a result counts."""

_ROUNDING = 1e-6
"""Difference below which two headings are equal, arcmin."""

_LEAST_SPLIT = 8
"""Fewest draws that are split into halves."""


class ConditionResult(NamedTuple):
    """Results under one condition, or over all of them.

    Attributes:
        point: values of `Comparison.keys`; None for all conditions.
        program: mean heading error of the program, arcmin.
        best: that of the best method of sinsjax, arcmin.
        difference: program minus best, paired by draw, arcmin.
        success: share of the program's runs that succeed.
        success_best: that of the best method.
        success_difference: program minus best.
        nees: mean NEES of the program over its three angles; None without sigmas.
    """

    point: tuple[Any, ...] | None
    program: Estimate
    best: Estimate
    difference: Estimate
    success: Estimate
    success_best: Estimate
    success_difference: Estimate
    nees: Estimate | None


class Comparison(NamedTuple):
    """A program against the best method of sinsjax.

    Attributes:
        name: of the program.
        best: the best method with its settings, in words.
        options: number of methods and settings that it is the best of.
        keys: swept keys that are conditions.
        overall: over all conditions.
        conditions: each of them, if there are several.
        enough_draws: draws from which on the difference would be sure, by its scatter; None if
            the draws do not differ.
        draws: number of draws.
        rivals: variants of each method with its settings by condition.
    """

    name: str
    best: str
    options: int
    keys: list[str]
    overall: ConditionResult
    conditions: list[ConditionResult]
    enough_draws: int | None
    draws: int
    rivals: list[dict[tuple[Any, ...], int]]

    @property
    def is_sure(self) -> bool:
        """Return whether the interval of the difference excludes zero."""
        return self.overall.difference.low > 0 or self.overall.difference.high < 0

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        all_, difference = self.overall, self.overall.difference
        verb = "does not differ for sure from"
        if self.is_sure:
            verb = "is better than" if difference.value < 0 else "is worse than"
        best = f"the best of {self.options} methods of sinsjax, {self.best}"
        if self.options == 1:
            best = f"sinsjax's {self.best}"
        digits = 1 if abs(difference.value) >= 1 else 3
        text = (
            f"{self.name} {verb} {best}: mean heading error"
            f" {format_estimate(all_.program)} against {format_estimate(all_.best, 'arcmin')},"
            f" paired difference {format_estimate(difference, 'arcmin', digits)}"
            f" on {format_count(self.draws, 'draw')}"
        )
        if self.draws < _LEAST_SPLIT:
            return f"{text} (few: the best was chosen on the same draws)"
        if self.enough_draws is None:
            return text
        if self.is_sure:
            return f"{text}, of which {self.enough_draws} would do"
        return f"{text}; about {self.enough_draws:,} would decide it"


def compare(study: Study, table: pa.Table, name: str, keys: list[str]) -> Comparison:
    """Compare a program with the best method of sinsjax.

    Args:
        study: with the program as a method.
        table: summary of all runs, by run_id.
        name: of the program.
        keys: swept keys that are conditions, see `runs.condition_keys`.
    """
    measures = success_measures(study)

    def by_variant(column: str) -> NDArray:
        return numeric_column(table, column).reshape(-1, study.n_variants)

    error = np.abs(by_variant("phi_u_arcmin"))
    error = np.where(np.isnan(error), FAILED_ARCMIN, error)
    ok = np.any([by_variant(measure.ok_column) > 0 for measure in measures], axis=0)
    settings = [key for key in study.axis_keys if key not in (*keys, "case", "method")]
    program, rivals = _arrange(study, name, keys, settings)
    points, columns = list(program), np.array(list(program.values()))
    variants = np.array([[rival.get(point, -1) for point in points] for rival in rivals])
    chosen, rival = _choose_best(error, variants)
    draws = np.arange(len(error))[:, None]
    errors, oks = ((values[:, columns], values[draws, rival]) for values in (error, ok))
    squares = by_variant("nees")[:, columns]

    def result(point: tuple[Any, ...] | None, places: slice) -> ConditionResult:
        ours, theirs = (values[:, places].ravel() for values in errors)
        won, lost = (values[:, places].ravel() for values in oks)
        cluster = np.broadcast_to(draws, errors[0][:, places].shape).ravel()
        nees = squares[:, places].ravel()
        return ConditionResult(
            point,
            analysis.mean(ours, cluster, limits=(0.0, FAILED_ARCMIN)),
            analysis.mean(theirs, cluster, limits=(0.0, FAILED_ARCMIN)),
            mean_difference(ours, theirs, cluster),
            analysis.share(won, cluster),
            analysis.share(lost, cluster),
            proportion_difference(won, lost),
            analysis.mean(nees, cluster) if np.isfinite(nees).any() else None,
        )

    conditions = [result(point, slice(i, i + 1)) for i, point in enumerate(points)]
    return Comparison(
        name,
        _describe_options(study, chosen.tolist(), settings),
        len(rivals),
        keys,
        result(None, slice(None)),
        conditions if len(points) > 1 else [],
        _enough_draws((errors[0] - errors[1]).mean(axis=1)),
        len(error),
        [found for found in rivals if found.keys() >= program.keys()],
    )


def _arrange(
    study: Study, name: str, keys: list[str], settings: list[str]
) -> tuple[dict[Any, int], list[dict[Any, int]]]:
    """Return the variant of the program by condition, and those of each method with settings."""
    points, first, methods = conditions_of(study, keys), study.duplicate_of, study.values("method")
    options = conditions_of(study, ["method", *settings])
    rivals: dict[Any, dict[Any, int]] = {}
    for variant, point in enumerate(points):
        option = (name,) if methods[variant] == name else options[first[variant]]
        rivals.setdefault(option, {}).setdefault(point, variant)
    program = rivals.pop((name,))
    return program, [found for option, found in rivals.items() if not external_names(option[:1])]


def _choose_best(error: NDArray, rivals: NDArray) -> tuple[NDArray, NDArray]:
    """Return the variants with the least mean error.

    Args:
        error: (draws, variants).
        rivals: (rivals, conditions), see `_arrange`.

    Returns:
        (conditions,) by all draws, which name the best, and (draws, conditions) by the other half
        of the draws, which are compared.
    """
    means = np.where(rivals < 0, np.inf, error[:, rivals])  # (draws, rivals, conditions)

    def choose(draws: NDArray) -> NDArray:
        mean = means[draws].mean(axis=0)
        if (rivals >= 0).all():
            return rivals[mean.mean(axis=-1).argmin()]
        return rivals[mean.argmin(axis=0), np.arange(rivals.shape[1])]

    draws = np.arange(len(error))
    best = choose(draws)
    if len(error) < _LEAST_SPLIT:
        return best, np.tile(best, (len(error), 1))
    halves = np.stack([choose(draws[draws % 2 != half]) for half in (0, 1)])
    return best, halves[draws % 2]


def _enough_draws(differences: NDArray) -> int | None:
    """Return the fewest draws whose t interval would exclude zero at this mean and scatter."""
    mean, count = abs(differences.mean()), len(differences)
    sigma = differences.std(ddof=1) if count > 1 else 0.0
    if sigma <= _ROUNDING or mean <= _ROUNDING:
        return None
    n = np.unique(np.round(np.geomspace(2, 1e9, 4000)))
    half = special.stdtrit(n - 1, 1 - TAIL) * sigma / np.sqrt(n)
    enough = n[half < mean]
    return int(enough[0]) if len(enough) else None


def _describe_options(study: Study, variants: list[int], settings: list[str]) -> str:
    """Return the methods with their settings in words; the label of a case stands for its keys."""
    of_case = set(study.cases[0]) if study.cases else set()
    label = "method"
    if "case" in of_case and of_case <= {"case", "method", *settings}:
        label, settings = "case", [key for key in settings if key not in of_case]
    texts = []
    for variant in variants:
        keys = [key for key in settings if not study.without_effect(key)[variant]]
        used = {key: study.values(key)[variant] for key in keys}
        name = study.values(label)[variant]
        texts.append(f"{name} ({describe_point(used)})" if used else str(name))
    return " or ".join(dict.fromkeys(texts))
