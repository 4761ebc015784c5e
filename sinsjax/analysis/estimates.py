"""Single numbers over some runs, each with its 95 % interval.

Nothing is dropped in silence: a run that never settled counts as an infinite settling time, and an
:class:`Estimate` says how many values it rests on. The intervals:

* shares: Wilson's score interval; means: Student's t;
* quantiles: the bootstrap's percentile interval, in closed form and at home with infinite values;
* standard deviations and root mean squares: seeded percentile bootstrap. Not BCa: its jackknife
  has no meaning with infinite values and costs n^2.

An interval's end is NaN where the values are too few to bound it.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

CONFIDENCE = 0.95
RESAMPLES = 1000
SEED = 0
TAIL = (1 - CONFIDENCE) / 2
_BLOCK = 2**22  # values drawn at a time: bounds the bootstrap's memory


class Estimate(NamedTuple):
    """A number with its 95 % interval.

    Attributes:
        value: the estimate; infinite means never, NaN means unknown.
        low: lower end of the interval; NaN where too few values bound it.
        high: upper end of the interval, likewise.
        n: how many values it rests on.
    """

    value: float
    low: float
    high: float
    n: int


UNKNOWN = Estimate(math.nan, math.nan, math.nan, 0)
"""The estimate that rests on nothing."""


def format_estimate(estimate: Estimate, unit: str = "", digits: int = 1) -> str:
    """An estimate as text, such as ``12.3 [11.9, 12.8] s``.

    Args:
        estimate: what to write; infinite numbers become ``never``, NaN becomes ``unknown``.
        unit: written after the interval if given.
        digits: decimals.
    """
    words = {"nan": "unknown", "inf": "never", "-inf": "-never"}
    printed = (f"{number:.{digits}f}" for number in estimate[:3])
    value, low, high = (words.get(text, text) for text in printed)
    return f"{value} [{low}, {high}] {unit}".rstrip()


def format_difference(
    estimate: Estimate,
    unit: str = "",
    digits: int = 1,
    sides: tuple[str, str] = ("one side", "one side"),
) -> str:
    """A difference of two settling times as text: what never settles is told in words.

    Such as ``12.3 [11.9, 12.8] s``, ``one side never settles`` or ``neither settles``.

    Args:
        estimate: of :func:`sinsjax.analysis.quantile_difference`; NaN of some pairs means that
            neither settles.
        unit: written after the interval if given.
        digits: decimals.
        sides: what was compared, the one that the other is taken from first.
    """
    value, low, high = map(float, estimate[:3])
    if math.isnan(value):
        return "neither settles" if estimate.n else "unknown"

    def text(number: float) -> str:
        if math.isinf(number):
            return f"{sides[0] if number > 0 else sides[1]} never settles"
        return "unknown" if math.isnan(number) else f"{number:.{digits}f}"

    if math.isinf(value) and {low, high} <= {value, 0.0}:  # ends at 0 where neither settles
        return text(value)
    return f"{text(value)} [{text(low)}, {text(high)}] {unit}".rstrip()


@lru_cache(maxsize=4096)
def proportion(k: int, n: int) -> Estimate:
    """The share k/n with Wilson's score interval.

    Args:
        k: runs that have the property.
        n: all runs.

    Raises:
        ValueError: n is below 1, or k outside 0..n.
    """
    if n < 1 or not 0 <= k <= n:
        raise ValueError(f"a share needs 0 <= k <= n and n >= 1, got k = {k}, n = {n}")
    share, z = k / n, float(special.ndtri(1 - TAIL))
    centre = (k + z * z / 2) / (n + z * z)
    half = z / (n + z * z) * math.sqrt(n * share * (1 - share) + z * z / 4)
    # At the ends the interval reaches the share itself, but for rounding.
    return Estimate(share, centre - half if k else 0.0, centre + half if k < n else 1.0, n)


def quantile(values: ArrayLike, q: float = 0.5) -> Estimate:
    """The smallest value that at least a share q of the values does not exceed.

    NaN (null in a table: never settled) counts as infinite, so the result is infinite where fewer
    than a share q ever settled. It is always one of the values, never an interpolation.

    The interval is the percentile interval of the bootstrap without the resampling: the k-th of n
    values drawn anew is at most the j-th of the sample with the probability that a binomial
    variable of n trials at j/n reaches k (Efron 1979, section 3; Hutson and Ernst 2000). An end is
    NaN where not even the smallest or the largest of so few values is such a bound.

    Args:
        values: shape (n,), any unit.
        q: from 0 to 1.

    Raises:
        ValueError: no values, or q out of range.
    """
    data = clean(values, missing=math.inf)
    n, at = data.size, place(data.size, q)
    low, high = _bounds(n, at + 1)
    ordered = np.partition(data, [at, low, high])
    return Estimate(
        float(ordered[at]),
        float(ordered[low]) if (1 - q) ** n <= TAIL else math.nan,
        float(ordered[high]) if q**n <= TAIL else math.nan,
        n,
    )


def place(n: int, q: float) -> int:
    """Where a quantile stands among n sorted values, from 0; as numpy's method "inverted_cdf".

    Raises:
        ValueError: q out of range.
    """
    if not 0 <= q <= 1:
        raise ValueError(f"a quantile needs 0 <= q <= 1, got {q}")
    rounding = 1 - 4 * np.finfo(float).eps  # of the product
    return max(math.ceil(n * q * rounding), 1) - 1


@lru_cache(maxsize=256)
def _bounds(n: int, k: int) -> tuple[int, int]:
    """Where the ends of the interval of the k-th of n sorted values stand, from 0."""
    low, high = (math.ceil(n * special.betaincinv(k, n - k + 1, p)) for p in (TAIL, 1 - TAIL))
    return low - 1, high - 1


def mean(values: ArrayLike) -> Estimate:
    """The mean of the finite values with Student's t interval.

    Values that are not finite are left out; ``n`` says how many were used. One value has no
    interval, none gives :data:`UNKNOWN`.

    Args:
        values: shape (m,), any unit.

    Raises:
        ValueError: no values at all.
    """
    data = _finite(values)
    if data.size < 2:
        return UNKNOWN._replace(value=float(data[0]) if data.size else math.nan, n=data.size)
    centre = float(np.mean(data))
    factor = special.stdtrit(data.size - 1, 1 - TAIL) / math.sqrt(data.size)
    half = float(factor * np.std(data, ddof=1))
    return Estimate(centre, centre - half, centre + half, data.size)


def std(values: ArrayLike) -> Estimate:
    """The sample standard deviation (n - 1) of the finite values with a bootstrap interval.

    Values that are not finite are left out; ``n`` says how many were used. Fewer than two have no
    standard deviation.

    Args:
        values: shape (m,), any unit.

    Raises:
        ValueError: no values at all.
    """
    data = _finite(values)
    if data.size < 2:
        return UNKNOWN._replace(n=data.size)
    low, high = bootstrap(lambda x: np.std(x, axis=-1, ddof=1), data)
    return Estimate(float(np.std(data, ddof=1)), low, high, data.size)


def rms(values: ArrayLike) -> Estimate:
    """The root mean square of the finite values with a bootstrap interval.

    Values that are not finite are left out; ``n`` says how many were used. One value has no
    interval.

    Args:
        values: shape (m,), any unit.

    Raises:
        ValueError: no values at all.
    """
    data = _finite(values)
    if data.size == 0:
        return UNKNOWN
    low, high = bootstrap(_root_mean_square, data)
    return Estimate(float(_root_mean_square(data)), low, high, data.size)


def _root_mean_square(values: NDArray) -> NDArray:
    return np.asarray(np.sqrt(np.mean(values**2, axis=-1)))


def chi2_mean_band(freedom: int, n: int) -> tuple[float, float]:
    """The 95 % band of the mean of n chi-square values: n times it has n times the freedom.

    Where a filter's belief is true, its mean NEES over independent runs lies in it in 95 of 100
    studies (Bar-Shalom, Li and Kirubarajan 2001, section 5.4).

    Args:
        freedom: degrees of freedom of one value, from 1.
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


def _finite(values: ArrayLike) -> NDArray:
    """The finite ones of some values, of which there must be one or more."""
    data = clean(values)
    return data[np.isfinite(data)]


def bootstrap(statistic: Callable[..., NDArray], *samples: NDArray) -> tuple[float, float]:
    """Percentile interval of a statistic, the same at every call.

    Args:
        statistic: of arrays (..., n), one a sample, over their last axis.
        samples: shape (n,) each; they share their resampling, which keeps pairs together.

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
