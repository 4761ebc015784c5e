"""Statistics over the summary table, each with its 95 % interval.

Nothing is dropped in silence: a run that never settled counts as an infinite settling time, and an
:class:`Estimate` says how many values it rests on. The intervals:

* shares: Wilson's score interval; means: Student's t;
* quantiles: order statistics with binomial ranks, free of any distribution and at home with
  infinite values;
* standard deviations and differences of quantiles: seeded percentile bootstrap. Not BCa: its
  jackknife fails for quantiles, has no meaning with infinite values and costs n^2.

An interval's end is NaN where the values are too few to bound it.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sinsjax.types import InputError

CONFIDENCE = 0.95
RESAMPLES = 1000
SEED = 0
_TAIL = (1 - CONFIDENCE) / 2
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


@lru_cache(maxsize=4096)  # scipy also works out a p-value, which costs 1 ms
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
    share, z = k / n, float(special.ndtri(1 - _TAIL))
    centre = (k + z * z / 2) / (n + z * z)
    half = z / (n + z * z) * math.sqrt(n * share * (1 - share) + z * z / 4)
    # At the ends the interval reaches the share itself, but for rounding.
    return Estimate(share, centre - half if k else 0.0, centre + half if k < n else 1.0, n)


def quantile(values: ArrayLike, q: float = 0.5) -> Estimate:
    """The smallest value that at least a share q of the values does not exceed.

    NaN (null in a table: never settled) counts as infinite, so the result is infinite where fewer
    than a share q ever settled. It is always one of the values, never an interpolation.

    Args:
        values: shape (n,), any unit.
        q: from 0 to 1.

    Raises:
        ValueError: no values, or q out of range.
    """
    data = np.sort(_values(values, missing=math.inf))
    value = float(np.quantile(data, q, method="inverted_cdf"))
    low, high = _ranks(data.size, q)
    bounded = np.concatenate([[np.nan], data, [np.nan]])
    return Estimate(value, float(bounded[low]), float(bounded[high]), data.size)


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
    factor = special.stdtrit(data.size - 1, 1 - _TAIL) / math.sqrt(data.size)
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
    low, high = _bootstrap(lambda x: np.std(x, axis=-1, ddof=1), data)
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
    low, high = _bootstrap(_root_mean_square, data)
    return Estimate(float(_root_mean_square(data)), low, high, data.size)


def _root_mean_square(values: NDArray) -> NDArray:
    return np.asarray(np.sqrt(np.mean(values**2, axis=-1)))


def numbers(table: pa.Table, column: str) -> NDArray:
    """A numeric column as float64, shape (rows,); null becomes NaN.

    Raises:
        InputError: the column is missing.
    """
    return _require(table, column).cast(pa.float64()).to_numpy()


def paired(a: pa.Table, b: pa.Table, column: str) -> tuple[NDArray, NDArray]:
    """One column of two tables, row by row on the same draw.

    Args:
        a: one row a draw, with ``draw_id``.
        b: the same draws, in any order.
        column: a numeric column of both.

    Returns:
        The column in a and in b, each in ascending order of ``draw_id``; null is NaN.

    Raises:
        InputError: a missing column, a repeated draw, or draws that differ.
    """
    (draws, first), (others, second) = (np.unique(numbers(t, "draw_id"), True) for t in (a, b))
    if draws.size < a.num_rows or others.size < b.num_rows:
        raise InputError(f"summary: draw_id repeats, so {column} cannot be paired by draw")
    if not np.array_equal(draws, others):
        raise InputError(f"summary: the draws differ, so {column} cannot be paired by draw")
    return numbers(a, column)[first], numbers(b, column)[second]


def difference(a: ArrayLike, b: ArrayLike) -> Estimate:
    """The mean of a - b over pairs on the same noise, with Student's t interval.

    A pair whose difference is not finite is left out; ``n`` says how many were used.

    Args:
        a: shape (n,), any unit.
        b: shape (n,), the same draws in the same order.

    Raises:
        ValueError: shapes differ, or no pairs.
    """
    first, second = _pair(a, b)
    with np.errstate(invalid="ignore"):  # infinite minus infinite, left out by mean
        return mean(first - second)


def quantile_difference(a: ArrayLike, b: ArrayLike, q: float = 0.5) -> Estimate:
    """The quantile of a minus that of b, with a bootstrap interval over the pairs.

    NaN counts as infinite as in :func:`quantile`. Infinite minus finite is infinite; infinite minus
    infinite is 0, since two that never settle show no difference. Pairs are resampled whole, which
    keeps the noise that they share.

    Args:
        a: shape (n,), any unit.
        b: shape (n,), the same draws in the same order.
        q: from 0 to 1.

    Raises:
        ValueError: shapes differ, no pairs, or q out of range.
    """
    first, second = _pair(a, b, missing=math.inf)

    def statistic(x: NDArray, y: NDArray) -> NDArray:
        left, right = (np.quantile(z, q, axis=-1, method="inverted_cdf") for z in (x, y))
        same = left == right  # also where both are infinite
        return np.where(same, 0.0, left - np.where(same, 0.0, right))

    low, high = _bootstrap(statistic, first, second)
    return Estimate(float(statistic(first, second)), low, high, first.size)


def groups(table: pa.Table, by: Sequence[str]) -> Iterator[tuple[dict[str, Any], pa.Table]]:
    """Splits a table by the values of some columns.

    Args:
        table: any table.
        by: key columns of any type, lists too; null is a key as any other. No column, one group.

    Yields:
        The key values and the group's rows in their order; groups by first appearance.

    Raises:
        InputError: a key column is missing.
    """
    code = np.zeros(table.num_rows, dtype=np.int64)
    for name in by:
        column = _require(table, name)
        if pa.types.is_nested(column.type) or pa.types.is_dictionary(column.type):
            seen: dict[str, int] = {}
            step = np.array([seen.setdefault(repr(v), len(seen)) for v in column.to_pylist()])
        else:
            whole = column.combine_chunks()
            step = pc.dictionary_encode(whole, null_encoding="encode").indices.to_numpy()
        # Numbered anew after each key, so that the product of many keys cannot overflow.
        code = np.unique(code * (table.num_rows + 1) + step, return_inverse=True)[1]
    _, first, size = np.unique(code, return_index=True, return_counts=True)
    ordered = table.take(np.argsort(code, kind="stable"))
    start = np.cumsum(size) - size
    for group in np.argsort(first):
        rows = ordered.slice(start[group], size[group])
        yield {name: rows[name][0].as_py() for name in by}, rows


def summarise(table: pa.Table, by: Sequence[str]) -> pa.Table:
    """The statistics of each group of runs, one row a group.

    Columns: the keys; ``n`` runs, of which ``nonfinite``; then ``X``, ``X_low``, ``X_high`` for X
    in ``success_rate`` (status ``ok``), ``diverged_rate``, ``settle_B_s_median`` and
    ``settle_B_s_q90`` for each band B of the table (infinite: never), ``phi_u_mean_arcmin_mean``
    and ``phi_u_mean_arcmin_std`` (the window means over the runs), ``phi_u_from_floor_arcmin_mean``
    (window mean minus floor) and ``nees_median`` (a run that is not finite counts as infinite).
    Null is unknown; without truth or reference all but ``n`` and ``nonfinite`` are.

    Args:
        table: the summary, one row a run.
        by: key columns as for :func:`groups`.

    Raises:
        InputError: the table has no rows, or a column is missing.
    """
    if table.num_rows == 0:
        raise InputError("summary: there are no runs to summarise")
    columns: dict[str, list] = {}
    for key, rows in groups(table, by):
        for name, value in (key | _statistics(rows)).items():
            columns.setdefault(name, []).append(value)
    kinds = {"n": pa.int64(), "nonfinite": pa.int64()}
    kinds |= {name: table.schema.field(name).type for name in by}
    arrays = [pa.array(v, kinds.get(k, pa.float64()), from_pandas=True) for k, v in columns.items()]
    return pa.table(arrays, names=list(columns))


def _statistics(rows: pa.Table) -> dict[str, int | float]:
    """One group's row of :func:`summarise`."""
    n = rows.num_rows
    yaw, floor, nees = (numbers(rows, c) for c in ("phi_u_mean_arcmin", "floor_arcmin", "nees"))
    status = _require(rows, "status").to_pylist()
    nonfinite = status.count("nonfinite")
    # Without truth every yaw error is null, and "never settled" would be an invention.
    truth = nonfinite > 0 or bool(np.isfinite(numbers(rows, "phi_u_arcmin")).any())
    estimates = {
        "success_rate": proportion(status.count("ok"), n) if truth else UNKNOWN,
        "diverged_rate": proportion(status.count("diverged"), n) if truth else UNKNOWN,
    }
    for name in rows.column_names:
        if name.startswith("settle_"):
            times = numbers(rows, name)
            estimates[f"{name}_median"] = quantile(times) if truth else UNKNOWN
            estimates[f"{name}_q90"] = quantile(times, 0.9) if truth else UNKNOWN
    estimates["phi_u_mean_arcmin_mean"] = mean(yaw)
    estimates["phi_u_mean_arcmin_std"] = std(yaw)
    estimates["phi_u_from_floor_arcmin_mean"] = difference(yaw, floor)
    estimates["nees_median"] = quantile(nees) if np.isfinite(nees).any() else UNKNOWN
    row: dict[str, int | float] = {"n": n, "nonfinite": nonfinite}
    for name, e in estimates.items():
        row |= {name: e.value, f"{name}_low": e.low, f"{name}_high": e.high}
    return row


def _require(table: pa.Table, name: str) -> pa.ChunkedArray:
    if name not in table.column_names:
        raise InputError(f"summary: column {name} is missing")
    return table[name]


def _values(values: ArrayLike, *, missing: float = math.nan) -> NDArray:
    data = np.asarray(values, dtype=np.float64)
    if data.ndim != 1 or data.size == 0:
        raise ValueError(f"one or more values in one dimension are needed, got shape {data.shape}")
    return np.where(np.isnan(data), missing, data)


def _finite(values: ArrayLike) -> NDArray:
    """The finite ones of some values, of which there must be one or more."""
    data = _values(values)
    return data[np.isfinite(data)]


def _pair(a: ArrayLike, b: ArrayLike, *, missing: float = math.nan) -> tuple[NDArray, NDArray]:
    first, second = _values(a, missing=missing), _values(b, missing=missing)
    if first.shape != second.shape:
        raise ValueError(f"pairs need equal lengths, got {first.size} and {second.size}")
    return first, second


@lru_cache(maxsize=256)
def _ranks(n: int, q: float) -> tuple[int, int]:
    """Which order statistics (1 to n) bound the q quantile; 0 and n + 1: none does."""
    below = special.bdtr(np.arange(n + 1), n, q)
    return int(np.searchsorted(below, _TAIL)), int(np.searchsorted(below, 1 - _TAIL)) + 1


def _bootstrap(statistic: Callable[..., NDArray], *samples: NDArray) -> tuple[float, float]:
    """Percentile interval of a statistic over the last axis; the samples share their resampling."""
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
    low, high = np.quantile(np.concatenate(drawn), [_TAIL, 1 - _TAIL], method="inverted_cdf")
    return float(low), float(high)
