"""Runs grouped for tables and figures: the lines along an axis, and bins of a drawn key."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis.summaries import NEEDED
from sinsjax.execution.source import Source
from sinsjax.plots.spreads import MOST_LINES
from sinsjax.plots.words import name_of
from sinsjax.study.schema import NUMBERS_DRAWN
from sinsjax.study.success import success_columns

BINS = "the median of each bin, of about as many draws."
_MOST_BINS = 8
_LEAST_DRAWS = 10  # a bin: an interval of fewer says little
_DIGITS = 3  # significant ones of a bin's name


def lines_of(table: pa.Table, others: Sequence[str]) -> dict[str, pa.Table]:
    """The rows of each line along an axis by its name: of the first ones that have room."""
    groups = list(analysis.groups(table, others))
    return {name_of(point): rows for point, rows in groups[:MOST_LINES]}


def lines_left(table: pa.Table, others: Sequence[str]) -> str:
    """A sentence on the lines along an axis that have no room, if there are any."""
    left = sum(1 for _ in analysis.groups(table.select(others), others)) - MOST_LINES
    return f" {left} more lines are not drawn." if left > 0 else ""


def keys_of_lines(source: Source) -> tuple[Sequence[str], str]:
    """The keys that tell few lines apart, and what is to be said of them.

    All of them where there are few variants, else the first that has few values, or none.
    """
    if source.study.n_variants <= MOST_LINES:
        return source.study.keys_shown, ""
    for own, values in source.study.axes_shown.items():
        if len(values) <= MOST_LINES:
            return own, f" All runs of the same {' and '.join(own)} make one line."
    return (), " All runs together."


def binned(source: Source) -> dict[str, tuple[Source, tuple[float, ...]]]:
    """For each drawn number of a study, its runs in bins of about as many draws.

    Returns:
        By key: the runs with the median of their bin as the value of the key, draws in that order
        and only the columns that statistics need; and these medians, ascending. No key of which
        there are too few draws for two bins.
    """
    study = source.study
    count = min(_MOST_BINS, source.draws // _LEAST_DRAWS)
    drawn = [key for key in study.drawn_keys if NUMBERS_DRAWN[key] == 1]
    found = {}
    for key in drawn if count > 1 else ():
        table = source.rows(
            [key, "run_id", "variant_id", *study.keys_shown, *NEEDED, *success_columns(study)]
        )
        medians = bin_medians(analysis.numbers(table, key), count)
        place = table.column_names.index(key)
        table = table.set_column(place, key, pa.array(medians))
        table = table.sort_by([(key, "ascending"), ("run_id", "ascending")])
        found[key] = replace(source, table=table), tuple(map(float, np.unique(medians)))
    return {key: one for key, one in found.items() if len(one[1]) > 1}


def bin_medians(values: NDArray, count: int) -> NDArray:
    """For each of some values the median of its bin; few distinct values are bins of their own.

    Args:
        values: (n,) finite ones.
        count: number of bins, of about as many values each.
    """
    if len(np.unique(values)) <= count:
        return values
    edges = np.quantile(values, np.arange(1, count) / count)
    number = np.searchsorted(edges, values, side="right")
    medians = np.array([np.median(values[number == n]) for n in range(count)])
    return np.array([float(f"{median:.{_DIGITS}g}") for median in medians])[number]
