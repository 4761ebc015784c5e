"""Statistics of some runs, each with its 95 % interval.

Nothing is omitted silently: a run that never settled counts as an infinite settling time, and an
`Estimate` states the number of values used. The intervals:

* shares: Clopper and Pearson's, extended to several runs per draw in `sinsjax.analysis.bounds`;
* quantiles: two of the values, by inverting the interval of the share below a value;
* means: Student's t, corrected for skewness;
* standard deviations and root mean squares: on a logarithmic scale, see `_root_interval`; for
  normal values chi-square.

Their coverage is in ``docs/results.md``, measured by a nightly test in ``tests/analysis``.

The runs of a draw share its noise, and all runs on a record share the record, so they are not
independent. All functions take the cluster of each value (see `sinsjax.analysis.cluster_ids`) and
count clusters instead of values. An interval holds for other draws of the same variants: the
spread between variants is not a sampling error. One cluster has no interval, since the spread
between clusters is unknown. An end of an interval is also NaN if there are too few values to bound
it.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sinsjax.analysis.bounds import DrawCounts, quantile_bounds
from sinsjax.analysis.clusters import ClusteredMean, validate_cluster_ids

CONFIDENCE = 0.95
RESAMPLES = 1000
SEED = 0
TAIL = (1 - CONFIDENCE) / 2
_MIN_CLUSTERS = 5  # fewest clusters that bound a standard deviation or a root mean square
_UPPER = 1.3  # factor on the upper reach of a root's interval, see `_root_interval`
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
    """The share k/n of independent runs with the interval of Clopper and Pearson.

    Args:
        k: number of runs that have the property.
        n: number of runs.

    Raises:
        ValueError: n is below 1, or k outside 0..n.

    Example:
        >>> analysis.format_estimate(analysis.proportion(16, 16), digits=2)
        '1.00 [0.79, 1.00]'
    """
    if n < 1 or not 0 <= k <= n:
        raise ValueError(f"a share needs 0 <= k <= n and n >= 1, got k = {k}, n = {n}")
    low = float(special.betaincinv(k, n - k + 1, TAIL)) if k else 0.0
    high = float(special.betaincinv(k + 1, n - k, 1 - TAIL)) if k < n else 1.0
    return Estimate(k / n, low, high, n)


def share(flags: ArrayLike, cluster: ArrayLike | None = None) -> Estimate:
    """The share of the values that are true, with an interval that holds for any dependence.

    The draws count, whatever the number and dependence of their runs: see
    `sinsjax.analysis.bounds`. For independent runs the interval equals that of `proportion`.

    Args:
        flags: shape (n,), bool.
        cluster: shape (n,), integer cluster of each value; None if each is its own.

    Raises:
        ValueError: no values.

    Example:
        Three draws of two runs each, of which one run fails:

        >>> found = analysis.share([True, True, True, True, True, False], [0, 0, 1, 1, 2, 2])
        >>> analysis.format_estimate(found, digits=2)
        '0.83 [0.23, 1.00]'
    """
    data = to_float_array(flags)
    n, value = data.size, float(np.mean(data))
    if cluster is None:
        return proportion(round(value * n), n)
    place = np.unique(validate_cluster_ids(cluster, n), return_inverse=True)[1]
    runs = np.bincount(place)
    if runs.size < 2:  # a draw or a record alone, be it of one run
        return UNKNOWN._replace(value=value, n=n)
    if runs.size == n:
        return proportion(round(value * n), n)
    draws = DrawCounts.from_runs(np.bincount(place, data), runs)
    return Estimate(value, draws.lower_bound(TAIL), 1 - draws.complement().lower_bound(TAIL), n)


def quantile(values: ArrayLike, q: float = 0.5, cluster: ArrayLike | None = None) -> Estimate:
    """The smallest value that at least a share q of the values does not exceed.

    NaN (null in a table: never settled) counts as infinite, so the result is infinite if fewer than
    a share q ever settled. It is always one of the values, never interpolated.

    The interval is distribution-free. For independent values the number below the quantile is
    binomial, and each end is an order statistic exceeded by it with at most 2.5 % probability
    (Conover 1999, section 3.2). With clusters an end is the last value whose share of runs below
    it, by draw, agrees with q: see `sinsjax.analysis.bounds.quantile_bounds`. An end is NaN if
    there are too few draws for such a bound: 16 draws of one run each do not bound a 90 % quantile
    from above.

    Args:
        values: shape (n,), any unit.
        q: from 0 to 1.
        cluster: shape (n,), integer cluster of each value; None if each is its own.

    Raises:
        ValueError: no values, or q out of range.

    Example:
        >>> never = float("nan")
        >>> analysis.format_estimate(analysis.quantile([50, 60, 70, 80, 90, never]), "s", 0)
        '70 [50, never] s'
        >>> analysis.format_estimate(analysis.quantile(range(16), q=0.9), "s", 0)
        '14 [11, few draws] s'
    """
    data = to_float_array(values, missing=math.inf)
    n, at = data.size, quantile_index(data.size, q)
    value = float(np.partition(data, at)[at])
    draw = np.arange(n)
    if cluster is not None:
        draw = np.unique(validate_cluster_ids(cluster, n), return_inverse=True)[1]
    draws = int(draw.max()) + 1
    if draws < 2 <= n:
        return UNKNOWN._replace(value=value, n=n)
    if draws < n:
        return Estimate(value, *quantile_bounds(data, draw, q, TAIL), n)
    low, high = _binomial_rank_bounds(n, q)
    ends = np.partition(data, [max(low - 1, 0), min(high - 1, n - 1)])
    return Estimate(
        value,
        float(ends[low - 1]) if low >= 1 else math.nan,
        float(ends[high - 1]) if high <= n else math.nan,
        n,
    )


def quantile_index(n: int, q: float) -> int:
    """Index of a quantile among n sorted values, as in numpy's method "inverted_cdf".

    Raises:
        ValueError: q out of range.
    """
    if not 0 <= q <= 1:
        raise ValueError(f"a quantile needs 0 <= q <= 1, got {q}")
    rounding = 1 - 4 * np.finfo(float).eps  # of the product
    return max(math.ceil(n * q * rounding), 1) - 1


@lru_cache(maxsize=256)
def _binomial_rank_bounds(n: int, q: float) -> tuple[int, int]:
    """Ranks, from 1, of the ends of a quantile's interval among n values; 0 or n + 1 for none."""
    below = special.bdtr(np.arange(n), n, q)  # probability that at most 0, 1, ... lie below it
    return int(np.sum(below <= TAIL)), int(np.sum(1 - below > TAIL)) + 1


def mean(
    values: ArrayLike,
    cluster: ArrayLike | None = None,
    *,
    limits: tuple[float, float] = (-math.inf, math.inf),
) -> Estimate:
    """The mean of the finite values with Student's t interval, wider if the values are skewed.

    Non-finite values are omitted; ``n`` is the number used. One value has no interval, none gives
    :data:`UNKNOWN`. With clusters, the variance is that of a ratio estimate: sums over the clusters
    by their sizes (Cochran 1977, Sampling techniques, section 9A).

    Each end is the outer one of Student's interval and of Hall's, which corrects it for the
    skewness of the values (Hall 1992, Journal of the Royal Statistical Society B 54, 221).

    Args:
        values: shape (m,), any unit.
        cluster: shape (m,), integer cluster of each value; None if each is its own.
        limits: least and largest value possible; the interval ends there, which costs no coverage.

    Raises:
        ValueError: no values at all.

    Example:
        >>> analysis.format_estimate(analysis.mean([1.0, 2.0, 3.0, 4.0]))
        '2.5 [0.4, 4.6]'
    """
    data, cluster = _finite_values(values, cluster)
    if data.size == 0:
        return UNKNOWN
    clustered = ClusteredMean.from_values(data, cluster)
    centre, reach = float(np.mean(data)), clustered.student_quantile(TAIL)
    low = centre - max(reach, clustered.skewness_corrected(reach)) * clustered.standard_error
    high = centre + max(reach, -clustered.skewness_corrected(-reach)) * clustered.standard_error
    low, high = np.clip((low, high), *limits).tolist()
    return Estimate(centre, low, high, data.size)


def std(values: ArrayLike, cluster: ArrayLike | None = None) -> Estimate:
    """The sample standard deviation (n - 1) of the finite values.

    Non-finite values are omitted; ``n`` is the number used. Fewer than two values have no standard
    deviation, fewer than five no interval. With clusters, the variance about
    the mean and that of the mean over the clusters are added; for independent values that is the
    same. For runs of mixed outcome use quantiles instead.

    Args:
        values: shape (m,), any unit.
        cluster: shape (m,), integer cluster of each value; None if each is its own.

    Raises:
        ValueError: no values at all.
    """
    data, cluster = _finite_values(values, cluster)
    n = data.size
    if n < 2:
        return UNKNOWN._replace(n=n)
    centred = data - np.mean(data)
    clustered = ClusteredMean.from_values(centred**2, cluster)
    of_mean = ClusteredMean.from_values(
        data, cluster
    )  # its variance is missing in that about the mean
    value = float(np.std(data, ddof=1))
    if of_mean.n > 1:
        value = math.sqrt(np.mean(centred**2) + of_mean.standard_error**2)
    return Estimate(value, *_root_interval(value, clustered), n)


def rms(
    values: ArrayLike, cluster: ArrayLike | None = None, *, max_magnitude: float = math.inf
) -> Estimate:
    """The root mean square of the finite values.

    Non-finite values are omitted; ``n`` is the number used. Fewer than five have no interval.

    Args:
        values: shape (m,), any unit.
        cluster: shape (m,), integer cluster of each value; None if each is its own.
        max_magnitude: largest magnitude that a value can have; the interval ends there.

    Raises:
        ValueError: no values at all.
    """
    data, cluster = _finite_values(values, cluster)
    if data.size == 0:
        return UNKNOWN
    value = math.sqrt(np.mean(data**2))
    low, high = np.minimum(
        _root_interval(value, ClusteredMean.from_values(data**2, cluster)), max_magnitude
    ).tolist()
    return Estimate(value, low, high, data.size)


def _root_interval(value: float, mean_square: ClusteredMean) -> tuple[float, float]:
    """The ends of the interval of the root of a mean square.

    Student's t on a logarithmic scale, with Bonett's two corrections (2006, Computational
    Statistics and Data Analysis 50, 775) for the correlation of the estimate with its error: both
    grow by the relative variance of the mean square, which is itself estimated with two degrees of
    freedom less. The upper reach is multiplied by `_UPPER`, because a sample seldom shows the tails
    of a heavy-tailed distribution; `tests/analysis` requires that value for
    Student's t with 5 degrees of freedom.
    """
    n = mean_square.n
    if value == 0.0 and n > 1:
        return value, value
    if n < _MIN_CLUSTERS:
        return math.nan, math.nan
    variance = n / (n - 2) * (mean_square.standard_error / mean_square.mean) ** 2
    reach = mean_square.student_quantile(TAIL) * math.sqrt(variance) * (1 + variance)
    return tuple(value * math.exp((variance + r) / 2) for r in (-reach, _UPPER * reach))  # type: ignore[return-value]


def chi2_mean_band(degrees_of_freedom: int, n: int) -> tuple[float, float]:
    """The 95 % band of the mean of n chi-square values.

    The mean NEES of a consistent filter over independent runs lies in it in 95 of 100 studies
    (Bar-Shalom, Li and Kirubarajan 2001, section 5.4).

    Args:
        degrees_of_freedom: degrees of freedom of one value, at least 1.
        n: number of values; 0 gives NaN.

    Returns:
        Lower and upper end.
    """
    if n < 1:
        return math.nan, math.nan
    low, high = 2 * special.gammaincinv(degrees_of_freedom * n / 2, [TAIL, 1 - TAIL]) / n
    return float(low), float(high)


def to_float_array(values: ArrayLike, *, missing: float = math.nan) -> NDArray:
    """Values as float64, shape (n,), with NaN replaced.

    Raises:
        ValueError: no values, or more than one dimension.
    """
    data = np.asarray(values, dtype=np.float64)
    if data.ndim != 1 or data.size == 0:
        raise ValueError(f"one or more values in one dimension are needed, got shape {data.shape}")
    return np.where(np.isnan(data), missing, data)


def _finite_values(values: ArrayLike, cluster: ArrayLike | None) -> tuple[NDArray, NDArray | None]:
    """The finite values, with their clusters; there must be at least one value."""
    data = to_float_array(values)
    is_finite = np.isfinite(data)
    return data[is_finite], None if cluster is None else validate_cluster_ids(cluster, data.size)[
        is_finite
    ]


def bootstrap_interval(statistic: Callable[..., NDArray], *samples: NDArray) -> tuple[float, float]:
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
