"""Statistics of some runs, each with its 95 % interval.

Nothing is omitted silently: a run that never settled counts as an infinite settling time, and an
`Estimate` states the number of values used. The intervals:

* shares: Wilson's score interval; means: Student's t;
* quantiles: two of the values, from the binomial distribution of the number below the quantile;
* standard deviations and root mean squares: on a logarithmic scale, see `_root`; for normal values
  chi-square.

Their coverage is in ``docs/results.md``, measured by ``benchmarks/interval_coverage.py``.

The runs of a draw share its noise, and all runs on a record share the record, so they are not
independent. All functions take the cluster of each value (see `sinsjax.analysis.clusters_of`) and
count clusters instead of values. One cluster has no interval, since the spread between clusters is
unknown. An end of an interval is also NaN if there are too few values to bound it.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sinsjax.analysis.clusters import Clustered, of_each

CONFIDENCE = 0.95
RESAMPLES = 1000
SEED = 0
TAIL = (1 - CONFIDENCE) / 2
_NORMAL = float(special.ndtri(1 - TAIL))
_LEAST = 5  # fewest clusters that bound a standard deviation or a root mean square
_UPPER = 1.3  # factor on the upper reach of a root's interval, see `_root`
_BLOCK = 2**22  # values drawn at a time, to bound the bootstrap's memory


class Estimate(NamedTuple):
    """A number with its 95 % interval.

    Attributes:
        value: the estimate; infinite means never, NaN means unknown.
        low: lower end of the interval; NaN if there are too few values to bound it.
        high: upper end of the interval, likewise.
        n: number of values used.
    """

    value: float
    low: float
    high: float
    n: int


UNKNOWN = Estimate(math.nan, math.nan, math.nan, 0)
"""The estimate without any values."""


@lru_cache(maxsize=4096)
def proportion(k: int, n: int) -> Estimate:
    """The share k/n with Wilson's score interval.

    Args:
        k: number of runs that have the property.
        n: number of runs.

    Raises:
        ValueError: n is below 1, or k outside 0..n.
    """
    if n < 1 or not 0 <= k <= n:
        raise ValueError(f"a share needs 0 <= k <= n and n >= 1, got k = {k}, n = {n}")
    return Estimate(k / n, *_wilson(k / n, float(n), _NORMAL), n)


def _wilson(share: float, n: float, z: float) -> tuple[float, float]:
    """The ends of Wilson's interval of a share of n values; n may be fractional."""
    centre = (n * share + z * z / 2) / (n + z * z)
    half = z / (n + z * z) * math.sqrt(n * share * (1 - share) + z * z / 4)
    # At 0 and 1 an end of the interval equals the share, apart from rounding.
    return centre - half if share > 0 else 0.0, centre + half if share < 1 else 1.0


def share(flags: ArrayLike, cluster: ArrayLike | None = None) -> Estimate:
    """The share of the values that are true, with Wilson's score interval.

    With clusters, the interval uses the effective number of independent values, from the variance
    of the share over the clusters, and Student's t of the clusters instead of z (Korn and Graubard
    1998, Survey Methodology 24, 193, with Wilson's interval instead of Clopper and Pearson's). If
    all values are equal, their correlation within clusters is unknown, so each cluster counts as
    one value.

    Args:
        flags: shape (n,), bool.
        cluster: shape (n,), integer cluster of each value; None if each is its own.

    Raises:
        ValueError: no values.
    """
    data = clean(flags)
    n, clustered = data.size, Clustered.of(data, cluster)
    value = float(np.mean(data))
    if cluster is not None and clustered.n < 2:  # a draw or a record alone, be it of one run
        return UNKNOWN._replace(value=value, n=n)
    if clustered.n == n:
        return proportion(round(value * n), n)
    return Estimate(value, *_wilson(value, clustered.worth(value), clustered.factor(TAIL)), n)


def quantile(values: ArrayLike, q: float = 0.5, cluster: ArrayLike | None = None) -> Estimate:
    """The smallest value that at least a share q of the values does not exceed.

    NaN (null in a table: never settled) counts as infinite, so the result is infinite if fewer than
    a share q ever settled. It is always one of the values, never interpolated.

    The interval is distribution-free: the number of values below the quantile is binomial, and each
    end is an order statistic exceeded by it with at most 2.5 % probability (Conover 1999, section
    3.2). An end is NaN if there are too few values for such a bound. With clusters, n is the
    effective number of independent values for that share, see `share` (Woodruff 1952, Journal of
    the American Statistical Association 47, 635).

    Args:
        values: shape (n,), any unit.
        q: from 0 to 1.
        cluster: shape (n,), integer cluster of each value; None if each is its own.

    Raises:
        ValueError: no values, or q out of range.
    """
    data = clean(values, missing=math.inf)
    n, at = data.size, place(data.size, q)
    value = float(np.partition(data, at)[at])
    clustered = Clustered.of((data <= value).astype(float), cluster)
    if clustered.n < 2 <= n:
        return UNKNOWN._replace(value=value, n=n)
    worth = n
    if clustered.n < n:
        reached = float(np.mean(data <= value))
        worth = max(int(clustered.worth(reached) * (_NORMAL / clustered.factor(TAIL)) ** 2), 1)
    low, high = _bounds(worth, q)
    if worth < n:  # scale the ranks among fewer values to ranks among these
        low, high = math.floor(low * n / worth), math.ceil(high * n / worth)
    ends = np.partition(data, [max(low - 1, 0), min(high - 1, n - 1)])
    return Estimate(
        value,
        float(ends[low - 1]) if low >= 1 else math.nan,
        float(ends[high - 1]) if high <= n else math.nan,
        n,
    )


def place(n: int, q: float) -> int:
    """Index of a quantile among n sorted values, as in numpy's method "inverted_cdf".

    Raises:
        ValueError: q out of range.
    """
    if not 0 <= q <= 1:
        raise ValueError(f"a quantile needs 0 <= q <= 1, got {q}")
    rounding = 1 - 4 * np.finfo(float).eps  # of the product
    return max(math.ceil(n * q * rounding), 1) - 1


@lru_cache(maxsize=256)
def _bounds(n: int, q: float) -> tuple[int, int]:
    """Ranks, from 1, of the ends of a quantile's interval among n values; 0 or n + 1 for none."""
    below = special.bdtr(np.arange(n), n, q)  # probability that at most 0, 1, ... lie below it
    return int(np.sum(below <= TAIL)), int(np.sum(1 - below > TAIL)) + 1


def mean(values: ArrayLike, cluster: ArrayLike | None = None) -> Estimate:
    """The mean of the finite values with Student's t interval.

    Non-finite values are omitted; ``n`` is the number used. One value has no interval, none gives
    :data:`UNKNOWN`. With clusters, the variance is that of a ratio estimate: sums over the clusters
    by their sizes (Cochran 1977, Sampling techniques, section 9A).

    Args:
        values: shape (m,), any unit.
        cluster: shape (m,), integer cluster of each value; None if each is its own.

    Raises:
        ValueError: no values at all.
    """
    data, cluster = _finite(values, cluster)
    if data.size == 0:
        return UNKNOWN
    clustered = Clustered.of(data, cluster)
    centre, half = float(np.mean(data)), clustered.factor(TAIL) * clustered.error
    return Estimate(centre, centre - half, centre + half, data.size)


def std(
    values: ArrayLike, cluster: ArrayLike | None = None, *, is_normal: bool = False
) -> Estimate:
    """The sample standard deviation (n - 1) of the finite values.

    Non-finite values are omitted; ``n`` is the number used. Fewer than two values have no standard
    deviation, fewer than five no interval unless they are normal. For runs of mixed outcome use
    quantiles instead.

    Args:
        values: shape (m,), any unit.
        cluster: shape (m,), integer cluster of each value; None if each is its own.
        is_normal: whether the values are normal by construction, such as a linear loop's response
            to white noise; then the interval is chi-square. Never infer this from the values.

    Raises:
        ValueError: no values at all.
    """
    data, cluster = _finite(values, cluster)
    n = data.size
    if n < 2:
        return UNKNOWN._replace(n=n)
    centred = data - np.mean(data)
    clustered = Clustered.of(centred**2, cluster)
    value = float(np.std(data, ddof=1))
    if is_normal and clustered.n == n:
        low, high = chi2_mean_band(n - 1, 1)
        return Estimate(value, value * ((n - 1) / high) ** 0.5, value * ((n - 1) / low) ** 0.5, n)
    return Estimate(value, *_root(value, clustered), n)


def rms(values: ArrayLike, cluster: ArrayLike | None = None, *, most: float = math.inf) -> Estimate:
    """The root mean square of the finite values.

    Non-finite values are omitted; ``n`` is the number used. Fewer than five have no interval.

    Args:
        values: shape (m,), any unit.
        cluster: shape (m,), integer cluster of each value; None if each is its own.
        most: largest magnitude that a value can have; the interval ends there.

    Raises:
        ValueError: no values at all.
    """
    data, cluster = _finite(values, cluster)
    if data.size == 0:
        return UNKNOWN
    value = math.sqrt(np.mean(data**2))
    low, high = np.minimum(_root(value, Clustered.of(data**2, cluster)), most).tolist()
    return Estimate(value, low, high, data.size)


def _root(value: float, squares: Clustered) -> tuple[float, float]:
    """The ends of the interval of the root of a mean square.

    Student's t on a logarithmic scale, with Bonett's two corrections (2006, Computational
    Statistics and Data Analysis 50, 775) for the correlation of the estimate with its error: both
    grow by the relative variance of the mean square, which is itself estimated with two degrees of
    freedom less. The upper reach is multiplied by `_UPPER`, because a sample seldom shows the tails
    of a heavy-tailed distribution; `benchmarks/interval_coverage.py` requires that value for
    Student's t with 5 degrees of freedom.
    """
    n = squares.n
    if value == 0.0 and n > 1:
        return value, value
    if n < _LEAST:
        return math.nan, math.nan
    variance = n / (n - 2) * (squares.error / squares.mean) ** 2
    reach = squares.factor(TAIL) * math.sqrt(variance) * (1 + variance)
    return tuple(value * math.exp((variance + r) / 2) for r in (-reach, _UPPER * reach))  # type: ignore[return-value]


def chi2_mean_band(freedom: int, n: int) -> tuple[float, float]:
    """The 95 % band of the mean of n chi-square values.

    The mean NEES of a consistent filter over independent runs lies in it in 95 of 100 studies
    (Bar-Shalom, Li and Kirubarajan 2001, section 5.4).

    Args:
        freedom: degrees of freedom of one value, at least 1.
        n: number of values; 0 gives NaN.

    Returns:
        Lower and upper end.
    """
    if n < 1:
        return math.nan, math.nan
    low, high = 2 * special.gammaincinv(freedom * n / 2, [TAIL, 1 - TAIL]) / n
    return float(low), float(high)


def clean(values: ArrayLike, *, missing: float = math.nan) -> NDArray:
    """Values as float64, shape (n,), with NaN replaced.

    Raises:
        ValueError: no values, or more than one dimension.
    """
    data = np.asarray(values, dtype=np.float64)
    if data.ndim != 1 or data.size == 0:
        raise ValueError(f"one or more values in one dimension are needed, got shape {data.shape}")
    return np.where(np.isnan(data), missing, data)


def _finite(values: ArrayLike, cluster: ArrayLike | None) -> tuple[NDArray, NDArray | None]:
    """The finite values, with their clusters; there must be at least one value."""
    data = clean(values)
    known = np.isfinite(data)
    return data[known], None if cluster is None else of_each(cluster, data.size)[known]


def bootstrap(statistic: Callable[..., NDArray], *samples: NDArray) -> tuple[float, float]:
    """Percentile bootstrap interval of a statistic, the same at every call.

    Args:
        statistic: function of arrays (..., n), one per sample, over their last axis.
        samples: shape (n,) each, resampled together to preserve pairs.

    Returns:
        Lower and upper end; NaN for fewer than two values.
    """
    random = np.random.default_rng(SEED)
    n = samples[0].size
    if n < 2:
        return math.nan, math.nan
    block = max(1, _BLOCK // n)
    drawn = []
    for start in range(0, RESAMPLES, block):
        pick = random.integers(0, n, (min(block, RESAMPLES - start), n))
        drawn.append(statistic(*(sample[pick] for sample in samples)))
    # Order statistics: interpolation between infinite values would give NaN.
    low, high = np.quantile(np.concatenate(drawn), [TAIL, 1 - TAIL], method="inverted_cdf")
    return float(low), float(high)
