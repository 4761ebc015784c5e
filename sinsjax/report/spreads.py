"""Figures of whole distributions over the runs: settling times, errors, consistency."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate
from sinsjax.plots import Belief, Spread
from sinsjax.report.base import Picture, Source, name_of, shown_keys, swept

_MOST_LINES = 7
_SETTLED = "settle_10_s"
_ERROR = ("phi_u_mean_arcmin", "floor_arcmin")
_SHARES = {"phi_u²": "p_above_error_share", "(phi_u - floor)²": "p_above_floor_error_share"}


def spreads(source: Source) -> Iterator[Picture]:
    """Settling times and errors, and consistency where the method has a covariance.

    A line a variant; of many variants a line a value of the first key that has few, with all runs
    that share it.
    """
    keys, note = _lines(source)
    needed = (*keys, _SETTLED, *_ERROR)
    shown = {name_of(key): rows for key, rows in analysis.groups(source.rows(needed), keys)}
    settling = {name: analysis.numbers(rows, _SETTLED) for name, rows in shown.items()}
    errors = {name: _from_limit(rows) for name, rows in shown.items()}
    yield Picture(
        "distribution",
        "Share of runs that have settled by a time, and with a window mean of phi_u below a"
        f" value.{note}",
        plots.distributions(
            [
                Spread("settling time to 10 arcmin (s)", settling, "never"),
                Spread("phi_u from its limit (arcmin)", errors, "no number", far=60.0),
            ],
            "Settling time and remaining heading error over the runs",
        ),
    )
    needed = (*keys, "nees", *_SHARES.values(), "draw_id", "start_s")
    groups = analysis.groups(source.rows(needed), keys)
    beliefs = [belief(name_of(key), rows) for key, rows in groups]
    if any(np.isfinite(one.nees).any() for one in beliefs):
        yield consistency(beliefs, note)


def _lines(source: Source) -> tuple[Sequence[str], str]:
    """The keys that tell lines apart, and what is to be said of them."""
    keys = shown_keys(source.study)
    if source.study.n_variants <= _MOST_LINES:
        return keys, ""
    for own, values in swept(source.study).items():
        if len(values) <= _MOST_LINES:
            return own, f" All runs of the same {' and '.join(own)} make one line."
    return (), " All runs together."


def _from_limit(rows: pa.Table) -> Any:
    mean, floor = (analysis.numbers(rows, column) for column in _ERROR)
    return mean - floor


def belief(name: str, rows: pa.Table) -> Belief:
    """NEES of some runs, and how often P_UU lies above the squared error.

    Args:
        name: of the line.
        rows: of the summary, with ``nees``, the shares of records and what tells clusters.
    """
    shares = {}
    for of, column in _SHARES.items():
        found = analysis.mean(analysis.numbers(rows, column), analysis.clusters_of(rows))
        low, high = np.clip(found[1:3], 0.0, 1.0).tolist()
        shares[of] = Estimate(found.value, low, high, found.n)
    return Belief(name, analysis.numbers(rows, "nees"), shares)


def consistency(beliefs: Sequence[Belief], note: str = "") -> Picture:
    """The figure of what the filter believes of its error."""
    return Picture(
        "consistency",
        "Left: NEES of phi at the end; a filter whose belief is true follows the dashed line, to"
        " its right it believes too much. Right: mean share of records in which P_UU exceeds the"
        f" squared error; dashed: 68 %, that of a normal error of that size.{note}",
        plots.beliefs(beliefs, "Does the filter know its own error?"),
    )
