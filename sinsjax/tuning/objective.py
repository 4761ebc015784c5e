"""Objective of a tuning run: a value for each run, and one score for all runs of a point."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy import special

from sinsjax import analysis, columns
from sinsjax.engine.metrics import Criteria, Outcome, outside
from sinsjax.execution.success import FLOOR, TRUTH
from sinsjax.study.schema import TuneSection
from sinsjax.study.study import Study
from sinsjax.study.success import success_criteria
from sinsjax.types import Array
from sinsjax.units import ARCMIN


def summary_columns(tune: TuneSection, study: Study) -> list[str]:
    """Return the columns of the summary from which the values of runs are computed."""
    truth = success_criteria(study).from_truth
    if tune.objective == "final_error":
        return ["run_id", "phi_u_arcmin", *([] if truth else ["floor_arcmin"])]
    return ["run_id", columns.settle_column(tune.objective_band_arcmin, truth=truth).name]


def run_values(tune: TuneSection, study: Study, table: pa.Table) -> NDArray:
    """Return the value of each run, of which the objective is a statistic.

    Args:
        tune: the objective.
        study: study of the runs.
        table: `summary_columns` of the summary, all runs.

    Returns:
        (variants, draws): settling time, s, or the run's length if it never settled; final heading
        error about the bias floor or the truth, arcmin; or 1 for a failure and 0 for a success.
    """
    order = np.argsort(analysis.numeric_column(table, "run_id"))
    numbers = [
        analysis.numeric_column(table, name)[order].reshape(-1, study.n_variants).T
        for name in summary_columns(tune, study)[1:]
    ]
    if tune.objective == "final_error":
        yaw, *floor = numbers
        return np.nan_to_num(np.abs(yaw - sum(floor)), nan=np.inf)
    (settled,) = numbers
    if tune.objective == "failure_rate":
        return np.isnan(settled).astype(float)
    return np.where(np.isnan(settled), study.spans_s[:, :1], settled)


def failure_score(tune: TuneSection, study: Study) -> float:
    """Return the objective if every run fails; infinite if it has no upper bound."""
    if tune.objective == "final_error":
        return np.inf
    end = np.ones((1, 1)) if tune.objective == "failure_rate" else study.spans_s[:, :1]
    return score(tune, end)


def score(tune: TuneSection, values: NDArray) -> float:
    """Return the objective of some runs, (variants, draws) `run_values`, in their unit."""
    if tune.objective == "settle_quantile":
        q = tune.objective_quantile
        by_variant = np.quantile(values, q, axis=-1, method="inverted_cdf")
    elif tune.objective == "final_error":
        by_variant = np.sqrt(np.mean(values**2, axis=-1))
    else:
        by_variant = np.mean(values, axis=-1)
    worst = tune.objective_across == "worst"
    return float(np.max(by_variant) if worst else np.mean(by_variant))


def relaxed_values(
    tune: TuneSection, criteria: Criteria, outcome: Outcome, *, from_truth_not_floor: bool
) -> Array:
    """Return the values of relaxed runs, corresponding to `run_values` of ordinary ones.

    Args:
        tune: the objective.
        criteria: of the study, with a sharpness.
        outcome: leaves (runs, ...).
        from_truth_not_floor: whether heading errors are about the truth rather than the bias floor.

    Returns:
        (runs,) settling times into a band with a soft edge, s; final heading errors about the
        bias floor or the truth, arcmin; or the degree, 0 to 1, to which the end is outside the
        band.
    """
    error = outcome.last.phi.z - (0.0 if from_truth_not_floor else outcome.floor.phi.z)
    if tune.objective == "final_error":
        return error / ARCMIN
    band = jnp.argmin(jnp.abs(criteria.bands - tune.objective_band_arcmin * ARCMIN))
    if tune.objective == "failure_rate":
        return jax.vmap(partial(outside, criteria))(error)[:, band]
    return outcome.outside_until[:, TRUTH if from_truth_not_floor else FLOOR, band]


def relaxed_score(tune: TuneSection, values: NDArray) -> tuple[Array, Array]:
    """Return the smooth objective of some points, and its derivatives by the runs' values.

    A quantile is Harrell and Davis's (1982), a weighted mean of all values; the worst variant is
    approximated by the power mean of order 16. Of (points, variants, draws) values it returns the
    objective (points,) and its derivatives (points, variants, draws).
    """
    weights = np.full(values.shape[-1], 1 / values.shape[-1])
    if tune.objective == "settle_quantile":
        weights = _harrell_davis_weights(values.shape[-1], tune.objective_quantile)
    power = _WORST if tune.objective_across == "worst" else 1
    return _smooth_score(tune.objective == "final_error", power, jnp.asarray(weights), values)


_WORST = 16


def _harrell_davis_weights(n: int, q: float) -> NDArray:
    """Return weights of n sorted values whose weighted sum is their quantile q."""
    edges = special.betainc((n + 1) * q, (n + 1) * (1 - q), np.arange(n + 1) / n)
    return np.diff(edges)


@partial(jax.jit, static_argnums=(0, 1))
def _smooth_score(squared: bool, power: int, weights: Array, values: Array) -> tuple[Array, Array]:
    def point_score(runs: Array) -> Array:
        if squared:
            by_variant = jnp.sqrt(jnp.mean(runs**2, axis=-1))
        else:
            by_variant = jnp.sort(runs, axis=-1) @ weights
        return jnp.mean(by_variant**power) ** (1 / power)

    return jax.vmap(jax.value_and_grad(point_score))(values)
