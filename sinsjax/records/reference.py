"""Reference attitudes, with which recorded studies are compared."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from sinsjax.errors import InputError
from sinsjax.messages import format_seconds, shorten
from sinsjax.records.layout import TIME_UNITS, FloatArray, Record, RecordLayout
from sinsjax.records.reader import MISSING_TEXT, Table, open_log

_LONGEST_GAP_S = 5.0  # that is interpolated; a swinging base turns within seconds
_SIGMAS = ("sigma_e_deg", "sigma_n_deg", "sigma_u_deg")


class Reference(NamedTuple):
    """A reference attitude at M times."""

    time_s: FloatArray  # (M,) increasing, on the record's clock
    attitude_deg: FloatArray  # (M, 3) pitch, roll and yaw (counter-clockwise from north)
    sigma_deg: FloatArray | None  # (M, 3) about east, north and up, 1 sigma; None if not given
    source: str = "reference"  # the file's name, for messages


def read_reference(path: str | Path, layout: RecordLayout | None = None) -> Reference:
    r"""Read a reference attitude from a Parquet file or delimited text.

    Columns: time_s, pitch_deg, roll_deg, one of yaw_deg, yaw_ccw_deg (both counter-clockwise from
    north) and heading_deg (clockwise), and optionally all of sigma_e_deg, sigma_n_deg, sigma_u_deg.
    The time column of a record's layout, in its unit, may replace time_s.

    Examples:
        >>> from pathlib import Path
        >>> lines = ("time_s,pitch_deg,roll_deg,yaw_deg", "0,0,0,10", "60,0,0,12")
        >>> _ = Path("reference.csv").write_text("\n".join(lines))
        >>> sinsjax.read_reference("reference.csv").attitude_deg[:, 2].tolist()  # yaw
        [10.0, 12.0]
    """
    return reference_from_table(open_log(path), layout)


def reference_from_table(table: Table, layout: RecordLayout | None = None) -> Reference:
    """Return the reference in an opened table, see `read_reference`."""
    yaws = [name for name in ("yaw_deg", "yaw_ccw_deg", "heading_deg") if name in table.names]
    if len(yaws) != 1:
        found = " and ".join(yaws) or f"none among {shorten(', '.join(map(repr, table.names)))}"
        problem = f"needs one column of yaw_deg, yaw_ccw_deg and heading_deg, and has {found}"
        raise InputError(f"{table.source}: {problem}")
    sigmas = _SIGMAS if {*_SIGMAS} & {*table.names} else ()
    time, unit = "time_s", "s"
    if layout and time not in table.names and layout.time_column in table.names:
        time, unit = layout.time_column, layout.time_unit
    names = [time, "pitch_deg", "roll_deg", *yaws, *sigmas]
    values = np.column_stack(table.read(names, [time] if unit == "iso" else []))
    time_s, attitude, sigma = values[:, 0] * TIME_UNITS[unit], values[:, 1:4], values[:, 4:]
    if yaws == ["heading_deg"]:
        attitude[:, 2] *= -1
    faults = (
        (~np.isfinite(values).all(axis=1), f"a cell is {MISSING_TEXT}"),
        (np.diff(time_s, prepend=-np.inf) <= 0, f"{time} does not increase"),
        (np.abs(attitude[:, 0]) > 90, "pitch_deg is beyond 90"),
        ((sigma < 0).any(axis=1), "a sigma is negative"),
    )
    for bad, text in faults:
        if bad.any():
            raise InputError(f"{table.source}: row {table.row_number(int(bad.argmax()))}: {text}")
    if len(time_s) < 2:
        raise InputError(f"{table.source}: a reference needs at least two rows")
    return Reference(time_s, attitude, sigma if sigmas else None, table.source)


class StoredRecord(NamedTuple):
    """A record for the engine, and an attitude to compare with, in times from its beginning."""

    record: Record
    reference: Reference | None

    @classmethod
    def from_record(cls, record: Record, reference: Reference | None) -> "StoredRecord":
        """Return a record with a reference whose times are on the record's clock."""
        if reference is not None:
            reference = reference._replace(time_s=reference.time_s - record.t0_s)
        return cls(record, reference)


def reference_attitudes(stored: StoredRecord, times: np.ndarray) -> np.ndarray:
    """Return the reference attitude at times from the record's start, (n, 4); NaN without one."""
    reference = stored.reference
    if reference is None:
        return np.full((len(times), 4), np.nan)
    first, last = reference.time_s[0], reference.time_s[-1]
    begin, end = times.min(), times.max()  # a backward pass ends before it begins
    slack = 1e-6 + 1 / stored.record.rate_hz
    if max(first - begin, end - last) > slack:
        clock, covers, needs = stored.record.t0_s, (first, last), (begin, end)
        covered, needed = (
            " to ".join(format_seconds(clock + time) for time in span) for span in (covers, needs)
        )
        raise InputError(
            f"{reference.source}: covers {covered} s, but the study needs {needed} s by the clock"
            f" of {stored.record.source} (change [record] start_s or [study] duration_s; or do"
            " their clocks differ?)"
        )
    # With the samples on either side, between which the ends are interpolated.
    low = np.searchsorted(reference.time_s, begin, side="right") - 1
    high = np.searchsorted(reference.time_s, end)
    gap = np.diff(reference.time_s[max(0, low) : high + 1]).max(initial=0.0)
    if gap > _LONGEST_GAP_S:
        raise InputError(
            f"{reference.source}: has a gap of {gap:g} s where the study needs it"
            f" (at most {_LONGEST_GAP_S:g} s are interpolated)"
        )
    from scipy.spatial.transform import Rotation, Slerp  # half the import time of sinsjax

    pitch, roll, yaw = reference.attitude_deg.T
    attitudes = Rotation.from_euler("ZXY", np.column_stack([yaw, pitch, roll]), degrees=True)
    return Slerp(reference.time_s, attitudes)(np.clip(times, first, last)).as_quat(
        scalar_first=True
    )
