"""Records and reference attitudes from arrays in memory: NumPy, pandas, Polars, Arrow."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from sinsjax.errors import InputError
from sinsjax.messages import first_error_line
from sinsjax.records.layout import RecordLayout, check_layout
from sinsjax.records.reader import Table, make_table
from sinsjax.records.reference import Reference, StoredRecord, reference_from_table
from sinsjax.records.tabular import record_from_table


def record_from_arrays(  # noqa: PLR0913
    time: Any,
    gyro: Any,
    accel: Any,
    *,
    gyro_unit: str = "rad_per_s",
    accel_unit: str = "m_per_s2",
    time_unit: str = "s",
    axes: str = "rfu",
    mounting_deg: Sequence[float] = (0.0, 0.0, 0.0),
    rate_hz: float | None = None,
    max_gap_s: float = 0.0,
    latitude_deg: float | None = None,
    height_m: float | None = None,
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
        mounting_deg: attitude of these axes in the vehicle: pitch, roll, counter-clockwise yaw.
        rate_hz: sample rate, Hz; None takes it from the times.
        max_gap_s: longest gap between good samples that is interpolated.
        latitude_deg: geodetic latitude, which a study's [earth] may then omit.
        height_m: height above the ellipsoid, likewise.
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
        mounting_deg=tuple(mounting_deg),
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
    record = record._replace(latitude_deg=latitude_deg, height_m=height_m, layout=layout)
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
