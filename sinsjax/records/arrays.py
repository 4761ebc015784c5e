"""Records and reference attitudes from arrays in memory: NumPy, pandas, Polars, Arrow."""

from collections.abc import Collection, Sequence
from datetime import datetime
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.messages import first_error_line, shorten
from sinsjax.records.files import MAX_MAGNITUDE
from sinsjax.records.layout import (
    FloatArray,
    RecordLayout,
    find_fault,
    message_key,
)
from sinsjax.records.reference import Reference, StoredRecord, reference_from_table
from sinsjax.records.tables import MISSING_TEXT, ColumnTable, find_columns
from sinsjax.records.tabular import record_from_table

_ARRAY_LAYOUT = RecordLayout("arrays")
_AXIS_SUFFIXES = tuple(f"[:, {axis}]" for axis in range(3))


def record_from_arrays(
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
        time: (T,) time at the end of each sample, in ``time_unit`` or as dates with time of any
            library, in UTC unless they have a zone; None if ``rate_hz`` determines the times.
        gyro: (T, 3) angular rates averaged over each sample, or increments over it, depending on
            the unit; nan, None or NA if a sample is missing.
        accel: (T, 3) specific forces likewise; upward on a base at rest.
        gyro_unit: "rad_per_s", "deg_per_s", "deg_per_h"; for increments "rad", "deg", "arcsec".
        accel_unit: "m_per_s2", "g", "mg", "ug"; for increments "m_per_s", "g_s", "ug_s".
        time_unit: "s", "ms", "us" or "ns".
        axes: directions of x, y and z of both arrays: "rfu" (right, front, up), "frd" or "flu"; or
            the axes that point right, front and up as a signed permutation, such as "y-xz".
        mounting_deg: attitude of these axes in the vehicle: pitch, roll and yaw
            (counter-clockwise), deg.
        rate_hz: sample rate, Hz; None takes it from the times.
        max_gap_s: longest time between two good samples across which missing ones are interpolated.
        latitude_deg: geodetic latitude, which a study's [earth] may then omit.
        height_m: height above the ellipsoid, likewise.
        reference: attitude to compare with: a mapping or table with the columns of
            `read_reference` (time_s, on the clock of ``time``, pitch_deg, roll_deg, and yaw_deg or
            heading_deg; dates with time are seconds since 1970), or a `Reference`.
        source: name of the record, for messages and manifests.

    Returns:
        The record with its reference.

    Raises:
        InputError: an argument is wrong; one line names the array and the row, from 0.

    Examples:
        >>> import numpy as np
        >>> gyro, accel = np.zeros((600, 3)), np.tile([0.0, 0.0, 9.8], (600, 1))
        >>> stored = sinsjax.record_from_arrays(None, gyro, accel, rate_hz=100.0)
        >>> float(stored.record.dv[0, 2])  # m/s per sample
        0.098
    """
    layout = RecordLayout(
        format="csv",  # with the fields of any table
        time_column="" if time is None else "time",
        gyro_columns=tuple(f"gyro{suffix}" for suffix in _AXIS_SUFFIXES),
        accel_columns=tuple(f"accel{suffix}" for suffix in _AXIS_SUFFIXES),
        gyro_unit=gyro_unit,
        accel_unit=accel_unit,
        axes_order=axes,
        mounting_deg=tuple(mounting_deg),
        rate_hz=rate_hz,
        time_unit=time_unit,
        max_gap_s=max_gap_s,
    )
    if time_unit == "iso":
        raise InputError(
            f"{source}: time_unit: 'iso' is for files (pass dates as a datetime array)"
        )
    if time is None and rate_hz is None:
        raise InputError(f"{source}: rate_hz: required if time is None")
    if layout_fault := find_fault(layout):
        raise InputError(
            f"{source}: {message_key(_ARRAY_LAYOUT, layout_fault.key)}: {layout_fault.text}"
        )
    vectors = {
        name: _to_vectors(source, name, array) for name, array in (("gyro", gyro), ("accel", accel))
    }
    columns = {
        f"{name}{suffix}": values[:, axis]
        for name, values in vectors.items()
        for axis, suffix in enumerate(_AXIS_SUFFIXES)
    }
    layout = layout._replace(format=_ARRAY_LAYOUT.format)
    if time is not None:
        columns["time"], is_date = _to_column(source, "time", time)
        if columns["time"].ndim != 1:
            shape = columns["time"].shape
            raise InputError(f"{source}: time: must have the shape (T,), not {shape}")
        layout = layout._replace(time_unit="iso" if is_date else time_unit)
    _check_equal_lengths(source, {**vectors, **({} if time is None else {"time": columns["time"]})})
    record = record_from_table(source, layout, _make_table(source, columns))
    record = record._replace(latitude_deg=latitude_deg, height_m=height_m, layout=layout)
    return StoredRecord.from_record(record, _make_reference(f"{source}: reference", reference))


def _to_floats(source: str, name: str, values: Any) -> FloatArray:
    """Return an array or table as float64, nan if missing; may be the caller's own array."""
    if hasattr(values, "filled"):  # of a masked array
        values = values.astype(float).filled(np.nan)
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        cells = _to_cells(values)
        if cells is None:
            raise InputError(f"{source}: {name}: not numeric: {first_error_line(error)}") from None
    numbers = np.empty(cells.shape)
    for index, cell in np.ndenumerate(cells):
        try:
            numbers[index] = np.nan if _is_missing(cell) else float(cell)
        except (TypeError, ValueError):
            row, *axis = index
            column = f"{name}[:, {axis[0]}]" if axis else name
            cell_text = shorten(repr(cell), 32)
            raise InputError(
                f"{source}: row {row}: column {column!r}: {cell_text} is not a number"
            ) from None
    return numbers


def _to_cells(values: Any) -> NDArray[Any] | None:
    """Return the cells of an array or table; None if its rows differ in length."""
    try:
        cells = np.asarray(values, dtype=object)
    except ValueError:
        return None
    return None if any(isinstance(cell, list | tuple) for cell in cells.flat) else cells


def _is_missing(cell: Any) -> bool:
    """Return whether a cell is None, NA or NaT, which pandas neither compares nor converts."""
    return cell is None or type(cell).__name__ in ("NAType", "NaTType")


def _to_vectors(source: str, name: str, values: Any) -> FloatArray:
    numbers = _to_floats(source, name, values)
    if numbers.ndim != 2 or numbers.shape[1] != 3:
        raise InputError(f"{source}: {name}: must have the shape (T, 3), not {numbers.shape}")
    return numbers


def _to_column(source: str, name: str, values: Any) -> tuple[FloatArray, bool]:
    """Return a column as numbers, and whether they are seconds since 1970 from dates."""
    array = np.asarray(values)
    if array.dtype.kind == "O" and array.ndim == 1:  # pandas stores dates with a zone as objects
        first = next((cell for cell in array if not _is_missing(cell)), None)
        if isinstance(first, datetime):
            array = _to_utc_dates(source, name, values)
    if array.dtype.kind != "M":
        return _to_floats(source, name, values), False
    nanoseconds = array.astype("datetime64[ns]").astype(np.int64) * 1e-9
    return np.where(np.isnat(array), np.nan, nanoseconds), True


def _to_utc_dates(source: str, name: str, values: Any) -> NDArray[Any]:
    """Return dates with time in UTC, from objects of which some may have a zone."""
    try:
        dates = pa.array(values, pa.timestamp("ns", "UTC"), from_pandas=True)
    except (pa.ArrowException, TypeError, ValueError) as error:
        raise InputError(
            f"{source}: {name}: not dates with time: {first_error_line(error)}"
        ) from None
    moments: NDArray[Any] = dates.to_numpy(zero_copy_only=False)
    return moments


def _check_equal_lengths(source: str, arrays: dict[str, FloatArray]) -> None:
    rows = {name: len(values) for name, values in arrays.items()}
    if not rows["gyro"]:
        raise InputError(f"{source}: gyro: has no rows")
    for name, count in rows.items():
        if count != rows["gyro"]:
            raise InputError(f"{source}: {name}: has {count} rows, gyro {rows['gyro']}")


def _make_table(source: str, columns: dict[str, FloatArray]) -> ColumnTable:
    """Return columns in memory as an opened table, whose rows count from 0."""

    def read(
        wanted: Sequence[str], *, blanks: bool = False, dates: Collection[str] = ()
    ) -> list[FloatArray]:
        find_columns(source, list(columns), wanted)
        result = []
        for name in wanted:
            values = np.array(columns[name], dtype=np.float64)  # a copy, which the reader changes
            large = np.isfinite(values) & (np.abs(values) > MAX_MAGNITUDE)
            bad = large if blanks else large | ~np.isfinite(values)
            if bad.any():
                row = int(bad.argmax())
                problem = f"out of range (beyond {MAX_MAGNITUDE:g})" if large[row] else MISSING_TEXT
                raise InputError(f"{source}: row {row}: column {name!r}: {problem}")
            result.append(values)
        return result

    return ColumnTable(list(columns), read, lambda k: k, "arrays")


def _make_reference(source: str, reference: Any) -> Reference | None:
    """Return a reference attitude from a mapping or table of columns."""
    if reference is None or isinstance(reference, Reference):
        return reference
    names = getattr(reference, "column_names", None)  # for Arrow, whose `columns` are arrays
    if names is None:
        names = getattr(reference, "columns", reference)
    columns = {str(name): _to_column(source, str(name), reference[name])[0] for name in names}
    rows = {len(values) for values in columns.values()}
    if len(rows) > 1 or not all(values.ndim == 1 for values in columns.values()):
        raise InputError(f"{source}: its columns must have one number per row")
    if rows == {0}:
        raise InputError(f"{source}: has no rows")
    return reference_from_table(source, _make_table(source, columns))
