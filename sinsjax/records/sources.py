"""Records from each source: delimited text or Parquet, PSINS text, and arrays in memory."""

import math
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from sinsjax.errors import InputError
from sinsjax.messages import first_error_line, shorten
from sinsjax.records.layout import PSINS_LAYOUT, Record, RecordLayout, check_layout, resolve_rate
from sinsjax.records.reader import (
    Table,
    data_lines,
    is_number,
    make_table,
    open_log,
    open_text,
    read_lines,
)
from sinsjax.records.reference import Reference, StoredRecord, reference_from_table
from sinsjax.records.tabular import record_from_table
from sinsjax.units import ARCSEC, micro_g


def read_record(path: str | Path, layout: RecordLayout) -> Record:
    r"""Read a record in the layout's format: "psins", "csv" (delimited text) or "parquet".

    Examples:
        >>> from pathlib import Path
        >>> from sinsjax.records import RecordLayout
        >>> _ = Path("log.csv").write_text("gx,gy,gz,ax,ay,az\n" + 200 * "0,0,0,0,0,0.098\n")
        >>> columns = {"gyro_columns": ("gx", "gy", "gz"), "accel_columns": ("ax", "ay", "az")}
        >>> sinsjax.read_record("log.csv", RecordLayout("csv", **columns, rate_hz=100.0)).dv.shape
        (200, 3)
    """
    if layout.format == "psins":
        return read_psins_counts(path, layout)
    check_layout(layout, str(path))
    return record_from_table(layout, open_log(path, layout.columns, layout.skip_rows))


_COUNT_COLUMNS = tuple(f"{sensor} {axis}" for sensor in ("gyro", "accelerometer") for axis in "xyz")


def read_psins_counts(path: str | Path, layout: RecordLayout = PSINS_LAYOUT) -> Record:
    """Read a PSINS SIMU log: three header lines, then six integer counts per sample.

    The format of the PSINS toolbox (G. Yan, NWPU). Lines that start with % are comments. Header:
    pitch, roll, yaw (deg), VE, VN, VU (m/s); latitude, longitude (deg), height (m), t0 (s),
    interval (ms), g (m/s^2); scale factors, three gyro (arcsec) and three accelerometer (ug*s, in
    that g). A latitude or height of nan is unknown. Of the layout, axes_order and rate_hz are used;
    the rate must agree with the header's interval.
    """
    check_layout(layout, str(path))
    lines = [*islice(data_lines(read_lines(path)), 3)]

    def refuse(number: int, problem: str) -> InputError:
        return InputError(f"{path}: row {lines[number].row}: header line {number + 1}: {problem}")

    hint = "not PSINS text? `sinsjax init record --from LOG` writes a [record] for others"
    for number, line in enumerate(lines):
        words = line.text.split()
        if len(lines) < 3 or len(words) != 6 or not all(map(is_number, words)):
            raise refuse(number, f"must have 6 numbers: {shorten(line.text, 60)!r} ({hint})")
    _, place, scale = (np.array([*map(float, line.text.split())]) for line in lines)
    latitude, _, height, t0, interval_ms, gravity = place.tolist()
    # Lines in the wrong order, or a missing one, are detected here.
    is_clock = 0 < interval_ms < math.inf and math.isfinite(t0)
    if not (is_clock and 9 < gravity < 11 and not abs(latitude) >= 90):
        raise refuse(
            1,
            f"latitude {latitude:g} deg, t0 {t0:g} s, interval {interval_ms:g} ms and g"
            f" {gravity:g} m/s^2 are no place and clock (a 3-line header must precede the samples)",
        )
    if not (np.isfinite(scale) & (scale > 0)).all():
        raise refuse(2, f"scale factors must be positive and finite, not {scale.min():g}")
    layout = layout._replace(
        gyro_columns=_COUNT_COLUMNS[:3],
        accel_columns=_COUNT_COLUMNS[3:],
        gyro_scale=tuple(scale[:3] * ARCSEC),
        accel_scale=tuple(scale[3:] * micro_g(gravity)),
        rate_hz=resolve_rate(1e3 / interval_ms, layout, 0.0, f"{path}: row {lines[1].row}"),
    )
    record = record_from_table(layout, open_text(path, _COUNT_COLUMNS, skip_rows=lines[2].row))
    return record._replace(
        t0_s=t0,
        latitude_deg=None if math.isnan(latitude) else latitude,
        height_m=None if math.isnan(height) else height,
        gravity_m_per_s2=gravity,
    )


def record_from_arrays(  # noqa: PLR0913
    time: Any,
    gyro: Any,
    accel: Any,
    *,
    gyro_unit: str = "rad_per_s",
    accel_unit: str = "m_per_s2",
    time_unit: str = "s",
    axes: str = "rfu",
    rate_hz: float | None = None,
    max_gap_s: float = 0.0,
    reference: Any = None,
    source: str = "arrays",
) -> StoredRecord:
    """Return a record from arrays of any library that NumPy reads, for `sinsjax.run`.

    Its study needs ``[record] format = "arrays"``.

    Args:
        time: (T,) time at the end of each sample, in ``time_unit`` or as dates with time, in UTC
            unless they have a zone; None if ``rate_hz`` determines the times.
        gyro: (T, 3) angular rates averaged over each sample, or increments over it; nan if missing.
        accel: (T, 3) specific forces likewise; upward on a base at rest.
        gyro_unit: "rad_per_s", "deg_per_s", "deg_per_h"; for increments "rad", "deg", "arcsec".
        accel_unit: "m_per_s2", "g", "mg", "ug"; for increments "m_per_s", "g_s", "ug_s".
        time_unit: "s", "ms", "us" or "ns".
        axes: directions of x, y and z: "rfu" (right, front, up), "frd" or "flu"; or the axes that
            point right, front and up as a signed permutation, such as "y-xz".
        rate_hz: sample rate, Hz; None takes it from the times.
        max_gap_s: longest gap between good samples that is interpolated.
        reference: attitude to compare with: a mapping or table with the columns of
            `read_reference`, on the clock of ``time``, or a `Reference`.
        source: name of the record, for messages and manifests.

    Returns:
        The record with its reference.

    Raises:
        InputError: an argument is wrong; one line names the array or column, and the row, from 0.

    Examples:
        >>> import numpy as np
        >>> gyro, accel = np.zeros((600, 3)), np.tile([0.0, 0.0, 9.8], (600, 1))
        >>> stored = sinsjax.record_from_arrays(None, gyro, accel, rate_hz=100.0)
        >>> float(stored.record.dv[0, 2])  # m/s per sample
        0.098
    """
    columns = _split_vectors(source, "gyro", gyro) | _split_vectors(source, "accel", accel)
    layout = RecordLayout(
        format="arrays",
        time_column="" if time is None else "time",
        gyro_columns=tuple(columns)[:3],
        accel_columns=tuple(columns)[3:],
        gyro_unit=gyro_unit,
        accel_unit=accel_unit,
        axes_order=axes,
        rate_hz=rate_hz,
        time_unit=time_unit,
        max_gap_s=max_gap_s,
    )
    check_layout(layout, source)
    if time is not None:
        columns["time"] = _to_arrow(source, "time", time)
        if pa.types.is_timestamp(columns["time"].type):
            layout = layout._replace(time_unit="iso")
    record = record_from_table(layout, _make_table(source, columns))
    if reference is not None and not isinstance(reference, Reference):
        place = f"{source}: reference"
        names = getattr(reference, "column_names", None)  # of Arrow, whose `columns` are arrays
        names = [*(getattr(reference, "columns", reference) if names is None else names)]
        arrays = {name: _to_arrow(place, name, reference[name]) for name in names}
        reference = reference_from_table(_make_table(place, arrays))
    return StoredRecord.from_record(record, reference)


def _split_vectors(source: str, name: str, vectors: Any) -> dict[str, pa.Array]:
    """Return the three columns of an array (T, 3), by name."""
    try:
        rows: Any = np.asarray(np.ma.filled(np.ma.asarray(vectors, float), np.nan))
    except (TypeError, ValueError) as error:
        raise InputError(f"{source}: {name}: {first_error_line(error)}") from None
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise InputError(f"{source}: {name}: must have the shape (T, 3), not {rows.shape}")
    return {f"{name}[:, {axis}]": pa.array(column) for axis, column in enumerate(rows.T)}


def _to_arrow(source: str, name: str, values: Any) -> pa.Array:
    """Return a column of any library as numbers or dates; null if missing."""
    try:  # dates with a zone, and missing ones of pandas, are objects
        return pa.array(np.asarray(values), from_pandas=True)
    except (pa.ArrowException, TypeError, ValueError) as error:
        raise InputError(f"{source}: {name}: {first_error_line(error)}") from None


def _make_table(source: str, columns: Mapping[str, pa.Array]) -> Table:
    """Return columns in memory as an opened table, whose rows count from 0."""
    rows = {name: len(column) for name, column in columns.items()}
    if len({*rows.values()}) != 1 or 0 in rows.values():
        counts = ", ".join(f"{name} {count}" for name, count in rows.items())
        raise InputError(f"{source}: columns must have the same number of rows, not 0: {counts}")
    return Table(source, make_table(columns.values(), [*columns]), int, "arrays")
