"""A layout for a file without a description: names tell, or the user is asked.

Columns, units and axes come from names. Only gravity counts as evidence: for the unit of the
accelerometers, and for the axis that points up. Everything else is an open question, which has to
be answered before anything is aligned.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from sinsjax.errors import InputError
from sinsjax.messages import shorten
from sinsjax.records.checks import gravity_units
from sinsjax.records.layout import (
    GYRO_UNITS,
    INCREMENTS,
    RATES,
    TIME_UNITS,
    FloatArray,
    RecordLayout,
    is_rate,
    rate_factor,
    to_body_axes,
)
from sinsjax.records.motion import EARTH_RATE
from sinsjax.records.names import Triad, find_named_orders, find_triads
from sinsjax.records.reader import MIN_COLUMNS, Table
from sinsjax.records.stamps import combine_times, find_sampling
from sinsjax.units import DEG, DEG_PER_H, STANDARD_GRAVITY

_SENSORS = {"gyro": "gyros", "accel": "accelerometers"}
_ROS = ("angular_velocity", "linear_acceleration")  # in rad/s and m/s^2
_TAG = re.compile(r"gyr|acc|magn|baro|temp", re.IGNORECASE)
_LABEL = re.compile(
    r"(?=.)(sensor|imu|device|node|unit|source|topic|message|msg)?[ _.]?(id|name|type|no)?",
    re.IGNORECASE,
)
"""Names of columns that tell of which sensor a row is."""
_HEAD_ROWS, _MAX_LABELS = 20, 5  # more are a count of the rows
_NO_RATE = "increments show their unit once the sample rate is known"
_TIME_NAME = re.compile(
    r"time|stamp|epoch|clock|(^|[._\s])(t|tow|sow|utc|[mun]?secs?|(milli|micro|nano)?sec(onds?)?)"
    r"($|[\s_\[(])",
    re.IGNORECASE,
)
_TIME_UNIT = re.compile(r"(?:^|[\s_.\[(])([nmu]|nano|micro|milli)?s(?:ec(?:ond)?s?)?[\])\s]*$")
_POSSIBLE_HZ = 0.5, 5000.0  # rates of IMUs
_MIN_NEW = 0.8  # share of stamps that differ from the one before, among repeated rows


@dataclass
class Proposal:
    """The layout of the record in a log, and what is not known of it, by key."""

    layout: RecordLayout  # open keys have values to examine the log with
    rate_hz: float = math.nan  # nan if it is an open question
    reasons: dict[str, str] = field(default_factory=dict)
    questions: dict[str, str] = field(default_factory=dict)  # evidence for open keys


def propose_layout(table: Table, answers: Mapping[str, Any]) -> Proposal:
    """Propose the layout of the record in an opened file.

    Args:
        table: the opened file.
        answers: keys of the layout that the user has given.

    Raises:
        InputError: the file is no table of the samples of one IMU.
    """
    if len(table.names) < MIN_COLUMNS:
        text = f"found {len(table.names)} columns; an IMU log needs at least {MIN_COLUMNS}"
        raise InputError(f"{table.source}: {text}")
    _refuse_tagged_rows(table)
    proposal = Proposal(RecordLayout(table.format))
    triads = {sensor: _find_triad(table, sensor, answers, proposal) for sensor in _SENSORS}
    names = {f"{sensor}_columns": triad.names for sensor, triad in triads.items() if triad}
    clock = _propose_clock(table, answers, {*chain(*names.values())})
    fields: dict[str, Any] = {**names, **clock.fields}
    proposal.layout = proposal.layout._replace(**fields)
    proposal.questions |= clock.questions
    proposal.rate_hz = answers.get("rate_hz", math.nan if clock.questions else clock.rate_hz)
    if len(names) == 2:
        _propose_sensors(table, [*filter(None, triads.values())], answers, proposal)
    else:
        open_keys = ("gyro_unit", "accel_unit", "axes_order")
        proposal.questions |= dict.fromkeys(open_keys, "open until the columns are known")
    known = {key: value for key, value in answers.items() if key in RecordLayout._fields}
    proposal.layout = proposal.layout._replace(**known)
    for key in known:
        proposal.questions.pop(key, None)
        proposal.reasons.pop(key, None)
    return proposal


def _refuse_tagged_rows(table: Table) -> None:
    """Refuse a file whose rows are of several sensors in turn."""
    for name, column in zip(table.names, table.data.columns, strict=True):
        labels = [*dict.fromkeys(map(str, column[:_HEAD_ROWS].drop_null().to_pylist()))]
        tags = [cell for cell in labels if _TAG.search(cell)]
        if len(tags) < 2 and _LABEL.fullmatch(name) and len(labels) <= _MAX_LABELS:
            tags = labels
        if len(tags) > 1:
            text = f"rows of several sensors in turn ({', '.join(tags[:3])})"
            hint = "make each a set of columns of one row, matched by the nearest stamp"
            raise InputError(f"{table.source}: {text}: {hint}")


# Sensors


def _read_means(table: Table, names: Sequence[str]) -> dict[str, float]:
    """Return the means of columns; nan without a number."""
    finite = (values[np.isfinite(values)] for values in table.read(names))
    means = (float(values.mean()) if len(values) else math.nan for values in finite)
    return dict(zip(names, means, strict=True))


def _find_triad(
    table: Table, sensor: str, answers: Mapping[str, Any], proposal: Proposal
) -> Triad | None:
    """Return the columns of a sensor; None, and a question, if names do not tell."""
    key = f"{sensor}_columns"
    triads = find_triads(answers.get(key, table.names), sensor, table.units)
    if key in answers:  # the user orders them, and their names state the unit
        found = triads[0] if len(triads) == 1 else Triad(())
        return found._replace(names=tuple(answers[key]))
    if len(triads) == 1:
        return triads[0]
    problem = f"no three columns are named as x, y and z of {_SENSORS[sensor]}."
    if triads:
        problem = f"which of these are the {_SENSORS[sensor]}, with gravity?"
    numbers = [name for name, kind in table.kinds.items() if kind == "numbers"]
    means = _read_means(table, [*chain(*(triad.names for triad in triads))] or numbers)
    shown = "; ".join(f"{name} {mean:.4g}" for name, mean in means.items())
    proposal.questions[key] = f"{problem} Means: {shorten(shown, 400)}"
    return None


def _propose_sensors(
    table: Table, triads: Sequence[Triad], answers: Mapping[str, Any], proposal: Proposal
) -> None:
    """Propose units, scales and axes of both sensors, with reasons or questions."""
    gyro, accel = triads
    means = _read_means(table, [*gyro.names, *accel.names])
    rate, force = (
        np.array([means[name] for name in triad.names]) * answers.get(f"{sensor}_scale", 1.0)
        for sensor, triad in zip(_SENSORS, triads, strict=True)
    )
    size = float(np.linalg.norm(force))
    accel_unit = answers.get("accel_unit") or _accel_unit(accel, size, proposal)
    of_rate = float(np.linalg.norm(rate))
    gyro_unit = answers.get("gyro_unit") or _gyro_unit(table, gyro, accel_unit, of_rate, proposal)
    texts = [*table.comments, *table.names, " ".join(gyro.names), " ".join(accel.names)]
    axes = _axes_order(find_named_orders(texts), force / (size or 1.0), proposal)
    proposal.layout = proposal.layout._replace(
        gyro_unit=gyro_unit, accel_unit=accel_unit, axes_order=axes
    )


def _accel_unit(accel: Triad, size: float, proposal: Proposal) -> str:
    """Return the unit of the accelerometers by their names or by gravity, or a question."""
    unit, are_rates, rate_hz = accel.unit, not accel.are_increments, proposal.rate_hz
    if unit:
        ratio = size * rate_factor(unit, rate_hz) / STANDARD_GRAVITY
        proposal.reasons["accel_unit"] = f"by the names; the mean is {ratio:.4g} times gravity"
        return unit
    if found := [u for u in gravity_units(size, rate_hz) if is_rate(u) == are_rates]:
        proposal.reasons["accel_unit"] = f"the mean has the magnitude of gravity, {size:.5g}"
        return found[0]
    counts = f"gravity in no unit: if these are counts, one is {1 / (size or 1.0):.4g} of gravity"
    question = _NO_RATE if accel.are_increments and math.isnan(rate_hz) else counts
    proposal.questions["accel_unit"] = f"the mean has a magnitude of {size:.5g}, {question}"
    return "g" if are_rates else "m_per_s"


def _gyro_unit(table: Table, gyro: Triad, accel_unit: str, size: float, proposal: Proposal) -> str:
    """Return the unit of the gyros by names, or one to examine them with, and a question."""
    unit, rate_hz = gyro.unit, proposal.rate_hz
    if unit in ("rad", "deg") and not gyro.are_increments and is_rate(accel_unit):
        unit = f"{unit}_per_s"  # as PX4 writes gyro_rad
    if unit:
        of_earth = size * rate_factor(unit, rate_hz) / EARTH_RATE
        reason = f"by the names; the mean rate is {of_earth:.3g} times Earth rate"
        proposal.reasons["gyro_unit"] = reason
        return unit
    is_ros = all(any(part in name for name in table.names) for part in _ROS)
    if is_ros and accel_unit == "m_per_s2":
        proposal.reasons["gyro_unit"] = "as ROS writes them"
        return "rad_per_s"
    question = "no name states it"
    if is_ros:
        question = f"ROS writes m/s^2, but force in {accel_unit} contradicts it"
    units = [*GYRO_UNITS[INCREMENTS if gyro.are_increments else RATES]]
    if gyro.are_increments and math.isnan(rate_hz):
        question += f", and {_NO_RATE}"
    else:
        rates = {unit: size * rate_factor(unit, rate_hz) for unit in units}
        question += "".join(
            f'; gyro_unit = "{unit}": mean rate {rate / DEG_PER_H:.3g} deg/h,'
            f" {rate / EARTH_RATE:.3g} times Earth rate"
            for unit, rate in rates.items()
        )
    proposal.questions["gyro_unit"] = question
    return units[0]


def _axes_order(named: list[str], up: FloatArray, proposal: Proposal) -> str:
    """Return the order of axes by names, or by gravity if x, y, z are those of usual boxes."""
    axis = int(np.argmax(np.abs(up)))
    pointing, question = f"{'xyz'[axis]} reads {up[axis]:+.2f} g", ""
    right, front, above = (*"yzx",) if axis == 0 else (*"zxy",) if axis == 1 else (*"xyz",)
    order = f"{right}{front}{above}" if up[axis] > 0 else f"{front}{right}-{above}"
    if len(named) > 1:
        question = f"the names state {' and '.join(named)}"
    elif named:
        order, proposal.reasons["axes_order"] = named[0], f"from names or comments; {pointing}"
        if to_body_axes(up[None], order)[0, 2] < math.cos(60 * DEG):
            question = f"a sign or an axis is wrong: the names state {order!r}"
    elif not abs(up[axis]) >= math.cos(30 * DEG):
        question = "no axis is near the vertical, and no name states the axes"
    elif axis == 2:
        order = "flu" if up[2] > 0 else "frd"
        proposal.reasons["axes_order"] = f"{pointing}; x is taken for the front"
    else:
        question = f'no name states the front; if it is {front}: axes_order = "{order}"'
    if question:
        proposal.questions["axes_order"] = f"{pointing}; {question}"
    return order


# Time


class _Clock(NamedTuple):
    """A proposed clock of a log: keys of the layout, the rate if known, and questions."""

    fields: dict[str, Any]
    rate_hz: float
    questions: dict[str, str]


def _propose_clock(table: Table, answers: Mapping[str, Any], taken: set[str]) -> _Clock:
    """Propose columns and units of time by names and by the steps of stamps, or ask for the rate.

    Columns of sensors are taken. Of several clocks the first one without a question counts.
    """
    kinds, given = table.kinds, answers.get("time_column")
    names = [
        name for name, kind in kinds.items()
        if name == given or name and name not in taken
        and (kind == "dates with time" or kind == "numbers" and _TIME_NAME.search(name))
    ]  # fmt: skip
    columns = table.read(names, [name for name in names if kinds[name] == "dates with time"])
    stamps = {n: s for n, s in zip(names, columns, strict=True) if np.isfinite(s).sum() > 1}
    units = {n: "iso" if kinds[n] == "dates with time" else _unit_by_name(table, n) for n in stamps}
    fractions = [
        name for name, unit in units.items()
        if unit in ("ms", "us", "ns") and np.nanmax(stamps[name]) * TIME_UNITS[unit] < 1
        and (np.diff(stamps[name]) < 0).any()  # they begin again with each second
    ]  # fmt: skip
    clocks = []
    for name in [given] if given in stamps else stamps:
        fields: dict[str, Any] = {"time_column": name, "time_unit": units[name] or "s"}
        questions = dict[str, str]()
        is_whole = np.array_equal(stamps[name], np.floor(stamps[name]), equal_nan=True)
        others = [other for other in fractions if other != name]
        if others and is_whole and units[name] in ("", "s"):
            fields |= {"time_fraction_column": others[0], "time_fraction_unit": units[others[0]]}
        elif units[name] != "iso" and "time_unit" not in answers:
            steps = np.diff(stamps[name][np.isfinite(stamps[name])])
            step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
            rates = {unit: 1 / (step * TIME_UNITS[unit]) for unit in ("s", "ms", "us", "ns")}
            possible = [u for u, hz in rates.items() if _POSSIBLE_HZ[0] <= hz <= _POSSIBLE_HZ[1]]
            fields["time_unit"] = units[name] or (possible or ["s"])[0]
            if units[name] not in possible and (units[name] or len(possible) != 1):
                stated = f"is named as {units[name]}, but" if units[name] else "states no unit, and"
                shown = ", ".join(f'"{unit}": {rates[unit]:.4g} Hz' for unit in possible or rates)
                questions["time_unit"] = f"column {name!r} {stated} its steps would be {shown}"
        fields |= {key: answers[key] for key in ("time_unit", "time_scale") if key in answers}
        clocks.append(_try_clock(table, _Clock(fields, math.nan, questions), stamps))
    unknown = _Clock({}, math.nan, {"rate_hz": "no column has times: give the true rate"})
    return min(clocks, key=lambda clock: (bool(clock.questions), not clock.fields), default=unknown)


def _try_clock(table: Table, clock: _Clock, stamps: Mapping[str, FloatArray]) -> _Clock:
    """Return a clock with its rate; without columns and with a question if it is no clock."""
    layout = RecordLayout(table.format, **clock.fields)
    time_s = combine_times([stamps[column] for column in layout.time_columns], layout)
    time_s = time_s[np.isfinite(time_s)]
    is_new = np.diff(time_s, prepend=-np.inf) != 0
    if is_new.mean() > _MIN_NEW:
        time_s = time_s[is_new]
    try:
        rate_hz = find_sampling(table.source, layout, time_s, lambda k: k + 1).rate_hz
        return clock._replace(rate_hz=rate_hz)
    except InputError as error:
        question = str(error).removeprefix(f"{table.source}: ").partition(" (drop")[0]
        return _Clock({}, math.nan, {"rate_hz": f"{question}: give the true rate"})


def _unit_by_name(table: Table, name: str) -> str:
    """Return the unit of a column of times by the row of units or its name; "" for none."""
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", table.units.get(name) or name)  # as TimeUS
    found = _TIME_UNIT.search(text.lower())
    return "" if not found else f"{(found[1] or '').replace('micro', 'u')[:1]}s"
