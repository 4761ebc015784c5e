"""A layout for a file without a description: names decide, or the user is asked.

Columns, units and axes come from names, which are compared in lower case, word by word:
``GyroX [deg/s]`` is gyro, x and deg/s. Only gravity counts as evidence: for the unit of the
accelerometers, and for the axis that points up. Everything else is an open question, which has to
be answered before anything is aligned.
"""

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from sinsjax.errors import InputError
from sinsjax.messages import shorten
from sinsjax.records.checks import EARTH_RATE
from sinsjax.records.layout import (
    ACCEL_UNITS,
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
from sinsjax.records.reader import MIN_COLUMNS, Table
from sinsjax.records.tabular import SHORTEST_STEP, combine_times, find_sampling
from sinsjax.units import DEG, DEG_PER_H, STANDARD_GRAVITY

_SENSOR_WORDS = (
    ("gyro", r"gyr|omega|ang(ular)?_?(vel|rate)|rot(ation)?_?rate|(d|delta)_?(theta|ang)"),
    ("accel", r"acc|force|d_?vel|delta_?v|(^|_)d_?v(_|$)"),
    ("gyro", r"(^|_)(w|g|om|rate)($|_)"),
    ("accel", r"(^|_)(a|f)($|_)"),
)
"""Patterns of the words for a sensor; the first one that fits counts."""
_OTHER_WORDS = re.compile(
    r"cov|accuracy|bias|std|sigma|temp|mag|var$|status|valid"
    r"|(^|_)(ned|enu|nwu|nav|navigation|world|earth|global|ecef|level(l?ed)?)(_|$)"
)
"""Words for columns that are no sensors in their own axes."""
_INCREMENT_WORDS = re.compile(r"delta|^d_?(v|theta|ang)|_d(v|theta)|incr")
_SPELLINGS = {
    "gyro": {
        "rad_per_s": "rad/s rads rad_s rps x8005",
        "deg_per_s": "deg/s degs deg_s dps",
        "deg_per_h": "deg/h deg_h dph",
        "rad": "rad x8007",
        "deg": "deg",
        "arcsec": "arcsec as",
    },
    "accel": {
        "m_per_s2": "m/s2 mps2 ms2 m_s2 mss",
        "g": "g gs x8004",
        "mg": "mg",
        "ug": "ug",
        "m_per_s": "m/s mps m_s",
        "g_s": "g_s g.s x8008",
        "ug_s": "ug_s ugs",
    },
}
"""Spellings of units, as `parse_unit` simplifies them; x8004 is MicroStrain's code."""


class Triad(NamedTuple):
    """Three columns of one sensor, and what their names or a row of units state."""

    names: tuple[str, ...]  # x, y, z
    unit: str = ""  # of `layout.GYRO_UNITS` or `ACCEL_UNITS`
    are_increments: bool = False


class _Name(NamedTuple):
    """The parts of a name: other words, axis, and unit."""

    stem: str
    axis: str
    unit: str


def find_triads(names: Iterable[str], sensor: str, units: Mapping[str, str]) -> list[Triad]:
    """Return the triads of ``"gyro"`` or ``"accel"`` among columns; a row gives units by name."""
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for name in names:
        stem, axis, unit = _parse_name(name, sensor, units.get(name, ""))
        kinds = (kind for kind, words in _SENSOR_WORDS if re.search(words, stem))
        if axis and not _OTHER_WORDS.search(stem) and next(kinds, "") == sensor:
            groups.setdefault((stem, unit), {}).setdefault(axis, name)
    return [
        Triad(tuple(columns[axis] for axis in axes), unit, bool(_INCREMENT_WORDS.search(stem)))
        for (stem, unit), columns in groups.items()
        if (axes := next((axes for axes in ("xyz", "012", "123") if {*axes} <= {*columns}), ""))
    ]


def _parse_name(name: str, sensor: str, overriding_unit: str) -> _Name:
    """Return the parts of a name, whose axis is "" if it has none."""
    unit, axis = parse_unit(overriding_unit, sensor), ""
    bracket = re.search(r"[\[(]([^\[(\])]*)[\])]\s*$", name)
    if bracket and (in_bracket := parse_unit(bracket[1], sensor)):
        unit, name = unit or in_bracket, name[: bracket.start()]
    separated = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.strip()).lower()
    words = [word for word in re.split(r"[^a-z0-9/°^²*µμ]+", separated) if word]
    for place in (-1, 0, -2):  # after a unit, as in acc_x_m_s2; before it, as in gyro_rad[0]
        for count in (3, 2, 1):
            found = parse_unit("_".join(words[-count:]), sensor) if len(words) > count else ""
            if found and not unit:
                unit, words = found, words[:-count]
        if not axis and len(words) >= max(2, -place) and words[place] in {*"xyz0123"}:
            axis = words.pop(place)
    if not axis and words and (glued := re.fullmatch(r"(.*[a-z])([xyz0-3])", words[-1])):
        words[-1], axis = glued.groups()
    return _Name("_".join(words), axis, unit)


def find_named_orders(texts: Iterable[str]) -> list[str]:
    """Return the axes that texts name, of `layout.NAMED_AXES`."""
    orders = set[str]()
    for text in texts:
        directions = re.findall("right|front|forward|left|up|down", text.lower())
        words = {*re.split(r"[^a-z]+", text.lower()), "".join(word[0] for word in directions)}
        orders |= {"rfu", "frd", "flu"} & words
    return sorted(orders)


def parse_unit(text: str, sensor: str) -> str:
    """Return the unit of a ``"gyro"`` or ``"accel"`` that a text spells, or ""."""
    text = re.sub(r"[\s^·*()\[\]]+", "", text.lower()).replace("²", "2")
    text = text.replace("µ", "u").replace("μ", "u").replace("°", "deg").replace("_per_", "/")
    for pattern, word in (
        (r"degrees?", "deg"),
        (r"radians?", "rad"),
        (r"sec(ond)?s?", "s"),
        (r"h(ou)?rs?$", "h"),
        (r"arcs$", "arcsec"),
        (r"^(.*[a-z])s-([12])$", r"\1/s\2"),
        (r"/s1$", "/s"),
        (r"/s/s$", "/s2"),
    ):
        text = re.sub(pattern, word, text)
    found = (unit for unit, forms in _SPELLINGS[sensor].items() if text in forms.split())
    return next(found, "")


_SENSORS = {"gyro": "gyros", "accel": "accelerometers"}
_ROS = ("angular_velocity", "linear_acceleration")  # in rad/s and m/s^2
_TAG = re.compile(r"gyr|acc|magn|baro|temp", re.IGNORECASE)
_LABEL = re.compile(
    r"(?=.)(sensor|imu|device|node|unit|source|topic|message|msg)?[ _.]?(id|name|type|no)?",
    re.IGNORECASE,
)
"""Names of columns that name the sensor of a row."""
_HEAD_ROWS, _MAX_LABELS = 20, 5  # more are a count of the rows
_NO_RATE = "increments show their unit once the sample rate is known"
_TIME_NAME = re.compile(
    r"time|stamp|epoch|clock|(^|[._\s])(t|tow|sow|utc|[mun]?secs?|(milli|micro|nano)?sec(onds?)?)"
    r"($|[\s_\[(])",
    re.IGNORECASE,
)
_TIME_UNIT = re.compile(r"(?:^|[\s_.\[(])([nmu]|nano|micro|milli)?s(?:ec(?:ond)?s?)?[\])\s]*$")
_POSSIBLE_HZ = 0.5, 5000.0  # rates of IMUs
_NEAR_GRAVITY = 0.018  # relative: cm/s^2 would be mg with 0.0193
_MIN_NEW = 0.8  # share of stamps that differ from the one before, among repeated rows


@dataclass
class Proposal:
    """The layout of the record in a log, and what is not known of it, by key."""

    layout: RecordLayout  # open keys have values to examine the log with
    rate_hz: float = math.nan  # nan if it is an open question
    reasons: dict[str, str] = field(default_factory=dict)
    questions: dict[str, str] = field(default_factory=dict)  # evidence for open keys


def propose_layout(table: Table, answers: Mapping[str, Any]) -> Proposal:
    """Propose the layout of the record in an opened file, with keys that the user has given."""
    if len(table.names) < MIN_COLUMNS:
        text = f"found {len(table.names)} columns; an IMU log needs at least {MIN_COLUMNS}"
        raise InputError(f"{table.source}: {text}")
    _refuse_tagged_rows(table)
    proposal = Proposal(RecordLayout(table.format))
    triads = {sensor: _find_triad_or_ask(table, sensor, answers, proposal) for sensor in _SENSORS}
    names = {f"{sensor}_columns": triad.names for sensor, triad in triads.items() if triad}
    clock = _propose_clock(table, answers, {*chain(*names.values())})
    fields: dict[str, Any] = {**names, **clock.fields}
    proposal.layout = proposal.layout._replace(**fields)
    proposal.questions |= clock.questions
    proposal.rate_hz = answers.get("rate_hz", math.nan if clock.questions else clock.rate_hz)
    if len(names) == 2:
        _propose_units_and_axes(table, [*filter(None, triads.values())], answers, proposal)
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


def _find_triad_or_ask(
    table: Table, sensor: str, answers: Mapping[str, Any], proposal: Proposal
) -> Triad | None:
    """Return the columns of a sensor; None, and a question, if names do not decide."""
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


def _propose_units_and_axes(
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
    for unit in ACCEL_UNITS[RATES if are_rates else INCREMENTS]:
        if abs(size * rate_factor(unit, rate_hz) / STANDARD_GRAVITY - 1) < _NEAR_GRAVITY:
            proposal.reasons["accel_unit"] = f"the mean has the magnitude of gravity, {size:.5g}"
            return unit
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


def _propose_clock(table: Table, answers: Mapping[str, Any], taken: Collection[str]) -> _Clock:
    """Return the first clock that names and steps of stamps identify, or one with a question."""
    kinds, given = table.kinds, answers.get("time_column")
    dates = [name for name, kind in kinds.items() if kind == "dates with time"]
    names = [
        name for name, kind in kinds.items()
        if name == given or name and name not in taken
        and (name in dates or kind == "numbers" and _TIME_NAME.search(name))
    ]  # fmt: skip
    columns = table.read(names, dates)
    stamps = {n: s for n, s in zip(names, columns, strict=True) if np.isfinite(s).sum() > 1}
    units = {n: "iso" if n in dates else _unit_by_name(table, n) for n in stamps}
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
            steps = steps[steps > SHORTEST_STEP]
            step = float(np.median(steps)) if steps.size else 1.0
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
