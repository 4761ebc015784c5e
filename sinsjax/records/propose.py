"""A layout for a file without a description: which column is what, see `clock` and `evidence`.

Nothing is assumed silently: a key has its reason, and its doubt, or it is an open question, which
the study must answer before anything is aligned.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sinsjax.errors import InputError
from sinsjax.messages import shorten
from sinsjax.records import evidence
from sinsjax.records.clock import find_timing
from sinsjax.records.column_names import (
    NO_UNIT,
    Clock,
    Triad,
    find_clocks,
    find_incomplete_triad,
    find_triads,
)
from sinsjax.records.layout import FloatArray, Note, RecordLayout
from sinsjax.records.means import Means
from sinsjax.records.tables import MIN_COLUMNS, ColumnTable

_LOGGERS = {
    "ROS": ("angular_velocity.x", "linear_acceleration.x"),
    "ArduPilot": ("TimeUS", "GyrX", "AccX"),
    "Sensor Logger": ("seconds_elapsed", "Gyroscope_x"),
}
"""Loggers whose gyros are in rad/s, by what some names end with."""

_INSTANCE = re.compile(r"i|instance|(imu|sensor|device)_?(id|no|number)?", re.IGNORECASE)
_SENSORS = {"gyro": "gyros", "accel": "accelerometers"}
_EXAMINED_LATER = Note(
    "", "", "open until the columns are known (`sinsjax init record --from LOG --set"
    " record.KEY=VALUE` examines the rest)",
)  # fmt: skip


class Proposal(NamedTuple):
    """The proposed layout of a file.

    Attributes:
        layout: layout of its record; open keys have values to examine the file with.
        notes: reasons, doubts and questions by key.
        means: mean measurements of its first minutes, in its own axes; None if the columns of the
            sensors are open, so that there is no record.
    """

    layout: RecordLayout
    notes: Mapping[str, Note]
    means: Means | None


def propose_layout(path: Path, table: ColumnTable, answers: Mapping[str, Any]) -> Proposal:
    """Propose the layout of a record in a file.

    Args:
        path: CSV or Parquet file, for messages.
        table: the opened file.
        answers: keys of the layout that the user has given.

    Raises:
        InputError: the file is no table of sensor values, or its time runs backward.
    """
    if len(table.names) < MIN_COLUMNS:
        raise InputError(
            f"{path}: {table.description}: {len(table.names)} columns, but an IMU has six (give"
            " [record] skip_rows if other lines come first)"
        )
    instances = [
        name for name in table.names if _INSTANCE.fullmatch(name) and name in table.numbers
    ]
    triads = {sensor: _find_triads(path, table, sensor, answers) for sensor in _SENSORS}
    used = list(dict.fromkeys(n for found in triads.values() for t in found for n in t.names))
    if not all(triads.values()):
        used = [name for name in table.names if name in table.numbers]
    clocks = _find_clocks(table, answers, used if all(triads.values()) else [])
    clock_names = [name for clock in clocks for name in (clock.name, clock.fraction) if name]
    names = list(dict.fromkeys([*used, *clock_names, *instances]))
    dates = [name for name in clock_names if name in table.dates]
    values = dict(zip(names, table.read(names, blanks=True, dates=dates), strict=True))
    for name in instances:
        if len(numbers := np.unique(values[name][np.isfinite(values[name])])) > 1:
            shown = shorten(", ".join(f"{number:g}" for number in numbers), 24)
            text = f"column {name!r} is {shown}: rows of several sensors (keep those of one)"
            raise InputError(f"{path}: {text}")
    timing = find_timing(path, clocks, values, [values[n] for n in used], table.row_number)
    file = _File(path, table, values, answers.get("rate_hz", timing.rate_hz), answers)
    layout, notes = timing.complete(RecordLayout(table.format)), {**timing.notes}
    gyro = triads["gyro"][0] if triads["gyro"] else None
    accel = _choose_accel(triads["accel"], file)
    means = None
    if gyro and accel:
        found = _find_units_and_axes(file, gyro, evidence.share_directions(gyro, accel))
        layout, means = layout._replace(**found.values), found.means
        notes |= found.notes | {"gyro_columns": _columns_note(triads["gyro"][1:])}
    else:
        for sensor, chosen in (("gyro", gyro), ("accel", accel)):
            key = f"{sensor}_columns"
            if chosen:
                given: dict[str, Any] = {key: chosen.names}
                layout, notes[key] = layout._replace(**given), Note("by their names")
            else:
                notes[key] = Note("", "", _ask_for_columns(table, sensor, triads[sensor], values))
        notes |= dict.fromkeys(("gyro_unit", "accel_unit", "axes_order"), _EXAMINED_LATER)
    known = {key: value for key, value in answers.items() if key in RecordLayout._fields}
    notes |= dict.fromkeys(known, Note("given"))
    return Proposal(layout._replace(**known), notes, means)


class _File(NamedTuple):
    """A file that is examined.

    Attributes:
        path: the file, for messages.
        table: its columns, which are read.
        values: (T,) values of the columns that may be used, by name.
        rate_hz: sample rate, Hz.
        answers: keys of the layout that the user has given.
    """

    path: Path
    table: ColumnTable
    values: Mapping[str, FloatArray]
    rate_hz: float
    answers: Mapping[str, Any]

    def rows(self, names: Sequence[str]) -> FloatArray:
        """Return the values of some columns, (T, columns)."""
        return np.column_stack([self.values[name] for name in names])


class _Found(NamedTuple):
    """Values and notes by key of the layout, and the means in the record's axes."""

    values: dict[str, Any]
    notes: dict[str, Note]
    means: Means


def _find_triads(
    path: Path, table: ColumnTable, sensor: str, answers: Mapping[str, Any]
) -> list[Triad]:
    """Return the columns that may be those of the gyros or accelerometers, by their names."""
    unit = (answers.get(f"{sensor}_unit", ""), 1.0)
    names = answers.get(f"{sensor}_columns")
    if names is not None:
        known = find_triads(names, sensor, table.units)
        triads = [Triad(names, known[0].unit if known else NO_UNIT, (1.0, 1.0, 1.0))]
    else:
        triads = find_triads([n for n in table.names if n in table.numbers], sensor, table.units)
        if not triads and (by_name := find_triads(table.names, sensor)):
            _refuse_text(path, table, by_name[0])
    return [triad._replace(unit=unit) if unit[0] else triad for triad in triads]


def _refuse_text(path: Path, table: ColumnTable, triad: Triad) -> None:
    """Refuse a sensor's column of text."""
    name = next(name for name in triad.names if name not in table.numbers)
    if name in table.types:
        raise InputError(f"{path}: column {name!r} contains {table.types[name]}, not numbers")
    row, cell = table.non_numbers[name]
    hint = "decimal commas are not read: write points"
    if not re.fullmatch(r"[+-]?\d*,\d+", cell):
        hint = "begin other rows with #, or give [record] skip_rows"
    text = f"row {row}: column {name!r}: {shorten(cell, 24)!r} is not a number"
    raise InputError(f"{path}: {text} ({hint})")


def _find_clocks(
    table: ColumnTable, answers: Mapping[str, Any], sensor_names: Collection[str]
) -> list[Clock]:
    """Return the columns that may be times: by their names, or else the first one."""
    usable = {*table.numbers, *table.dates} - {*sensor_names}
    unit = (answers.get("time_unit", ""), answers.get("time_scale", 1.0))
    given = answers.get("time_column")
    clocks = [clock for clock in find_clocks(table.names, table.units) if clock.name in usable]
    if given is not None:
        named = [clock for clock in clocks if clock.name == given]
        clocks = named or [Clock(given, NO_UNIT)]
        if fraction := answers.get("time_fraction_column"):
            fraction_unit = answers.get("time_fraction_unit", "ns")
            clocks = [clocks[0]._replace(fraction=fraction, fraction_unit=fraction_unit)]
    elif not clocks and table.names[0] in usable:
        clocks = [Clock(table.names[0], NO_UNIT)]
    fractions = {clock.fraction for clock in clocks}
    clocks = [clock for clock in clocks if clock.name not in fractions]
    clocks = [c._replace(unit=("iso", 1.0)) if c.name in table.dates else c for c in clocks]
    return [clock._replace(unit=unit) if unit[0] else clock for clock in clocks]


def _choose_accel(triads: Sequence[Triad], file: _File) -> Triad | None:
    """Return the accelerometers with gravity in them; None if it has been removed from all."""
    scaled = [(triad, file.rows(triad.names) * triad.unit[1]) for triad in triads]
    with_gravity = [t for t, v in scaled if evidence.is_gravity(v, t.unit[0], file.rate_hz)]
    others = [t for t, v in scaled if not evidence.lacks_gravity(v, file.rate_hz)]
    return next(iter([*with_gravity, *others]), None)


def _find_units_and_axes(file: _File, gyro: Triad, accel: Triad) -> _Found:
    """Find columns, units, scales and axes of chosen sensors."""
    answers, notes = file.answers, {"accel_columns": Note("by their names")}
    gyro_scale, accel_scale = (
        answers.get(f"{sensor}_scale", tuple(sign * triad.unit[1] for sign in triad.signs))
        for sensor, triad in (("gyro", gyro), ("accel", accel))
    )
    complete = np.isfinite(file.rows((*gyro.names, *accel.names))).all(axis=1)
    if complete.sum() < max(2, file.rate_hz):
        raise InputError(f"{file.path}: has less than a second without missing samples")
    force = file.rows(accel.names)[complete] * accel_scale
    texts = [*file.table.comments, *file.table.names]
    order, notes["axes_order"] = evidence.find_axes_order(force.mean(axis=0), texts, gyro, accel)
    gyro = evidence.with_turns_in_order(gyro, answers.get("axes_order", order))
    rates = file.rows(gyro.names)[complete] * gyro_scale
    samples = evidence.Samples(rates, force, file.rate_hz)
    accel_unit = evidence.find_accel_unit(samples, gyro, accel)
    notes["accel_unit"] = accel_unit.note
    if accel_unit.question:
        notes["accel_scale"] = Note("", "", accel_unit.question)
        accel_scale = tuple(np.multiply(accel_scale, accel_unit.scale).tolist())
        samples = samples._replace(accel=force * accel_unit.scale)
    logger = _find_logger(file.table.names) if not gyro.unit[0] else ""
    if logger:
        gyro = gyro._replace(unit=("rad_per_s", 1.0))
    gyro_unit = evidence.find_gyro_unit(samples, gyro, accel, accel_unit.unit)
    notes["gyro_unit"] = gyro_unit.note
    if logger:
        reason = f"as {logger} writes them; {gyro_unit.note.reason}"
        notes["gyro_unit"] = gyro_unit.note._replace(reason=reason)
    if "gyro_scale" not in answers:
        if accel_unit.question and not gyro.unit[0]:  # they are counts, too
            notes["gyro_unit"] = Note("of one count, see gyro_scale")
            question = evidence.ask_for_gyro_scale(samples, gyro_unit.unit)
        else:
            question = evidence.ask_about_signs(samples)
        if question:
            notes["gyro_scale"] = Note("", "", question)
    is_sign_known = notes["axes_order"].reason.startswith(evidence.NAMED_AXES_REASON)
    if not is_sign_known and (doubt := evidence.doubt_of_signs(gyro_unit.means)):
        note = notes["axes_order"]
        notes["axes_order"] = note._replace(doubt="; ".join(filter(None, (note.doubt, doubt))))
    found = {
        "gyro_columns": gyro.names,
        "accel_columns": accel.names,
        "gyro_unit": gyro_unit.unit,
        "accel_unit": accel_unit.unit,
        "gyro_scale": gyro_scale,
        "accel_scale": accel_scale,
        "axes_order": order,
    }
    return _Found(found, notes, gyro_unit.means)


def _find_logger(names: Sequence[str]) -> str:
    """Return the logger that writes such names, "" for none."""
    for logger, endings in _LOGGERS.items():
        if all(any(name.endswith(ending) for name in names) for ending in endings):
            return logger
    return ""


def _columns_note(others: Sequence[Triad]) -> Note:
    names = "; or ".join(", ".join(triad.names) for triad in others)
    return Note("by their names", f"or {names}?" if others else "")


def _ask_for_columns(
    table: ColumnTable, sensor: str, triads: Sequence[Triad], values: Mapping[str, FloatArray]
) -> str:
    """Return the question about the columns of a sensor, with what its candidates contain."""
    if triads:
        names = ", ".join(triads[0].names)
        magnitude = float(np.linalg.norm([np.nanmean(values[name]) for name in triads[0].names]))
        return (
            f"the mean of {names} has a magnitude of {magnitude:.3g}: has gravity been removed? The"
            " specific force has it, as accelerometers measure it"
        )
    problem = f"no names of {_SENSORS[sensor]} among the columns"
    if pair := find_incomplete_triad(table.names, sensor):
        present = " and ".join(map(repr, pair[0]))
        problem = f"there are {present}, but no column of the {_SENSORS[sensor]} named {pair[1]}"
    means = ", ".join(f"{n} {np.nanmean(values[n]):.4g}" for n in table.names if n in values)
    return f"{problem}. Their means: {shorten(means, 400)}"
