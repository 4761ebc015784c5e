"""What points are worth by covariance analysis: one noise-free run of each stands for all draws."""

import numpy as np
from numpy.typing import NDArray

from sinsjax.engine import batch, covariance
from sinsjax.engine.build import Scenario
from sinsjax.engine.verdicts import FLOOR, TRUTH
from sinsjax.methods.registry import METHODS
from sinsjax.study.schema import TuneSection
from sinsjax.study.study import Study
from sinsjax.study.success import settling_bands, success_criteria
from sinsjax.tuning import search
from sinsjax.units import ARCMIN

SAMPLES = 64
"""Errors sampled per point and variant."""


def values(study: Study, tune: TuneSection) -> NDArray:
    """`objective.values` of sampled errors, (variants, samples), from one run of each variant."""
    scenario = Scenario(study, curves=True)
    kind = TRUTH if success_criteria(study).from_truth else FLOOR
    at = int(np.argmin(np.abs(np.asarray(settling_bands(study)) - tune.objective_band_arcmin)))
    out = np.empty((study.n_variants, SAMPLES))
    end = study.spans_s[:, 0]
    for number, ids in enumerate(scenario.variant_ids):
        group = covariance.watched(scenario.part(number, range(1)).group, SAMPLES)
        for chunk in batch.chunks(group, devices=2):
            out[ids[chunk.variant]] = _of_chunk(tune, chunk, kind, at, end[ids[chunk.variant]])
    return out


def _of_chunk(tune: TuneSection, chunk: batch.Chunk, kind: int, band: int, end: NDArray) -> NDArray:
    told = chunk.curves
    assert isinstance(told, covariance.Spread)
    settled: NDArray = told.outside_until[:, kind, band]
    if tune.objective == "final_error":
        mean = told.phi[:, 2, -1] - (chunk.outcome.limit.phi.z if kind == FLOOR else 0.0)
        sigma = told.sigma[:, 2, -1]
        if kind == FLOOR and told.from_floor is not None:
            sigma = told.from_floor[:, -1]
        return np.repeat(np.hypot(mean, sigma)[:, None] / ARCMIN, settled.shape[1], axis=1)
    if tune.objective == "failure_rate":
        return (settled >= end[:, None]).astype(float)
    return settled


def steps(study: Study) -> float:
    """What `values` costs, in steps of a plain run."""
    return runs(study) * search.cost(study) / study.n_draws


def runs(study: Study) -> float:
    """What an estimate costs in plain runs of its variant, of the dearest method."""
    return max(METHODS[name].estimate_runs for name in study.methods)
