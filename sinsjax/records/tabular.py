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
from sinsjax.records.layout import (
    ACCEL_UNITS,
    GYRO_UNITS,
    TIME_UNITS,
    Flaw,
    FloatArray,
    Layout,
    Record,
    agreed_rate,
    axes,
    check_layout,
    from_body,
    spans_of,
)
from sinsjax.records.oddities import oddities
from sinsjax.records.stamps import Sampling, between, sampling
from sinsjax.records.tables import MISSING, ColumnTable, open_csv, open_parquet

_INTERPOLATED_S = 1.0
"""Longest gap for which interpolation is offered: most bases sway more slowly than this."""


def read_csv(path: str | Path, layout: Layout) -> Record:
    """Read a record from comma-, semicolon- or tab-separated text whose first line names columns.

    Rates are multiplied by the sampling interval. Time stamps are the ends of the samples and may
    be a few milliseconds late. A missing sample, through a gap or an empty cell, is interpolated as
    far as max_gap_s allows; otherwise it is nan and a flaw of the record, see `require_span`.

    Args:
        path: the file.
        layout: columns, units, axes, and rate_hz unless there is a time column.

    Returns:
        The record; fields that only a PSINS header has are None.

    Raises:
        InputError: the layout or the file is invalid; the message names the key, the column or the
            row (line of the file, from 1).
    """
    check_layout(layout, str(path))
    return record_of(path, layout, open_csv(path))


def read_parquet(path: str | Path, layout: Layout) -> Record:
    """Read a record from a Parquet file; as `read_csv`, with rows of the table from 1."""
    check_layout(layout, str(path))
    return record_of(path, layout, open_parquet(path))


def record_of(path: str | Path, layout: Layout, table: ColumnTable) -> Record:
    """The record that an opened table holds, see `read_csv`; the layout is valid."""
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
            known, row_of = np.flatnonzero(np.isfinite(time_s)), table.row
            if not known.size:
                raise InputError(f"{path}: column {layout.time_column!r}: {MISSING}")
            columns, time_s = [column[known] for column in columns], time_s[known]
            table = table._replace(row=lambda k: row_of(int(known[k])))
        taken = sampling(str(path), layout, time_s, table.row)
    else:
        # check_layout ensures that there is a time column or a rate.
        assert layout.rate_hz is not None
        taken = Sampling(layout.rate_hz, 0.0, np.arange(len(columns[0])))
    flaws, filled = _make_whole(columns, _Read(path, layout, table, time_s, taken))
    gyro_factor, accel_factor = _factors(layout)
    spread = taken.rate_hz if layout.quantity == "rates" else 1.0
    odd = oddities(
        names[:6],
        columns,
        [factor * taken.rate_hz / spread for factor in (gyro_factor, accel_factor) for _ in "xyz"],
        taken.rate_hz,
        lambda sample: table.row(int(np.searchsorted(taken.number, sample))),
    )
    dv = _increments(columns, accel_factor, spread, layout.axes_order)
    return Record(
        dtheta=_increments(columns, gyro_factor, spread, layout.axes_order),
        dv=dv,
        rate_hz=taken.rate_hz,
        t0_s=taken.t0_s,
        source=str(path),
        flaws=tuple(flaws),
        filled=filled,
        oddities=odd,
    )


def _increments(columns: list[FloatArray], factor: float, spread: float, order: str) -> FloatArray:
    """(T, 3) increments in body axes of the last three columns, which are consumed.

    In place, because there is no memory for a second copy of a column of a long record.
    """
    index, signs = axes(order)
    own = [columns.pop() for _ in range(3)][::-1]
    made = np.empty((3, len(own[0]))).T  # column-major, as it is filled and read
    for axis, (place, sign) in enumerate(zip(index, signs, strict=True)):
        values = own[place]
        values *= factor
        values /= spread
        values *= sign
        made[:, axis] = values
    return made


class _Read(NamedTuple):
    """Origin and sampling times of the values of a file."""

    path: str | Path
    layout: Layout
    table: ColumnTable
    time_s: FloatArray | None
    taken: Sampling


def _make_whole(columns: list[FloatArray], read: _Read) -> tuple[list[Flaw], int]:
    """Extend columns, in place, to every sample from the first to the last.

    Short gaps are interpolated; others become nan and a flaw.
    """
    rate, number = read.taken.rate_hz, read.taken.number
    missing = np.zeros(number[-1] + 1, bool)
    for place, column in enumerate(columns):
        if len(column) < len(missing):
            columns[place] = np.full(len(missing), np.nan)
            columns[place][number] = column
        missing |= ~np.isfinite(columns[place])
    if not missing.any():
        return [], 0
    fill, flaws = np.zeros(len(missing), bool), []
    for begin, end in spans_of(missing):
        inside = begin > 0 and end < len(missing)
        gap_s = (end - begin + 1) / rate if inside else math.inf
        if gap_s <= read.layout.max_gap_s * (1 + 1e-9):
            fill[begin:end] = True
        else:
            flaws.append(Flaw(begin, end, _lack(columns, read, begin, gap_s)))
    good = np.flatnonzero(~missing)
    for column in columns:
        if fill.any():
            column[fill] = np.interp(np.flatnonzero(fill), good, column[good])
        column[missing & ~fill] = np.nan
    return flaws, int(fill.sum())


def _lack(columns: list[FloatArray], read: _Read, sample: int, gap_s: float) -> str:
    """The message about a run of missing samples in a gap, with the row of the first."""
    number, layout = read.taken.number, read.layout
    k = int(np.searchsorted(number, sample))
    remedy = ""
    if gap_s <= _INTERPOLATED_S:
        remedy = f" (max_gap_s = {_upward(gap_s):g} would interpolate it)"
    if number[k] != sample:
        assert read.time_s is not None
        where = f"{read.path}: column {layout.time_column!r}: row {read.table.row(k)}"
        gap = f"a gap at {read.taken.rate_hz:g} Hz, {between(read.time_s, k - 1)}"
        return f"{where}: {gap}{remedy}"
    names = zip((*layout.gyro_columns, *layout.accel_columns), columns, strict=True)
    name = next(name for name, column in names if not np.isfinite(column[sample]))
    return f"{read.path}: row {read.table.row(k)}: column {name!r}: {MISSING}{remedy}"


def _upward(gap_s: float) -> float:
    """The next longer time of three digits, as a user would write it."""
    unit = float(10.0 ** (math.floor(math.log10(gap_s)) - 2))
    return float(math.ceil(gap_s / unit - 1e-9) * unit)


def _factors(layout: Layout) -> tuple[float, float]:
    gyro = GYRO_UNITS[layout.quantity][layout.gyro_unit]
    return gyro, ACCEL_UNITS[layout.quantity][layout.accel_unit]


def write_csv(record: Record, path: str | Path, layout: Layout) -> None:
    """Write a record as comma-separated text in the layout's columns, units and axes.

    Increments in rad and m/s are read back bit for bit. The time column, if any, holds the end of
    each sample. The record's position, attitude and g are not written.

    Args:
        record: the record.
        path: the file to write; written atomically.
        layout: its rate_hz, if given, must be the record's.

    Raises:
        InputError: the layout or the record cannot be written, or the target is not writable.
    """
    columns = _columns(record, path, layout)
    header = io.StringIO()
    csv.writer(header, lineterminator="\n").writerow(columns)
    with atomic_write(path) as file:
        file.write(header.getvalue().encode())
        pa.csv.write_csv(pa.table(columns), file, pa.csv.WriteOptions(include_header=False))


def write_parquet(record: Record, path: str | Path, layout: Layout) -> None:
    """Write a record as a Parquet file of float64 columns; as `write_csv`."""
    columns = _columns(record, path, layout)
    with atomic_write(path) as file:
        pq.write_table(pa.table(columns), file)


def _columns(record: Record, path: str | Path, layout: Layout) -> dict[str, FloatArray]:
    check_layout(layout, str(path))
    if layout.time_unit == "iso":
        raise InputError(f"{path}: cannot be written: time_unit: 'iso' can only be read")
    agreed_rate(record.rate_hz, layout, 0.0, f"{path}: cannot be written: the record")
    if not (np.isfinite(record.dtheta).all() and np.isfinite(record.dv).all()):
        raise InputError(f"{path}: cannot be written: an increment is not finite")
    gyro_factor, accel_factor = _factors(layout)
    spread = record.rate_hz if layout.quantity == "rates" else 1.0
    gyro = from_body(record.dtheta, layout.axes_order) * spread / gyro_factor
    accel = from_body(record.dv, layout.axes_order) * spread / accel_factor
    columns: dict[str, FloatArray] = {}
    if layout.time_column:
        ends = np.arange(1, len(gyro) + 1)
        time_s = record.t0_s + ends / record.rate_hz
        columns[layout.time_column] = time_s / TIME_UNITS[layout.time_unit]
    columns |= dict(zip(layout.gyro_columns, gyro.T, strict=True))
    columns |= dict(zip(layout.accel_columns, accel.T, strict=True))
    return columns
