"""Early stopping of a study by ``[stop_when]``.

Interim analyses occur at fixed numbers of draws and use all rows of those draws, so the result does
not depend on chunks, workers or their order.
"""

import math

import pyarrow as pa

from sinsjax import columns
from sinsjax.study import success
from sinsjax.study.study import Study

FIRST_INTERIM = 64
"""Draws at the first interim analysis; each further one doubles them."""


def interim_draws(study: Study) -> list[int]:
    """Return the numbers of draws at the interim analyses; the last is the maximum."""
    ends = [FIRST_INTERIM if study.stop_when else study.n_draws]
    while ends[-1] < study.n_draws:
        ends.append(2 * ends[-1])
    return [*ends[:-1], study.n_draws]


def required_columns(study: Study) -> list[str]:
    """Return the columns of the summary that an interim analysis needs, that of its value last."""
    assert study.stop_when is not None
    name = study.stop_when.statistic
    if name == "success_rate":
        return ["run_id", "draw_id", "variant_id", "status"]
    truth = success.success_criteria(study).from_truth
    bands = {
        f"{columns.settle_column(band).name}_mean": columns.settle_column(band, truth=truth).name
        for band in success.settling_bands(study)
    }
    return ["run_id", "draw_id", "variant_id", bands[name]]


def widest_half_width(study: Study, table: pa.Table, draws: int) -> float:
    """Return the largest half width over the variants of the statistic's 95 % interval.

    It is infinite if a variant has too few settled runs for an interval.

    Args:
        study: study with [stop_when].
        table: `required_columns` of the summary in any order, with all runs of the first draws.
        draws: number of draws to analyse.
    """
    # Late: scipy takes a quarter of a second, and few studies need it.
    from sinsjax import analysis

    rows = table.filter(pa.compute.less(table["draw_id"], draws)).sort_by("run_id")
    column, widest = required_columns(study)[-1], 0.0
    for _, runs in analysis.group_rows(rows, ["variant_id"]):
        if column == "status":
            estimate = analysis.share(analysis.numeric_column(runs, "status=ok"))
        else:
            estimate = analysis.mean(analysis.numeric_column(runs, column))
        half = (estimate.high - estimate.low) / 2
        widest = max(widest, math.inf if math.isnan(half) else half)
    return widest
