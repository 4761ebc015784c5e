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
    navigation_words,
    rank_pair,
)
from sinsjax.records.interleaved import find_several_sensors
from sinsjax.records.layout import FloatArray, Note, RecordLayout
from sinsjax.records.means import Means
from sinsjax.records.tables import MIN_COLUMNS, ColumnTable

_LOGGERS = {
    "ROS": ("angular_velocity.x", "linear_acceleration.x"),
    "ArduPilot": ("TimeUS", "GyrX", "AccX"),
    "Sensor Logger": ("seconds_elapsed", "Gyroscope_x"),
}
"""Loggers whose gyros are in rad/s, by what some names end with."""

_SAME_DIRECTION = 2e-3  # rad, of two triads that differ in their range or filter only
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
    triads = {sensor: _find_triads(path, table, sensor, answers) for sensor in _SENSORS}
    used = list(dict.fromkeys(n for found in triads.values() for t in found for n in t.names))
    if not all(triads.values()):
        used = [name for name in table.names if name in table.numbers]
    clocks = _find_clocks(table, answers, used if all(triads.values()) else [])
    clock_names = [name for clock in clocks for name in (clock.name, clock.fraction) if name]
    labels: dict[str, dict[str, float]] = {
        name: {} for name in table.repetitive if name not in {*used, *clock_names}
    }
    names = list(dict.fromkeys([*used, *clock_names, *labels]))
    dates = [name for name in clock_names if name in table.dates]
    columns = table.read(names, blanks=True, dates=dates, labels=labels)
    values = dict(zip(names, columns, strict=True))
    _refuse_several_sensors(path, triads, values, labels)
    samples = [values[name] for name in used]
    timing = find_timing(
        path, clocks, values, samples, table.row_number, _describe_unread_time(table)
    )
    file = _File(path, table, values, answers.get("rate_hz", timing.rate_hz), answers)
    layout, notes = timing.complete(RecordLayout(table.format)), {**timing.notes}
    chosen = _choose_triads(triads["gyro"], triads["accel"], file)
    means = None
    if chosen.gyro and chosen.accel and not any(note.question for note in chosen.notes.values()):
        accel = evidence.share_directions(chosen.gyro, chosen.accel)
        found = _find_units_and_axes(file, chosen.gyro, accel)
        layout, means = layout._replace(**found.values), found.means
        notes |= found.notes | chosen.notes
    else:
        for sensor, triad in (("gyro", chosen.gyro), ("accel", chosen.accel)):
            key = f"{sensor}_columns"
            if triad:
                given: dict[str, Any] = {key: triad.names}
                layout, notes[key] = layout._replace(**given), chosen.notes[key]
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
    elif not clocks:
        dates = [name for name in table.names if name in table.dates]
        clocks = [Clock(name, NO_UNIT) for name in dates or table.names[:1] if name in usable]
    fractions = {clock.fraction for clock in clocks}
    clocks = [clock for clock in clocks if clock.name not in fractions]
    clocks = [c._replace(unit=("iso", 1.0)) if c.name in table.dates else c for c in clocks]
    return [clock._replace(unit=unit) if unit[0] else clock for clock in clocks]


def _describe_unread_time(table: ColumnTable) -> str:
    """Return the message about the first column of times in an unknown format; "" for none."""
    named = {clock.name for clock in find_clocks(table.names)}
    for name, (row, cell) in table.non_numbers.items():
        if name not in table.dates and (name in named or re.search(r"\d:\d\d", cell)):
            return (
                f"row {row}: column {name!r}: {shorten(cell, 32)!r} is no number, and no date and"
                " time as in 2026-03-11 09:35:12.5 or 11.03.2026 09:35:12,5"
            )
    return ""


def _refuse_several_sensors(
    path: Path,
    triads: Mapping[str, Sequence[Triad]],
    values: Mapping[str, FloatArray],
    labels: Mapping[str, dict[str, float]],
) -> None:
    """Refuse a file whose rows are of several sensors."""
    if not all(triads.values()):
        return
    samples = {
        sensor: [np.column_stack([values[name] for name in triad.names]) for triad in found]
        for sensor, found in triads.items()
    }
    # Of several triads of accelerometers, some may lack gravity.
    gyro, accel = samples["gyro"][0], max(samples["accel"], key=lambda v: abs(np.nansum(v)))
    numbered = {name: (values[name], [*texts]) for name, texts in labels.items()}
    if text := find_several_sensors(numbered, gyro, accel):
        raise InputError(f"{path}: {text}")


class _Choice(NamedTuple):
    """Chosen triads, None for an unknown one, and the notes about their columns by key."""

    gyro: Triad | None
    accel: Triad | None
    notes: dict[str, Note]


def _choose_triads(gyros: Sequence[Triad], accels: Sequence[Triad], file: _File) -> _Choice:
    """Choose the gyros and the accelerometers of one sensor, with gravity in them."""
    forces = {triad: file.rows(triad.names) * triad.unit[1] for triad in accels}
    by_gravity = [t for t in accels if evidence.is_gravity(forces[t], t.unit[0], file.rate_hz)] or [
        t for t in accels if not evidence.lacks_gravity(forces[t], file.rate_hz)
    ]
    by_name = Note("by their names")
    notes = {"gyro_columns": by_name, "accel_columns": by_name}
    if not gyros or not by_gravity:
        gyro, accel = next(iter(gyros), None), next(iter(by_gravity), None)
        return _Choice(gyro, accel, notes)
    pairs = [(gyro, accel) for gyro in gyros for accel in by_gravity]
    gyro, accel = min(pairs, key=lambda pair: rank_pair(*pair))
    best = rank_pair(gyro, accel)
    instances = [
        f"or {_list(g)} with {_list(a)}?" for g, a in pairs
        if g != gyro and a != accel and rank_pair(g, a) == best
    ]  # fmt: skip
    if instances:
        doubt = f"{' '.join(instances)} Give gyro_columns and accel_columns together"
        notes["gyro_columns"] = by_name._replace(doubt=doubt)
    elif len(gyros) > 1:
        names = "; or ".join(_list(other) for other in gyros if other != gyro)
        notes["gyro_columns"] = by_name._replace(doubt=f"or {names}?")
    if words := navigation_words(gyro, accel):
        question = (
            f"{_list(accel)} are named as in a navigation frame ({', '.join(sorted(words))}), but"
            " an IMU measures along its own axes"
        )
        notes["accel_columns"] = Note("", "", question)
        return _Choice(gyro, accel, notes)
    others = [
        other for other in by_gravity
        if other != accel
        and not navigation_words(gyro, other)
        and min(rank_pair(g, other) for g in gyros) == rank_pair(gyro, other)
    ]  # fmt: skip
    rivals = [other for other in others if rank_pair(gyro, other) == best]
    turned = [t for t in rivals if _angle_between(forces[t], forces[accel]) > _SAME_DIRECTION]
    if turned:
        means = "; ".join(f"{_list(t)}: {_mean_text(forces[t])}" for t in (accel, *turned))
        question = f"their names do not tell which of these belong to the gyros. Means: {means}"
        notes["accel_columns"] = Note("", "", question)
    elif others:
        names = "; or ".join(_list(t) for t in others)
        notes["accel_columns"] = by_name._replace(doubt=f"or {names}?")
    return _Choice(gyro, accel, notes)


def _list(triad: Triad) -> str:
    return ", ".join(triad.names)


def _mean_text(values: FloatArray) -> str:
    return " ".join(f"{mean:.4g}" for mean in np.nanmean(values, axis=0))


def _angle_between(first: FloatArray, second: FloatArray) -> float:
    """Return the angle between the means of two triads (T, 3), rad."""
    a, b = (np.nanmean(values, axis=0) for values in (first, second))
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def _find_units_and_axes(file: _File, gyro: Triad, accel: Triad) -> _Found:
    """Find columns, units, scales and axes of chosen sensors."""
    answers, notes = file.answers, dict[str, Note]()
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
    is_named = notes["axes_order"].reason.startswith(evidence.NAMED_AXES_REASON)
    has_question = bool(notes["axes_order"].question)
    if "roll" in gyro.words and not is_named and not has_question:  # p is about x by definition
        turns = file.rows(gyro.names)[complete]
        order, notes["axes_order"] = evidence.find_front_of_turns(
            turns, force, file.rate_hz, gyro, order
        )
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
    if not is_named and (doubt := evidence.doubt_of_signs(gyro_unit.means)):
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
