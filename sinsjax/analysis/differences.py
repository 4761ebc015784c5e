"""Differences between two sets of runs on the same noise, each with its 95 % interval.

Runs of one draw share their noise, most of which cancels in a paired difference: the interval is
much narrower than the two separate intervals suggest.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sinsjax.analysis.estimates import (
    TAIL,
    Estimate,
    bootstrap_interval,
    mean,
    quantile_index,
    to_float_array,
)


def mean_difference(a: ArrayLike, b: ArrayLike, cluster: ArrayLike | None = None) -> Estimate:
    """The mean of a - b over pairs on the same noise, with the interval of `mean`.

    Pairs whose difference is not finite are omitted; ``n`` is the number used.

    Args:
        a: shape (n,), any unit.
        b: shape (n,), the same draws in the same order.
        cluster: shape (n,), cluster of each pair, as for `sinsjax.analysis.mean`.

    Raises:
        ValueError: shapes differ, or no pairs.
    """
    first, second = _paired_arrays(a, b)
    with np.errstate(invalid="ignore"):  # infinite minus infinite, omitted by mean
        return mean(first - second, cluster)


def quantile_difference(a: ArrayLike, b: ArrayLike, q: float = 0.5) -> Estimate:
    """The quantile of a minus that of b, with a bootstrap interval over the pairs.

    NaN counts as infinite as in `sinsjax.analysis.quantile`. Infinite minus finite is
    infinite. Infinite minus infinite is NaN as a value and 0 as an end of the interval, since two
    runs that never settle do not differ. Whole pairs are resampled, which preserves their common
    noise.

    Args:
        a: shape (n,), any unit.
        b: shape (n,), the same draws in the same order.
        q: from 0 to 1.

    Raises:
        ValueError: shapes differ, no pairs, or q out of range.
    """
    first, second = _paired_arrays(a, b, missing=math.inf)
    at = quantile_index(first.size, q)

    def statistic(x: NDArray, y: NDArray) -> NDArray:
        left, right = (np.partition(z, at, axis=-1)[..., at] for z in (x, y))
        same = left == right  # also where both are infinite
        return np.where(same, 0.0, left - np.where(same, 0.0, right))

    low, high = bootstrap_interval(statistic, first, second)
    neither = all(math.isinf(np.partition(x, at)[at]) for x in (first, second))
    value = math.nan if neither else float(statistic(first, second))
    return Estimate(value, low, high, first.size)


def proportion_difference(a: ArrayLike, b: ArrayLike) -> Estimate:
    """The share of a minus that of b over pairs on the same noise, with Newcombe's interval.

    It combines Wilson's intervals of the two shares, corrected for the correlation of the pairs
    (Newcombe 1998, Statistics in Medicine 17, 2635, method 10). Unlike Student's t and Wald's
    interval it has a width even if no pair differs, and stays within -1 and 1.

    Args:
        a: shape (n,), bool: whether a run has the property.
        b: shape (n,), the same draws in the same order.

    Raises:
        ValueError: shapes differ, or no pairs.
    """
    first, second = (x.astype(bool) for x in _paired_arrays(a, b))
    n = first.size
    share_a, share_b = (_wilson_interval(int(np.count_nonzero(x)), n) for x in (first, second))
    correlation = _paired_correlation(first, second)
    difference = share_a.value - share_b.value

    def half_width(x: float, y: float) -> float:
        return math.sqrt(max(x * x - 2 * correlation * x * y + y * y, 0.0))

    low = difference - half_width(share_a.value - share_a.low, share_b.high - share_b.value)
    high = difference + half_width(share_a.high - share_a.value, share_b.value - share_b.low)
    return Estimate(difference, low, high, n)


def _wilson_interval(k: int, n: int) -> Estimate:
    """The share k/n with Wilson's score interval."""
    share, z = k / n, float(special.ndtri(1 - TAIL))
    centre = (k + z * z / 2) / (n + z * z)
    half = z / (n + z * z) * math.sqrt(n * share * (1 - share) + z * z / 4)
    # At 0 and 1 an end of the interval equals the share, apart from rounding.
    return Estimate(share, centre - half if k else 0.0, centre + half if k < n else 1.0, n)


def _paired_correlation(a: NDArray, b: NDArray) -> float:
    """Pearson's phi of two paired shares, with Newcombe's continuity correction."""
    n = a.size
    both, only_a, only_b = (float(np.count_nonzero(x)) for x in (a & b, a & ~b, b & ~a))
    none = n - both - only_a - only_b
    scale = math.sqrt((both + only_a) * (only_b + none) * (both + only_b) * (only_a + none))
    excess = both * none - only_a * only_b
    if excess > 0:
        excess = max(excess - n / 2, 0.0)
    return excess / scale if scale else 0.0


def _paired_arrays(
    a: ArrayLike, b: ArrayLike, *, missing: float = math.nan
) -> tuple[NDArray, NDArray]:
    first, second = to_float_array(a, missing=missing), to_float_array(b, missing=missing)
    if first.shape != second.shape:
        raise ValueError(f"pairs need equal lengths, got {first.size} and {second.size}")
    return first, second
