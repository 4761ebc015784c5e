"""Estimates of a study's variants without draws, as tables and as curves over time.

One noise-free run of a variant, and the covariance of the true error beside it, stand for all draws
(`engine.covariance`). Rows depend only on the study, as those of runs do.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import columns
from sinsjax.columns import Column
from sinsjax.engine import batch
from sinsjax.engine.batch import Calls, Chunk, Plan
from sinsjax.engine.build import Scenario
from sinsjax.engine.covariance import MOST_TOGETHER, Spread, watched, watched_program
from sinsjax.engine.lanes import Group
from sinsjax.engine.realisations import Static
from sinsjax.engine.study_limits import limited_variants
from sinsjax.engine.verdicts import FLOOR, TRUTH
from sinsjax.errors import InputError
from sinsjax.execution import layouts
from sinsjax.execution.tables import nullable, table_of
from sinsjax.platform import runtime
from sinsjax.study.load import load_study
from sinsjax.study.rules import require_modelled
from sinsjax.study.study import Study
from sinsjax.study.success import bands
from sinsjax.units import ARCMIN

DATASET = "estimates"
FEW_TILES = 2
_QUANTILES = {"q10": 0.1, "median": 0.5, "q90": 0.9}
_CURVE_SAMPLES = 2
"""Sampled errors of a run, none of which curves show: the fewest."""


class Estimates:
    """The covariance of the true error as the output of a study's tasks, see `outputs.Output`.

    Attributes:
        layouts: columns by dataset.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Take a study that is estimated by covariance.

        Raises:
            InputError: curves are asked for where there are no runs.
        """
        study = scenario.study
        if scenario.curves:
            raise InputError(f"{study.name}: a covariance estimate has no runs with curves to keep")
        assert study.study.estimate_samples is not None
        self.layouts: Mapping[str, tuple[Column, ...]] = {DATASET: layouts.estimates(study)}
        self._samples = study.study.estimate_samples
        self._bands = bands(study)
        self._times: list[float | None] = [*study.report_times_s, None]
        self._records = told_records(study)
        self._end_s = study.spans_s[:, 0]
        self._limited = limited_variants(study)
        self._by_variant = layouts.of_variants(study, self.layouts[DATASET])

    def program(self, static: Static) -> Static:
        """The program of a part."""
        return watched_program(static, self._samples)

    def group(self, group: Group) -> Group:
        """What the engine runs of a part."""
        return watched(group, self._samples, self._records)

    def plan(self, static: Static, draws: int, count: int, tiles: int | None) -> Plan:
        """See `Output`; many samples would fill the memory."""
        few = FEW_TILES if self._samples > MOST_TOGETHER else tiles
        return Plan(static, draws, count, tiles_a_chunk=few)

    def calls(self, group: Group, tiles: int | None) -> Calls:
        """See `Output`."""
        few = FEW_TILES if self._samples > MOST_TOGETHER else tiles
        return Calls(group, tiles_a_chunk=few)

    def tables(self, chunk: Chunk, variant_ids: NDArray) -> dict[str, pa.Table]:
        """Estimates of a chunk, one row per variant.

        Args:
            chunk: engine results, with `Spread`.
            variant_ids: (variants of the part,) their numbers in the study.
        """
        spread, variant = chunk.curves, variant_ids[chunk.variant]
        assert isinstance(spread, Spread)
        limited = self._limited[variant]
        floor = np.where(limited, chunk.outcome.limit.phi.z, np.nan)
        values: dict[str, Any] = {"variant_id": variant}
        values |= {name: column.take(variant) for name, column in self._by_variant.items()}
        for place, time_s in enumerate(self._times):
            phi, sigma, belief = (np.asarray(a)[:, :, place] for a in spread[:3])
            own = None if spread.from_floor is None else np.asarray(spread.from_floor)[:, place]
            names = (
                c.name
                for c in columns.estimate_columns(self._bands, time_s, floors_vary=own is not None)
            )
            values |= zip(names, self._at(phi, sigma, belief, floor, own), strict=True)
        until = np.ascontiguousarray(spread.outside_until)  # sums of one order, however cut
        for truth, about in ((False, FLOOR), (True, TRUTH)):
            for number, band in enumerate(self._bands):
                settled = settled_of(until[:, about, number], self._end_s[variant])
                known = limited if about == FLOOR else np.ones_like(limited)
                names = (c.name for c in columns.settle_estimate_columns(band, truth=truth))
                cells = (nullable(np.where(known, value, np.nan)) for value in settled)
                values |= zip(names, cells, strict=True)
        values |= {"has_floor": pa.array(limited), "floor_arcmin": nullable(floor / ARCMIN)}
        # Those of the check of linearity are still to come.
        for column in self.layouts[DATASET]:
            values.setdefault(column.name, pa.nulls(len(variant), column.dtype))
        return {DATASET: table_of(self.layouts[DATASET], values)}

    def failures(self, tables: Mapping[str, pa.Table]) -> int:
        """Number of variants whose noise-free run became non-finite."""
        return tables[DATASET]["phi_u_arcmin"].null_count

    def _at(
        self,
        phi: NDArray,
        sigma: NDArray,
        belief: NDArray,
        floor: NDArray,
        from_floor: NDArray | None,
    ) -> list[pa.Array]:
        """Columns of one time from misalignment, 1 sigma and belief (runs, 3), and floor (runs,).

        All of them rad, in the order of `columns.estimate_columns`; ``from_floor`` as of `Spread`.
        """
        angles = [*(np.concatenate([phi, sigma, belief], axis=1).T / ARCMIN)]
        about_floor = sigma[:, 2]
        if from_floor is not None:
            about_floor = np.where(np.isnan(floor), np.nan, from_floor)
            angles.append(about_floor / ARCMIN)
        shares = [
            _share_within(band * ARCMIN, phi[:, 2] - centre, spread)
            for centre, spread in ((floor, about_floor), (np.zeros_like(floor), sigma[:, 2]))
            for band in self._bands
        ]
        return [nullable(one) for one in (*angles, *shares)]


def told_records(study: Study) -> NDArray:
    """Numbers, from 0, of the records at the report times and at the end."""
    every_s = study.record_every / study.rate_hz
    numbers = [round(time_s / every_s) - 1 for time_s in study.report_times_s]
    return np.array([*numbers, study.records - 1])


def _share_within(band: float, mean: NDArray, sigma: NDArray) -> NDArray:
    """P(|error| <= band) of normal errors, (runs,)."""
    from scipy.special import ndtr  # late: a tenth of a second, which studies of draws do not need

    with np.errstate(divide="ignore", invalid="ignore"):  # without noise: inside or outside
        return ndtr((band - mean) / sigma) - ndtr((-band - mean) / sigma)


def settled_of(until_s: NDArray, end_s: NDArray, *, opposite: bool = True) -> tuple[NDArray, ...]:
    """Mean, its standard error, and quantiles of settling times, in the order of their columns.

    Args:
        until_s: (runs, samples) end of the last interval outside the band, s.
        end_s: (runs,) lengths, s.
        opposite: whether the second half of the samples has the opposite noise of the first.
    """
    apart = np.mean(np.split(until_s, 2, axis=1), axis=0) if opposite else until_s
    error = apart.std(axis=1, ddof=1) / np.sqrt(apart.shape[1])
    settled = np.where(until_s >= end_s[:, None] * (1 - 1e-12), np.inf, until_s)
    quantiles = np.quantile(settled, list(_QUANTILES.values()), axis=1, method="inverted_cdf")
    return (until_s.mean(axis=1), error, *quantiles)


def estimated_curves(study: Study | str | Path) -> pa.Table:
    """Covariance analysis of a study's variants over time, in memory.

    Args:
        study: study for which covariance analysis holds, with draws of its own or without, its
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
    require_modelled(study)
    scenario = Scenario(study)
    tables = []
    for number, ids in enumerate(scenario.variant_ids):
        group = watched(scenario.part(number, range(1)).group, _CURVE_SAMPLES)
        tables += [_curve_table(study, chunk, ids[chunk.variant]) for chunk in batch.chunks(group)]
    order = [("variant_id", "ascending"), ("time_s", "ascending")]
    return pa.concat_tables(tables).sort_by(order)


def _curve_table(study: Study, chunk: Chunk, variant: NDArray) -> pa.Table:
    spread = chunk.curves
    assert isinstance(spread, Spread)
    runs, _, records = np.shape(spread.phi)
    times = np.arange(1, records + 1) * (study.record_every / study.rate_hz)
    angles = np.concatenate(spread[:3], axis=1) / ARCMIN  # (runs, 9, records)
    layout = columns.ESTIMATED_CURVES
    names = (c.name for c in layout[2:])
    values = {"variant_id": np.repeat(variant, records), "time_s": np.tile(times, runs)}
    values |= zip(names, (nullable(one.ravel()) for one in np.moveaxis(angles, 1, 0)), strict=True)
    return table_of(layout, values)
