"""A layout for a file without a description: names tell, or the user is asked.

Columns, units and axes come from names. Only gravity counts as evidence: for the unit of the
accelerometers, and for the axis that points up. Everything else is an open question, which has to
be answered before anything is aligned.
"""

import math
import re
from collections.abc import Collection, Iterable, Mapping
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
from sinsjax.records.names import NO_UNIT, Triad, find_named_order, find_triads
from sinsjax.records.reader import MIN_COLUMNS, Table
from sinsjax.records.stamps import combine_times, find_sampling
from sinsjax.units import DEG, DEG_PER_H, STANDARD_GRAVITY

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
_NO_RATE = "increments show their unit once the sample rate is known"
_MAX_LABELS = 5  # more are a count of the rows
_TIME_NAME = re.compile(
    r"time|stamp|epoch|clock|(^|[._\s])(t|tow|sow|utc|[mun]?secs?|(milli|micro|nano)?seconds?"
    r"|(milli|micro|nano)sec)($|[\s_\[(])",
    re.IGNORECASE,
)
_TIME_UNIT = re.compile(r"(?:^|[\s_.\[(])(nano|micro|milli|[nmu])?s(?:ec(?:ond)?s?)?[\])\s]*$")
_TIME_UNITS = {
    None: "s",
    "n": "ns",
    "nano": "ns",
    "u": "us",
    "micro": "us",
    "m": "ms",
    "milli": "ms",
}
_POSSIBLE_HZ = 0.5, 5000.0  # rates of IMUs
_MIN_NEW = 0.8  # share of stamps that differ from the one before, among repeated rows


@dataclass
class Proposal:
    """The layout of the record in a log, and what is not known of it, by key of the layout."""

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
    names: dict[str, Any] = {
        f"{sensor}_columns": triad.names for sensor, triad in triads.items() if triad
    }
    clock = _propose_clock(table, answers, [*chain.from_iterable(names.values())])
    proposal.layout = proposal.layout._replace(**names, **clock.fields)
    proposal.questions |= clock.questions
    proposal.rate_hz = answers.get("rate_hz", math.nan if clock.questions else clock.rate_hz)
    gyro, accel = triads["gyro"], triads["accel"]
    if gyro and accel:
        _propose_sensors(table, gyro, accel, answers, proposal)
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
    for name, cells in table.head.items():
        labels = [*dict.fromkeys(filter(None, cells))]
        tags = [cell for cell in labels if _TAG.search(cell)]
        if len(tags) < 2 and _LABEL.fullmatch(name) and len(labels) <= _MAX_LABELS:
            tags = labels
        if len(tags) > 1:
            text = f"rows of several sensors in turn ({', '.join(tags[:3])})"
            hint = "make each a set of columns of one row, matched by the nearest stamp"
            raise InputError(f"{table.source}: {text}: {hint}")


# Sensors


def _read_means(table: Table, names: Iterable[str]) -> dict[str, float]:
    """Return the means of columns, which are read at once; nan without a number."""
    wanted = [*dict.fromkeys(names)]
    good = (values[np.isfinite(values)] for values in table.read(wanted, blanks=True))
    means = (float(values.mean()) if len(values) else math.nan for values in good)
    return dict(zip(wanted, means, strict=True))


def _find_triad(
    table: Table, sensor: str, answers: Mapping[str, Any], proposal: Proposal
) -> Triad | None:
    """Return the columns of a sensor; None, and a question, if names do not tell."""
    key, noun = f"{sensor}_columns", _SENSORS[sensor]
    names = answers.get(key, table.names)
    triads = find_triads(names, sensor, table.units)
    if key in answers:  # the user orders them, and their names state the unit
        found = triads[0] if len(triads) == 1 else Triad(names, NO_UNIT, (1.0, 1.0, 1.0))
        return found._replace(names=names, signs=(1.0, 1.0, 1.0), has_directions=False)
    if len(triads) == 1 and not triads[0].in_navigation_frame:
        return triads[0]
    numbers = [name for name, kind in table.kinds.items() if kind == "number"]
    means = _read_means(table, [n for triad in triads for n in triad.names] or numbers)
    if sensor == "accel" and len(triads) > 1:  # a phone writes it with and without gravity
        heavy = [
            triad for triad in triads
            if gravity_units(math.hypot(*map(means.__getitem__, triad.names)) * triad.unit[1])
        ]  # fmt: skip
        if len(heavy) == 1:
            return heavy[0]
    problem = f"no column is named as of {noun}"
    if triads:
        problem = f"which of these are the {noun} of one box, in its own axes?"
    shown = "; ".join(f"{name} {mean:.4g}" for name, mean in means.items())
    proposal.questions[key] = f"{problem}. Means: {shorten(shown, 400)}"
    return None


def _propose_sensors(
    table: Table, gyro: Triad, accel: Triad, answers: Mapping[str, Any], proposal: Proposal
) -> None:
    """Propose units, scales and axes of both sensors, with reasons or questions."""
    means = _read_means(table, [*gyro.names, *accel.names])
    vectors = dict[str, FloatArray]()
    for sensor, triad in (("gyro", gyro), ("accel", accel)):
        scale = answers.get(f"{sensor}_scale", tuple(s * triad.unit[1] for s in triad.signs))
        proposal.layout = proposal.layout._replace(**{f"{sensor}_scale": scale})
        vectors[sensor] = np.array([means[name] for name in triad.names]) * scale
    force = float(np.linalg.norm(vectors["accel"]))
    accel_unit = answers.get("accel_unit") or _accel_unit(accel, force, proposal)
    rate = float(np.linalg.norm(vectors["gyro"]))
    gyro_unit = answers.get("gyro_unit") or _gyro_unit(table, gyro, accel_unit, rate, proposal)
    axes = _axes_order(table, gyro, accel, vectors["accel"] / (force or 1.0), proposal)
    proposal.layout = proposal.layout._replace(
        gyro_unit=gyro_unit, accel_unit=accel_unit, axes_order=axes
    )


def _accel_unit(accel: Triad, magnitude: float, proposal: Proposal) -> str:
    """Return the unit of the accelerometers by their names or by gravity, or a question."""
    unit, are_rates, rate_hz = accel.unit[0], not accel.are_increments, proposal.rate_hz
    if unit:
        ratio = magnitude * rate_factor(unit, rate_hz) / STANDARD_GRAVITY
        proposal.reasons["accel_unit"] = f"by the names; the mean is {ratio:.4g} times gravity"
        return unit
    if found := [u for u in gravity_units(magnitude, rate_hz) if is_rate(u) == are_rates]:
        reason = f"the mean has the magnitude of gravity, {magnitude:.5g}"
        proposal.reasons["accel_unit"] = reason
        return found[0]
    unit = "g" if are_rates else "m_per_s"
    if not are_rates and math.isnan(rate_hz):
        proposal.questions["accel_unit"] = _NO_RATE
        return unit
    one = STANDARD_GRAVITY / (magnitude or 1.0) / rate_factor(unit, rate_hz)
    proposal.questions["accel_scale"] = (
        f"the mean of {', '.join(accel.names)} has a magnitude of {magnitude:.5g}, gravity in no"
        f" unit: are these counts? {one:.4g} {unit} a count would be gravity"
    )
    return unit


def _gyro_unit(table: Table, gyro: Triad, accel_unit: str, mean: float, proposal: Proposal) -> str:
    """Return the unit of the gyros by names, or one to examine them with, and a question."""
    unit, rate_hz = gyro.unit[0], proposal.rate_hz
    if unit in ("rad", "deg") and not gyro.are_increments and is_rate(accel_unit):
        unit = f"{unit}_per_s"  # as PX4 writes gyro_rad
    if unit:
        of_earth = mean * rate_factor(unit, rate_hz) / EARTH_RATE
        reason = f"by the names; the mean rate is {of_earth:.3g} times Earth rate"
        proposal.reasons["gyro_unit"] = reason
        return unit
    if gyro.are_increments and math.isnan(rate_hz):
        proposal.questions["gyro_unit"] = _NO_RATE
        return "rad"
    question = "no name states it"
    for standard, parts in _STANDARDS.items():
        if all(any(part in name for name in table.names) for part in parts):
            if accel_unit == "m_per_s2":
                proposal.reasons["gyro_unit"] = f"as {standard} writes them"
                return "rad_per_s"
            question = f"{standard} writes m/s^2, but force in {accel_unit} contradicts it"
    if "accel_scale" in proposal.questions:
        scale = f"the mean rate is {mean:.4g} counts: see the data sheet, and give gyro_unit"
        proposal.questions["gyro_scale"] = scale
    units = [*GYRO_UNITS[INCREMENTS if gyro.are_increments else RATES]]
    for unit in units:
        rate = mean * rate_factor(unit, rate_hz)
        question += (
            f'; gyro_unit = "{unit}": mean rate {rate / DEG_PER_H:.3g} deg/h,'
            f" {rate / EARTH_RATE:.3g} times Earth rate"
        )
    proposal.questions["gyro_unit"] = question
    return units[0]


def _axes_order(table: Table, gyro: Triad, accel: Triad, up: FloatArray, proposal: Proposal) -> str:
    """Return the order of axes by names, or by gravity if x, y, z are those of usual boxes."""
    axis, question = int(np.argmax(np.abs(up))), ""
    pointing = f"{'xyz'[axis]} reads {up[axis]:+.2f} g"
    orders = [find_named_order([*table.comments, *table.names])]
    reason = f"from names or comments; {pointing}"
    if gyro.has_directions or accel.has_directions:
        orders, reason = ["rfu"], "from names"
        if not (gyro.has_directions and accel.has_directions):
            question = "only one sensor names right, front and up: which axes has the other?"
    if orders[0]:
        if not question and to_body_axes(up[None], orders[0])[0, 2] < math.cos(60 * DEG):
            question = f"the names state {orders[0]!r}, but {pointing}: a sign or an axis is wrong"
    elif axis == 2 and abs(up[2]) > math.cos(30 * DEG):
        orders = ["flu" if up[2] > 0 else "frd"]
        reason = f"{pointing}; x is taken for the front, so the heading is that of x"
    else:
        a, b, c = "xyzxy"[axis + 1], "xyzxy"[axis + 2], "xyz"[axis]
        orders = [f"{a}{b}{c}", f"{b}-{a}{c}", f"-{a}-{b}{c}", f"-{b}{a}{c}"]
        if up[axis] < 0:
            orders = [f"{b}{a}-{c}", f"-{a}{b}-{c}", f"-{b}-{a}-{c}", f"{a}-{b}-{c}"]
        lines = " or ".join(f'axes_order = "{order}"' for order in orders)
        question = f"{pointing}, and no name states which axis points front: {lines}"
        if not abs(up[axis]) >= math.cos(30 * DEG):
            question = f"no axis is near the vertical ({pointing}), and no name states the axes"
    proposal.reasons["axes_order"] = reason
    if question:
        proposal.questions["axes_order"] = question
    return orders[0]


# Time


class _Clock(NamedTuple):
    """A proposed clock of a log: keys of the layout, the rate if known, and questions."""

    fields: dict[str, Any]
    rate_hz: float
    questions: dict[str, str]


def _propose_clock(table: Table, answers: Mapping[str, Any], taken: Collection[str]) -> _Clock:
    """Propose columns and units of time by names and by the steps of stamps, or ask for the rate.

    Columns of sensors are taken. Of several clocks the first one without a question counts.
    """
    given, kinds = answers.get("time_column"), table.kinds
    names = [
        name for name, kind in kinds.items()
        if name == given or name and name not in taken
        and (kind == "date" or kind == "number" and _TIME_NAME.search(name))
    ]  # fmt: skip
    dates = [name for name in names if kinds[name] == "date"]
    pairs = zip(names, table.read(names, blanks=True, dates=dates), strict=True)
    columns = {name: stamps for name, stamps in pairs if np.isfinite(stamps).sum() > 1}
    units = {name: "iso" if name in dates else _unit_by_name(table, name) for name in columns}
    fractions = {
        name: unit for name, unit in units.items()
        if unit in ("ms", "us", "ns") and np.nanmax(columns[name]) * TIME_UNITS[unit] < 1
        and (np.diff(columns[name]) < 0).any()  # they begin again with each second
    }  # fmt: skip
    clocks = []
    for name in [given] if given in columns else columns:
        fields: dict[str, Any] = {"time_column": name, "time_unit": units[name] or "s"}
        fields |= {k: answers[k] for k in ("time_unit", "time_scale") if k in answers}
        stamps, questions = columns[name], dict[str, str]()
        is_whole = np.array_equal(stamps, np.floor(stamps), equal_nan=True)
        fraction = next((other for other in fractions if other != name), "")
        if fraction and is_whole and units[name] in ("", "s"):
            fields |= {"time_fraction_column": fraction, "time_fraction_unit": units[fraction]}
        elif units[name] != "iso" and "time_unit" not in answers:
            fields["time_unit"], question = _unit_by_steps(name, units[name], stamps)
            questions |= {"time_unit": question} if question else {}
        layout = RecordLayout(table.format, **fields)
        times = [columns[column] for column in layout.time_columns]
        clock = _try_clock(table.source, layout, times)
        clocks.append(clock if clock.questions else _Clock(fields, clock.rate_hz, questions))
    unknown = _Clock({}, math.nan, {"rate_hz": "no column has times: give the true rate"})
    return min(clocks, key=lambda clock: (bool(clock.questions), not clock.fields), default=unknown)


def _try_clock(source: str, layout: RecordLayout, times: list[FloatArray]) -> _Clock:
    """Return the rate of columns of times; a question about it if they are no clock."""
    time_s = combine_times(times, layout)
    time_s = time_s[np.isfinite(time_s)]
    is_new = np.diff(time_s, prepend=-np.inf) != 0
    if is_new.mean() > _MIN_NEW:
        time_s = time_s[is_new]
    try:
        return _Clock({}, find_sampling(source, layout, time_s, lambda k: k + 1).rate_hz, {})
    except InputError as error:
        question = str(error).removeprefix(f"{source}: ").partition(" (drop")[0]
        if len(time_s) > 1 and np.ptp(time_s) > 0:
            rate_hz = (len(time_s) - 1) / np.ptp(time_s)
            question += f"; the mean step would give {rate_hz:.6g} Hz"
        return _Clock({}, math.nan, {"rate_hz": f"{question}: give the true rate"})


def _unit_by_name(table: Table, name: str) -> str:
    """Return the unit of a column of times by the row of units or its name; "" for none."""
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", table.units.get(name) or name)  # as TimeUS
    found = _TIME_UNIT.search(text.lower())
    return _TIME_UNITS[found[1]] if found else ""


def _unit_by_steps(name: str, named: str, stamps: FloatArray) -> tuple[str, str]:
    """Return the unit of stamps (T,), the named one or what their steps can be; and a question."""
    steps = np.diff(stamps[np.isfinite(stamps)])
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    rates = {unit: 1 / max(step * TIME_UNITS[unit], 1e-300) for unit in ("s", "ms", "us", "ns")}
    possible = [unit for unit in rates if _POSSIBLE_HZ[0] <= rates[unit] <= _POSSIBLE_HZ[1]]
    unit = named or (possible or ["s"])[0]
    if unit in possible and (named or len(possible) == 1):
        return unit, ""
    shown = ", ".join(f'"{other}": {rates[other]:.4g} Hz' for other in possible or rates)
    problem = f"is named as {named}, but" if named else "does not tell its unit:"
    return unit, f"column {name!r} {problem} its steps of {step:.4g} are {shown}"
