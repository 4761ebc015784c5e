"""Early stopping of a study by ``[stop_when]``.

Interim analyses occur at fixed numbers of draws and use all rows of those draws, so the result does
not depend on chunks, workers or their order.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import pyarrow as pa

from sinsjax import columns as result_columns
from sinsjax.study import success
from sinsjax.study.study import Study

if TYPE_CHECKING:
    from sinsjax.analysis import Estimate

FIRST_INTERIM = 64
"""Draws at the first interim analysis; each further one doubles them."""


class InterimAnalysis(NamedTuple):
    """Result of an interim analysis.

    Attributes:
        draws: number of draws analysed.
        half_width: largest half width over the variants of the statistic's 95 % interval; infinite
            if a variant has too few settled runs for an interval.
        is_sufficient: whether that is narrow enough to stop.
    """

    draws: int
    half_width: float
    is_sufficient: bool


def interim_draws(study: Study) -> list[int]:
    """Return the numbers of draws at the interim analyses; the last is the maximum."""
    if study.stop_when is None:
        return [study.n_draws]
    ends = [FIRST_INTERIM]
    while ends[-1] < study.n_draws:
        ends.append(2 * ends[-1])
    return [*ends[:-1], study.n_draws]


def required_columns(study: Study) -> list[str]:
    """Return the columns of the summary that an interim analysis needs."""
    assert study.stop_when is not None
    return ["run_id", "draw_id", "variant_id", _statistic_column(study)]


def _statistic_column(study: Study) -> str:
    """Return the column of the statistic, about truth or floor as the success criterion demands."""
    assert study.stop_when is not None
    name = study.stop_when.statistic
    if name == "success_rate":
        return "status"
    truth = success.success_criteria(study).from_truth
    return next(
        result_columns.settle_column(band, truth=truth).name
        for band in success.settling_bands(study)
        if name == f"{result_columns.settle_column(band).name}_mean"
    )


def analyse_interim(study: Study, table: pa.Table, draws: int) -> InterimAnalysis:
    """Analyse the rows of the first draws.

    Args:
        study: study with [stop_when].
        table: `required_columns` of the summary in any order, with all runs of these draws.
        draws: number of draws.
    """
    # Late: scipy takes a quarter of a second, and few studies need it.
    from sinsjax import analysis

    assert study.stop_when is not None
    rows = table.filter(pa.compute.less(table["draw_id"], draws)).sort_by("run_id")
    name = study.stop_when.statistic
    widths = []
    for _, variant_rows in analysis.group_rows(rows, ["variant_id"]):
        if name == "success_rate":
            estimate = analysis.proportion(
                variant_rows["status"].to_pylist().count("ok"), variant_rows.num_rows
            )
        else:
            estimate = analysis.mean(
                analysis.numeric_column(variant_rows, _statistic_column(study))
            )
        widths.append(_half_width(estimate))
    widest = max(widths)
    return InterimAnalysis(draws, widest, widest <= study.stop_when.half_width)


def _half_width(estimate: "Estimate") -> float:
    half = (estimate.high - estimate.low) / 2
    return math.inf if math.isnan(half) else half
