"""When enough draws have been run: the rule of ``[stop_when]``.

It looks at fixed numbers of draws only, at all rows below that number: so it stops at the same
place for any chunk, worker and order.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import pyarrow as pa

from sinsjax import columns as layout
from sinsjax.study import success
from sinsjax.study.study import Study

if TYPE_CHECKING:
    from sinsjax.analysis import Estimate

FIRST_INTERIM = 64
"""Draws at the first look; each further one is at twice as many."""


class InterimAnalysis(NamedTuple):
    """What a look at the rows found.

    Attributes:
        draws: looked at.
        half_width: the widest over the variants, of the statistic's 95 % interval; infinite where
            a variant has too few settled runs for one.
        enough: whether it is narrow enough.
    """

    draws: int
    half_width: float
    enough: bool


def interim_draws(study: Study) -> list[int]:
    """Numbers of draws after which is looked, the last one being the most."""
    if study.stop_when is None:
        return [study.n_draws]
    ends = [FIRST_INTERIM]
    while ends[-1] < study.n_draws:
        ends.append(2 * ends[-1])
    return [*ends[:-1], study.n_draws]


def columns(study: Study) -> list[str]:
    """Columns of the summary that a look needs."""
    assert study.stop_when is not None
    return ["run_id", "draw_id", "variant_id", _needed(study)]


def _needed(study: Study) -> str:
    """The column of the summary that the statistic is made of: from truth or limit, as judged."""
    assert study.stop_when is not None
    name = study.stop_when.statistic
    if name == "success_rate":
        return "status"
    truth = success.success_of(study).from_truth
    return next(
        layout.settle_column(band, truth=truth).name
        for band in success.bands(study)
        if name == f"{layout.settle_column(band).name}_mean"
    )


def analyse_interim(study: Study, table: pa.Table, draws: int) -> InterimAnalysis:
    """Judge the rows of the first draws.

    Args:
        study: with [stop_when].
        table: `columns` of the summary, in any order, all runs of the draws at least.
        draws: how many.
    """
    from sinsjax import analysis  # late: scipy takes a quarter of a second, and few studies ask

    assert study.stop_when is not None
    rows = table.filter(pa.compute.less(table["draw_id"], draws)).sort_by("run_id")
    name = study.stop_when.statistic
    widths = []
    for _, own in analysis.groups(rows, ["variant_id"]):
        if name == "success_rate":
            found = analysis.proportion(own["status"].to_pylist().count("ok"), own.num_rows)
        else:
            found = analysis.mean(analysis.numbers(own, _needed(study)))
        widths.append(_half_width(found))
    widest = max(widths)
    return InterimAnalysis(draws, widest, widest <= study.stop_when.half_width)


def _half_width(estimate: "Estimate") -> float:
    half = (estimate.high - estimate.low) / 2
    return math.inf if math.isnan(half) else half
