"""Which runs may depend on one another, and what is left of them: the rule of all intervals.

Runs of one draw share its noise, so where variants are pooled, draws are counted, not runs. Runs on
a record share the record: its biases whatever their start, and its samples where their spans
overlap, so that all of them are one cluster, which has no interval.
"""

import math
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sinsjax.analysis.tables import numbers

COLUMNS = ("draw_id", "start_s")
"""Columns of the summary that tell clusters."""

NO_INTERVAL = (
    "No intervals: the runs are on one record. They share its sensor biases, and most of its"
    " samples where their spans overlap, so that their spread does not tell how far another record"
    " would differ."
)
"""Said where runs are on a record."""


def clusters_of(table: pa.Table) -> NDArray | None:
    """The cluster of each run, shape (rows,): its draw, or 0 for all runs on a record.

    Start times that differ are those of a record. None, each run its own, without ``draw_id``.

    Args:
        table: of the summary, with `COLUMNS` if it has them.
    """
    draw, start = COLUMNS
    if draw not in table.column_names:
        return None
    found = numbers(table, draw).astype(int)
    if start in table.column_names and np.unique(numbers(table, start)).size > 1:
        return np.zeros_like(found)
    return found


def are_single(table: pa.Table) -> bool:
    """Whether no two runs of a table are of one cluster, so that statistics by run hold."""
    found = clusters_of(table)
    return found is None or np.unique(found).size == found.size


def of_each(cluster: ArrayLike, size: int) -> NDArray:
    """The clusters of some values, shape (size,).

    Raises:
        ValueError: there are more or fewer.
    """
    found = np.asarray(cluster)
    if found.shape != (size,):
        raise ValueError(f"{size} values need as many clusters, got {found.size}")
    return found


class Clustered(NamedTuple):
    """The mean of values that come in clusters.

    Attributes:
        mean: of the values.
        error: its standard error, NaN for one cluster.
        n: number of clusters.
        size: values in all.
    """

    mean: float
    error: float
    n: int
    size: int

    @classmethod
    def of(cls, data: NDArray, cluster: ArrayLike | None) -> "Clustered":
        """Sums over clusters as a ratio to their sizes; each value alone is the plain mean.

        Args:
            data: shape (n,), finite.
            cluster: shape (n,); None: each value is its own.

        Raises:
            ValueError: lengths differ.
        """
        centre = float(np.mean(data))
        sums: NDArray = data - centre
        if cluster is not None:
            sums = np.bincount(np.unique(of_each(cluster, data.size), return_inverse=True)[1], sums)
        count = sums.size
        spread = float(np.sum(sums**2)) * count / (count - 1) if count > 1 else math.nan
        return cls(centre, math.sqrt(spread) / data.size, count, data.size)

    def factor(self, tail: float) -> float:
        """Student's t of the clusters that has a probability above it; NaN for one cluster."""
        return float(special.stdtrit(self.n - 1, 1 - tail)) if self.n > 1 else math.nan

    def worth(self, share: float) -> float:
        """How many independent values tell a share as well; not more than there are."""
        if share in (0.0, 1.0):
            return float(self.n)
        return share * (1 - share) / max(self.error**2, share * (1 - share) / self.size)
