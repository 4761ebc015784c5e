"""Records in CSV and Parquet files, read and written by a `RecordLayout`."""

import csv
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.platform.files import atomic_write
from sinsjax.records.anomalies import find_anomalies
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
from sinsjax.records.stamps import Sampling, find_sampling, format_step, unwrap_midnight
from sinsjax.records.tables import MISSING_TEXT, ColumnTable, open_parquet
from sinsjax.records.text import open_csv

_MAX_OFFERED_GAP_S = 1.0
"""Longest gap for which interpolation is offered: most bases sway more slowly than this."""


def read_csv(path: str | Path, layout: RecordLayout) -> Record:
    """Read a record from delimited text, see `text`.

    Rates are multiplied by the sampling interval. Time stamps are the ends of the samples and may
    be a few milliseconds late. A row that repeats the one before it, stamp included, is left out.
    A missing sample, from a gap or an empty cell, is interpolated if max_gap_s allows it; otherwise
    it is nan and a flaw of the record, see `require_span`.

    Args:
        path: the file.
        layout: columns, units, axes, and rate_hz unless there is a time column.

    Returns:
        The record; fields of PSINS headers are None.

    Raises:
        InputError: the layout or the file is invalid; the message names the key, the column or the
            row (line of the file, from 1).
    """
    check_layout(layout, str(path))
    return record_from_table(path, layout, open_csv(path, layout.columns, layout.skip_rows))


def read_parquet(path: str | Path, layout: RecordLayout) -> Record:
    """Read a record from a Parquet file, like `read_csv`, with rows of the table from 1."""
    check_layout(layout, str(path))
    return record_from_table(path, layout, open_parquet(path))


def record_from_table(path: str | Path, layout: RecordLayout, table: ColumnTable) -> Record:
    """Return the record in an opened table, see `read_csv`; the layout is valid."""
    names = [*layout.gyro_columns, *layout.accel_columns]
    dates = [layout.time_column] if layout.time_unit == "iso" else []
    columns = table.read([*names, *layout.time_columns], blanks=True, dates=dates)
    columns, times = columns[:6], columns[6:]
    remarks, time_s = [*table.remarks], None
    if times:
        time_s = combine_times(times, layout)
        kept = np.isfinite(time_s)  # a sample without a time stamp is missing
        if not kept.any():
            raise InputError(f"{path}: column {layout.time_column!r}: {MISSING_TEXT}")
        repeated = find_repeated_rows(time_s, columns) & kept
        if repeated.any():
            remarks.append(repeated_rows_text(repeated, table.row_number))
            kept &= ~repeated
        if not kept.all():
            samples, row_in_file = np.flatnonzero(kept), table.row_number
            columns, time_s = [column[kept] for column in columns], time_s[kept]
            table = table._replace(row_number=lambda k: row_in_file(int(samples[k])))
        sampling_ = find_sampling(str(path), layout, time_s, table.row_number)
    else:
        # check_layout ensures that there is a time column or a rate.
        assert layout.rate_hz is not None
        sampling_ = Sampling(layout.rate_hz, 0.0, np.arange(len(columns[0])))
    flaws, filled = _fill_gaps(columns, _ReadTable(path, layout, table, time_s, sampling_))
    rate_hz = sampling_.rate_hz
    units_and_scales = (
        (layout.gyro_unit, layout.gyro_scale),
        (layout.accel_unit, layout.accel_scale),
    )
    factors = [
        [increment_factor(unit, rate_hz) * factor for factor in scale]
        for unit, scale in units_and_scales
    ]
    anomalies = find_anomalies(
        names,
        columns,
        [factor * rate_hz for triad in factors for factor in triad],
        rate_hz,
        lambda sample: table.row_number(int(np.searchsorted(sampling_.number, sample))),
    )
    dv, dtheta = (
        to_vehicle_axes(
            _to_increments(columns, unit, scale, rate_hz, layout.axes_order), layout.mounting_deg
        )
        for unit, scale in reversed(units_and_scales)
    )
    return Record(
        dtheta=dtheta,
        dv=dv,
        rate_hz=rate_hz,
        t0_s=sampling_.t0_s,
        source=str(path),
        flaws=tuple(flaws),
        filled=filled,
        anomalies=anomalies,
        remarks=tuple(remarks),
    )


def combine_times(times: list[FloatArray], layout: RecordLayout) -> FloatArray:
    """Return stamps (T,) in s from the time columns of a layout, which are changed."""
    time_s = times[0]
    time_s *= TIME_UNITS[layout.time_unit] * layout.time_scale
    if layout.time_unit == "iso":
        time_s = unwrap_midnight(time_s)
    if len(times) > 1:
        time_s += times[1] * TIME_UNITS[layout.time_fraction_unit]
    return time_s


def find_repeated_rows(time_s: FloatArray, columns: Sequence[FloatArray]) -> NDArray[np.bool_]:
    """Return whether each row (T,) has the stamp and the values of the one before it."""
    repeated = np.zeros(len(time_s), bool)
    candidates = np.flatnonzero(time_s[1:] == time_s[:-1]) + 1
    if candidates.size:
        same = [column[candidates] == column[candidates - 1] for column in columns]
        repeated[candidates] = np.logical_and.reduce(same)
    return repeated


def repeated_rows_text(repeated: NDArray[np.bool_], row_number: Callable[[int], int]) -> str:
    """Return the remark about rows that repeat the one before them."""
    first = row_number(int(repeated.argmax()))
    if repeated.sum() == 1:
        return f"row {first} repeats the one before it and is left out"
    count = f"{repeated.sum()} rows that repeat the one before them are left out"
    return f"{count}, row {first} and others"


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


class _ReadTable(NamedTuple):
    """Origin and sampling times of the values of a file."""

    path: str | Path
    layout: RecordLayout
    table: ColumnTable
    time_s: FloatArray | None
    sampling: Sampling


def _fill_gaps(columns: list[FloatArray], read: _ReadTable) -> tuple[list[Flaw], int]:
    """Extend columns, in place, to all samples from the first to the last.

    Short gaps are interpolated; others become nan and a flaw.
    """
    rate, number = read.sampling.rate_hz, read.sampling.number
    missing = np.zeros(number[-1] + 1, bool)
    for index, column in enumerate(columns):
        if len(column) < len(missing):
            columns[index] = np.full(len(missing), np.nan)
            columns[index][number] = column
        missing |= ~np.isfinite(columns[index])
    if not missing.any():
        return [], 0
    fill, flaws = np.zeros(len(missing), bool), []
    for begin, end in find_spans(missing):
        inside = begin > 0 and end < len(missing)
        gap_s = (end - begin + 1) / rate if inside else math.inf
        if gap_s <= read.layout.max_gap_s * (1 + 1e-9):
            fill[begin:end] = True
        else:
            flaws.append(Flaw(begin, end, _describe_gap(columns, read, begin, gap_s)))
    good = np.flatnonzero(~missing)
    for column in columns:
        if fill.any():
            column[fill] = np.interp(np.flatnonzero(fill), good, column[good])
        column[missing & ~fill] = np.nan
    return flaws, int(fill.sum())


def _describe_gap(columns: list[FloatArray], read: _ReadTable, sample: int, gap_s: float) -> str:
    """Return the message about missing samples in a gap, with the row of the first one."""
    number, layout = read.sampling.number, read.layout
    k = int(np.searchsorted(number, sample))
    remedy = ""
    if gap_s <= _MAX_OFFERED_GAP_S:
        remedy = f" (max_gap_s = {_round_up_to_3_digits(gap_s):g} would interpolate it)"
    if number[k] != sample:
        assert read.time_s is not None
        place = f"{read.path}: column {layout.time_column!r}: row {read.table.row_number(k)}"
        gap = f"a gap at {read.sampling.rate_hz:g} Hz, {format_step(read.time_s, k - 1)}"
        return f"{place}: {gap}{remedy}"
    names = zip((*layout.gyro_columns, *layout.accel_columns), columns, strict=True)
    name = next(name for name, column in names if not np.isfinite(column[sample]))
    return f"{read.path}: row {read.table.row_number(k)}: column {name!r}: {MISSING_TEXT}{remedy}"


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

    Args:
        record: the record.
        path: the file to write; written atomically.
        layout: its rate_hz, if given, must be the record's.
        delimiter: between the columns.

    Raises:
        InputError: the layout or the record cannot be written, or the target is not writable.
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
    if layout.time_unit == "iso":
        raise InputError(f"{path}: cannot be written: time_unit: 'iso' can only be read")
    resolve_rate(record.rate_hz, layout, 0.0, f"{path}: cannot be written: the record")
    if not (np.isfinite(record.dtheta).all() and np.isfinite(record.dv).all()):
        raise InputError(f"{path}: cannot be written: an increment is not finite")
    if layout.time_fraction_column or any(layout.mounting_deg):
        key = "time_fraction_column" if layout.time_fraction_column else "mounting_deg"
        raise InputError(f"{path}: cannot be written: {key}: can only be read")
    gyro, accel = (
        from_body_axes(increments, layout.axes_order)
        * (record.rate_hz if quantity_of(unit) == RATES else 1.0)
        / (unit_factor(unit) * np.array(scale))
        for increments, unit, scale in (
            (record.dtheta, layout.gyro_unit, layout.gyro_scale),
            (record.dv, layout.accel_unit, layout.accel_scale),
        )
    )
    columns: dict[str, FloatArray] = {}
    if layout.time_column:
        ends = np.arange(1, len(gyro) + 1)
        time_s = record.t0_s + ends / record.rate_hz
        columns[layout.time_column] = time_s / TIME_UNITS[layout.time_unit] / layout.time_scale
    columns |= dict(zip(layout.gyro_columns, gyro.T, strict=True))
    columns |= dict(zip(layout.accel_columns, accel.T, strict=True))
    return columns
