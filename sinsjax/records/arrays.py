"""Records and reference attitudes from arrays in memory: NumPy, pandas, Polars, Arrow."""

from collections.abc import Collection, Sequence
from datetime import datetime
from typing import Any

import numpy as np
import pyarrow as pa

from sinsjax.errors import InputError
from sinsjax.messages import first_error_line, shorten
from sinsjax.records.layout import FloatArray, RecordLayout, find_fault, message_key
from sinsjax.records.reader import Table, check_values, find_columns
from sinsjax.records.reference import Reference, StoredRecord, reference_from_table
from sinsjax.records.tabular import record_from_table

_ARRAY_LAYOUT = RecordLayout("arrays")
_AXIS_SUFFIXES = tuple(f"[:, {axis}]" for axis in range(3))


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
    if fault := find_fault(layout):
        raise InputError(f"{source}: {message_key(_ARRAY_LAYOUT, fault.key)}: {fault.text}")
    layout = layout._replace(format=_ARRAY_LAYOUT.format)
    columns, rows = dict[str, FloatArray](), dict[str, int]()
    for name, array in (("gyro", gyro), ("accel", accel)):
        vectors = _to_floats(source, name, array)
        if vectors.ndim != 2 or vectors.shape[1] != 3:
            raise InputError(f"{source}: {name}: must have the shape (T, 3), not {vectors.shape}")
        columns |= zip((f"{name}{suffix}" for suffix in _AXIS_SUFFIXES), vectors.T, strict=True)
        rows[name] = len(vectors)
    if time is not None:
        columns["time"], is_date = _to_column(source, "time", time)
        layout = layout._replace(time_unit="iso" if is_date else time_unit)
        rows["time"] = len(columns["time"])
    for name, count in rows.items():
        if count != rows["gyro"] or not count:
            raise InputError(f"{source}: {name}: has {count} rows, gyro {rows['gyro']}")
    record = record_from_table(source, layout, _make_table(source, columns))
    record = record._replace(latitude_deg=latitude_deg, height_m=height_m, layout=layout)
    return StoredRecord.from_record(record, _make_reference(f"{source}: reference", reference))


def _to_floats(source: str, name: str, values: Any) -> FloatArray:
    """Return an array or table as float64, nan if missing; may be the caller's own array."""
    if hasattr(values, "filled"):  # of a masked array
        values = values.astype(float).filled(np.nan)
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        cells = np.asarray(values, dtype=object)
    numbers = np.empty(cells.shape)
    for index, cell in np.ndenumerate(cells):
        try:
            numbers[index] = np.nan if _is_missing(cell) else float(cell)
        except (TypeError, ValueError):
            column = name + "".join(f"[:, {axis}]" for axis in index[1:])
            text = f"{shorten(repr(cell), 32)} is not a number"
            raise InputError(f"{source}: row {index[0]}: column {column!r}: {text}") from None
    return numbers


def _is_missing(cell: Any) -> bool:
    """Return whether a cell is None, NA or NaT, which pandas neither compares nor converts."""
    return cell is None or type(cell).__name__ in ("NAType", "NaTType")


def _to_column(source: str, name: str, values: Any) -> tuple[FloatArray, bool]:
    """Return a column as numbers, and whether they are seconds since 1970 from dates."""
    array = np.asarray(values)
    if array.dtype.kind == "O" and array.ndim == 1:  # pandas stores dates with a zone as objects
        first = next((cell for cell in array if not _is_missing(cell)), None)
        if isinstance(first, datetime):
            try:
                dates = pa.array(values, pa.timestamp("ns", "UTC"), from_pandas=True)
            except (pa.ArrowException, TypeError, ValueError) as error:
                reason = f"not dates with time: {first_error_line(error)}"
                raise InputError(f"{source}: {name}: {reason}") from None
            array = dates.to_numpy(zero_copy_only=False)
    if array.dtype.kind == "M":
        nanoseconds = array.astype("datetime64[ns]").astype(np.int64) * 1e-9
        return np.where(np.isnat(array), np.nan, nanoseconds), True
    numbers = _to_floats(source, name, values)
    if numbers.ndim != 1:
        raise InputError(f"{source}: {name}: must have the shape (T,), not {numbers.shape}")
    return numbers, False


def _make_table(source: str, columns: dict[str, FloatArray]) -> Table:
    """Return columns in memory as an opened table, whose rows count from 0."""

    def read(
        wanted: Sequence[str], *, blanks: bool = False, dates: Collection[str] = ()
    ) -> list[FloatArray]:
        find_columns(source, list(columns), wanted)
        for name in wanted:
            check_values(source, name, columns[name], 0, blanks=blanks)
        return [columns[name].copy() for name in wanted]  # which the reader changes

    return Table(list(columns), read, lambda k: k, "arrays")


def _make_reference(source: str, reference: Any) -> Reference | None:
    """Return a reference attitude from a mapping or table of columns."""
    if reference is None or isinstance(reference, Reference):
        return reference
    names = getattr(reference, "column_names", None)  # for Arrow, whose `columns` are arrays
    if names is None:
        names = getattr(reference, "columns", reference)
    columns = {str(name): _to_column(source, str(name), reference[name])[0] for name in names}
    if len({*map(len, columns.values())}) != 1 or not len(next(iter(columns.values()))):
        raise InputError(f"{source}: its columns must have one number per row, and some rows")
    return reference_from_table(source, _make_table(source, columns))
