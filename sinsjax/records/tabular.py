"""Records from named columns of numbers, by a `RecordLayout`, with the rate that stamps imply.

A stamp may be late, as one of a busy logger is, if the following ones are in step with the sample
count again within 0.1 s. If the stamps remain late, samples are missing.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.messages import format_count
from sinsjax.records.checks import find_anomalies
from sinsjax.records.layout import (
    TIME_UNITS,
    Flaw,
    FloatArray,
    Record,
    RecordLayout,
    find_spans,
    is_rate,
    rate_factor,
    resolve_rate,
    to_body_axes,
    unit_factor,
)
from sinsjax.records.reader import MISSING_TEXT, Table

SHORTEST_STEP = 1e-12  # in any unit: less is a stamp that repeats
_CATCH_UP_S = 0.1  # longest time for which stamps are late
_AVERAGED_STEPS = 8  # of which some may be late
_MAX_MISSING_FACTOR = 10  # times the samples present; a larger gap is a set clock


class Sampling(NamedTuple):
    """Sampling times of a file."""

    rate_hz: float
    t0_s: float  # start of the first sample
    number: NDArray[np.int64]  # (T,) of each sample, from 0; it jumps where samples are missing
    remark: str = ""  # how many stamps are late


def combine_times(times: Sequence[FloatArray], layout: RecordLayout) -> FloatArray:
    """Return stamps (T,) in s from the time columns of a layout."""
    time_s = times[0] * (TIME_UNITS[layout.time_unit] * layout.time_scale)
    if len(times) > 1:
        time_s += times[1] * TIME_UNITS[layout.time_fraction_unit]
    return time_s


def find_sampling(
    source: str, layout: RecordLayout, time_s: FloatArray, row_number: Callable[[int], int]
) -> Sampling:
    """Return the sampling from the stamps at the ends of the samples, (T,), finite, T > 0.

    The rate of the layout takes precedence if given. Stamps that do not increase or imply another
    rate are refused, with their row.
    """
    place = f"{source}: column {layout.time_column!r}"
    if len(time_s) == 1:
        raise InputError(f"{source}: has only one sample")

    def refuse(k: int, problem: str) -> NoReturn:
        hint = "drop this column and give rate_hz if the stamps are bad"
        row = f"row {row_number(k + 1)}"
        raise InputError(f"{place}: {row}: {problem}, {format_step(time_s, k)} ({hint})")

    step_s = np.diff(time_s)
    if step_s.min() < SHORTEST_STEP:
        k = int((step_s < SHORTEST_STEP).argmax())
        refuse(k, "time runs backward" if step_s[k] < 0 else "time repeats")
    clean_s = _gapless_steps(time_s)  # whose mean averages out the rounding of the stamps
    rate = resolve_rate(
        _round_rate(float(1 / clean_s.mean()), time_s), layout, 1 / len(clean_s), place
    )
    ahead = (time_s - time_s[0]) * rate - np.arange(len(time_s))
    window = max(2, round(min(_CATCH_UP_S * rate, len(time_s))))
    on_time = _min_of_following(ahead, window)
    if len(time_s) > window:  # the last stamps, which none follow, may be as late as others
        latest, last = float((ahead - on_time)[:-window].max()), on_time[-window - 1]
        end = on_time[-window:]
        on_time[-window:] = np.where(end <= last + latest, np.minimum(end, last), end)
    before = -_min_of_following(-on_time[::-1], 2 * window)[::-1]  # an early stamp is no gap
    jumps = on_time[1:] - before[:-1]
    steps = 1 + np.where(jumps > 0, np.rint(jumps), -np.floor(0.1 - jumps)).astype(np.int64)
    if steps.min() < 1:
        k = int((steps < 1).argmax())
        refuse(k + int(step_s[k : k + window].argmin()), f"a short step at {rate:g} Hz")
    if steps.max() > _MAX_MISSING_FACTOR * len(time_s):
        refuse(int(steps.argmax()), f"a gap at {rate:g} Hz")
    number, late, remark = np.concatenate([[0], np.cumsum(steps)]), ahead - on_time, ""
    if count := int((late > 0.5).sum()):
        longest_ms = 1e3 * float(late.max()) / rate
        remark = f"{count} stamps are late by up to {longest_ms:.3g} ms: read as if on time"
    return Sampling(rate, float(time_s[0]) - 1 / rate, number, remark)


def _gapless_steps(time_s: FloatArray) -> FloatArray:
    """Return the steps of increasing stamps without gaps; of several steps if these alternate."""
    step_s = np.diff(time_s)
    count = max(1, min(_AVERAGED_STEPS, len(step_s) // 8))
    long_step_s = (time_s[count:] - time_s[:-count]) / count
    typical_s = float(np.quantile(long_step_s, 0.5, method="lower"))
    clean = step_s[(step_s >= 0.5 * typical_s) & (step_s <= 1.5 * typical_s)]
    if 2 * len(clean) < len(step_s):  # stamps alternate, or come in bursts
        clean = long_step_s[np.abs(long_step_s - typical_s) < 0.5 * typical_s]
    return clean


def _round_rate(rate_hz: float, time_s: FloatArray) -> float:
    """Return a whole rate, or one of four digits, if the resolution of the stamps allows it."""
    tolerance_hz = rate_hz * 2 * float(np.spacing(np.abs(time_s).max())) / float(np.ptp(time_s))
    rounded = (float(round(rate_hz)), float(f"{rate_hz:.4g}"))
    return next((hz for hz in rounded if abs(hz - rate_hz) <= tolerance_hz), rate_hz)


def _min_of_following(values: FloatArray, count: int) -> FloatArray:
    """Return the smallest of each value (T,) and those after it, ``count`` in all."""
    padded = np.concatenate([values, np.full(count - 1, np.inf)])
    return np.asarray(sliding_window_view(padded, count).min(axis=1))


def format_step(time_s: FloatArray, k: int) -> str:
    """Return the times of a stamp and the next one, for messages."""
    return f"from {float(time_s[k])!r} to {float(time_s[k + 1])!r} s"


class _Samples(NamedTuple):
    """The rows of a table that have a time of their own."""

    values: FloatArray  # (n, 6) as in the table
    row: NDArray[np.int64]  # (n,) in the table
    time_s: FloatArray  # (n,), or empty without a column of times
    sampling: Sampling
    remarks: list[str]


def record_from_table(layout: RecordLayout, table: Table) -> Record:
    """Return the record in an opened table, by a valid layout.

    Rates are multiplied by the sampling interval. Time stamps are the ends of the samples and may
    be a few milliseconds late. A row that repeats the one before it, stamp included, is left out.
    A missing sample, from a gap or an empty cell, is interpolated if max_gap_s allows it; otherwise
    it is nan and a flaw of the record, see `require_samples`. Errors name the row and the column.
    """
    names = [name for sensor in layout.sensors for name in sensor.columns]
    samples = _read_raw_samples(layout, table, names)
    rate_hz, t0_s, number, _ = samples.sampling
    whole = np.full((number[-1] + 1, 6), np.nan)
    whole[number] = samples.values
    whole[~np.isfinite(whole).all(axis=1)] = np.nan

    def row_number(sample: int) -> int:
        return table.row_number(int(samples.row[np.searchsorted(number, sample)]))

    def describe_gap(sample: int) -> str:
        k = int(np.searchsorted(number, sample))
        row = f"row {row_number(sample)}"
        if number[k] != sample:
            place = f"{table.source}: column {layout.time_column!r}: {row}"
            return f"{place}: a gap at {rate_hz:g} Hz, {format_step(samples.time_s, k - 1)}"
        channel = int(np.isfinite(samples.values[k]).argmin())
        return f"{table.source}: {row}: column {names[channel]!r}: {MISSING_TEXT}"

    remarks = samples.remarks
    if count := _interpolate_short_gaps(whole, rate_hz, layout.max_gap_s):
        remarks.append(f"{format_count(count, 'missing sample')} interpolated, see max_gap_s")
    hint = "" if layout.format == "psins" else " (max_gap_s interpolates short gaps)"
    missing = find_spans(np.isnan(whole[:, 0]))
    factors = np.concatenate(
        [np.multiply(rate_factor(unit, rate_hz), scale) for _, unit, scale in layout.sensors]
    )
    anomalies = find_anomalies(names, whole, factors, rate_hz, row_number)
    dtheta, dv = (
        to_body_axes(values * (unit_factor(unit) * np.array(scale)), layout.axes_order)
        / (rate_hz if is_rate(unit) else 1.0)
        for values, (_, unit, scale) in zip(np.hsplit(whole, 2), layout.sensors, strict=True)
    )
    return Record(
        dtheta,
        dv,
        rate_hz,
        t0_s,
        source=table.source,
        flaws=tuple(Flaw(begin, end, describe_gap(begin) + hint) for begin, end in missing),
        anomalies=anomalies,
        remarks=tuple(remarks),
    )


def _read_raw_samples(layout: RecordLayout, table: Table, names: list[str]) -> _Samples:
    """Return the samples of a table, without rows that have no time or repeat the one before."""
    dates = [layout.time_column] if layout.time_unit == "iso" else []
    columns = table.read([*names, *layout.time_columns], dates)
    values, times = np.column_stack(columns[:6]), columns[6:]
    del columns  # to save the memory of a second copy of a long record
    if not np.isfinite(values).all(axis=1).any():
        raise InputError(f"{table.source}: no row has a number in all six columns of the sensors")
    if not times:
        assert layout.rate_hz is not None  # as `check_layout` ensures
        row = np.arange(len(values))
        return _Samples(values, row, np.empty(0), Sampling(layout.rate_hz, 0.0, row), [])
    time_s = combine_times(times, layout)
    if not np.isfinite(time_s).any():
        raise InputError(f"{table.source}: column {layout.time_column!r}: {MISSING_TEXT}")
    repeated = np.zeros(len(values), bool)
    repeated[1:] = (time_s[1:] == time_s[:-1]) & (values[1:] == values[:-1]).all(axis=1)
    row = np.flatnonzero(np.isfinite(time_s) & ~repeated)
    if len(row) < len(values):
        values, time_s = values[row], time_s[row]
    sampling = find_sampling(table.source, layout, time_s, lambda k: table.row_number(int(row[k])))
    remarks = [*filter(None, [sampling.remark])]
    if repeated.any():
        count = format_count(int(repeated.sum()), "row")
        first = table.row_number(int(repeated.argmax()))
        remarks.append(f"{count} left out that repeat the one before, the first in row {first}")
    return _Samples(values, row, time_s, sampling, remarks)


def _interpolate_short_gaps(rows: FloatArray, rate_hz: float, max_gap_s: float) -> int:
    """Interpolate short gaps of rows that are nan, in place; return the number of such rows."""
    missing = np.isnan(rows[:, 0])
    good, short = np.flatnonzero(~missing), np.zeros(len(rows), bool)
    for begin, end in find_spans(missing):
        gap_s = (end - begin + 1) / rate_hz  # between good samples
        short[begin:end] = begin > 0 and end < len(rows) and gap_s <= max_gap_s * (1 + 1e-9)
    for column in rows.T:
        column[short] = np.interp(np.flatnonzero(short), good, column[good])
    return int(short.sum())
