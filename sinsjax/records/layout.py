"""Inertial records, file layouts, and the conversion of units and axes between the two."""

import math
import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.messages import format_seconds
from sinsjax.units import ARCSEC, DEG, DEG_PER_H, STANDARD_GRAVITY, micro_g

FloatArray = NDArray[np.float64]

INCREMENTS, RATES = "increments", "rates"

GYRO_UNITS = {
    INCREMENTS: {"rad": 1.0, "deg": DEG, "arcsec": ARCSEC},
    RATES: {"rad_per_s": 1.0, "deg_per_s": DEG, "deg_per_h": DEG_PER_H},
}
"""Factors to rad or rad/s, by quantity and unit name."""

ACCEL_UNITS = {
    INCREMENTS: {"m_per_s": 1.0, "g_s": STANDARD_GRAVITY, "ug_s": micro_g()},
    RATES: {"m_per_s2": 1.0, "g": STANDARD_GRAVITY, "mg": 1e3 * micro_g(), "ug": micro_g()},
}
"""Factors to m/s or m/s^2, by quantity and unit name; g is the standard gravity."""

_TABLES = (*GYRO_UNITS.values(), *ACCEL_UNITS.values())

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "iso": 1.0}
"""Factors to s, by unit name; dates with time are read as seconds since 1970."""

NAMED_AXES = {"rfu": "xyz", "frd": "yx-z", "flu": "-yxz"}
"""Orders of axes by the directions of x, y and z: right, front, left, up or down."""

# Clocks deviate this far from their nominal rate; a larger difference is a wrong rate.
_RATE_TOLERANCE = 1e-4


class Flaw(NamedTuple):
    """Missing samples of a record, from ``begin`` to before ``end``, and the message."""

    begin: int
    end: int
    text: str


class Finding(NamedTuple):
    """What is implausible, or certainly wrong, for a base at rest."""

    is_certain: bool
    text: str  # the message, without the file
    hides_north: bool = False  # pitch and roll can be found, but no heading
    begin: int = 0  # its samples, from begin to before end; 0 for those of a whole span
    end: int = 0


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
        gravity_m_per_s2: the g that scales the file's specific force, or None.
        source: the file's name, for messages.
        flaws: missing samples, which are nan in dtheta and dv.
        filled: number of missing samples that were interpolated.
        layout: of arrays, for messages; None for a file, whose layout is in the study.
        anomalies: samples that are impossible for a base at rest.
        remarks: what was left out or assumed while the file was read, one line each.
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
    layout: "RecordLayout | None" = None
    anomalies: tuple[Finding, ...] = ()
    remarks: tuple[str, ...] = ()


class RecordLayout(NamedTuple):
    """Which column of a file is what, in which unit, on which axis, and at what time.

    The fields are keys of a study's ``[record]`` section (``sinsjax keys record``), with the sample
    rate. Increments are over each sample, rates averaged over it, stamps at its end. ``format`` may
    be "arrays" for arrays in memory; PSINS text uses only axes_order, mounting_deg and rate_hz.
    Columns of sensors are in the record's own x, y, z; scales multiply them, in their unit.
    ``axes_order`` names the record's axes that point right, front and up: "y-xz" means that right
    is +y of the record, front is -x and up is +z; or is a name of `NAMED_AXES`. ``mounting_deg`` is
    the attitude of these axes in the vehicle. "" is no column of times, None a rate from the file.
    """

    format: str
    columns: tuple[str, ...] = ()
    skip_rows: int = 0
    time_column: str = ""
    time_unit: str = "s"
    time_scale: float = 1.0
    time_fraction_column: str = ""
    time_fraction_unit: str = "ns"
    gyro_columns: tuple[str, ...] = ()
    accel_columns: tuple[str, ...] = ()
    gyro_unit: str = "rad"
    accel_unit: str = "m_per_s"
    gyro_scale: tuple[float, ...] = (1.0, 1.0, 1.0)
    accel_scale: tuple[float, ...] = (1.0, 1.0, 1.0)
    axes_order: str = "xyz"
    mounting_deg: tuple[float, ...] = (0.0, 0.0, 0.0)
    rate_hz: float | None = None
    max_gap_s: float = 0.0

    @property
    def time_columns(self) -> tuple[str, ...]:
        """The columns of time: none, one, or seconds and their fraction."""
        return tuple(filter(None, (self.time_column, self.time_fraction_column)))

    @property
    def sensors(self) -> "tuple[Sensor, Sensor]":
        """The gyros and the accelerometers."""
        return (
            Sensor(self.gyro_columns, self.gyro_unit, self.gyro_scale),
            Sensor(self.accel_columns, self.accel_unit, self.accel_scale),
        )


class Sensor(NamedTuple):
    """Three columns of a file in the record's x, y, z, their unit, and their multipliers."""

    columns: tuple[str, ...]
    unit: str
    scale: tuple[float, ...]


def find_spans(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the spans in which flags (T,) are set: first index, and the one after the last."""
    edges = np.flatnonzero(np.diff(flags, prepend=False, append=False)).reshape(-1, 2)
    return [(begin, end) for begin, end in edges.tolist()]


PSINS_LAYOUT = RecordLayout("psins")
"""PSINS text with right-front-up axes, at the header's rate."""


def check_layout(layout: RecordLayout, source: str) -> None:
    """Reject an invalid layout; the message begins with the source and names the key."""
    for key, text in find_faults(layout):
        raise InputError(f"{source}: {key}: {text}")


def find_faults(layout: RecordLayout) -> Iterator[tuple[str, str]]:
    """Yield faults of a layout, key and message; those after the first may be consequences."""
    if layout.rate_hz is not None and not 0 < layout.rate_hz < math.inf:
        yield "rate_hz", f"must be positive, not {layout.rate_hz!r}"
    try:
        parse_axes_order(layout.axes_order)
    except ValueError as error:
        yield "axes_order", str(error)
    if layout.format == "psins":
        return
    for key, units in (
        ("gyro_unit", GYRO_UNITS[INCREMENTS] | GYRO_UNITS[RATES]),
        ("accel_unit", ACCEL_UNITS[INCREMENTS] | ACCEL_UNITS[RATES]),
        ("time_unit", TIME_UNITS),
        ("time_fraction_unit", TIME_UNITS),
    ):
        if getattr(layout, key) not in units:
            yield key, f"{getattr(layout, key)!r} is not one of {', '.join(units)}"
    key_by_column: dict[str, str] = {}
    for key in ("time_column", "time_fraction_column", "gyro_columns", "accel_columns"):
        names = getattr(layout, key)
        if isinstance(names, str):
            names = (names,) if names else ()
        elif len(names) != 3 or not all(names):
            yield key, f"must name three columns, not {len([*filter(None, names)])}"
        for name in names:
            if name in key_by_column:
                yield key, f"column {name!r} is already used in {key_by_column[name]}"
            if layout.columns and name not in layout.columns:
                yield key, f"column {name!r} is not in columns"
            key_by_column[name] = key
    for key in ("gyro_scale", "accel_scale", "time_scale"):
        if not all(math.isfinite(f) and f for f in np.atleast_1d(getattr(layout, key)).tolist()):
            yield key, "must be finite and not 0"
    for key, (columns, _, scale) in zip(("gyro", "accel"), layout.sensors, strict=True):
        for name, factor in zip(columns, scale, strict=True):
            if factor > 0 and re.search(r"(^|[_.\s])(neg(ative)?|minus)([_.\s]|$)", name, re.I):
                text = f"column {name!r} has a minus in its name: give it a negative {key}_scale"
                yield f"{key}_columns", f"{text} (or name the column otherwise)"
    if not layout.time_column and layout.rate_hz is None:
        yield "rate_hz", "required without a time_column"


def is_rate(unit: str) -> bool:
    """Return whether a unit of gyros or accelerometers is of rates, not of increments."""
    return unit in GYRO_UNITS[RATES] or unit in ACCEL_UNITS[RATES]


def unit_factor(unit: str) -> float:
    """Return the factor of a unit of gyros or accelerometers to SI."""
    return next(units[unit] for units in _TABLES if unit in units)


def rate_factor(unit: str, rate_hz: float) -> float:
    """Return the factor to SI rates from a unit of rates, or of increments over each sample."""
    return unit_factor(unit) * (1.0 if is_rate(unit) else rate_hz)


def parse_axes_order(order: str) -> tuple[list[int], FloatArray]:
    """Return the record's axes for body right, front and up: three indices and signs (3,).

    Raises:
        ValueError: not a signed permutation of xyz, such as "y-xz", or left-handed.
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
    if np.linalg.det(signs[:, None] * np.eye(3)[index]) < 0:
        raise ValueError(f"{order!r} is left-handed: it mirrors the axes; change one sign")
    return index, signs


def to_vehicle_axes(values: FloatArray, layout: RecordLayout) -> FloatArray:
    """Transform (T, 3) vectors from a record's axes to those of the vehicle, right-front-up."""
    values, (pitch, roll, yaw) = to_body_axes(values, layout.axes_order), layout.mounting_deg
    if not any(layout.mounting_deg):
        return values
    from scipy.spatial.transform import Rotation  # half the import time of sinsjax

    mounting = Rotation.from_euler("ZXY", [yaw, pitch, roll], degrees=True)
    return np.asarray(mounting.apply(values))


def to_body_axes(values: FloatArray, order: str) -> FloatArray:
    """Transform (T, 3) vectors from the record's axes to right-front-up; exact."""
    index, signs = parse_axes_order(order)
    return values[:, index] * signs


def from_body_axes(values: FloatArray, order: str) -> FloatArray:
    """Transform (T, 3) vectors from right-front-up to the record's axes; exact."""
    index, signs = parse_axes_order(order)
    return (values * signs)[:, np.argsort(index)]


def resolve_rate(file_hz: float, layout: RecordLayout, uncertainty: float, source: str) -> float:
    """Return the sample rate of the layout, or else that of the file, Hz.

    A rate from the file is rounded to 12 digits, so that an interval of 0.01 s means 100 Hz. It may
    differ from the layout's by ``uncertainty``, relative, and the 1e-4 of a clock; otherwise the
    error begins with the source.
    """
    file_hz = float(f"{file_hz:.12g}")
    if layout.rate_hz is None:
        return file_hz
    if abs(file_hz / layout.rate_hz - 1) > _RATE_TOLERANCE + uncertainty:
        raise InputError(f"{source} gives {file_hz:.6g} Hz, but rate_hz is {layout.rate_hz:g}")
    return layout.rate_hz


def require_span(record: Record, start_s: float, needed_s: float, breakdown: str = "") -> None:
    """Reject a record that does not cover a time span from its beginning, or lacks samples in it.

    ``breakdown`` is the composition of the needed length as text, after a blank.
    """
    available_s, end_s = len(record.dtheta) / record.rate_hz, start_s + needed_s
    # A thousandth of a sample absorbs the rounding of the sum without hiding a missing sample.
    if start_s < 0 or end_s > available_s + 1e-3 / record.rate_hz:
        raise InputError(
            f"{record.source}: has {format_seconds(available_s)} s, but from start_s ="
            f" {format_seconds(start_s)} the study needs {format_seconds(needed_s)} s{breakdown},"
            f" up to {format_seconds(end_s)} s"
        )
    begin, end = start_s * record.rate_hz, end_s * record.rate_hz
    for flaw in record.flaws:
        if flaw.begin < end - 1e-3 and flaw.end > begin + 1e-3:
            raise InputError(flaw.text)
