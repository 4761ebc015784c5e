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

_RATE_TOLERANCE = 1e-4  # relative deviation of clocks from their nominal rate


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
    """An inertial record of T samples, b = right-front-up."""

    dtheta: FloatArray  # (T, 3) rotation increments over each sample, rad
    dv: FloatArray  # (T, 3) specific-force increments over each sample, m/s
    rate_hz: float
    t0_s: float = 0.0  # begin of the first sample; sample k ends at t0_s + (k + 1) / rate_hz
    latitude_deg: float | None = None  # geodetic, from the file's header; so are the next two
    height_m: float | None = None
    gravity_m_per_s2: float | None = None  # the g that scales the file's specific force
    source: str = "record"  # the file's name, for messages
    flaws: tuple[Flaw, ...] = ()  # missing samples, which are nan in dtheta and dv
    anomalies: tuple[Finding, ...] = ()  # samples that are impossible for a base at rest
    remarks: tuple[str, ...] = ()  # what was left out, filled or assumed while the file was read


class RecordLayout(NamedTuple):
    """Which column of a file is what, in which unit, on which axis, and at what time.

    The fields are keys of a study's ``[record]`` section (``sinsjax keys record``), with the sample
    rate. Increments are over each sample, rates averaged over it, stamps at its end. PSINS text
    uses only axes_order and rate_hz. ``axes_order`` names the record's axes that
    point right, front and up: "y-xz" means that right is +y of the record, front is -x and up is
    +z; or is a name of `NAMED_AXES`. "" is no column of times, None a rate from the file.
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
    gyro_units, accel_units = ({**u[INCREMENTS], **u[RATES]} for u in (GYRO_UNITS, ACCEL_UNITS))
    units = {"gyro_unit": gyro_units, "accel_unit": accel_units, "time_unit": TIME_UNITS}
    for key, known in (units | {"time_fraction_unit": TIME_UNITS}).items():
        if getattr(layout, key) not in known:
            yield key, f"{getattr(layout, key)!r} is not one of {', '.join(known)}"
    taken = list(layout.time_columns)
    for sensor, (columns, _, scale) in zip(("gyro", "accel"), layout.sensors, strict=True):
        if len(columns) != 3 or not all(columns):
            yield f"{sensor}_columns", "must name three columns"
        for name, factor in zip(columns, scale, strict=False):
            if name in taken:
                yield f"{sensor}_columns", f"column {name!r} is named twice"
            if factor > 0 and re.search(r"(^|[_.\s])(neg(ative)?|minus)([_.\s]|$)", name, re.I):
                text = f"column {name!r} has a minus in its name: give it a negative {sensor}_scale"
                yield f"{sensor}_columns", f"{text} (or name the column otherwise)"
            taken.append(name)
        if not all(math.isfinite(factor) and factor for factor in scale):
            yield f"{sensor}_scale", "must be finite and not 0"
    for name in taken if layout.columns else ():
        if name not in layout.columns:
            yield "columns", f"lacks column {name!r}"
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
        text = "is not a signed permutation of xyz, such as 'y-xz', or 'rfu', 'frd' or 'flu'"
        raise ValueError(f"{order!r} {text}")
    index = ["xyz".index(name) for name in names]
    signs = np.array([-1.0 if sign == "-" else 1.0 for sign, _ in terms])
    if np.linalg.det(signs[:, None] * np.eye(3)[index]) < 0:
        raise ValueError(f"{order!r} is left-handed: it mirrors the axes; change one sign")
    return index, signs


def to_body_axes(values: FloatArray, order: str) -> FloatArray:
    """Transform (T, 3) vectors from the record's axes to right-front-up; exact."""
    index, signs = parse_axes_order(order)
    return values[:, index] * signs


def resolve_rate(file_hz: float, layout: RecordLayout, uncertainty: float, source: str) -> float:
    """Return the sample rate of the layout, or else that of the file, Hz.

    The two may differ by an uncertainty, relative, and the 1e-4 of a clock; otherwise the error
    begins with the source.
    """
    file_hz = float(f"{file_hz:.12g}")  # so that an interval of 0.01 s means 100 Hz
    if layout.rate_hz is None:
        return file_hz
    if abs(file_hz / layout.rate_hz - 1) > _RATE_TOLERANCE + uncertainty:
        raise InputError(f"{source} gives {file_hz:.6g} Hz, but rate_hz is {layout.rate_hz:g}")
    return layout.rate_hz


def require_samples(record: Record, start_s: float, length_s: float) -> None:
    """Reject a record that does not cover a time span from its beginning, or lacks samples."""
    available_s, end_s = len(record.dtheta) / record.rate_hz, start_s + length_s
    # A thousandth of a sample absorbs the rounding of the sum without hiding a missing sample.
    if start_s < 0 or end_s > available_s + 1e-3 / record.rate_hz:
        raise InputError(
            f"{record.source}: has {format_seconds(available_s)} s, but from start_s ="
            f" {format_seconds(start_s)} the study needs {format_seconds(length_s)} s,"
            f" up to {format_seconds(end_s)} s"
        )
    begin, end = start_s * record.rate_hz, end_s * record.rate_hz
    for flaw in record.flaws:
        if flaw.begin < end - 1e-3 and flaw.end > begin + 1e-3:
            raise InputError(flaw.text)
