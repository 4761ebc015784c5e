"""Bounds of shares and quantiles over draws, whatever the dependence of the runs of a draw.

The shares of the draws are weighted at random, with Dirichlet(1, ..., 1) weights, together with one
further draw, whose share is 0 for a lower bound and 1 for an upper bound. The bounds are the 2.5 %
and 97.5 % quantiles of the weighted share (Gaffke 2005, Three test statistics for a nonparametric
one-sided hypothesis on the mean of a nonnegative variable; Learned-Miller and Thomas 2020,
arXiv:1905.06208). With one run per draw they are those of Clopper and Pearson, and no distribution
is known that they cover less often than 95 %. If the numbers of runs differ, the weighted share is
the ratio of the weighted sums, as is the estimate.
"""

import math
from bisect import bisect_left

import numpy as np
from numpy.typing import NDArray
from scipy import special

_NODE = 0.25  # spacing of the nodes of the integral
_SMALL = 1e12  # where the integrand has decayed by this factor, it is cut off
_ROUNDING = 1e-12  # of a share


def share_bounds(hits: NDArray, runs: NDArray, tail: float) -> tuple[float, float]:
    """Bounds of the share of runs that have a property.

    Args:
        hits: runs of each draw that have it, shape (draws,).
        runs: all runs of each draw, shape (draws,).
        tail: probability of a share beyond one of the bounds.
    """
    low, rest = (
        _weighted_share_quantile(np.append(k, 0.0), np.append(runs, runs.max()), tail)
        for k in (hits, runs - hits)
    )
    return low, 1 - rest


def quantile_bounds(
    values: NDArray, draw_ids: NDArray, q: float, tail: float
) -> tuple[float, float]:
    """Bounds of the quantile of the runs of several draws: two of the values.

    The lower one is the smallest value up to which the share of runs may reach q, the upper one the
    smallest value up to which it must exceed q, by the bounds of the mean share. The further draw
    has no share of 0 or 1 here, with which the spread between variants would count: ranked by
    value, each of its runs exceeds the extreme of its rank over the draws by the range of that
    rank.

    Args:
        values: shape (n,); infinite for never.
        draw_ids: draw of each value, from 0, shape (n,).
        q: from 0 to 1.
        tail: probability of a quantile beyond one of the bounds.

    Returns:
        Lower and upper bound; NaN where there are too few draws to bound it.
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
        return _probability_below(1 - q, others, sizes) >= tail

    def must_exceed(place: int) -> bool:
        own = hits(place, float(np.mean(most < distinct[place])))
        return _probability_below(q, own, sizes) < tail

    middle = min(int(np.searchsorted(ends / values.size, q)), distinct.size - 1)
    low = bisect_left(range(middle + 1), True, key=may_reach)
    high = bisect_left(range(distinct.size), True, lo=middle, key=must_exceed)
    return (
        math.nan if low == 0 and may_reach(-1) else float(distinct[low]),
        math.nan if high == distinct.size else float(distinct[high]),
    )


def _weighted_share_quantile(hits: NDArray, runs: NDArray, tail: float) -> float:
    """The ``tail`` quantile of the weighted share, which is below the share of all runs."""
    from scipy import optimize  # late: it takes a tenth of a second, and few studies need it

    shares, draws = np.unique(hits / runs, return_counts=True)
    if shares.size == 1:
        return float(shares[0])
    if shares.size == 2 and np.ptp(runs) == 0:
        few, many = draws
        return float(shares[0] + np.ptp(shares) * special.betaincinv(many, few, tail))

    def excess(share: float) -> float:
        return _probability_below(share, hits, runs) - tail

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
