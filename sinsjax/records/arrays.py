"""Records and reference attitudes from arrays in memory: NumPy, pandas, Polars, Arrow."""

from collections.abc import Collection, Sequence
from datetime import datetime
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.messages import first_error_line, shorten
from sinsjax.records.files import LARGEST
from sinsjax.records.layout import (
    ACCEL_UNITS,
    GYRO_UNITS,
    FloatArray,
    Layout,
    fault,
    given_as,
)
from sinsjax.records.reference import Reference, StoredRecord, reference_of
from sinsjax.records.tables import MISSING, ColumnTable, column_index
from sinsjax.records.tabular import record_of

_OF_ARRAYS = Layout("arrays")
_PLACES = tuple(f"[:, {axis}]" for axis in range(3))


def record_from_arrays(
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
    latitude_deg: float | None = None,
    height_m: float | None = None,
    reference: Any = None,
    source: str = "arrays",
) -> StoredRecord:
    """A record from arrays of any library that NumPy understands, as `sinsjax.run` takes it.

    The study that runs on it has ``[record] format = "arrays"``.

    Args:
        time: (T,) time at the end of each sample, in ``time_unit`` or as dates with time of any
            library, in UTC unless they have a zone; None where ``rate_hz`` gives the times.
        gyro: (T, 3) angular rates averaged over each sample, or increments over it, as the unit
            tells; nan, None or NA where a sample is missing.
        accel: (T, 3) specific forces likewise: of a base at rest it points up.
        gyro_unit: "rad_per_s", "deg_per_s", "deg_per_h"; of increments "rad", "deg", "arcsec".
        accel_unit: "m_per_s2", "g", "mg", "ug"; of increments "m_per_s", "g_s", "ug_s".
        time_unit: "s", "ms", "us" or "ns".
        axes: where x, y and z of both arrays point: "rfu" (right, front, up), "frd" or "flu"; or
            the axes that point right, front and up as a signed permutation, such as "y-xz".
        rate_hz: sample rate, Hz; None takes it from the times.
        max_gap_s: longest time between two good samples across which missing ones are interpolated.
        latitude_deg: geodetic latitude, which a study's [earth] may leave out then.
        height_m: height above the ellipsoid, likewise.
        reference: attitude to compare with: a mapping or table of columns as `read_reference` reads
            them from a file (time_s, on the clock of ``time``, pitch_deg, roll_deg, and yaw_deg or
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
    layout = Layout(
        format="csv",  # its fields are those of any table
        quantity=_quantity(source, gyro_unit, accel_unit),
        time_column="" if time is None else "time",
        gyro_columns=tuple(f"gyro{place}" for place in _PLACES),
        accel_columns=tuple(f"accel{place}" for place in _PLACES),
        gyro_unit=gyro_unit,
        accel_unit=accel_unit,
        axes_order=axes,
        rate_hz=rate_hz,
        time_unit=time_unit,
        max_gap_s=max_gap_s,
    )
    if time_unit == "iso":
        raise InputError(f"{source}: time_unit: 'iso' is of files (pass dates as a datetime array)")
    if time is None and rate_hz is None:
        raise InputError(f"{source}: rate_hz: required where time is None")
    if found := fault(layout):
        raise InputError(f"{source}: {given_as(_OF_ARRAYS, found.key)}: {found.text}")
    vectors = {
        name: _vectors(source, name, own) for name, own in (("gyro", gyro), ("accel", accel))
    }
    columns = {
        f"{name}{place}": values[:, axis]
        for name, values in vectors.items()
        for axis, place in enumerate(_PLACES)
    }
    layout = layout._replace(format=_OF_ARRAYS.format)
    if time is not None:
        columns["time"], is_date = _column(source, "time", time)
        if columns["time"].ndim != 1:
            shape = columns["time"].shape
            raise InputError(f"{source}: time: must have the shape (T,), not {shape}")
        layout = layout._replace(time_unit="iso" if is_date else time_unit)
    _require_one_length(source, {**vectors, **({} if time is None else {"time": columns["time"]})})
    record = record_of(source, layout, _table(source, columns))
    record = record._replace(latitude_deg=latitude_deg, height_m=height_m, layout=layout)
    return StoredRecord.of(record, _reference(f"{source}: reference", reference))


def _quantity(source: str, gyro_unit: str, accel_unit: str) -> str:
    """What both arrays hold, by their units: rates or increments."""
    held = {}
    for name, unit, known in (
        ("gyro_unit", gyro_unit, GYRO_UNITS),
        ("accel_unit", accel_unit, ACCEL_UNITS),
    ):
        quantity = next((quantity for quantity, units in known.items() if unit in units), None)
        if quantity is None:
            every = ", ".join(unit for units in known.values() for unit in units)
            raise InputError(f"{source}: {name}: {unit!r} is not one of {every}")
        held[name] = quantity
    if len(set(held.values())) > 1:
        raise InputError(
            f"{source}: accel_unit: {accel_unit!r} is of {held['accel_unit']}, gyro_unit"
            f" {gyro_unit!r} of {held['gyro_unit']}: both arrays must hold the same"
        )
    return held["gyro_unit"]


def _numbers(source: str, name: str, values: Any) -> FloatArray:
    """Numbers of an array or table as float64, nan where missing: the caller's own or a copy."""
    if hasattr(values, "filled"):  # of a masked array
        values = values.astype(float).filled(np.nan)
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        cells = _cells(values)
        if cells is None:
            raise InputError(f"{source}: {name}: no numbers: {first_error_line(error)}") from None
    numbers = np.empty(cells.shape)
    for place, cell in np.ndenumerate(cells):
        try:
            numbers[place] = np.nan if _is_missing(cell) else float(cell)
        except (TypeError, ValueError):
            row, *axis = place
            column = f"{name}[:, {axis[0]}]" if axis else name
            shown = shorten(repr(cell), 32)
            raise InputError(
                f"{source}: row {row}: column {column!r}: {shown} is no number"
            ) from None
    return numbers


def _cells(values: Any) -> NDArray[Any] | None:
    """The single cells of an array or table; None where its rows differ in length."""
    try:
        cells = np.asarray(values, dtype=object)
    except ValueError:
        return None
    return None if any(isinstance(cell, list | tuple) for cell in cells.flat) else cells


def _is_missing(cell: Any) -> bool:
    """Whether a cell is None, NA or NaT: those of pandas neither compare nor become numbers."""
    return cell is None or type(cell).__name__ in ("NAType", "NaTType")


def _vectors(source: str, name: str, values: Any) -> FloatArray:
    numbers = _numbers(source, name, values)
    if numbers.ndim != 2 or numbers.shape[1] != 3:
        raise InputError(f"{source}: {name}: must have the shape (T, 3), not {numbers.shape}")
    return numbers


def _column(source: str, name: str, values: Any) -> tuple[FloatArray, bool]:
    """A column as numbers, and whether they are seconds since 1970 from dates."""
    plain = np.asarray(values)
    if plain.dtype.kind == "O" and plain.ndim == 1:  # pandas gives dates with a zone as objects
        first = next((cell for cell in plain if not _is_missing(cell)), None)
        if isinstance(first, datetime):
            plain = _moments(source, name, values)
    if plain.dtype.kind != "M":
        return _numbers(source, name, values), False
    nanoseconds = plain.astype("datetime64[ns]").astype(np.int64) * 1e-9
    return np.where(np.isnat(plain), np.nan, nanoseconds), True


def _moments(source: str, name: str, values: Any) -> NDArray[Any]:
    """Dates with time in UTC, of objects of which some may have a zone."""
    try:
        dates = pa.array(values, pa.timestamp("ns", "UTC"), from_pandas=True)
    except (pa.ArrowException, TypeError, ValueError) as error:
        raise InputError(
            f"{source}: {name}: no dates with time: {first_error_line(error)}"
        ) from None
    moments: NDArray[Any] = dates.to_numpy(zero_copy_only=False)
    return moments


def _require_one_length(source: str, arrays: dict[str, FloatArray]) -> None:
    rows = {name: len(values) for name, values in arrays.items()}
    if not rows["gyro"]:
        raise InputError(f"{source}: gyro: has no rows")
    for name, count in rows.items():
        if count != rows["gyro"]:
            raise InputError(f"{source}: {name}: has {count} rows, gyro {rows['gyro']}")


def _table(source: str, columns: dict[str, FloatArray]) -> ColumnTable:
    """Columns in memory as a file's are opened; its rows count from 0."""

    def read(
        wanted: Sequence[str], *, blanks: bool = False, dates: Collection[str] = ()
    ) -> list[FloatArray]:
        column_index(source, list(columns), wanted)
        found = []
        for name in wanted:
            values = np.array(columns[name], dtype=np.float64)  # a copy, which the reader changes
            large = np.isfinite(values) & (np.abs(values) > LARGEST)
            bad = large if blanks else large | ~np.isfinite(values)
            if bad.any():
                row = int(bad.argmax())
                what = f"out of range (beyond {LARGEST:g})" if large[row] else MISSING
                raise InputError(f"{source}: row {row}: column {name!r}: {what}")
            found.append(values)
        return found

    return ColumnTable(list(columns), read, lambda k: k)


def _reference(source: str, given: Any) -> Reference | None:
    """A reference attitude from a mapping or table of columns."""
    if given is None or isinstance(given, Reference):
        return given
    names = getattr(given, "column_names", None)  # of Arrow, whose `columns` are arrays
    if names is None:
        names = getattr(given, "columns", given)
    columns = {str(name): _column(source, str(name), given[name])[0] for name in names}
    rows = {len(values) for values in columns.values()}
    if len(rows) > 1 or not all(values.ndim == 1 for values in columns.values()):
        raise InputError(f"{source}: its columns must have one number for each of its rows")
    if rows == {0}:
        raise InputError(f"{source}: has no rows")
    return reference_of(source, _table(source, columns))
