"""Runs grouped for tables and figures: the lines along an axis, and bins of a drawn key."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis.summaries import REQUIRED_COLUMNS
from sinsjax.execution.results import Results
from sinsjax.plots.comparison import MAX_LINES
from sinsjax.study.schema import NUMBERS_DRAWN
from sinsjax.study.success import success_columns

BINS_NOTE = "the median of each bin, of about as many draws."
_MAX_BINS = 8
_MIN_DRAWS_PER_BIN = 10  # per bin: the interval of fewer draws is too wide to be of use
_DIGITS = 3  # significant ones of a bin's name


def describe_undrawn_lines(table: pa.Table, line_keys: Sequence[str]) -> str:
    """A sentence on the lines along an axis that have no room, if there are any."""
    left = sum(1 for _ in analysis.group_rows(table.select(line_keys), line_keys)) - MAX_LINES
    return f" {left} more lines are not drawn." if left > 0 else ""


def choose_line_keys(source: Results) -> tuple[Sequence[str], str]:
    """Return the keys that identify a few lines, and a note for the caption.

    These are all keys if there are few variants, else the first key with few values, or none.
    """
    if source.study.n_variants <= MAX_LINES:
        return source.study.keys_shown, ""
    for keys, values in source.study.axes_shown.items():
        if len(values) <= MAX_LINES:
            return keys, f" All runs of the same {' and '.join(keys)} make one line."
    return (), " All runs together."


def bin_drawn_keys(source: Results) -> dict[str, tuple[Results, tuple[float, ...]]]:
    """Return the runs of each drawn number of a study in bins of about as many draws.

    Returns:
        By key: the runs with the median of their bin as the value of the key, draws in that order
        and only the columns that statistics need; and these medians, ascending. No key of which
        there are too few draws for two bins.
    """
    study = source.study
    count = min(_MAX_BINS, source.draws // _MIN_DRAWS_PER_BIN)
    drawn = [key for key in study.drawn_keys if NUMBERS_DRAWN[key] == 1]
    found = {}
    for key in drawn if count > 1 else ():
        table = source.rows(
            [
                key,
                "run_id",
                "variant_id",
                *study.keys_shown,
                *REQUIRED_COLUMNS,
                *success_columns(study),
            ]
        )
        medians = bin_medians(analysis.numeric_column(table, key), count)
        place = table.column_names.index(key)
        table = table.set_column(place, key, pa.array(medians))
        table = table.sort_by([(key, "ascending"), ("run_id", "ascending")])
        found[key] = source.with_summary(table), tuple(map(float, np.unique(medians)))
    return {key: bins for key, bins in found.items() if len(bins[1]) > 1}


def bin_medians(values: NDArray, n_bins: int) -> NDArray:
    """Return the median of the bin of each value; few distinct values are bins of their own.

    Args:
        values: (n,) finite ones.
        n_bins: number of bins, of about as many values each.
    """
    if len(np.unique(values)) <= n_bins:
        return values
    edges = np.quantile(values, np.arange(1, n_bins) / n_bins)
    number = np.searchsorted(edges, values, side="right")
    medians = np.array([np.median(values[number == n]) for n in range(n_bins)])
    return np.array([float(f"{median:.{_DIGITS}g}") for median in medians])[number]
