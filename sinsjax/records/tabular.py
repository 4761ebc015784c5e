"""Records in CSV and Parquet files: named columns, units, axes and an optional time column."""

import csv
import io
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from sinsjax.errors import InputError
from sinsjax.platform.files import atomic_write
from sinsjax.records.anomalies import find_anomalies
from sinsjax.records.layout import (
    ACCEL_UNITS,
    GYRO_UNITS,
    TIME_UNITS,
    Flaw,
    FloatArray,
    Layout,
    Record,
    check_layout,
    find_spans,
    from_body_axes,
    parse_axes_order,
    resolve_rate,
)
from sinsjax.records.stamps import Sampling, find_sampling, format_step
from sinsjax.records.tables import MISSING_TEXT, ColumnTable, open_csv, open_parquet

_MAX_OFFERED_GAP_S = 1.0
"""Longest gap for which interpolation is offered: most bases sway more slowly than this."""


def read_csv(path: str | Path, layout: Layout) -> Record:
    """Read a record from comma-, semicolon- or tab-separated text whose first line names columns.

    Rates are multiplied by the sampling interval. Time stamps are the ends of the samples and may
    be a few milliseconds late. A missing sample, from a gap or an empty cell, is interpolated if
    max_gap_s allows it; otherwise it is nan and a flaw of the record, see `require_span`.

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
    return record_from_table(path, layout, open_csv(path))


def read_parquet(path: str | Path, layout: Layout) -> Record:
    """Read a record from a Parquet file, like `read_csv`, with rows of the table from 1."""
    check_layout(layout, str(path))
    return record_from_table(path, layout, open_parquet(path))


def record_from_table(path: str | Path, layout: Layout, table: ColumnTable) -> Record:
    """Return the record in an opened table, see `read_csv`; the layout is valid."""
    names = [*layout.gyro_columns, *layout.accel_columns]
    dates: list[str] = []
    if layout.time_column:
        names.append(layout.time_column)
        dates += [layout.time_column] if layout.time_unit == "iso" else []
    columns = table.read(names, blanks=True, dates=dates)
    time_s = None
    if layout.time_column:
        time_s = columns.pop()
        time_s *= TIME_UNITS[layout.time_unit]
        if not np.isfinite(time_s).all():  # a sample without a time stamp is missing
            stamped, row_in_file = np.flatnonzero(np.isfinite(time_s)), table.row_number
            if not stamped.size:
                raise InputError(f"{path}: column {layout.time_column!r}: {MISSING_TEXT}")
            columns, time_s = [column[stamped] for column in columns], time_s[stamped]
            table = table._replace(row_number=lambda k: row_in_file(int(stamped[k])))
        sampling_ = find_sampling(str(path), layout, time_s, table.row_number)
    else:
        # check_layout ensures that there is a time column or a rate.
        assert layout.rate_hz is not None
        sampling_ = Sampling(layout.rate_hz, 0.0, np.arange(len(columns[0])))
    flaws, filled = _fill_gaps(columns, _ReadTable(path, layout, table, time_s, sampling_))
    gyro_factor, accel_factor = _unit_factors(layout)
    rate_divisor = sampling_.rate_hz if layout.quantity == "rates" else 1.0
    anomalies = find_anomalies(
        names[:6],
        columns,
        [
            factor * sampling_.rate_hz / rate_divisor
            for factor in (gyro_factor, accel_factor)
            for _ in "xyz"
        ],
        sampling_.rate_hz,
        lambda sample: table.row_number(int(np.searchsorted(sampling_.number, sample))),
    )
    dv = _to_increments(columns, accel_factor, rate_divisor, layout.axes_order)
    return Record(
        dtheta=_to_increments(columns, gyro_factor, rate_divisor, layout.axes_order),
        dv=dv,
        rate_hz=sampling_.rate_hz,
        t0_s=sampling_.t0_s,
        source=str(path),
        flaws=tuple(flaws),
        filled=filled,
        anomalies=anomalies,
    )


def _to_increments(
    columns: list[FloatArray], factor: float, rate_divisor: float, order: str
) -> FloatArray:
    """Convert the last three columns, which are consumed, to increments (T, 3) in body axes.

    In place, to save the memory of a second copy of a long record.
    """
    index, signs = parse_axes_order(order)
    axis_columns = [columns.pop() for _ in range(3)][::-1]
    increments = np.empty((3, len(axis_columns[0]))).T  # column-major, as it is filled and read
    for axis, (source_axis, sign) in enumerate(zip(index, signs, strict=True)):
        values = axis_columns[source_axis]
        values *= factor
        values /= rate_divisor
        values *= sign
        increments[:, axis] = values
    return increments


class _ReadTable(NamedTuple):
    """Origin and sampling times of the values of a file."""

    path: str | Path
    layout: Layout
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


def _unit_factors(layout: Layout) -> tuple[float, float]:
    gyro = GYRO_UNITS[layout.quantity][layout.gyro_unit]
    return gyro, ACCEL_UNITS[layout.quantity][layout.accel_unit]


def write_csv(record: Record, path: str | Path, layout: Layout) -> None:
    """Write a record as comma-separated text in the layout's columns, units and axes.

    Increments in rad and m/s are read back bit for bit. The time column, if any, is the end of each
    sample. The record's position, attitude and g are not written.

    Args:
        record: the record.
        path: the file to write; written atomically.
        layout: its rate_hz, if given, must be the record's.

    Raises:
        InputError: the layout or the record cannot be written, or the target is not writable.
    """
    columns = _record_to_columns(record, path, layout)
    header = io.StringIO()
    csv.writer(header, lineterminator="\n").writerow(columns)
    with atomic_write(path) as file:
        file.write(header.getvalue().encode())
        pa.csv.write_csv(pa.table(columns), file, pa.csv.WriteOptions(include_header=False))


def write_parquet(record: Record, path: str | Path, layout: Layout) -> None:
    """Write a record as a Parquet file of float64 columns, like `write_csv`."""
    columns = _record_to_columns(record, path, layout)
    with atomic_write(path) as file:
        pq.write_table(pa.table(columns), file)


def _record_to_columns(record: Record, path: str | Path, layout: Layout) -> dict[str, FloatArray]:
    check_layout(layout, str(path))
    if layout.time_unit == "iso":
        raise InputError(f"{path}: cannot be written: time_unit: 'iso' can only be read")
    resolve_rate(record.rate_hz, layout, 0.0, f"{path}: cannot be written: the record")
    if not (np.isfinite(record.dtheta).all() and np.isfinite(record.dv).all()):
        raise InputError(f"{path}: cannot be written: an increment is not finite")
    gyro_factor, accel_factor = _unit_factors(layout)
    rate_factor = record.rate_hz if layout.quantity == "rates" else 1.0
    gyro = from_body_axes(record.dtheta, layout.axes_order) * rate_factor / gyro_factor
    accel = from_body_axes(record.dv, layout.axes_order) * rate_factor / accel_factor
    columns: dict[str, FloatArray] = {}
    if layout.time_column:
        ends = np.arange(1, len(gyro) + 1)
        time_s = record.t0_s + ends / record.rate_hz
        columns[layout.time_column] = time_s / TIME_UNITS[layout.time_unit]
    columns |= dict(zip(layout.gyro_columns, gyro.T, strict=True))
    columns |= dict(zip(layout.accel_columns, accel.T, strict=True))
    return columns
