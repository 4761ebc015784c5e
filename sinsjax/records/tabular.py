"""Records from named columns of numbers, by a `RecordLayout`."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.messages import format_count
from sinsjax.records.checks import find_anomalies
from sinsjax.records.layout import (
    Flaw,
    FloatArray,
    Record,
    RecordLayout,
    find_spans,
    is_rate,
    rate_factor,
    to_body_axes,
    unit_factor,
)
from sinsjax.records.reader import MISSING_TEXT, Table
from sinsjax.records.stamps import Sampling, combine_times, find_sampling, format_step


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
    it is nan and a flaw of the record, see `require_span`. Errors name the row and the column.
    """
    names = [name for sensor in layout.sensors for name in sensor.columns]
    samples = _read_samples(layout, table, names)
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
    if count := _interpolate_gaps(whole, rate_hz, layout.max_gap_s):
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


def _read_samples(layout: RecordLayout, table: Table, names: list[str]) -> _Samples:
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


def _interpolate_gaps(rows: FloatArray, rate_hz: float, max_gap_s: float) -> int:
    """Interpolate short gaps of rows that are nan, in place; return the number of such rows."""
    missing = np.isnan(rows[:, 0])
    good, short = np.flatnonzero(~missing), np.zeros(len(rows), bool)
    for begin, end in find_spans(missing):
        gap_s = (end - begin + 1) / rate_hz  # between good samples
        short[begin:end] = begin > 0 and end < len(rows) and gap_s <= max_gap_s * (1 + 1e-9)
    for column in rows.T:
        column[short] = np.interp(np.flatnonzero(short), good, column[good])
    return int(short.sum())
