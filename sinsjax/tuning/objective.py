"""Objective of a tuning run: a value for each run, and one score for all runs of a point."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
from jax.scipy.special import ndtr
from numpy.typing import NDArray
from scipy import special

from sinsjax import analysis, columns
from sinsjax.engine.covariance import Spread
from sinsjax.engine.metrics import Criteria, Outcome, outside
from sinsjax.engine.verdicts import FLOOR, TRUTH
from sinsjax.study.schema import TuneSection
from sinsjax.study.study import Study
from sinsjax.study.success import success_of
from sinsjax.types import Array
from sinsjax.units import ARCMIN

_OVER_DRAWS: dict[str, Callable[[TuneSection, NDArray], NDArray]] = {
    "settle_mean": lambda tune, values: np.mean(values, axis=-1),
    "settle_quantile": lambda tune, values: np.quantile(
        values, tune.objective_quantile, axis=-1, method="inverted_cdf"
    ),
    "final_error": lambda tune, values: np.sqrt(np.mean(values**2, axis=-1)),
    "failure_rate": lambda tune, values: np.mean(values, axis=-1),
}


def columns_of(tune: TuneSection, study: Study) -> list[str]:
    """Columns of the summary from which the values of runs are computed."""
    truth = success_of(study).from_truth
    if tune.objective == "final_error":
        return ["run_id", "phi_u_arcmin", *([] if truth else ["floor_arcmin"])]
    return ["run_id", columns.settle_column(tune.objective_band_arcmin, truth=truth).name]


def values(tune: TuneSection, study: Study, table: pa.Table) -> NDArray:
    """The value of each run, of which the objective is a statistic.

    Args:
        tune: the objective.
        study: study of the runs.
        table: `columns_of` the summary, all runs.

    Returns:
        (variants, draws): settling time, s, or the run's length if it never settled; final heading
        error about the bias floor or the truth, arcmin; or 1 for a failure and 0 for a success.
    """
    order = np.argsort(analysis.numeric_column(table, "run_id"))
    end = study.spans_s[:, :1]
    if tune.objective == "final_error":
        yaw, *limit = (analysis.numeric_column(table, name) for name in columns_of(tune, study)[1:])
        found = np.nan_to_num(np.abs(yaw - sum(limit)), nan=np.inf)
    else:
        found = analysis.numeric_column(table, columns_of(tune, study)[1])
    by_variant = found[order].reshape(-1, study.n_variants).T
    if tune.objective == "final_error":
        return by_variant
    if tune.objective == "failure_rate":
        return np.isnan(by_variant).astype(float)
    return np.where(np.isnan(by_variant), end, by_variant)


def failing(tune: TuneSection, study: Study) -> float:
    """The objective if every run fails; infinite if it has no upper bound."""
    if tune.objective == "final_error":
        return np.inf
    end = np.ones((1, 1)) if tune.objective == "failure_rate" else study.spans_s[:, :1]
    return score(tune, end)


def score(tune: TuneSection, values: NDArray) -> float:
    """The objective of some runs, in the unit of their values.

    Args:
        tune: the objective.
        values: (variants, draws), from `values`.
    """
    each = _OVER_DRAWS[tune.objective](tune, values)
    return float(np.max(each) if tune.objective_across == "worst" else np.mean(each))


def relaxed_values(
    tune: TuneSection, criteria: Criteria, outcome: Outcome, *, truth: bool
) -> Array:
    """The values of relaxed runs, corresponding to `values` of ordinary ones.

    Args:
        tune: the objective.
        criteria: of the study, with a sharpness.
        outcome: leaves (runs, ...).
        truth: whether heading errors are about the truth rather than the bias floor.

    Returns:
        (runs, 1): settling times into a band with a soft edge, s; final heading errors about the
        bias floor or the truth, arcmin; or the degree, 0 to 1, to which the end is outside the
        band.
    """
    error = outcome.last.phi.z - (0.0 if truth else outcome.limit.phi.z)
    if tune.objective == "final_error":
        return error[:, None] / ARCMIN
    band = _band(tune, criteria)
    if tune.objective == "failure_rate":
        return jax.vmap(partial(outside, criteria))(error)[:, band, None]
    return outcome.outside_until[:, TRUTH if truth else FLOOR, band, None]


def relaxed_estimates(
    tune: TuneSection, criteria: Criteria, outcome: Outcome, told: Spread, *, truth: bool
) -> Array:
    """As `relaxed_values`, of one noise-free run of each variant and the spread about it.

    Args:
        tune: the objective.
        criteria: of the study, with a sharpness.
        outcome: leaves (runs, ...).
        told: of the runs, (runs,) being the last axis of each leaf.
        truth: whether heading errors are about the truth rather than the bias floor.

    Returns:
        (runs, samples): settling times of sampled errors, s. Else (runs, 1): rms of the final
        heading error, arcmin, or the probability that it is outside the band.
    """
    if tune.objective in ("settle_mean", "settle_quantile"):
        return jnp.moveaxis(
            told.outside_until[TRUTH if truth else FLOOR, _band(tune, criteria)], 0, 1
        )
    mean = told.phi[2, -1] - (0.0 if truth else outcome.limit.phi.z)
    sigma = told.sigma[2, -1] if truth or told.from_floor is None else told.from_floor[-1]
    if tune.objective == "final_error":
        return jnp.sqrt(mean**2 + sigma**2)[:, None] / ARCMIN
    ends = tune.objective_band_arcmin * ARCMIN
    inside = ndtr((ends - mean) / sigma) - ndtr((-ends - mean) / sigma)
    return 1.0 - inside[:, None]


def _band(tune: TuneSection, criteria: Criteria) -> Array:
    """Number of the objective's band."""
    return jnp.argmin(jnp.abs(criteria.bands - tune.objective_band_arcmin * ARCMIN))


def relaxed_score(tune: TuneSection, values: NDArray) -> tuple[Array, Array]:
    """The smooth objective of some points, and its derivatives with respect to the runs' values.

    A quantile is Harrell and Davis's (1982), a weighted mean of all values; the worst variant is
    approximated by the power mean of order 16.

    Args:
        tune: the objective.
        values: (points, variants, draws).

    Returns:
        The objective (points,) and its derivatives (points, variants, draws).
    """
    weights = np.full(values.shape[-1], 1 / values.shape[-1])
    if tune.objective == "settle_quantile":
        weights = _harrell_davis(values.shape[-1], tune.objective_quantile)
    power = _WORST if tune.objective_across == "worst" else 1
    return _smooth(tune.objective == "final_error", power, jnp.asarray(weights), values)


_WORST = 16


def _harrell_davis(n: int, q: float) -> NDArray:
    """Weights of n sorted values whose weighted sum is their quantile q."""
    edges = special.betainc((n + 1) * q, (n + 1) * (1 - q), np.arange(n + 1) / n)
    return np.diff(edges)


@partial(jax.jit, static_argnums=(0, 1))
def _smooth(squared: bool, power: int, weights: Array, values: Array) -> tuple[Array, Array]:
    def one(runs: Array) -> Array:
        if squared:
            each = jnp.sqrt(jnp.mean(runs**2, axis=-1))
        else:
            each = jnp.sort(runs, axis=-1) @ weights
        return jnp.mean(each**power) ** (1 / power)

    return jax.vmap(jax.value_and_grad(one))(values)
