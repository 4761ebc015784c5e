"""Bootstrap intervals of standard deviations, for tests and a script on covariance analysis."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 4000


def bootstrap_intervals(values: NDArray, tail: float, seed: int = 1) -> NDArray:
    """Return the percentile intervals (2, k) of the standard deviations of columns (n, k).

    Args:
        values: one row per draw.
        tail: share of resamples beyond both ends together.
        seed: seed of the resamples.
    """
    # Only the counts of draws matter: sums are matrix products.
    n, deviations = len(values), values - values.mean(axis=0)
    mean, square = (_resample_counts(n, seed) @ power / n for power in (deviations, deviations**2))
    sigma = np.sqrt(np.maximum(square - mean**2, 0) * n / (n - 1))
    return np.quantile(sigma, [tail / 2, 1 - tail / 2], axis=0)


@cache
def _resample_counts(n: int, seed: int) -> NDArray:
    """Return how often each draw is taken per resample, (resamples, n)."""
    random = np.random.default_rng(seed)
    return random.multinomial(n, np.full(n, 1 / n), RESAMPLES).astype(float)
