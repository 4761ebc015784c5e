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

from sinsjax.analysis.tables import numeric_column

CLUSTER_COLUMNS = ("draw_id", "start_s")
"""Columns of the summary that identify clusters."""

NO_INTERVAL = (
    "No intervals: the runs are on one record. They share its sensor biases, and most of its"
    " samples where their spans overlap, so their spread does not show how far another record"
    " would differ."
)
"""Note for results of runs on a record."""

_SYMMETRIC = 1e-6


def cluster_ids(table: pa.Table) -> NDArray | None:
    """The cluster of each run, shape (rows,): its draw, or 0 for all runs on a record.

    Differing start times imply a record. None without ``draw_id``: each run is its own cluster.

    Args:
        table: rows of the summary, with those of `CLUSTER_COLUMNS` that it has.
    """
    draw, start = CLUSTER_COLUMNS
    if draw not in table.column_names:
        return None
    ids = numeric_column(table, draw).astype(int)
    if start in table.column_names and np.unique(numeric_column(table, start)).size > 1:
        return np.zeros_like(ids)
    return ids


def has_independent_runs(table: pa.Table) -> bool:
    """Return whether no two runs of a table share a cluster, so that runs are independent."""
    ids = cluster_ids(table)
    return ids is None or np.unique(ids).size == ids.size


def validate_cluster_ids(cluster: ArrayLike, size: int) -> NDArray:
    """The clusters of some values, shape (size,).

    Raises:
        ValueError: the number of clusters differs from the number of values.
    """
    ids = np.asarray(cluster)
    if ids.shape != (size,):
        raise ValueError(f"{size} values need as many clusters, got {ids.size}")
    return ids


class ClusteredMean(NamedTuple):
    """The mean of clustered values.

    Attributes:
        mean: mean of the values.
        standard_error: its standard error, NaN for one cluster.
        n: number of clusters.
        skewness: of the clusters' sums, with the usual correction for small samples; 0 for fewer
            than three clusters.
    """

    mean: float
    standard_error: float
    n: int
    skewness: float

    @classmethod
    def from_values(cls, values: NDArray, cluster: ArrayLike | None) -> "ClusteredMean":
        """Ratio estimate from the sums and sizes of the clusters; the plain mean without clusters.

        Args:
            values: shape (n,), finite.
            cluster: shape (n,); None if each value is its own cluster.

        Raises:
            ValueError: lengths differ.
        """
        centre = float(np.mean(values))
        sums: NDArray = values - centre
        if cluster is not None:
            sums = np.bincount(
                np.unique(validate_cluster_ids(cluster, values.size), return_inverse=True)[1], sums
            )
        n = sums.size
        square = float(np.sum(sums**2))
        error = math.sqrt(square * n / (n - 1)) / values.size if n > 1 else math.nan
        skewness = 0.0
        if n > 2 and square > 0:
            cubic = float(np.mean(sums**3)) / (square / n) ** 1.5
            skewness = cubic * math.sqrt(n * (n - 1)) / (n - 2)
        return cls(centre, error, n, skewness)

    def student_quantile(self, tail: float) -> float:
        """Upper ``tail`` quantile of Student's t for the clusters; NaN for one cluster."""
        return float(special.stdtrit(self.n - 1, 1 - tail)) if self.n > 1 else math.nan

    def skewness_corrected(self, score: float) -> float:
        """The standardised error of the mean that Hall's transformation maps to a score.

        Args:
            score: quantile of Student's t.
        """
        skew = self.skewness / math.sqrt(self.n)
        if abs(skew) < _SYMMETRIC:
            return score
        return 3 / skew * (float(np.cbrt(1 + skew * (score - skew / 6))) - 1)
