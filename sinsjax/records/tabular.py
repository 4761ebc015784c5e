"""Records in CSV and Parquet files, read and written by a `RecordLayout`."""

import csv
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.messages import format_count
from sinsjax.platform.files import atomic_write
from sinsjax.records.checks import find_anomalies
from sinsjax.records.layout import (
    RATES,
    TIME_UNITS,
    Flaw,
    FloatArray,
    Record,
    RecordLayout,
    check_layout,
    find_spans,
    from_body_axes,
    increment_factor,
    parse_axes_order,
    quantity_of,
    resolve_rate,
    to_vehicle_axes,
    unit_factor,
)
from sinsjax.records.reader import MISSING_TEXT, Table, open_parquet, open_text
from sinsjax.records.stamps import Sampling, combine_times, find_sampling, format_step

_MAX_OFFERED_GAP_S = 1.0
"""Longest gap for which interpolation is offered: most bases sway more slowly than this."""


def read_csv(path: str | Path, layout: RecordLayout) -> Record:
    """Read a record from delimited text, see `reader`.

    Rates are multiplied by the sampling interval. Time stamps are the ends of the samples and may
    be a few milliseconds late. A row that repeats the one before it, stamp included, is left out.
    A missing sample, from a gap or an empty cell, is interpolated if max_gap_s allows it; otherwise
    it is nan and a flaw of the record, see `require_span`. Errors name the key, or the row and the
    column.
    """
    check_layout(layout, str(path))
    return record_from_table(path, layout, open_text(path, layout.columns, layout.skip_rows))


def read_parquet(path: str | Path, layout: RecordLayout) -> Record:
    """Read a record from a Parquet file, like `read_csv`, with rows of the table from 1."""
    check_layout(layout, str(path))
    return record_from_table(path, layout, open_parquet(path))


def record_from_table(path: str | Path, layout: RecordLayout, table: Table) -> Record:
    """Return the record in an opened table, see `read_csv`; the layout is valid."""
    names = [*layout.gyro_columns, *layout.accel_columns]
    dates = [layout.time_column] if layout.time_unit == "iso" else []
    columns = table.read([*names, *layout.time_columns], blanks=True, dates=dates)
    columns, times = columns[:6], columns[6:]
    if not any(np.isfinite(np.add.reduce(columns))):
        raise InputError(f"{path}: no row has a number in all six columns of the sensors")
    remarks, row_number = list[str](), table.row_number
    if times:
        time_s = combine_times(times, layout)
        kept = np.isfinite(time_s)  # a sample without a time stamp is missing
        if not kept.any():
            raise InputError(f"{path}: column {layout.time_column!r}: {MISSING_TEXT}")
        repeated = find_repeated_rows(time_s, columns) & kept
        if repeated.any():
            count = format_count(int(repeated.sum()), "row")
            first = row_number(int(repeated.argmax()))
            remarks.append(f"{count} left out that repeat the one before, the first in row {first}")
        samples = np.flatnonzero(kept & ~repeated)
        if len(samples) < len(time_s):
            columns, time_s = [column[samples] for column in columns], time_s[samples]

        def row_number(k: int) -> int:
            return table.row_number(int(samples[k]))

        sampling = find_sampling(str(path), layout, time_s, row_number)
        remarks += filter(None, [sampling.remark])
    else:
        # check_layout ensures that there is a time column or a rate.
        assert layout.rate_hz is not None
        time_s, sampling = np.empty(0), Sampling(layout.rate_hz, 0.0, np.arange(len(columns[0])))
    rate_hz, number = sampling.rate_hz, sampling.number

    def describe_gap(columns: Sequence[FloatArray], sample: int) -> str:
        k = int(np.searchsorted(number, sample))
        if number[k] != sample:
            place = f"column {layout.time_column!r}: row {row_number(k)}"
            return f"{path}: {place}: a gap at {rate_hz:g} Hz, {format_step(time_s, k - 1)}"
        channel = next(c for c, column in enumerate(columns) if not np.isfinite(column[sample]))
        return f"{path}: row {row_number(k)}: column {names[channel]!r}: {MISSING_TEXT}"

    columns, flaws, filled = _fill_gaps(columns, sampling, layout.max_gap_s, describe_gap)
    scales = (layout.gyro_unit, layout.gyro_scale), (layout.accel_unit, layout.accel_scale)
    anomalies = find_anomalies(
        names,
        columns,
        [increment_factor(unit, rate_hz) * f * rate_hz for unit, scale in scales for f in scale],
        rate_hz,
        lambda sample: row_number(int(np.searchsorted(number, sample))),
    )
    dv, dtheta = (
        to_vehicle_axes(
            _to_increments(columns, unit, scale, rate_hz, layout.axes_order), layout.mounting_deg
        )
        for unit, scale in reversed(scales)
    )
    return Record(
        dtheta=dtheta,
        dv=dv,
        rate_hz=rate_hz,
        t0_s=sampling.t0_s,
        source=str(path),
        flaws=tuple(flaws),
        filled=filled,
        anomalies=anomalies,
        remarks=tuple(remarks),
    )


def find_repeated_rows(time_s: FloatArray, columns: Sequence[FloatArray]) -> NDArray[np.bool_]:
    """Return whether each row (T,) has the stamp and the values of the one before it."""
    repeated = np.zeros(len(time_s), bool)
    candidates = np.flatnonzero(time_s[1:] == time_s[:-1]) + 1
    if candidates.size:
        same = [column[candidates] == column[candidates - 1] for column in columns]
        repeated[candidates] = np.logical_and.reduce(same)
    return repeated


def _to_increments(
    columns: list[FloatArray], unit: str, scale: Sequence[float], rate_hz: float, order: str
) -> FloatArray:
    """Convert the last three columns, which are consumed, to increments (T, 3) in the box's axes.

    In place, to save the memory of a second copy of a long record.
    """
    index, signs = parse_axes_order(order)
    axis_columns = [columns.pop() for _ in range(3)][::-1]
    increments = np.empty((3, len(axis_columns[0]))).T  # column-major, as it is filled and read
    for axis, (source_axis, sign) in enumerate(zip(index, signs, strict=True)):
        values = axis_columns[source_axis]
        values *= unit_factor(unit) * scale[source_axis]
        if quantity_of(unit) == RATES:
            values /= rate_hz
        values *= sign
        increments[:, axis] = values
    return increments


def _fill_gaps(
    columns: list[FloatArray],
    sampling: Sampling,
    max_gap_s: float,
    describe_gap: Callable[[Sequence[FloatArray], int], str],
) -> tuple[list[FloatArray], list[Flaw], int]:
    """Return columns of all samples from the first to the last, the flaws and the filled samples.

    Short gaps are interpolated; others become nan and a flaw. The columns may be changed.
    """
    rate, number = sampling.rate_hz, sampling.number
    missing = np.zeros(number[-1] + 1, bool)
    whole = []
    for column in columns:
        if len(column) < len(missing):
            values = np.full(len(missing), np.nan)
            values[number] = column
            column = values
        missing |= ~np.isfinite(column)
        whole.append(column)
    fill, flaws = np.zeros(len(missing), bool), list[Flaw]()
    for begin, end in find_spans(missing):
        inside = begin > 0 and end < len(missing)
        gap_s = (end - begin + 1) / rate if inside else math.inf
        if gap_s <= max_gap_s * (1 + 1e-9):
            fill[begin:end] = True
            continue
        text = describe_gap(whole, begin)
        if gap_s <= _MAX_OFFERED_GAP_S:
            text += f" (max_gap_s = {_round_up_to_3_digits(gap_s):g} would interpolate it)"
        flaws.append(Flaw(begin, end, text))
    for column in whole:
        if fill.any():
            good = np.flatnonzero(~missing)
            column[fill] = np.interp(np.flatnonzero(fill), good, column[good])
        column[missing & ~fill] = np.nan
    return whole, flaws, int(fill.sum())


def _round_up_to_3_digits(gap_s: float) -> float:
    """Return the next longer time of three digits, as a user would write it."""
    unit = float(10.0 ** (math.floor(math.log10(gap_s)) - 2))
    return float(math.ceil(gap_s / unit - 1e-9) * unit)


def write_csv(
    record: Record, path: str | Path, layout: RecordLayout, *, delimiter: str = ","
) -> None:
    """Write a record as delimited text in the layout's columns, units and axes.

    Increments in rad and m/s are read back bit for bit. The time column, if any, is the end of each
    sample. The record's position, attitude and g are not written, and no names if the layout gives
    them.
    """
    columns = _record_to_columns(record, path, layout)
    header = io.StringIO()
    if layout.columns:
        columns = {name: columns[name] for name in layout.columns if name in columns}
    else:
        csv.writer(header, delimiter=delimiter, lineterminator="\n").writerow(columns)
    options = pa.csv.WriteOptions(include_header=False, delimiter=delimiter)
    with atomic_write(path) as file:
        file.write(header.getvalue().encode())
        pa.csv.write_csv(pa.table(columns), file, options)


def write_parquet(record: Record, path: str | Path, layout: RecordLayout) -> None:
    """Write a record as a Parquet file of float64 columns, like `write_csv`."""
    columns = _record_to_columns(record, path, layout)
    with atomic_write(path) as file:
        pq.write_table(pa.table(columns), file)


def _record_to_columns(
    record: Record, path: str | Path, layout: RecordLayout
) -> dict[str, FloatArray]:
    check_layout(layout, str(path))
    place = f"{path}: cannot be written"
    resolve_rate(record.rate_hz, layout, 0.0, f"{place}: the record")
    if layout.time_unit == "iso" or layout.time_fraction_column or any(layout.mounting_deg):
        raise InputError(f"{place}: dates, fractions of seconds and mounting_deg are only read")
    if not (np.isfinite(record.dtheta).all() and np.isfinite(record.dv).all()):
        raise InputError(f"{place}: an increment is not finite")
    columns: dict[str, FloatArray] = {}
    if layout.time_column:
        time_s = record.t0_s + np.arange(1, len(record.dv) + 1) / record.rate_hz
        columns[layout.time_column] = time_s / TIME_UNITS[layout.time_unit] / layout.time_scale
    for names, increments, unit, scale in (
        (layout.gyro_columns, record.dtheta, layout.gyro_unit, layout.gyro_scale),
        (layout.accel_columns, record.dv, layout.accel_unit, layout.accel_scale),
    ):
        values = from_body_axes(increments, layout.axes_order)
        values = values * (record.rate_hz if quantity_of(unit) == RATES else 1.0)
        columns |= zip(names, (values / (unit_factor(unit) * np.array(scale))).T, strict=True)
    return columns
