"""Statistics of some runs, and differences between two sets of runs, with 95 % intervals.

Nothing is omitted silently: a run that never settled counts as an infinite settling time, and an
`Estimate` states the number of values used. Coverage of the intervals is in ``docs/results.md``.

All functions take values of shape (n,) in any unit. The runs of a draw share its noise, and all
runs on a record share its sensor biases, so they are not independent: ``cluster`` is the integer
cluster of each value, shape (n,), see `draw_id_clusters`, or None if each is its own, and intervals
count clusters instead of values. An interval holds for other draws of the same variants: the spread
between variants is not a sampling error. One cluster has no interval, and an end of an interval is
NaN if there are too few values to bound it. All functions raise `ValueError` without values, if
lengths differ, and if a share q of a quantile is not between 0 and 1.
"""

import math
from bisect import bisect_left
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sinsjax.analysis.tables import numeric_column

CONFIDENCE = 0.95
RESAMPLES = 1000
TAIL = (1 - CONFIDENCE) / 2
CLUSTER_COLUMNS = ("draw_id", "start_s")

_MIN_CLUSTERS = 5  # fewest clusters that bound a root mean square
_UPPER = 1.3  # factor on the upper reach of a root's interval; Student's t, 5 degrees, needs it
_BLOCK = 2**22  # values drawn at a time, to bound the bootstrap's memory
_SYMMETRIC = 1e-6
_NODE = 0.25  # spacing of the nodes of the integral
_SMALL = 1e12  # where the integrand has decayed by this factor, it is cut off
_ROUNDING = 1e-12  # of a share


class Estimate(NamedTuple):
    """A number of n values with its 95 % interval; infinite means never, NaN unknown.

    An end of the interval is NaN if there are too few values to bound it.
    """

    value: float
    low: float
    high: float
    n: int


UNKNOWN = Estimate(math.nan, math.nan, math.nan, 0)
"""The estimate without any values."""


def draw_id_clusters(table: pa.Table) -> NDArray | None:
    """The cluster of each run of a summary, shape (rows,): its draw, or 0 for all runs on a record.

    Differing start times imply a record. None without ``draw_id``: each run is its own cluster.
    """
    draw, start = CLUSTER_COLUMNS
    if draw not in table.column_names:
        return None
    ids = numeric_column(table, draw).astype(int)
    if start in table.column_names and np.unique(numeric_column(table, start)).size > 1:
        return np.zeros_like(ids)
    return ids


def share(flags: ArrayLike, cluster: ArrayLike | None = None) -> Estimate:
    """The share of the values that are true, with an interval that holds for any dependence.

    It is that of `_lower_share_bound`; for independent runs that of Clopper and Pearson.

    Example:
        >>> analysis.format_estimate(analysis.share([True] * 16), digits=2)
        '1.00 [0.79, 1.00]'

        Three draws of two runs each, of which one run fails:

        >>> found = analysis.share([True, True, True, True, True, False], [0, 0, 1, 1, 2, 2])
        >>> analysis.format_estimate(found, digits=2)
        '0.83 [0.23, 1.00]'
    """
    data = _to_floats(flags)
    value, place = float(np.mean(data)), _cluster_places(cluster, data.size)
    runs, hits = np.bincount(place), np.bincount(place, data)
    if runs.size < 2 and cluster is not None:  # a draw or a record alone, be it of one run
        return UNKNOWN._replace(value=value, n=data.size)
    with_one_more = np.append(runs, runs.max())
    low, rest = (_lower_share_bound(np.append(k, 0.0), with_one_more) for k in (hits, runs - hits))
    return Estimate(value, low, 1 - rest, data.size)


def quantile(values: ArrayLike, q: float = 0.5, cluster: ArrayLike | None = None) -> Estimate:
    """The smallest value that at least a share q of the values does not exceed.

    NaN (null in a table: never settled) counts as infinite, so the result is infinite if fewer than
    a share q ever settled. It is always one of the values, never interpolated. So are the ends of
    its interval, which is distribution-free: order statistics for independent values (Conover 1999,
    section 3.2), else those of `_quantile_bounds`. An end is NaN if there are too few draws: 16
    draws of one run each do not bound a 90 % quantile from above.

    Example:
        >>> never = float("nan")
        >>> analysis.format_estimate(analysis.quantile([50, 60, 70, 80, 90, never]), "s", 0)
        '70 [50, never] s'
        >>> analysis.format_estimate(analysis.quantile(range(16), q=0.9), "s", 0)
        '14 [11, few draws] s'
    """
    data = _to_floats(values, missing=math.inf)
    n, at = data.size, _quantile_index(data.size, q)
    value, place = float(np.partition(data, at)[at]), _cluster_places(cluster, n)
    draws = int(place.max()) + 1
    if draws < 2 <= n:
        return UNKNOWN._replace(value=value, n=n)
    if draws < n:
        return Estimate(value, *_quantile_bounds(data, place, q), n)
    low, high = _binomial_rank_bounds(n, q)
    ends = [math.nan, *np.sort(data).tolist(), math.nan]
    return Estimate(value, ends[low], ends[high], n)


def _quantile_index(n: int, q: float) -> int:
    """Index of a quantile among n sorted values, as in numpy's method "inverted_cdf"."""
    if not 0 <= q <= 1:
        raise ValueError(f"a quantile needs 0 <= q <= 1, got {q}")
    rounding = 1 - 4 * np.finfo(float).eps  # of the product
    return max(math.ceil(n * q * rounding), 1) - 1


@lru_cache(maxsize=256)
def _binomial_rank_bounds(n: int, q: float) -> tuple[int, int]:
    """Ranks, from 1, of the ends of a quantile's interval among n values; 0 or n + 1 for none."""
    below = special.bdtr(np.arange(n), n, q)  # probability that at most 0, 1, ... lie below it
    return int(np.sum(below <= TAIL)), int(np.sum(1 - below > TAIL)) + 1


def _quantile_bounds(values: NDArray, draw_ids: NDArray, q: float) -> tuple[float, float]:
    """Bounds of the quantile of the runs of several draws: two of the values, or NaN.

    The lower one is the smallest value up to which the share of runs may reach q, the upper one the
    smallest value up to which it must exceed q, by the bounds of the mean share. The further draw
    has no share of 0 or 1 here, with which the spread between variants would count: ranked by
    value, each of its runs exceeds the extreme of its rank over the draws by the range of that
    rank. Draws count from 0.
    """
    order = np.argsort(values, kind="stable")
    values, draw_ids = values[order], draw_ids[order]
    distinct, first = np.unique(values, return_index=True)
    ends = np.append(first[1:], values.size)
    runs = np.bincount(draw_ids)
    sizes = np.append(runs, runs.max())
    least, most = np.array([-math.inf]), np.array([math.inf])
    if not np.ptp(runs):  # otherwise there are no ranks that all draws have
        ranks = values[np.argsort(draw_ids, kind="stable")].reshape(runs.size, -1)
        least, most = ranks.min(axis=0), ranks.max(axis=0)
        with np.errstate(invalid="ignore"):  # of a rank that never settles
            reach = np.nan_to_num(most - least, nan=0.0, posinf=math.inf)
        least, most = least - reach, most + reach

    def hits(place: int, extra_share: float) -> NDArray:
        own = np.bincount(draw_ids[: ends[place]] if place >= 0 else (), minlength=runs.size)
        return np.append(own, extra_share * sizes[-1])

    def may_reach(place: int) -> bool:  # -1: below all values
        others = sizes - hits(place, float(np.mean(least <= distinct[max(place, 0)])))
        return _probability_below(1 - q, others, sizes) >= TAIL

    def must_exceed(place: int) -> bool:
        own = hits(place, float(np.mean(most < distinct[place])))
        return _probability_below(q, own, sizes) < TAIL

    middle = min(int(np.searchsorted(ends / values.size, q)), distinct.size - 1)
    low = bisect_left(range(middle + 1), True, key=may_reach)
    high = bisect_left(range(distinct.size), True, lo=middle, key=must_exceed)
    return (
        math.nan if low == 0 and may_reach(-1) else float(distinct[low]),
        math.nan if high == distinct.size else float(distinct[high]),
    )


def _lower_share_bound(hits: NDArray, runs: NDArray) -> float:
    """The 2.5 % quantile of a randomly weighted share, a bound of it for any dependence in a draw.

    ``hits`` of the ``runs`` of each draw have the property; one further draw, the last, has a share
    of 0 for a lower bound and 1 for an upper bound. The shares are weighted with Dirichlet(1, ...,
    1) weights (Gaffke 2005, Three test statistics for a nonparametric one-sided hypothesis on the
    mean of a nonnegative variable; Learned-Miller and Thomas 2020, arXiv:1905.06208). With one run
    per draw the bounds are those of Clopper and Pearson, and no distribution is known that they
    cover less often than 95 %. If the numbers of runs differ, the weighted share is the ratio of
    the weighted sums, as is the estimate.
    """
    shares, draws = np.unique(hits / runs, return_counts=True)
    if shares.size == 1:
        return float(shares[0])
    if shares.size == 2 and np.ptp(runs) == 0:
        few, many = draws
        return float(shares[0] + np.ptp(shares) * special.betaincinv(many, few, TAIL))

    from scipy import optimize  # late: it takes a tenth of a second, and few studies need it

    def excess(share: float) -> float:
        return _probability_below(share, hits, runs) - TAIL

    return float(optimize.brentq(excess, shares[0], hits.sum() / runs.sum(), xtol=1e-9))


def _probability_below(share: float, hits: NDArray, runs: NDArray) -> float:
    """Probability that the weighted share is below a value; 1 from the share of all runs on.

    The weights are exponential variables over their sum, so this is the probability that the sum of
    these variables times ``excess`` is negative: the integral of its moment generating function
    over s along the line Re(s) = -at through the saddle point, for Im(s) = width sinh u, by the
    trapezoidal rule in u. Equal draws are counted together.
    """
    from scipy import optimize

    excess = hits - share * runs
    excess[np.abs(excess) < _ROUNDING * runs] = 0.0
    excess, copies = np.unique(excess, return_counts=True)
    if copies @ excess <= 0:
        return 1.0
    if excess[0] >= 0:
        return 0.0
    most = -1 / excess[0]

    def rise(at: float) -> float:
        return float(copies @ (excess / (1 + excess * at))) + 1 / at

    # Any nearby line gives the same integral.
    at = optimize.brentq(rise, 1e-9 * most, (1 - 1e-9) * most, rtol=0.01)
    width = 1 / math.sqrt(float(copies @ (excess / (1 + excess * at)) ** 2) + 1 / at**2)
    n_draws = copies.sum()
    u_end = math.asinh(math.sqrt(n_draws * (_SMALL ** (2 / n_draws) - 1)))
    u = np.arange(0.0, u_end + _NODE, _NODE)
    line = at + 1j * width * np.sinh(u)
    weight = width * np.cosh(u) * np.where(u > 0, 1.0, 0.5) * _NODE / np.pi
    values = np.exp(-np.log(1 + np.multiply.outer(line, excess)) @ copies) * weight / line
    return float(values.real.sum())


def _mean_error_count_skew(values: NDArray, cluster: NDArray) -> tuple[float, float, int, float]:
    """A mean, its standard error (NaN for one cluster), the number and skewness of clusters.

    A ratio estimate from the sums and sizes of the clusters (Cochran 1977, section 9A).
    """
    centre = float(np.mean(values))
    sums = np.bincount(np.unique(cluster, return_inverse=True)[1], values - centre)
    n, square = sums.size, float(np.sum(sums**2))
    error, skewness = math.nan, 0.0
    if n > 1:
        error = math.sqrt(square * n / (n - 1)) / values.size
    if n > 2 and square > 0:
        cubic = float(np.mean(sums**3)) / (square / n) ** 1.5
        skewness = cubic * math.sqrt(n * (n - 1)) / (n - 2)
    return centre, error, n, skewness


def _student_reach(n: int) -> float:
    """Upper 2.5 % quantile of Student's t for n clusters; NaN for one cluster."""
    return float(special.stdtrit(n - 1, 1 - TAIL)) if n > 1 else math.nan


def _skewness_corrected(score: float, skew: float) -> float:
    """The standardised error of the mean that Hall's transformation maps to a score."""
    if abs(skew) < _SYMMETRIC:
        return score
    return 3 / skew * (float(np.cbrt(1 + skew * (score - skew / 6))) - 1)


def mean(
    values: ArrayLike,
    cluster: ArrayLike | None = None,
    *,
    limits: tuple[float, float] = (-math.inf, math.inf),
) -> Estimate:
    """The mean of the finite values with Student's t interval, wider if the values are skewed.

    Non-finite values are omitted; ``n`` is the number used. One value has no interval, none gives
    :data:`UNKNOWN`. Each end is the outer one of Student's interval and of Hall's, which corrects
    it for the skewness of the values (Hall 1992, Journal of the Royal Statistical Society B 54,
    221). It ends at the limits, the least and largest value possible, which costs no coverage.

    Example:
        >>> analysis.format_estimate(analysis.mean([1.0, 2.0, 3.0, 4.0]))
        '2.5 [0.4, 4.6]'
    """
    data, place = _finite_values(values, cluster)
    if data.size == 0:
        return UNKNOWN
    centre, error, n, skewness = _mean_error_count_skew(data, place)
    reach, skew = _student_reach(n), skewness / math.sqrt(n)
    low = centre - max(reach, _skewness_corrected(reach, skew)) * error
    high = centre + max(reach, -_skewness_corrected(-reach, skew)) * error
    low, high = np.clip((low, high), *limits).tolist()
    return Estimate(centre, low, high, data.size)


def rms(
    values: ArrayLike, cluster: ArrayLike | None = None, *, max_magnitude: float = math.inf
) -> Estimate:
    """The root mean square of the finite values.

    Non-finite values are omitted; ``n`` is the number used. The interval is Student's t on a
    logarithmic scale, with Bonett's two corrections (2006, Computational Statistics and Data
    Analysis 50, 775) for the correlation of the estimate with its error, and `_UPPER`, since a
    sample seldom shows the tails of a distribution. Fewer than five values have none. It ends at
    ``max_magnitude``, the largest magnitude that a value can have.
    """
    data, place = _finite_values(values, cluster)
    if data.size == 0:
        return UNKNOWN
    square, error, n, _ = _mean_error_count_skew(data**2, place)
    value, ends = math.sqrt(square), (math.nan, math.nan)
    if square == 0.0 and n > 1:
        ends = 0.0, 0.0
    elif n >= _MIN_CLUSTERS:
        variance = n / (n - 2) * (error / square) ** 2
        reach = _student_reach(n) * math.sqrt(variance) * (1 + variance)
        low, high = (value * math.exp((variance + r) / 2) for r in (-reach, _UPPER * reach))
        ends = min(low, max_magnitude), min(high, max_magnitude)
    return Estimate(value, *ends, data.size)


def mean_difference(a: ArrayLike, b: ArrayLike, cluster: ArrayLike | None = None) -> Estimate:
    """The mean of a - b over pairs on the same noise, with the interval of `mean`.

    Pairs whose difference is not finite are omitted; ``n`` is the number used. b has the same draws
    in the same order as a.
    """
    first, second = _paired_arrays(a, b)
    with np.errstate(invalid="ignore"):  # infinite minus infinite, omitted by mean
        return mean(first - second, cluster)


def quantile_difference(a_by_draw: ArrayLike, b_by_draw: ArrayLike, q: float = 0.5) -> Estimate:
    """The quantile of a minus that of b, with a bootstrap interval over the pairs.

    b has the same draws in the same order as a. NaN counts as infinite as in `quantile`. Infinite
    minus finite is infinite. Infinite minus infinite is NaN as a value and 0 as an end of the
    interval, since two runs that never settle do not differ.
    """
    pair = _paired_arrays(a_by_draw, b_by_draw, missing=math.inf)
    at = _quantile_index(pair[0].size, q)

    def difference(picks: NDArray) -> NDArray:
        left, right = (np.partition(x[picks], at, axis=-1)[..., at] for x in pair)
        same = left == right  # also where both are infinite
        return np.where(same, 0.0, left - np.where(same, 0.0, right))

    every = np.arange(pair[0].size)
    never = all(math.isinf(np.partition(x, at)[at]) for x in pair)
    value = math.nan if never else float(difference(every))
    return Estimate(value, *bootstrap_interval(difference, every), every.size)


def proportion_difference(a_by_draw: ArrayLike, b_by_draw: ArrayLike) -> Estimate:
    """The share of true values of a minus that of b over pairs on the same noise.

    The interval is Newcombe's: it combines Wilson's intervals of the two shares, corrected for the
    correlation of the pairs (Newcombe 1998, Statistics in Medicine 17, 2635, method 10). Unlike
    Student's t it has a width even if no pair differs, and stays within -1 and 1. b has the same
    draws in the same order as a.
    """
    first, second = (x.astype(bool) for x in _paired_arrays(a_by_draw, b_by_draw))
    n = first.size
    k, m, both = (int(np.count_nonzero(x)) for x in (first, second, first & second))
    (one, one_low, one_high), (two, two_low, two_high) = (_wilson_interval(x, n) for x in (k, m))
    # Pearson's phi of the pairs, with Newcombe's continuity correction.
    scale, excess = math.sqrt(k * (n - k) * m * (n - m)), float(n * both - k * m)
    excess = max(excess - n / 2, 0.0) if excess > 0 else excess
    correlation = excess / scale if scale else 0.0

    def half_width(x: float, y: float) -> float:
        return math.sqrt(max(x * x - 2 * correlation * x * y + y * y, 0.0))

    low = one - two - half_width(one - one_low, two_high - two)
    high = one - two + half_width(one_high - one, two - two_low)
    return Estimate(one - two, low, high, n)


def _wilson_interval(k: int, n: int) -> tuple[float, float, float]:
    """The share k/n, and the ends of Wilson's score interval."""
    part, z = k / n, float(special.ndtri(1 - TAIL))
    centre = (k + z * z / 2) / (n + z * z)
    half = z / (n + z * z) * math.sqrt(n * part * (1 - part) + z * z / 4)
    # At 0 and 1 an end of the interval equals the share, apart from rounding.
    return part, centre - half if k else 0.0, centre + half if k < n else 1.0


def bootstrap_interval(
    statistic: Callable[[NDArray], NDArray], numbers: NDArray
) -> tuple[float, float]:
    """Percentile bootstrap interval of a statistic, the same at every call.

    The statistic is a function of resampled numbers, shape (..., n), over their last axis. The ends
    are NaN for fewer than two numbers, such as those of the draws, shape (n,).
    """
    random, n = np.random.default_rng(0), numbers.size
    if n < 2:
        return math.nan, math.nan
    block = max(1, _BLOCK // n)
    drawn = [
        statistic(numbers[random.integers(0, n, (min(block, RESAMPLES - start), n))])
        for start in range(0, RESAMPLES, block)
    ]
    # Order statistics: interpolation between infinite values would give NaN.
    low, high = np.quantile(np.concatenate(drawn), [TAIL, 1 - TAIL], method="inverted_cdf")
    return float(low), float(high)


def _to_floats(values: ArrayLike, *, missing: float = math.nan) -> NDArray:
    """Values as float64, shape (n,), with NaN replaced; there must be at least one."""
    data = np.asarray(values, dtype=np.float64)
    if data.ndim != 1 or data.size == 0:
        raise ValueError(f"one or more values in one dimension are needed, got shape {data.shape}")
    return np.where(np.isnan(data), missing, data)


def _cluster_places(cluster: ArrayLike | None, size: int) -> NDArray:
    """The number of the cluster of each value, from 0, shape (size,)."""
    if cluster is None:
        return np.arange(size)
    ids = np.asarray(cluster)
    if ids.shape != (size,):
        raise ValueError(f"{size} values need as many clusters, got {ids.size}")
    return np.unique(ids, return_inverse=True)[1]


def _finite_values(values: ArrayLike, cluster: ArrayLike | None) -> tuple[NDArray, NDArray]:
    """The finite values, with the numbers of their clusters."""
    data = _to_floats(values)
    is_finite = np.isfinite(data)
    return data[is_finite], _cluster_places(cluster, data.size)[is_finite]


def _paired_arrays(a: ArrayLike, b: ArrayLike, missing: float = math.nan) -> tuple[NDArray, ...]:
    first, second = _to_floats(a, missing=missing), _to_floats(b, missing=missing)
    if first.shape != second.shape:
        raise ValueError(f"pairs need equal lengths, got {first.size} and {second.size}")
    return first, second
