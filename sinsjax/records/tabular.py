"""Records in CSV and Parquet: named columns, units, axes and an optional time column."""

import csv
import io
from pathlib import Path
from typing import NoReturn

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from sinsjax.files import replacing
from sinsjax.records.layout import (
    ACCEL_UNITS,
    GYRO_UNITS,
    FloatArray,
    Layout,
    Record,
    agreed_rate,
    check_layout,
    from_body,
    to_body,
)
from sinsjax.records.tables import Table, open_csv, open_parquet
from sinsjax.types import InputError


def read_csv(path: str | Path, layout: Layout) -> Record:
    """Reads a comma-separated record; its first line names the columns.

    Rates become increments by the sampling interval. Time stamps are ends of samples: a step may
    differ from the sampling interval by half of it, and no sample may be missing.

    Args:
        path: the file.
        layout: columns, units, axes, and rate_hz where there is no time column.

    Returns:
        The record; what only a PSINS header says is None.

    Raises:
        InputError: the layout or the file cannot be used; the line names the key, the column or the
            row (line of the file, from 1).
    """
    check_layout(layout, str(path))
    return _record(path, layout, open_csv(path))


def read_parquet(path: str | Path, layout: Layout) -> Record:
    """Reads a record from a Parquet file; as `read_csv`, with rows of the table from 1."""
    check_layout(layout, str(path))
    return _record(path, layout, open_parquet(path))


def _record(path: str | Path, layout: Layout, table: Table) -> Record:
    names = [*layout.gyro_columns, *layout.accel_columns]
    if layout.time_column:
        names.append(layout.time_column)
    values = table.read(names)
    if layout.time_column:
        rate, t0 = _sampling(path, layout, values[:, 6], table)
    else:
        # check_layout has seen to it that one of the two is there.
        assert layout.rate_hz is not None
        rate, t0 = layout.rate_hz, 0.0
    gyro_factor, accel_factor = _factors(layout)
    spread = rate if layout.quantity == "rates" else 1.0
    return Record(
        dtheta=to_body(values[:, :3] * gyro_factor / spread, layout.axes_order),
        dv=to_body(values[:, 3:6] * accel_factor / spread, layout.axes_order),
        rate_hz=rate,
        t0_s=t0,
        source=str(path),
    )


def _factors(layout: Layout) -> tuple[float, float]:
    gyro = GYRO_UNITS[layout.quantity][layout.gyro_unit]
    return gyro, ACCEL_UNITS[layout.quantity][layout.accel_unit]


def _sampling(
    path: str | Path, layout: Layout, time_s: FloatArray, table: Table
) -> tuple[float, float]:
    """The sampling rate (Hz) and the beginning of the first sample (s), or what is wrong."""
    where = f"{path}: column {layout.time_column!r}"
    step_s = np.diff(time_s)
    if len(step_s) == 0:
        if layout.rate_hz is None:
            raise InputError(f"{path}: rate_hz: needed, since there is only one sample")
        return layout.rate_hz, float(time_s[0]) - 1 / layout.rate_hz

    def refuse(k: int, what: str) -> NoReturn:
        before, after = float(time_s[k]), float(time_s[k + 1])
        raise InputError(f"{where}: row {table.row(k + 1)}: {what}, from {before!r} to {after!r} s")

    stuck = step_s <= 0
    if stuck.any():
        k = int(stuck.argmax())
        refuse(k, "time repeats" if step_s[k] == 0 else "time runs backward")
    # The mean undoes rounded time stamps; the median, itself a step, keeps gaps out of it.
    median = np.quantile(step_s, 0.5, method="lower")
    clean = step_s[(step_s >= 0.5 * median) & (step_s <= 1.5 * median)]
    rate = agreed_rate(float(1 / clean.mean()), layout, 1 / len(clean), where)
    odd = (step_s < 0.5 / rate) | (step_s > 1.5 / rate)
    if odd.any():
        k = int(odd.argmax())
        refuse(k, f"{'a gap' if step_s[k] > 1 / rate else 'a short step'} at {rate:g} Hz")
    return rate, float(time_s[0]) - 1 / rate


def write_csv(record: Record, path: str | Path, layout: Layout) -> None:
    """Writes a record as comma-separated text in the layout's columns, units and axes.

    Increments in rad and m/s come back bit for bit. The time column, if any, holds the end of each
    sample. Place, attitude and g of the record are not written.

    Args:
        record: the record.
        path: the file to write; it appears whole or not at all.
        layout: its rate_hz, if given, must be the record's.

    Raises:
        InputError: the layout or the record cannot be written, or the target is not writable.
    """
    columns = _columns(record, path, layout)
    header = io.StringIO()
    csv.writer(header, lineterminator="\n").writerow(columns)
    with replacing(path) as file:
        file.write(header.getvalue().encode())
        pa.csv.write_csv(pa.table(columns), file, pa.csv.WriteOptions(include_header=False))


def write_parquet(record: Record, path: str | Path, layout: Layout) -> None:
    """Writes a record as a Parquet file of float64 columns; as `write_csv`."""
    columns = _columns(record, path, layout)
    with replacing(path) as file:
        pq.write_table(pa.table(columns), file)


def _columns(record: Record, path: str | Path, layout: Layout) -> dict[str, FloatArray]:
    check_layout(layout, str(path))
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
        columns[layout.time_column] = record.t0_s + ends / record.rate_hz
    columns |= dict(zip(layout.gyro_columns, gyro.T, strict=True))
    columns |= dict(zip(layout.accel_columns, accel.T, strict=True))
    return columns
