"""Bounds of shares and quantiles over draws, whatever the dependence of the runs of a draw.

The shares of the draws are weighted at random, with Dirichlet(1, ..., 1) weights, together with one
further draw, whose share is 0 for a lower bound and 1 for an upper bound. The bounds are the 2.5 %
and 97.5 % quantiles of the weighted share (Gaffke 2005, Three test statistics for a nonparametric
one-sided hypothesis on the mean of a nonnegative variable; Learned-Miller and Thomas 2020,
arXiv:1905.06208). With one run per draw they are those of Clopper and Pearson, and no distribution
is known that they cover less often than 95 %. Both decrease with each additional failure. If the
numbers of runs differ, the weighted share is the ratio of the weighted sums, as is the estimate.
"""

import math
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

_STEPS = 60  # at most, of a root search
_NODE = 0.25  # spacing of the nodes of the integral
_SMALL = 1e12  # where the integrand has decayed by this factor, it is cut off
_FAR = 5.0  # standard deviations; an exponential tail is then below 0.3 %
_NEAR = 0.002  # standard deviations; so small a Newton step leaves an error of its square
_ROUNDING = 1e-12  # of a share
_MAX_UNCOUNTED_DRAWS = 64  # up to which counting equal draws does not pay


class DrawCounts(NamedTuple):
    """Numbers of runs per draw; draws with the same numbers are counted together.

    Attributes:
        hits: runs with the property, shape (different draws,).
        runs: all runs, likewise.
        copies: number of such draws, likewise.
    """

    hits: NDArray
    runs: NDArray
    copies: NDArray

    @classmethod
    def from_runs(cls, hits: NDArray, runs: NDArray) -> "DrawCounts":
        """Count equal draws together, from the numbers of each draw, shape (draws,) both."""
        pairs, count = np.unique(hits + 1j * runs, return_counts=True)
        return cls(pairs.real, pairs.imag, count.astype(float))

    def complement(self) -> "DrawCounts":
        """The same draws with the runs that do not have the property."""
        return self._replace(hits=self.runs - self.hits)

    def with_extra_draw(self, share: float) -> "DrawCounts":
        """Add one draw with a share, of as many runs as the largest draw."""
        most = self.runs.max()
        added = (share * most, most, 1.0)
        return DrawCounts(
            *(np.append(counts, extra) for counts, extra in zip(self, added, strict=True))
        )

    def mean_share(self) -> float:
        """The share of all runs."""
        return float(self.hits @ self.copies) / float(self.runs @ self.copies)

    def standard_deviation(self) -> float:
        """Approximate standard deviation of the weighted share."""
        excess = self.hits - self.mean_share() * self.runs
        return math.sqrt(float(self.copies @ excess**2)) / float(self.runs @ self.copies)

    def skewness(self) -> float:
        """Approximate skewness of the weighted share."""
        excess = self.hits - self.mean_share() * self.runs
        return 2 * float(self.copies @ excess**3) / float(self.copies @ excess**2) ** 1.5

    def exceeds(self, share: float, tail: float) -> bool:
        """Return whether a share is below the ``tail`` quantile of the weighted share.

        Its density is log-concave (a B-spline), so that a value beyond the mean, or many standard
        deviations from it, needs no integral.
        """
        excess = self.hits - share * self.runs
        excess[np.abs(excess) < _ROUNDING * self.runs] = 0.0
        total = float(self.copies @ excess)
        if total <= 0 or excess.min() >= 0 or total > _FAR * math.sqrt(self.copies @ excess**2):
            return total > 0
        return _probability_below(excess, self.runs, self.copies)[0] < tail

    def lower_bound(self, tail: float) -> float:
        """The value that the mean share of the draws is below with at most this probability."""
        return _weighted_share_quantile(*map(tuple, self.with_extra_draw(0.0)), tail)


@lru_cache(maxsize=4096)
def _weighted_share_quantile(
    hits: Iterable[float], runs: Iterable[float], copies: Iterable[float], tail: float
) -> float:
    """The ``tail`` quantile of the weighted share of `DrawCounts`."""
    draws = DrawCounts(*map(np.asarray, (hits, runs, copies)))
    shares, place = np.unique(draws.hits / draws.runs, return_inverse=True)
    if shares.size == 1:
        return float(shares[0])
    if shares.size == 2 and np.ptp(draws.runs) == 0:
        few, many = np.bincount(place, draws.copies)
        return float(shares[0] + np.ptp(shares) * special.betaincinv(many, few, tail))
    mean, spread = draws.mean_share(), draws.standard_deviation()
    goal = float(special.ndtri(tail))
    low, high = float(shares[0]), float(shares[-1])
    skewed = (goal * goal - 1) / 6 * draws.skewness()
    share = max(mean + (goal + skewed) * spread, low + 0.1 * (mean - low))
    for _ in range(_STEPS):  # Newton's method for the normal score, which is nearly linear
        below, slope = _probability_below(draws.hits - share * draws.runs, draws.runs, draws.copies)
        low, high = (low, share) if below > tail else (share, high)
        score = float(special.ndtri(below))
        density = math.exp(-score * score / 2) / math.sqrt(2 * math.pi)
        after = share + (goal - score) * density / slope if slope > 0 else math.nan
        if not low < after < high:
            after = (low + high) / 2
        share, moved = after, abs(after - share)
        if moved < _NEAR * spread:
            break
    return share


def quantile_bounds(
    values: NDArray, draw_ids: NDArray, q: float, tail: float
) -> tuple[float, float]:
    """Bounds of the quantile of the runs of several draws: two of the values.

    The lower one is the smallest value up to which the share of runs may reach q, the upper one the
    smallest value up to which it must exceed q, by the bounds of the mean share. The further draw
    has no share of 0 or 1 here: ranked by value, each of its runs exceeds the extreme of its rank
    over the draws by the range of that rank. With a share of 0 or 1 the spread between
    variants would count: of eight variants that differ by far more than the draws, the 90 %
    quantile of 16 draws would be bounded by the next variant or not at all. If all runs of a draw
    are equal, and with one run per draw, the further draw is beyond all values, which makes the
    bounds binomial.

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
    distinct = np.unique(values)
    ends = np.searchsorted(values, distinct, side="right")
    runs = np.bincount(draw_ids)
    least, most = _extra_draw_range(values, draw_ids, runs)
    sizes = np.append(runs, runs.max()).astype(float)

    def counts_up_to(place: int, extra_share: float) -> DrawCounts:
        hits = np.bincount(draw_ids[: ends[place]] if place >= 0 else (), minlength=sizes.size)
        hits = hits.astype(float)
        hits[-1] = extra_share * sizes[-1]
        if sizes.size > _MAX_UNCOUNTED_DRAWS:
            return DrawCounts.from_runs(hits, sizes)
        return DrawCounts(hits, sizes, np.ones_like(sizes))

    def may_reach(place: int) -> bool:  # -1: below all values
        share = np.count_nonzero(least <= distinct[max(place, 0)]) / least.size
        return not counts_up_to(place, share).complement().exceeds(1 - q, tail)

    def must_exceed(place: int) -> bool:
        share = np.count_nonzero(most < distinct[place]) / most.size
        return counts_up_to(place, share).exceeds(q, tail)

    shares = ends / values.size
    middle = min(int(np.searchsorted(shares, q)), distinct.size - 1)
    reach = 2 * counts_up_to(middle, q).standard_deviation()
    first, last = np.searchsorted(shares, (q - reach, q + reach)).tolist()
    low = _first_passing_index(may_reach, 0, middle + 1, first)
    high = _first_passing_index(must_exceed, middle, distinct.size, last)
    return (
        math.nan if low == 0 and may_reach(-1) else float(distinct[low]),
        math.nan if high == distinct.size else float(distinct[high]),
    )


def _extra_draw_range(values: NDArray, draw_ids: NDArray, runs: NDArray) -> tuple[NDArray, NDArray]:
    """The values of a draw below the others and of one above the others: see `quantile_bounds`."""
    if np.ptp(runs):  # no ranks that all draws have
        return np.array([-math.inf]), np.array([math.inf])
    ranks = values[np.argsort(draw_ids, kind="stable")].reshape(runs.size, -1)
    least, most = ranks.min(axis=0), ranks.max(axis=0)
    with np.errstate(invalid="ignore"):  # of a rank that never settles
        reach = np.nan_to_num(most - least, nan=0.0, posinf=math.inf)
    return least - reach, most + reach


def _first_passing_index(test: Callable[[int], bool], start: int, stop: int, guess: int) -> int:
    """First place from start to stop that passes a test, as all later ones do; stop for none."""
    low, high, step = start, stop, max((stop - start) // 64, 1)
    place = min(max(guess, start), stop - 1)
    while low < high:
        passed = test(place)
        low, high = (low, place) if passed else (place + 1, high)
        if low > start and high < stop:
            place = (low + high) // 2
        else:
            place = max(low, place - step) if passed else min(high - 1, place + step)
            step *= 2
    return low


def _probability_below(excess: NDArray, runs: NDArray, copies: NDArray) -> tuple[float, float]:
    """Probability that the weighted share is below a value, and its derivative by the value.

    The weights are exponential variables over their sum, so this is the probability that the sum of
    these variables times ``excess`` is negative: the integral of its moment generating function
    over s along the line Re(s) = -at through the saddle point, for Im(s) = width sinh u, by the
    trapezoidal rule in u.

    Args:
        excess: hits minus value times runs of each different draw, of both signs.
        runs: runs of each different draw.
        copies: number of such draws.
    """
    low, high = 0.0, -1 / float(excess.min())
    drift, square = float(copies @ excess), float(copies @ excess**2)
    at = min((drift + math.sqrt(drift * drift + 4 * square)) / (2 * square), 0.9 * high)
    for _ in range(_STEPS):
        scaled = excess / (1 + excess * at)
        rise, bend = float(copies @ scaled) + 1 / at, float(copies @ scaled**2) + 1 / at**2
        low, high = (at, high) if rise > 0 else (low, at)
        after = at + rise / bend
        if not low < after < high:
            after = (low + high) / 2
        at, moved = after, abs(after - at)
        if moved < 0.01 * at:  # any nearby line gives the same integral
            break
    scaled = excess / (1 + excess * at)
    width = 1 / math.sqrt(float(copies @ scaled**2) + 1 / at**2)
    sinh, weight = _integration_nodes(float(copies.sum()))
    line = at + 1j * width * sinh
    factors = 1 + np.multiply.outer(line, excess)
    values = np.exp(-np.log(factors) @ copies) * width * weight
    slopes = values * ((copies * runs) / factors).sum(axis=-1)
    return float((values / line).real.sum()), float(slopes.real.sum())


@lru_cache(maxsize=256)
def _integration_nodes(n_draws: float) -> tuple[NDArray, NDArray]:
    """Sinh u, and cosh u times the weight, at the nodes of the integral for so many draws."""
    reach = math.asinh(math.sqrt(n_draws * (_SMALL ** (2 / n_draws) - 1)))
    u = np.arange(0.0, reach + _NODE, _NODE)
    return np.sinh(u), np.cosh(u) * np.where(u > 0, 1.0, 0.5) * _NODE / np.pi
