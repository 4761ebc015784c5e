"""A layout for a file without a description: names tell, or the user is asked.

Columns, units and axes come from names. Only gravity counts as evidence: for the unit of the
accelerometers, and for the axis that points up. Everything else is an open question, which has to
be answered before anything is aligned.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sinsjax.errors import InputError
from sinsjax.messages import shorten
from sinsjax.records.layout import (
    ACCEL_UNITS,
    GYRO_UNITS,
    INCREMENTS,
    RATES,
    FloatArray,
    Note,
    RecordLayout,
    quantity_of,
    to_body_axes,
    unit_factor,
)
from sinsjax.records.motion import EARTH_RATE
from sinsjax.records.names import Triad, find_named_order, find_triads, name_given_triad
from sinsjax.records.reader import MIN_COLUMNS, Table
from sinsjax.records.stamps import propose_clock
from sinsjax.units import DEG, DEG_PER_H, STANDARD_GRAVITY

_NEAR_GRAVITY = 0.1  # relative: accelerometers are better
_SENSORS = {"gyro": "gyros", "accel": "accelerometers"}
_STANDARDS = {
    "ROS": ("angular_velocity", "linear_acceleration"),
    "ArduPilot": ("GyrX", "AccX"),
    "Sensor Logger": ("seconds_elapsed", "Gyroscope"),
}
"""Message standards with gyros in rad/s and forces in m/s^2, by what names contain."""
_TAG = re.compile(r"gyr|acc|magn|baro|temp", re.IGNORECASE)
_LABEL = re.compile(
    r"(?=.)(sensor|imu|device|node|unit|source|topic|message|msg)?[ _.]?(id|name|type|no)?",
    re.IGNORECASE,
)
"""Names of columns that tell of which sensor a row is."""
_MAX_LABELS = 5  # more are a count of the rows
_NO_RATE = Note("", "", "increments show their unit once the sample rate is known")


class Proposal(NamedTuple):
    """The proposed layout of a file.

    Attributes:
        layout: layout of its record; open keys have values to examine the file with.
        notes: reasons, doubts and questions by key.
        is_readable: whether columns and clock are known, so that there is a record.
    """

    layout: RecordLayout
    notes: Mapping[str, Note]
    is_readable: bool


def propose_layout(path: Path, table: Table, answers: Mapping[str, Any]) -> Proposal:
    """Propose the layout of a record in a file.

    Args:
        path: CSV or Parquet file, for messages.
        table: the opened file.
        answers: keys of the layout that the user has given.

    Raises:
        InputError: the file is no table of the samples of one IMU.
    """
    if len(table.names) < MIN_COLUMNS:
        text = f"found {len(table.names)} columns; an IMU log needs at least {MIN_COLUMNS}"
        raise InputError(f"{path}: {text}")
    _refuse_tagged_rows(path, table)
    notes: dict[str, Note] = {}
    triads = {sensor: _find_triad(path, table, sensor, answers, notes) for sensor in _SENSORS}
    taken = [name for triad in triads.values() if triad for name in triad.names]
    clock = propose_clock(str(path), table, answers, taken)
    layout = RecordLayout(table.format, rate_hz=None, **clock.fields)
    if not clock.fields:
        layout = layout._replace(rate_hz=clock.rate_hz)
    notes |= clock.notes
    rate_hz = answers.get("rate_hz", math.nan if clock.is_open else clock.rate_hz)
    gyro, accel = triads["gyro"], triads["accel"]
    if gyro is None or accel is None:
        names = {f"{sensor}_columns": triad.names for sensor, triad in triads.items() if triad}
        open_ = Note("", "", "open until the columns are known")
        notes |= dict.fromkeys(("gyro_unit", "accel_unit", "axes_order"), open_)
        layout = layout._replace(**names)  # type: ignore[arg-type]
    else:
        layout = _propose_sensors(path, table, gyro, accel, answers, rate_hz, layout, notes)
    known = {key: value for key, value in answers.items() if key in RecordLayout._fields}
    notes |= dict.fromkeys(known, Note("given"))
    is_timed = not any(key in notes and notes[key].question for key in ("rate_hz", "time_unit"))
    return Proposal(layout._replace(**known), notes, is_timed and None not in (gyro, accel))


def _refuse_tagged_rows(path: Path, table: Table) -> None:
    """Refuse a file whose rows are of several sensors in turn."""
    for name, cells in table.head.items():
        labels = [*dict.fromkeys(filter(None, cells))]
        tags = [cell for cell in labels if _TAG.search(cell)]
        if len(tags) < 2 and _LABEL.fullmatch(name) and len(labels) <= _MAX_LABELS:
            tags = labels
        if len(tags) > 1:
            text = f"rows of several sensors in turn ({', '.join(tags[:3])})"
            hint = "make each a set of columns of one row, matched by the nearest stamp"
            raise InputError(f"{path}: {text}: {hint}")


def _find_triad(
    path: Path, table: Table, sensor: str, answers: Mapping[str, Any], notes: dict[str, Note]
) -> Triad | None:
    """Return the columns of a sensor; None, and a question in the notes, if names do not tell."""
    key = f"{sensor}_columns"
    if given := answers.get(key):
        return name_given_triad(given, sensor, table.units)
    triads = find_triads([n for n in table.names if n in table.numbers], sensor, table.units)
    if not triads and (by_name := find_triads(table.names, sensor)):
        name = next(name for name in by_name[0].names if name not in table.numbers)
        cell = next((c for c in table.head.get(name, ()) if c), "")
        text = f"column {name!r}: {shorten(cell, 24)!r} is not a number"
        raise InputError(f"{path}: {text} (begin other rows with #, or give [record] skip_rows)")
    if sensor == "accel" and len(triads) > 1:  # a phone writes the force with and without gravity
        heavy = [t for t in triads if _gravity_units(_magnitude(table, t), 1.0, RATES)]
        triads = heavy if len(heavy) == 1 else triads
    if len(triads) == 1 and not triads[0].in_navigation_frame:
        notes[key] = Note("by their names")
        return triads[0]
    problem = f"no column is named as of {_SENSORS[sensor]}."
    if triads:
        problem = f"which of these are the {_SENSORS[sensor]} of one box, in its own axes?"
    shown: list[tuple[str, ...]] = [triad.names for triad in triads]
    shown = shown or [(name,) for name in table.names if name in table.numbers]
    means = "; ".join(_describe_means(table, shown))
    notes[key] = Note("", "", f"{problem} Means: {shorten(means, 400)}")
    return None


def _describe_means(table: Table, groups: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield the names and means of groups of columns, which are read at once."""
    names = [*dict.fromkeys(name for group in groups for name in group)]
    values = dict(zip(names, table.read(names, blanks=True), strict=True))
    for group in groups:
        means = ("?" if np.isnan(v := values[n]).all() else f"{np.nanmean(v):.4g}" for n in group)
        yield f"{', '.join(group)} {' '.join(means)}"


def _magnitude(table: Table, triad: Triad) -> float:
    """Return the magnitude of the mean of three columns, in their unit."""
    values = np.column_stack(table.read(triad.names, blanks=True))
    values = values[np.isfinite(values).all(axis=1)]
    return float(np.linalg.norm(values.mean(axis=0))) * triad.unit[1] if len(values) else 0.0


def _gravity_units(magnitude: float, rate_hz: float, quantity: str) -> list[str]:
    """Return the units in which a magnitude is that of gravity."""
    return [
        unit for unit in ACCEL_UNITS[quantity]
        if abs(magnitude * _rate_factor(unit, rate_hz) / STANDARD_GRAVITY - 1) < _NEAR_GRAVITY
    ]  # fmt: skip


def _rate_factor(unit: str, rate_hz: float) -> float:
    """Return the factor to SI rates; nan for increments if the sample rate is unknown, nan."""
    return unit_factor(unit) * (1.0 if quantity_of(unit) == RATES else rate_hz)


def _propose_sensors(
    path: Path,
    table: Table,
    gyro: Triad,
    accel: Triad,
    answers: Mapping[str, Any],
    rate_hz: float,
    layout: RecordLayout,
    notes: dict[str, Note],
) -> RecordLayout:
    """Return the layout with columns, units, scales and axes of both sensors."""
    rows = np.column_stack(table.read([*gyro.names, *accel.names], blanks=True))
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < 2 or len(rows) < rate_hz:
        raise InputError(f"{path}: has less than a second without missing samples")
    scales = {
        f"{sensor}_scale": answers.get(
            f"{sensor}_scale", tuple(sign * triad.unit[1] for sign in triad.signs)
        )
        for sensor, triad in (("gyro", gyro), ("accel", accel))
    }
    force = rows[:, 3:].mean(axis=0) * scales["accel_scale"]
    magnitude = float(np.linalg.norm(force))
    accel_unit = answers.get("accel_unit") or accel.unit[0]
    quantity = INCREMENTS if accel.are_increments else RATES
    if accel_unit:
        ratio = magnitude * _rate_factor(accel_unit, rate_hz) / STANDARD_GRAVITY
        doubt = "far from gravity in the stated unit" if abs(ratio - 1) > _NEAR_GRAVITY else ""
        reason = f"; the mean is {ratio:.4g} times gravity" if ratio > 0 else ""
        notes["accel_unit"] = Note(f"by the names{reason}", doubt)
    elif found := _gravity_units(magnitude, rate_hz, quantity):
        accel_unit = found[0]
        notes["accel_unit"] = Note(f"the mean has the magnitude of gravity, {magnitude:.5g}")
    elif quantity == INCREMENTS and math.isnan(rate_hz):
        accel_unit, notes["accel_unit"] = "m_per_s", _NO_RATE
    else:
        accel_unit = "g" if quantity == RATES else "m_per_s"
        one = STANDARD_GRAVITY / (magnitude or 1.0)
        one /= _rate_factor(accel_unit, rate_hz)
        notes["accel_unit"] = Note("of one count, see accel_scale")
        question = (
            f"the mean of {', '.join(accel.names)} has a magnitude of {magnitude:.5g}, gravity in"
            f" no unit: are these counts? {one:.4g} {accel_unit} a count would be gravity"
        )
        notes["accel_scale"] = Note("", "", question)
    mean = float(np.linalg.norm(rows[:, :3].mean(axis=0) * scales["gyro_scale"]))
    gyro_unit = answers.get("gyro_unit") or _gyro_unit(
        table, gyro, accel_unit, mean, rate_hz, notes
    )
    layout = layout._replace(
        gyro_columns=gyro.names,
        accel_columns=accel.names,
        gyro_unit=gyro_unit,
        accel_unit=accel_unit,
        gyro_scale=scales["gyro_scale"],
        accel_scale=scales["accel_scale"],
    )
    order = _propose_axes(table, gyro, accel, force / (magnitude or 1.0), notes)
    return layout._replace(axes_order=order)


def _gyro_unit(
    table: Table,
    gyro: Triad,
    accel_unit: str,
    mean: float,
    rate_hz: float,
    notes: dict[str, Note],
) -> str:
    """Return the unit of the gyros by their names, or one to examine them with, and a question."""
    unit = gyro.unit[0]
    if unit in ("rad", "deg") and not gyro.are_increments and quantity_of(accel_unit) == RATES:
        unit = f"{unit}_per_s"  # as PX4 writes gyro_rad
    if unit:
        of_earth = mean * _rate_factor(unit, rate_hz) / EARTH_RATE
        reason = f"; the mean rate is {of_earth:.3g} times Earth rate" if of_earth >= 0 else ""
        notes["gyro_unit"] = Note(f"by the names{reason}")
        return unit
    if gyro.are_increments and math.isnan(rate_hz):
        notes["gyro_unit"] = _NO_RATE
        return "rad"
    rates = _rates(mean, INCREMENTS if gyro.are_increments else RATES, rate_hz)
    question = f"no name states it. {rates}"
    for standard, parts in _STANDARDS.items():
        if all(any(part in name for name in table.names) for part in parts):
            if accel_unit == "m_per_s2":
                notes["gyro_unit"] = Note(f"as {standard} writes them")
                return "rad_per_s"
            text = f"{standard} writes rad/s and m/s^2, but force in {accel_unit} contradicts it"
            question = f"{text}. {rates}"
    if notes.get("accel_scale", Note("")).question:
        scale = f"the mean rate is {mean:.4g} counts: see the data sheet, and give gyro_unit"
        notes["gyro_scale"] = Note("", "", scale)
    notes["gyro_unit"] = Note("", "", question)
    return "rad" if gyro.are_increments else "rad_per_s"


def _rates(mean: float, quantity: str, rate_hz: float) -> str:
    """Return the mean rate in each candidate unit, over Earth rate too, and the line to write."""
    lines = []
    for unit in GYRO_UNITS[quantity]:
        rate = mean * _rate_factor(unit, rate_hz)
        text = f"mean rate {rate / DEG_PER_H:.3g} deg/h, {rate / EARTH_RATE:.3g} times Earth rate"
        lines.append(f'gyro_unit = "{unit}": {text}')
    return "; ".join(lines)


def _propose_axes(
    table: Table, gyro: Triad, accel: Triad, up: FloatArray, notes: dict[str, Note]
) -> str:
    """Return the order of axes by names, or by gravity if x, y and z are those of usual boxes."""
    axis = int(np.argmax(np.abs(up)))
    pointing = f"{'xyz'[axis]} reads {up[axis]:+.2f} g"
    named = find_named_order([*table.comments, *table.names])
    if gyro.has_directions or accel.has_directions:
        named, pointing = "rfu", f"up reads {up[2]:+.2f} g"
        if not (gyro.has_directions and accel.has_directions):
            question = "only one sensor names right, front and up: which axes has the other one?"
            notes["axes_order"] = Note("", "", question)
            return named
    if named:
        question = ""
        if float(to_body_axes(up[None], named)[0, 2]) < math.cos(60 * DEG):
            question = f"the names state {named!r}, but {pointing}: a sign or an axis is wrong"
        notes["axes_order"] = Note(f"from names or comments; {pointing}", "", question)
        return named
    order = "flu" if up[2] > 0 else "frd"
    if axis == 2 and abs(up[2]) > math.cos(30 * DEG):
        reason = f"{pointing}; x is taken for the front, so the heading is that of x"
        notes["axes_order"] = Note(reason)
        return order
    candidates = _orders_with_up(axis, is_positive=bool(up[axis] > 0))
    lines = " or ".join(f'axes_order = "{one}"' for one in candidates)
    question = f"{pointing}, and no name states which axis points front: {lines}"
    if abs(up[axis]) < math.cos(30 * DEG):
        question = f"no axis is near the vertical ({pointing}), and no name states the axes"
    notes["axes_order"] = Note("", "", question)
    return candidates[0]


def _orders_with_up(axis: int, *, is_positive: bool) -> list[str]:
    """Return the four right-handed orders of axes with an axis, or its opposite, up."""
    a, b, up = "xyz"[(axis + 1) % 3], "xyz"[(axis + 2) % 3], "xyz"[axis]
    pairs = [(a, b), (b, f"-{a}"), (f"-{a}", f"-{b}"), (f"-{b}", a)]  # right and front
    if is_positive:
        return [f"{right}{front}{up}" for right, front in pairs]
    return [f"{right}{front}-{up}" for front, right in pairs]
