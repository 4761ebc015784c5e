"""Statistics of a study's draws, controlled by companions whose expectation is known."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import columns
from sinsjax.analysis import Estimate
from sinsjax.analysis.controlled import (
    Expectation,
    controlled_mean,
    controlled_rms,
    controlled_share,
    samples_needed,
)
from sinsjax.execution import layouts
from sinsjax.execution.layouts import Statistic
from sinsjax.execution.tables import nullable, with_column
from sinsjax.study.study import Study
from sinsjax.study.times import spans_s

ESTIMATE = {"settle": controlled_mean, "within": controlled_share, "rms": controlled_rms}
"""By the kind of a statistic."""

SHARE = 0.05
"""Of the variance of a controlled mean: that of the companions' expectation stays below."""

MOST_ROUNDS = 16
"""The most that the sampled errors of an expectation are multiplied by for that."""


class Draws(NamedTuple):
    """The runs of one variant, (draws,) by column of the summary; null as NaN.

    Attributes:
        rows: by column.
        end_s: length of the run, s.
    """

    rows: dict[str, NDArray]
    end_s: float

    def of(self, one: Statistic, whose: str = "") -> NDArray:
        """What a statistic is the mean of, (draws,); ``whose`` is "companion_" for companions'."""
        if one.kind == "settle":
            return np.nan_to_num(self.rows[f"{whose}{one.column}"], nan=self.end_s)
        phi = self.rows[f"{whose}phi_u{one.at}_arcmin"]
        error = phi if one.truth else phi - self.rows["floor_arcmin"]
        if one.kind == "rms":
            return error
        within = (np.abs(error) <= one.band_arcmin).astype(float)
        return np.where(np.isnan(error) & np.isfinite(phi), np.nan, within)


def needed(study: Study) -> list[str]:
    """Columns of the summary that the statistics are made of."""
    own = [column.name for column in layouts.of_companions(study)]
    values = [name.removeprefix("companion_") for name in own]
    return ["draw_id", "variant_id", "floor_arcmin", *values, *own]


def rounds(study: Study, summary: pa.Table, of: Sequence[Statistic] | None = None) -> int:
    """How many times as many sampled errors the expectations of some variants need.

    Args:
        study: with companions.
        summary: the columns `needed` of all their runs, in any order.
        of: for which settling times; None for all.
    """
    settled = [one for one in of or layouts.controlled(study) if one.kind == "settle"]
    most = max(
        samples_needed(draws.of(one), draws.of(one, "companion_"), SHARE)
        for draws in by_variant(study, summary)
        for one in settled
    )
    assert study.study.estimate_samples is not None
    return max(1, math.ceil(min(MOST_ROUNDS, most / study.study.estimate_samples)))


def before_the_end(study: Study, settled: str, rows: pa.Table) -> Estimate:
    """The mean of a settling time from the draws of a variant so far.

    Only its interval is worth anything: the expectation of the companions is still to come, with
    the error that `rounds` leaves it.

    Args:
        study: with companions.
        settled: column of the settling time.
        rows: `draw_id`, `variant_id`, that column and its companion's.
    """
    (one,) = (s for s in layouts.controlled(study) if s.kind == "settle" and s.column == settled)
    (draws,) = by_variant(study, rows)
    y, x = draws.of(one), draws.of(one, "companion_")
    samples = rounds(study, rows, [one]) * (study.study.estimate_samples or 1)
    error = float(np.std(x, ddof=1)) / math.sqrt(samples)
    return controlled_mean(y, x, Expectation(float(np.mean(x)), error)).controlled


def pooled(study: Study, tables: list[pa.Table]) -> pa.Table:
    """Estimates from all rounds of sampled errors: means, and quantiles of the first round."""
    whole = tables[0]
    for one in layouts.controlled(study):
        if one.kind == "settle":
            mean, error = (f"{one.settled}_{what}_s" for what in ("mean", "mean_error"))
            for name, divisor in ((mean, 1.0), (error, math.sqrt(len(tables)))):
                values = [t[name].to_numpy(zero_copy_only=False) for t in tables]
                whole = with_column(whole, name, nullable(np.mean(values, axis=0) / divisor))
    return whole


def concluded(study: Study, estimates: pa.Table, summary: pa.Table) -> pa.Table:
    """Estimates of variants, with the statistics of their draws.

    Args:
        study: with companions.
        estimates: of some variants, ordered by variant_id, statistics still to come.
        summary: the columns `needed` of all their runs, in any order.
    """
    statistics = layouts.controlled(study)
    found = [
        [_statistic(one, draws, estimate) for one in statistics]
        for draws, estimate in zip(by_variant(study, summary), estimates.to_pylist(), strict=True)
    ]
    for number, one in enumerate(statistics):
        cells = np.array([row[number] for row in found]).T
        for column, values in zip(one.columns, cells, strict=True):
            estimates = with_column(estimates, column.name, nullable(values))
    draws = summary.num_rows // estimates.num_rows
    return with_column(estimates, columns.DRAWS.name, nullable(np.full(estimates.num_rows, draws)))


def by_variant(study: Study, summary: pa.Table) -> Iterator[Draws]:
    """The draws of each variant, in the order of the variants."""
    ends = spans_s(study)[:, 0]
    summary = summary.sort_by([("variant_id", "ascending"), ("draw_id", "ascending")])
    rows = {n: summary[n].to_numpy(zero_copy_only=False) for n in summary.column_names}
    ids = rows.pop("variant_id")
    bounds = np.flatnonzero(np.diff(ids, prepend=-1))
    for first, last in zip(bounds, [*bounds[1:], len(ids)], strict=True):
        yield Draws({n: c[first:last] for n, c in rows.items()}, float(ends[ids[first]]))


def _statistic(one: Statistic, draws: Draws, estimate: dict[str, Any]) -> list[float]:
    """The cells of a statistic, in the order of its columns."""
    values, companions = draws.of(one), draws.of(one, "companion_")
    expected = _expectation(one, estimate)
    found = ESTIMATE[one.kind](values, companions, expected)
    return [*(end for e in found for end in (e.value, e.low, e.high)), found.saved]


def _expectation(one: Statistic, estimate: dict[str, Any]) -> Expectation:
    """Of the companions: exact for normal errors, sampled for settling times."""

    def told(name: str) -> float:
        return math.nan if estimate[name] is None else float(estimate[name])

    if one.kind == "settle":
        return Expectation(told(f"{one.settled}_mean_s"), told(f"{one.settled}_mean_error_s"))
    if one.kind == "within":
        side = "_truth" if one.truth else ""
        return Expectation(told(f"within_{one.band_arcmin:g}{side}{one.at}_share"))
    centre = 0.0 if one.truth else told("floor_arcmin")
    mean, sigma = told(f"phi_u{one.at}_arcmin"), told(f"true_sigma_u{one.at}_arcmin")
    if not one.truth and (name := f"true_sigma_u_from_limit{one.at}_arcmin") in estimate:
        sigma = told(name)
    return Expectation((mean - centre) ** 2 + sigma**2)
