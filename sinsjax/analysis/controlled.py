"""Estimates that known expectations control: companions of the values, whose mean is known.

What a companion explains of a value's scatter is taken off, so that few draws give the interval of
many (control variates: Glasserman 2003, Monte Carlo methods in financial engineering, section 4.1).
"""

import math
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sinsjax.analysis.estimates import (
    TAIL,
    UNKNOWN,
    Estimate,
    clean,
    mean,
    proportion,
    rms,
)

_HIDDEN = 2
"""Residuals of one standard deviation that a few draws may have hidden."""


class Expectation(NamedTuple):
    """What is known of the mean of companions.

    Attributes:
        value: that mean.
        error: its standard error; 0 where it is exact.
    """

    value: float
    error: float = 0.0


class Controlled(NamedTuple):
    """An estimate from draws alone, and the same with companions.

    Attributes:
        plain: from the values alone.
        controlled: with the companions.
    """

    plain: Estimate
    controlled: Estimate

    @property
    def saved(self) -> float:
        """How many times as many draws the plain estimate needs for the same interval.

        NaN where an interval is unknown, or has no width.
        """
        plain, controlled = (one.high - one.low for one in self)
        return (plain / controlled) ** 2 if controlled > 0 else math.nan


NOTHING = Controlled(UNKNOWN, UNKNOWN)
"""Of no values, or where some are unknown."""


def controlled_mean(values: ArrayLike, companions: ArrayLike, expected: Expectation) -> Controlled:
    """The mean of values, with their regression on companions whose mean is known.

    The interval is Student's t of the residuals, n - 2 degrees of freedom, and has the error of
    the expectation in it. Two residuals of one standard deviation are added (`_HIDDEN`), without
    which few draws promise too much: most settle with their companions to the second, the rest far
    apart. So companions save at most a factor of n/2; `benchmarks/interval_coverage.py` measures
    the coverage.

    Args:
        values: (n,) finite numbers, any unit; otherwise nothing is known.
        companions: (n,) likewise, of the same draws in the same order.
        expected: mean of the companions over all draws.
    """
    y, x = _pairs(values, companions)
    if not np.isfinite([*y, *x, *expected]).all():
        return NOTHING
    plain, fit = mean(y), _fit(y, x)
    if fit is None:
        return Controlled(plain, plain)
    slope, residual, spread = fit
    away = float(np.mean(x)) - expected.value
    value = plain.value - slope * away
    variance = residual * (1 / y.size + away**2 / spread) + (slope * expected.error) ** 2
    half = -float(special.stdtrit(y.size - 2, TAIL)) * math.sqrt(variance)
    return Controlled(plain, Estimate(value, value - half, value + half, y.size))


def controlled_rms(values: ArrayLike, companions: ArrayLike, expected: Expectation) -> Controlled:
    """The root mean square of values, from the controlled mean of their squares.

    The interval is that of the mean square on a logarithmic scale, as for
    `sinsjax.analysis.rms`; where that mean is not beyond zero, it is the plain one.

    Args:
        values: (n,) finite numbers, any unit; otherwise nothing is known.
        companions: (n,) likewise, of the same draws in the same order.
        expected: mean of the companions' squares over all draws.
    """
    y, x = _pairs(values, companions)
    square = controlled_mean(y**2, x**2, expected).controlled
    if math.isnan(square.value):
        return NOTHING
    plain = rms(y)
    if square.value <= 0:
        return Controlled(plain, plain)
    value, reach = math.sqrt(square.value), (square.high - square.value) / square.value / 2
    low, high = (value * math.exp(sign * reach) for sign in (-1, 1))
    return Controlled(plain, Estimate(value, low, high, y.size))


def controlled_share(flags: ArrayLike, companions: ArrayLike, expected: Expectation) -> Controlled:
    """The share of the values that are true, beside that of their companions, which is known.

    The known share and the difference of the two, with the interval of Bonett and Price for paired
    shares (2012, Journal of Educational and Behavioral Statistics 37, 479), which has a width even
    where none differ.

    Args:
        flags: (n,) bool.
        companions: (n,) bool, of the same draws in the same order.
        expected: share of all companions.
    """
    y, x = _pairs(flags, companions)
    if not np.isfinite([*y, *x, *expected]).all():
        return NOTHING
    n, more, less = y.size, int(np.sum(y > x)), int(np.sum(y < x))
    plain = proportion(round(float(np.sum(y))), n)
    # A pair is added to either kind of those that differ.
    apart, differ = (more - less) / (n + 2), (more + less + 2) / (n + 2)
    variance = (differ - apart**2) / (n + 2) + expected.error**2
    half = float(special.ndtri(1 - TAIL)) * math.sqrt(variance)
    parts = ((more - less) / n, apart - half, apart + half)
    value, low, high = (min(max(expected.value + part, 0.0), 1.0) for part in parts)
    return Controlled(plain, Estimate(value, low, high, n))


def samples_needed(values: ArrayLike, companions: ArrayLike, share: float) -> float:
    """How many samples of the companions give an expectation that is good enough.

    Args:
        values: (n,) any unit.
        companions: (n,) of the same draws.
        share: of the variance of the controlled mean, which that of the expectation is below.
    """
    y, x = _pairs(values, companions)
    fit = _fit(y, x) if np.isfinite([*y, *x]).all() else None
    if fit is None:
        return 0.0
    slope, residual, _ = fit
    scatter = slope**2 * float(np.var(x, ddof=1))
    if scatter == 0.0:
        return 0.0
    return scatter * y.size / (share * residual) if residual > 0 else math.inf


def _fit(y: NDArray, x: NDArray) -> tuple[float, float, float] | None:
    """Slope of y over x, variance of the residuals, and sum of squares of x about its mean.

    None where x does not scatter, or for fewer than three values.
    """
    spread = float(np.sum((x - np.mean(x)) ** 2))
    if y.size < 3 or spread <= 1e-24 * float(np.sum(x**2)):
        return None
    centred = y - np.mean(y)
    slope = float(np.sum((x - np.mean(x)) * centred)) / spread
    total = float(np.sum(centred**2))
    left = max(total - slope**2 * spread, 0.0)
    hidden = _HIDDEN * max(total, spread) / (y.size - 1)
    return slope, (left + hidden) / (y.size - 2), spread


def _pairs(values: ArrayLike, companions: ArrayLike) -> tuple[NDArray, NDArray]:
    y, x = clean(values), clean(companions)
    if y.shape != x.shape:
        raise ValueError(f"as many companions as values are needed: {x.size} for {y.size}")
    return y, x


def mean_over_variants(
    rows: pa.Table, column: str, expected: list[NDArray], ends: NDArray
) -> Controlled:
    """Mean settling time over some variants, draw by draw: they share their noise.

    Args:
        rows: of whole variants, with ``variant_id``, ``draw_id``, the column and its companion.
        column: of the settling times, s; one that is null counts as the length of the run.
        expected: mean and standard error of the companions by variant, s.
        ends: length of the run by variant, s.
    """
    rows = rows.sort_by([("draw_id", "ascending"), ("variant_id", "ascending")])
    ids = np.unique(rows["variant_id"].to_numpy())

    def of(name: str) -> NDArray:
        seconds = rows[name].to_numpy(zero_copy_only=False).reshape(-1, len(ids))
        return np.where(np.isnan(seconds), ends[ids], seconds).mean(axis=1)

    # The sampled errors of all variants have the same noise: their errors add up.
    value, error = (float(one[ids].mean()) for one in expected)
    return controlled_mean(of(column), of(f"companion_{column}"), Expectation(value, error))
