"""Estimates of a study's variants without draws, as tables and as curves over time.

One noise-free run of a variant and the covariance of its true error represent all draws
(`engine.covariance`). Rows depend only on the study, like those of runs.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import columns
from sinsjax.columns import Column
from sinsjax.covariance.analysis import (
    SAMPLES_PER_BLOCK,
    ErrorCovariance,
    analysis_group,
    analysis_static,
)
from sinsjax.engine import batch
from sinsjax.engine.batch import Calls, Chunk, Plan
from sinsjax.engine.bias_floors import variants_with_floor
from sinsjax.engine.build import Scenario
from sinsjax.engine.environment import Static
from sinsjax.engine.lanes import Group
from sinsjax.engine.success import FLOOR, TRUTH
from sinsjax.errors import InputError
from sinsjax.execution import schemas
from sinsjax.execution.tables import make_table, nullable_array
from sinsjax.platform import runtime
from sinsjax.study.load import load_study
from sinsjax.study.rules import require_covariance_model
from sinsjax.study.study import Study
from sinsjax.study.success import settling_bands
from sinsjax.units import ARCMIN

DATASET = "estimates"
TILES_PER_CALL = 2
_QUANTILES = {"q10": 0.1, "median": 0.5, "q90": 0.9}
_CURVE_SAMPLES = 2
"""Sampled errors of a run; curves show none of them, so the fewest possible."""


class EstimateOutput:
    """Covariance of the true error as the output of a study's tasks, see `outputs.Output`.

    Attributes:
        schemas: columns by dataset.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Prepare the columns of a study that is estimated by covariance.

        Raises:
            InputError: curves are requested, but there are no runs.
        """
        study = scenario.study
        if scenario.curves:
            raise InputError(
                f"{study.name}: curves: a covariance estimate has no runs (leave them out)"
            )
        assert study.study.estimate_samples is not None
        self.schemas: Mapping[str, tuple[Column, ...]] = {DATASET: schemas.estimate_columns(study)}
        self._samples = study.study.estimate_samples
        self._bands = settling_bands(study)
        self._times: list[float | None] = [*study.report_times_s, None]
        self._records = report_record_indices(study)
        self._end_s = study.spans_s[:, 0]
        self._has_floor = variants_with_floor(study)
        self._by_variant = schemas.variant_columns(study, self.schemas[DATASET])

    def adapt_program(self, static: Static) -> Static:
        """Return the program of a part."""
        return analysis_static(static)

    def adapt_group(self, group: Group) -> Group:
        """Return the runs of a part for the engine."""
        return analysis_group(group, self._samples, self._records)

    def plan_calls(self, static: Static, draws: int, variants: int, tiles: int | None) -> Plan:
        """Return the division into calls; many samples need small calls, to limit the memory."""
        tiles_per_call = TILES_PER_CALL if self._samples > SAMPLES_PER_BLOCK else tiles
        return Plan(static, draws, variants, tiles_per_chunk=tiles_per_call)

    def make_calls(self, group: Group, tiles: int | None) -> Calls:
        """Return the calls of such a plan."""
        tiles_per_call = TILES_PER_CALL if self._samples > SAMPLES_PER_BLOCK else tiles
        return Calls(group, tiles_per_chunk=tiles_per_call)

    def make_tables(self, chunk: Chunk, variant_ids: NDArray) -> dict[str, pa.Table]:
        """Return the estimates of a chunk, one row per variant.

        Args:
            chunk: engine results, with `ErrorCovariance`.
            variant_ids: (variants of the part,) their numbers in the study.
        """
        spread, variant = chunk.curves, variant_ids[chunk.variant]
        assert isinstance(spread, ErrorCovariance)
        has_floor = self._has_floor[variant]
        floor = np.where(has_floor, chunk.outcome.floor.phi.z, np.nan)
        values: dict[str, Any] = {"variant_id": variant}
        values |= {name: column.take(variant) for name, column in self._by_variant.items()}
        for place, time_s in enumerate(self._times):
            phi, sigma, believed_sigma = (np.asarray(a)[:, :, place] for a in spread[:3])
            sigma_about_floor = (
                None if spread.from_floor is None else np.asarray(spread.from_floor)[:, place]
            )
            names = (
                c.name
                for c in columns.estimate_columns(
                    self._bands, time_s, floors_vary=sigma_about_floor is not None
                )
            )
            values |= zip(
                names,
                self._time_columns(phi, sigma, believed_sigma, floor, sigma_about_floor),
                strict=True,
            )
        outside_until = np.ascontiguousarray(spread.outside_until)  # sums of one order, however cut
        for truth, centre in ((False, FLOOR), (True, TRUTH)):
            for number, band in enumerate(self._bands):
                settled = settling_statistics(
                    outside_until[:, centre, number], self._end_s[variant]
                )
                known = has_floor if centre == FLOOR else np.ones_like(has_floor)
                names = (c.name for c in columns.settle_estimate_columns(band, truth=truth))
                cells = (nullable_array(np.where(known, value, np.nan)) for value in settled)
                values |= zip(names, cells, strict=True)
        values |= {"has_floor": pa.array(has_floor), "floor_arcmin": nullable_array(floor / ARCMIN)}
        # `linearity` fills these later.
        for column in self.schemas[DATASET]:
            values.setdefault(column.name, pa.nulls(len(variant), column.dtype))
        return {DATASET: make_table(self.schemas[DATASET], values)}

    def count_failures(self, tables: Mapping[str, pa.Table]) -> int:
        """Return the number of variants whose noise-free run became non-finite."""
        return tables[DATASET]["phi_u_arcmin"].null_count

    def _time_columns(
        self,
        phi: NDArray,
        sigma: NDArray,
        believed_sigma: NDArray,
        floor: NDArray,
        sigma_about_floor: NDArray | None,
    ) -> list[pa.Array]:
        """Return the columns of one time from phi, sigma and belief (runs, 3), and floor (runs,).

        All in rad, in the order of `columns.estimate_columns`; see `ErrorCovariance.from_floor`.
        """
        angles = [*(np.concatenate([phi, sigma, believed_sigma], axis=1).T / ARCMIN)]
        sigma_used = sigma[:, 2]
        if sigma_about_floor is not None:
            sigma_used = np.where(np.isnan(floor), np.nan, sigma_about_floor)
            angles.append(sigma_used / ARCMIN)
        shares = [
            _probability_within(band * ARCMIN, phi[:, 2] - centre, spread)
            for centre, spread in ((floor, sigma_used), (np.zeros_like(floor), sigma[:, 2]))
            for band in self._bands
        ]
        return [nullable_array(values) for values in (*angles, *shares)]


def report_record_indices(study: Study) -> NDArray:
    """Return the indices of the records at the report times and at the end."""
    interval_s = study.record_every / study.rate_hz
    numbers = [round(time_s / interval_s) - 1 for time_s in study.report_times_s]
    return np.array([*numbers, study.records - 1])


def _probability_within(band: float, mean: NDArray, sigma: NDArray) -> NDArray:
    """Return P(|error| <= band) of normal errors, (runs,)."""
    from scipy.special import ndtr  # late: takes 0.1 s, and few studies need it

    with np.errstate(divide="ignore", invalid="ignore"):  # without noise: inside or outside
        return ndtr((band - mean) / sigma) - ndtr((-band - mean) / sigma)


def settling_statistics(
    outside_until_s: NDArray, end_s: NDArray, *, antithetic: bool = True
) -> tuple[NDArray, ...]:
    """Return mean, standard error and quantiles of settling times, in the order of their columns.

    Args:
        outside_until_s: (runs, samples) end of the last interval outside the band, s.
        end_s: (runs,) lengths, s.
        antithetic: whether the second half of the samples has the opposite noise of the first.
    """
    independent = (
        np.mean(np.split(outside_until_s, 2, axis=1), axis=0) if antithetic else outside_until_s
    )
    error = independent.std(axis=1, ddof=1) / np.sqrt(independent.shape[1])
    settled = np.where(outside_until_s >= end_s[:, None] * (1 - 1e-12), np.inf, outside_until_s)
    quantiles = np.quantile(settled, list(_QUANTILES.values()), axis=1, method="inverted_cdf")
    return (outside_until_s.mean(axis=1), error, *quantiles)


def estimated_curves(study: Study | str | Path) -> pa.Table:
    """Run covariance analysis of a study's variants over time, in memory.

    Args:
        study: study for which covariance analysis holds, with or without draws, its
            file, or the name of a shipped study.

    Returns:
        One row per variant and record time: the misalignment of the noise-free run, its 1 sigma
        over the noise, and the method's own sigma. The schema has units and meanings.

    Raises:
        InputError: covariance analysis does not hold for the study.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.rate_hz": 10.0})
        >>> curves = sinsjax.estimated_curves(study)
        >>> curves.num_rows, curves.column_names[:3]
        (2700, ['variant_id', 'time_s', 'phi_e_arcmin'])
    """
    runtime.ensure_configured()
    study = load_study(study)
    require_covariance_model(study)
    scenario = Scenario(study)
    tables = []
    for number, ids in enumerate(scenario.variant_ids):
        group = analysis_group(scenario.part(number, range(1)).group, _CURVE_SAMPLES)
        tables += [
            _make_curve_table(study, chunk, ids[chunk.variant]) for chunk in batch.run_chunks(group)
        ]
    order = [("variant_id", "ascending"), ("time_s", "ascending")]
    return pa.concat_tables(tables).sort_by(order)


def _make_curve_table(study: Study, chunk: Chunk, variant: NDArray) -> pa.Table:
    spread = chunk.curves
    assert isinstance(spread, ErrorCovariance)
    runs, _, records = np.shape(spread.phi)
    times = np.arange(1, records + 1) * (study.record_every / study.rate_hz)
    angles = np.concatenate(spread[:3], axis=1) / ARCMIN  # (runs, 9, records)
    layout = columns.ESTIMATED_CURVES
    names = (c.name for c in layout[2:])
    values = {"variant_id": np.repeat(variant, records), "time_s": np.tile(times, runs)}
    values |= zip(
        names, (nullable_array(angle.ravel()) for angle in np.moveaxis(angles, 1, 0)), strict=True
    )
    return make_table(layout, values)
