"""Clusters of dependent runs, and their effect on confidence intervals.

Runs of one draw share its noise, so if variants are pooled, the draws count instead of the runs.
Runs on a record share its sensor biases, and its samples where their spans overlap; all of them are
one cluster, for which there is no interval, nor is there for a single run.
"""

import math
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sinsjax.analysis.tables import numbers

COLUMNS = ("draw_id", "start_s")
"""Columns of the summary that identify clusters."""

NO_INTERVAL = (
    "No intervals: the runs are on one record. They share its sensor biases, and most of its"
    " samples where their spans overlap, so that their spread does not tell how far another record"
    " would differ."
)
"""Note for results of runs on a record."""

_SYMMETRIC = 1e-6


def clusters_of(table: pa.Table) -> NDArray | None:
    """The cluster of each run, shape (rows,): its draw, or 0 for all runs on a record.

    Differing start times imply a record. None without ``draw_id``: each run is its own cluster.

    Args:
        table: rows of the summary, with `COLUMNS` if it has them.
    """
    draw, start = COLUMNS
    if draw not in table.column_names:
        return None
    found = numbers(table, draw).astype(int)
    if start in table.column_names and np.unique(numbers(table, start)).size > 1:
        return np.zeros_like(found)
    return found


def are_single(table: pa.Table) -> bool:
    """Whether no two runs of a table share a cluster, so that runs are independent."""
    found = clusters_of(table)
    return found is None or np.unique(found).size == found.size


def of_each(cluster: ArrayLike, size: int) -> NDArray:
    """The clusters of some values, shape (size,).

    Raises:
        ValueError: the number of clusters differs from the number of values.
    """
    found = np.asarray(cluster)
    if found.shape != (size,):
        raise ValueError(f"{size} values need as many clusters, got {found.size}")
    return found


class Clustered(NamedTuple):
    """The mean of clustered values.

    Attributes:
        mean: mean of the values.
        error: its standard error, NaN for one cluster.
        n: number of clusters.
        skewness: of the clusters' sums, with the usual correction for small samples; 0 for fewer
            than three clusters.
    """

    mean: float
    error: float
    n: int
    skewness: float

    @classmethod
    def of(cls, data: NDArray, cluster: ArrayLike | None) -> "Clustered":
        """Ratio estimate from the sums and sizes of the clusters; the plain mean without clusters.

        Args:
            data: shape (n,), finite.
            cluster: shape (n,); None if each value is its own cluster.

        Raises:
            ValueError: lengths differ.
        """
        centre = float(np.mean(data))
        sums: NDArray = data - centre
        if cluster is not None:
            sums = np.bincount(np.unique(of_each(cluster, data.size), return_inverse=True)[1], sums)
        n = sums.size
        square = float(np.sum(sums**2))
        error = math.sqrt(square * n / (n - 1)) / data.size if n > 1 else math.nan
        skewness = 0.0
        if n > 2 and square > 0:
            cubic = float(np.mean(sums**3)) / (square / n) ** 1.5
            skewness = cubic * math.sqrt(n * (n - 1)) / (n - 2)
        return cls(centre, error, n, skewness)

    def factor(self, tail: float) -> float:
        """Upper ``tail`` quantile of Student's t for the clusters; NaN for one cluster."""
        return float(special.stdtrit(self.n - 1, 1 - tail)) if self.n > 1 else math.nan

    def skewed(self, score: float) -> float:
        """The standardised error of the mean that Hall's transformation maps to a score.

        Args:
            score: quantile of Student's t.
        """
        skew = self.skewness / math.sqrt(self.n)
        if abs(skew) < _SYMMETRIC:
            return score
        return 3 / skew * (float(np.cbrt(1 + skew * (score - skew / 6))) - 1)
