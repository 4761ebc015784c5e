"""Mean and spread of a study's errors over time, without draws, in memory."""

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import columns
from sinsjax.engine import batch
from sinsjax.engine.build import Scenario
from sinsjax.engine.covariance import Spread, watched
from sinsjax.execution.tables import nullable, table_of
from sinsjax.platform import runtime
from sinsjax.study.estimating import require_modelled
from sinsjax.study.study import Study
from sinsjax.units import ARCMIN

_SAMPLES = 2
"""Sampled errors of a run, of which nothing is told here: the fewest."""


def estimated_curves(study: Study) -> pa.Table:
    """Covariance analysis of a study's variants over time, in memory.

    Args:
        study: checked study for which covariance analysis holds, with draws of its own or without.

    Returns:
        One row per variant and record time: the misalignment of the noise-free run, its 1 sigma
        over the noise, and the method's own sigma. The schema has units and meanings.

    Raises:
        InputError: covariance analysis does not hold for the study.
    """
    runtime.ensure_configured()
    require_modelled(study)
    scenario = Scenario(study)
    tables = []
    for number, ids in enumerate(scenario.variant_ids):
        group = watched(scenario.part(number, range(1)).group, _SAMPLES)
        tables += [_table(study, chunk, ids[chunk.variant]) for chunk in batch.chunks(group)]
    order = [("variant_id", "ascending"), ("time_s", "ascending")]
    return pa.concat_tables(tables).sort_by(order)


def _table(study: Study, chunk: batch.Chunk, variant: NDArray) -> pa.Table:
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
