"""Inertial records, file layouts, and the conversion of units and axes between the two."""

import math
import re
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.messages import format_seconds
from sinsjax.units import ARCSEC, DEG, DEG_PER_H, STANDARD_GRAVITY, micro_g

FloatArray = NDArray[np.float64]

GYRO_UNITS = {
    "increments": {"rad": 1.0, "deg": DEG, "arcsec": ARCSEC},
    "rates": {"rad_per_s": 1.0, "deg_per_s": DEG, "deg_per_h": DEG_PER_H},
}
"""Factors to rad or rad/s, by quantity and unit name."""

ACCEL_UNITS = {
    "increments": {"m_per_s": 1.0, "g_s": STANDARD_GRAVITY, "ug_s": micro_g()},
    "rates": {"m_per_s2": 1.0, "g": STANDARD_GRAVITY, "mg": 1e3 * micro_g(), "ug": micro_g()},
}
"""Factors to m/s or m/s^2, by quantity and unit name; g is the standard gravity."""

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "iso": 1.0}
"""Factors to s, by unit name; ISO dates are read as seconds since 1970."""

_FORMATS = ("psins", "csv", "parquet")

NAMED_AXES = {"rfu": "xyz", "frd": "yx-z", "flu": "-yxz"}
"""Orders of axes by the letters of where x, y and z point: right, front, left, up or down."""

# Clocks deviate this far from their nominal rate; a larger difference is a mistake in the rate.
_RATE_TOLERANCE = 1e-4


class Flaw(NamedTuple):
    """Missing samples of a record, ``begin`` up to but not including ``end``, and the message."""

    begin: int
    end: int
    text: str


class Oddity(NamedTuple):
    """Samples, ``begin`` up to but not including ``end``, that no sensor of a base at rest gives.

    ``hard`` if they are certainly wrong; the message is without the file's name.
    """

    begin: int
    end: int
    hard: bool
    text: str


class Record(NamedTuple):
    """An inertial record of T samples, b = right-front-up.

    Attributes:
        dtheta: (T, 3) rotation increments over each sample, rad.
        dv: (T, 3) specific-force increments over each sample, m/s.
        rate_hz: sample rate, Hz.
        t0_s: time at which the first sample begins; sample k ends at t0_s + (k + 1) / rate_hz.
        latitude_deg: geodetic latitude from the file's header, or None.
        height_m: height from the file's header, or None.
        attitude_deg: pitch, roll and yaw (counter-clockwise from north) exactly as in the file's
            header, or None.
        gravity_m_per_s2: the g that the file's specific force is scaled by, or None.
        source: the file's name, for messages.
        flaws: missing samples, which are nan in dtheta and dv.
        filled: number of missing samples that were interpolated.
        layout: how arrays held it, for messages about their units and axes; None of a file, whose
            layout the study has.
        oddities: samples that no sensor of a base at rest gives.
    """

    dtheta: FloatArray
    dv: FloatArray
    rate_hz: float
    t0_s: float = 0.0
    latitude_deg: float | None = None
    height_m: float | None = None
    attitude_deg: tuple[float, float, float] | None = None
    gravity_m_per_s2: float | None = None
    source: str = "record"
    flaws: tuple[Flaw, ...] = ()
    filled: int = 0
    layout: "Layout | None" = None
    oddities: tuple[Oddity, ...] = ()


class Layout(NamedTuple):
    """Layout of a record in a file; the fields are the keys of a study's ``[record]`` section.

    Attributes:
        format: "psins", "csv" or "parquet". PSINS text otherwise uses only axes_order and rate_hz.
            "arrays" of what was given in memory, which no file has.
        quantity: "increments" over each sample, or "rates" averaged over each sample.
        time_column: time at the end of each sample; "" if the file has no time.
        gyro_columns: three names, in the record's own x, y, z.
        accel_columns: three names, in the record's own x, y, z.
        gyro_unit: a key of `GYRO_UNITS` for the quantity.
        accel_unit: a key of `ACCEL_UNITS` for the quantity.
        axes_order: the record's axes that point right, front and up: "y-xz" means that right is +y
            of the record, front is -x and up is +z; or a name of `NAMED_AXES`.
        rate_hz: sample rate, Hz; None takes it from the header or the time column.
        time_unit: unit of the time column: "s", "ms", "us", "ns", or "iso" for dates with time.
        max_gap_s: longest time between two good samples across which missing ones are
            interpolated.
    """

    format: str
    quantity: str = "increments"
    time_column: str = ""
    gyro_columns: tuple[str, ...] = ()
    accel_columns: tuple[str, ...] = ()
    gyro_unit: str = "rad"
    accel_unit: str = "m_per_s"
    axes_order: str = "xyz"
    rate_hz: float | None = None
    time_unit: str = "s"
    max_gap_s: float = 0.0


_ARGUMENTS = {"time_column": "time", "axes_order": "axes"}


def given_as(layout: Layout, key: str) -> str:
    """What messages call a key of a layout: that of a file, or the argument that gives arrays."""
    return _ARGUMENTS.get(key, key) if layout.format == "arrays" else key


def spans_of(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Where flags (T,) are set: of every run the first place, and the one after its last."""
    edges = np.flatnonzero(np.diff(flags, prepend=False, append=False)).reshape(-1, 2)
    return [(begin, end) for begin, end in edges.tolist()]


class Note(NamedTuple):
    """Why a key of a layout has its value, and what cannot be known about it; "" for nothing."""

    reason: str
    doubt: str = ""


PSINS_LAYOUT = Layout("psins")
"""PSINS text with right-front-up axes, at the header's rate."""


def check_layout(layout: Layout, source: str) -> None:
    """Reject an invalid layout.

    Args:
        layout: the layout.
        source: name of the file that holds the keys, with which the message begins.

    Raises:
        InputError: names the key and what is wrong with it.
    """
    if found := fault(layout):
        raise InputError(f"{source}: {found.key}: {found.text}")


class Fault(NamedTuple):
    """What is wrong with a layout: the key and the message."""

    key: str
    text: str


def fault(layout: Layout) -> Fault | None:
    """The first fault of a layout; None if it is valid."""
    return next((Fault(*found) for found in _layout_faults(layout)), None)


def _layout_faults(layout: Layout) -> Iterator[tuple[str, str]]:
    # Only the first fault is ever read, so later checks may rely on earlier ones.
    if layout.format not in _FORMATS:
        yield "format", _not_one_of(layout.format, _FORMATS)
    if layout.quantity not in GYRO_UNITS:
        yield "quantity", _not_one_of(layout.quantity, GYRO_UNITS)
    if layout.rate_hz is not None and not 0 < layout.rate_hz < math.inf:
        yield "rate_hz", f"must be positive, not {layout.rate_hz!r}"
    try:
        axes(layout.axes_order)
    except ValueError as error:
        yield "axes_order", str(error)
    if layout.format == "psins":
        if layout.quantity != "increments":
            yield "quantity", "PSINS text holds increments, not rates"
        return
    yield from _column_faults(layout)


def _column_faults(layout: Layout) -> Iterator[tuple[str, str]]:
    units = (
        ("gyro_unit", layout.gyro_unit, GYRO_UNITS),
        ("accel_unit", layout.accel_unit, ACCEL_UNITS),
    )
    for key, unit, known in units:
        if unit not in known[layout.quantity]:
            yield key, f"{_not_one_of(unit, known[layout.quantity])} for {layout.quantity}"
    seen = {layout.time_column: "time_column"}
    for key, names in (
        ("gyro_columns", layout.gyro_columns),
        ("accel_columns", layout.accel_columns),
    ):
        if len(names) != 3:
            yield key, f"must name three columns, not {len(names)}"
        for name in names:
            if not name:
                yield key, "a column name is empty"
            if name in seen:
                yield key, f"column {name!r} is already used in {seen[name]}"
            seen[name] = key
    if layout.time_unit not in TIME_UNITS:
        yield "time_unit", _not_one_of(layout.time_unit, TIME_UNITS)
    if not 0 <= layout.max_gap_s < math.inf:
        yield "max_gap_s", f"must not be negative, not {layout.max_gap_s!r}"
    if not layout.time_column and layout.rate_hz is None:
        yield "rate_hz", "required without a time_column"


def _not_one_of(value: str, known: Iterable[str]) -> str:
    return f"{value!r} is not one of {', '.join(known)}"


def axes(order: str) -> tuple[list[int], FloatArray]:
    """Parse an axes order: for body right, front and up the record's axis and its sign.

    Args:
        order: a signed permutation of xyz, such as "y-xz", or a name of `NAMED_AXES`.

    Returns:
        The three indices into the record's axes, and the three signs (3,).

    Raises:
        ValueError: not a signed permutation of xyz, or left-handed.
    """
    order = NAMED_AXES.get(order, order)
    terms = re.findall(r"([+-]?)([xyz])", order)
    names = [name for _, name in terms]
    if "".join(sign + name for sign, name in terms) != order or sorted(names) != list("xyz"):
        known = ", ".join(map(repr, NAMED_AXES))
        raise ValueError(
            f"{order!r} is not a signed permutation of xyz, such as 'y-xz', or {known}"
        )
    index = ["xyz".index(name) for name in names]
    signs = np.array([-1.0 if sign == "-" else 1.0 for sign, _ in terms])
    matrix = signs[:, None] * np.eye(3)[index]
    if np.linalg.det(matrix) < 0:
        raise ValueError(f"{order!r} is left-handed: it mirrors the axes; change one sign")
    return index, signs


def to_body(values: FloatArray, order: str) -> FloatArray:
    """Transform (T, 3) vectors from the record's axes to right-front-up; exact."""
    index, signs = axes(order)
    return values[:, index] * signs


def from_body(values: FloatArray, order: str) -> FloatArray:
    """Transform (T, 3) vectors from right-front-up to the record's axes; exact."""
    index, signs = axes(order)
    return (values * signs)[:, np.argsort(index)]


def agreed_rate(found_hz: float, layout: Layout, slack: float, source: str) -> float:
    """Determine the sample rate from those of the file and of the layout.

    Args:
        found_hz: the rate according to the file.
        layout: its ``rate_hz`` takes precedence if given.
        slack: relative uncertainty of found_hz, in addition to a clock's 1e-4.
        source: start of the error message.

    Returns:
        The rate, Hz. A rate from the file is rounded to 12 digits, so that an interval of 0.01 s
        means 100 Hz.

    Raises:
        InputError: the two rates differ.
    """
    found_hz = float(f"{found_hz:.12g}")
    if layout.rate_hz is None:
        return found_hz
    if abs(found_hz / layout.rate_hz - 1) > _RATE_TOLERANCE + slack:
        raise InputError(f"{source} gives {found_hz:.6g} Hz, but rate_hz is {layout.rate_hz:g}")
    return layout.rate_hz


def require_span(record: Record, start_s: float, needed_s: float, made_of: str = "") -> None:
    """Reject a record that does not cover a time span, or lacks samples within it.

    Args:
        record: the record.
        start_s: start of the span, from the beginning of the record, s.
        needed_s: length of the span, s.
        made_of: what that length consists of, in words after a blank.

    Raises:
        InputError: gives the length of the record and what is needed, or the missing samples.
    """
    has_s = len(record.dtheta) / record.rate_hz
    if start_s < 0:
        raise InputError(
            f"{record.source}: start_s = {format_seconds(start_s)} is before the record"
        )
    # A thousandth of a sample absorbs the rounding of the sum without hiding a missing sample.
    if start_s + needed_s > has_s + 1e-3 / record.rate_hz:
        raise InputError(
            f"{record.source}: has {format_seconds(has_s)} s, but {format_seconds(needed_s)}"
            f" s{made_of} from start_s = {format_seconds(start_s)} need"
            f" {format_seconds(start_s + needed_s)} s"
        )
    begin, end = start_s * record.rate_hz, (start_s + needed_s) * record.rate_hz
    for flaw in record.flaws:
        if flaw.begin < end - 1e-3 and flaw.end > begin + 1e-3:
            raise InputError(flaw.text)
