"""Interpretation of column names: gyros, accelerometers and time, with axes and units.

Names are compared in lower case, word by word: ``GyroX [deg/s]`` is gyro, x and deg/s.
"""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

_SENSOR_WORDS = {
    "gyro": re.compile(
        r"gyr|omega|ang(ular)?_?(vel|rate)|rot(ation)?_?rate|d_?theta|delta_?(angle|theta)|d_?ang"
    ),
    "accel": re.compile(r"acc|force|d_?vel|delta_?v|(^|_)d_?v(_|$)"),
}
_SENSOR_LETTERS = {"gyro": ("w", "g", "om", "rate"), "accel": ("a", "f")}
_EXCLUDED_WORDS = re.compile(r"cov|accuracy|bias|std|sigma|temp|mag|var$|status|valid|raw_?count")
_TIME = re.compile(r"time|stamp|epoch|clock|^(t|tow|sow|utc|date|secs?|seconds)$")
_AXES = {
    **{letter: number for number, letter in enumerate("xyz")},
    **{letter: number for number, letter in enumerate("123")},
}
_DIRECTIONS = {
    "right": "r", "left": "l", "front": "f", "forward": "f", "fwd": "f", "up": "u", "down": "d",
    "rgt": "r", "lft": "l", "frt": "f", "dn": "d", "dwn": "d",
    "r": "r", "l": "l", "f": "f", "u": "u", "d": "d",
}  # fmt: skip
_TURN_AXES = {"roll": "x", "pitch": "y", "yaw": "z", "p": "x", "q": "y", "r": "z"}
"""Axes of an aircraft's rotations, such as roll_rate, or p alone."""
_TURN_STEM = "turn_rate"
_DIRECTION_GROUPS = ("rl", "f", "ud")
"""Directions of three axes; of a pair, either one."""
_DIRECTION_NAMES = {"r": "right", "l": "left", "f": "front", "u": "up", "d": "down"}
_ORDERS = ("rfu", "frd", "flu")
_ORDERS_IN_WORDS = {
    "right-front-up": "rfu",
    "right-forward-up": "rfu",
    "front-right-down": "frd",
    "forward-right-down": "frd",
    "front-left-up": "flu",
    "forward-left-up": "flu",
}
_UNIT_SPELLINGS = {
    "gyro": {
        "rad_per_s": ("rad/s", "rads", "rad_s", "rps", "rad_per_s", "rad/sec", "rad_sec"),
        "deg_per_s": ("deg/s", "degs", "deg_s", "dps", "deg_per_s", "°/s", "deg/sec", "deg_sec"),
        "deg_per_h": ("deg/h", "deg/hr", "deg_h", "dph", "deg_per_h", "°/h", "deg_hr"),
        "rad": ("rad",),
        "deg": ("deg", "°"),
        "arcsec": ("arcsec", "as", '"'),
    },
    "accel": {
        "m_per_s2": (
            "m/s^2", "m/s2", "m/s²", "m/s/s", "mps2", "ms2", "m_s2", "m_per_s2", "ms-2", "m/s**2",
        ),
        "g": ("g",),
        "mg": ("mg",),
        "ug": ("ug", "µg", "μg"),
        "m_per_s": ("m/s", "mps", "m_s", "m_per_s"),
        "g_s": ("g_s", "g*s", "gs", "g·s", "g.s"),
        "ug_s": ("ug_s", "ug*s", "ugs"),
    },
    "time": {
        "s": ("s", "sec", "secs", "second", "seconds"),
        "ms": ("ms", "msec", "msecs", "millis", "milliseconds"),
        "us": ("us", "µs", "μs", "usec", "usecs", "micros", "microseconds"),
        "ns": ("ns", "nsec", "nsecs", "nanos", "nanoseconds"),
    },
}  # fmt: skip


class Triad(NamedTuple):
    """Three columns of one sensor.

    Attributes:
        names: columns in the order of the record's x, y, z.
        unit: unit in the names, a key of `layout.GYRO_UNITS` or `ACCEL_UNITS`; "" if none.
        directions: directions of x, y and z in the names, such as "frd"; "" if none.
        are_increments: whether the names indicate increments.
    """

    names: tuple[str, str, str]
    unit: str
    directions: str
    are_increments: bool


class Clock(NamedTuple):
    """A possible time column, and the unit in its name; "" if none."""

    name: str
    unit: str


def find_triads(names: Sequence[str], sensor: str) -> list[Triad]:
    """Return the triads of ``"gyro"`` or ``"accel"`` among a file's columns, in its order."""
    columns_by_axis = _columns_by_axis(names, sensor).items()
    candidates = [_make_triad(stem, unit, columns) for (stem, unit), columns in columns_by_axis]
    return [triad for triad in candidates if triad is not None]


def find_incomplete_triad(names: Sequence[str], sensor: str) -> tuple[list[str], str] | None:
    """Return two columns of a triad, and the missing ending of the third one's name, if any."""
    for (stem, _), columns in _columns_by_axis(names, sensor).items():
        by_direction = {
            _DIRECTIONS[axis]: name for axis, name in columns.items() if axis in _DIRECTIONS
        }
        turn_names = (
            dict(zip("xyz", ("roll", "pitch", "yaw"), strict=True)) if stem == _TURN_STEM else {}
        )
        for present, axes in (
            (columns, ("x", "y", "z")),
            (columns, ("1", "2", "3")),
            (by_direction, _DIRECTION_GROUPS),
        ):
            missing = [axis for axis in axes if not any(letter in present for letter in axis)]
            if len(present) == 2 and len(missing) == 1:
                wanted = " or ".join(
                    _DIRECTION_NAMES.get(letter, turn_names.get(letter, letter))
                    for letter in missing[0]
                )
                return list(present.values()), wanted
    return None


def _columns_by_axis(names: Sequence[str], sensor: str) -> dict[tuple[str, str], dict[str, str]]:
    """Return the columns of ``"gyro"`` or ``"accel"`` by stem and unit, and by axis."""
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for name in names:
        parts = _split_axis(name, sensor)
        if parts is None:
            continue
        stem, axis, unit = parts
        if _is_sensor_name(sensor, stem) and not _EXCLUDED_WORDS.search(stem):
            groups.setdefault((stem, unit), {})[axis] = name
    return groups


def find_clocks(names: Sequence[str]) -> list[Clock]:
    """Return the columns whose names indicate time, in the file's order."""
    clocks_found = []
    for name in names:
        stem, unit = _split_unit(name, "time")
        if any(_TIME.search(part) for part in (stem, *stem.split("_"))):
            clocks_found.append(
                Clock(name, unit or ("s" if re.search(r"sec|tow|sow", stem) else ""))
            )
    return clocks_found


def find_axes_order(texts: Iterable[str]) -> str:
    """Return the axes that texts name, one of `layout.NAMED_AXES`; "" if none or several."""
    orders = set()
    for text in texts:
        lower = re.sub(r"[\s/,_-]+", "-", text.lower())
        orders |= {order for words, order in _ORDERS_IN_WORDS.items() if words in lower}
        orders |= set(_ORDERS) & set(re.split(r"[^a-z]+", lower))
    return orders.pop() if len(orders) == 1 else ""


def is_counter(name: str) -> bool:
    """Return whether a column counts samples."""
    words = set(_normalise_name(name).split("_"))
    return bool(words & {"index", "idx", "count", "counter", "sample", "seq", "n", "no", "packet"})


def _is_sensor_name(sensor: str, stem: str) -> bool:
    """Return whether the words of a name before its axis denote the sensor."""
    other_sensor = "accel" if sensor == "gyro" else "gyro"
    if _SENSOR_WORDS[sensor].search(stem):
        return not (sensor == "accel" and _SENSOR_WORDS[other_sensor].search(stem))
    return stem.rpartition("_")[2] in _SENSOR_LETTERS[sensor] and not _SENSOR_WORDS[
        other_sensor
    ].search(stem)


def _normalise_name(name: str) -> str:
    """Return a name in lower case, with its words joined by underscores."""
    separated = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.strip())
    return re.sub(r"[^a-z0-9/°^²*µμ\"]+", "_", separated.lower()).strip("_")


def _split_unit(name: str, kind: str) -> tuple[str, str]:
    """Return the words of a name without its unit, and the unit; "" without one."""
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", name)
    if bracket and (unit := _parse_unit(bracket[1], kind)):
        return _normalise_name(name[: bracket.start()]), unit
    parts = _normalise_name(name).split("_")
    for count in (3, 2, 1):
        if len(parts) > count and (unit := _parse_unit("_".join(parts[-count:]), kind)):
            return "_".join(parts[:-count]), unit
    return "_".join(parts), ""


def _parse_unit(text: str, kind: str) -> str:
    spelling = text.lower().replace(" ", "")
    return next((unit for unit, forms in _UNIT_SPELLINGS[kind].items() if spelling in forms), "")


def _split_axis(name: str, kind: str) -> tuple[str, str, str] | None:
    """Return the stem, the axis and the unit of a name; None without an axis."""
    for stem_and_axis, unit in (_split_unit(name, kind), (_normalise_name(name), "")):
        turn = re.sub(r"_?(rate|vel(ocity)?)$", "", stem_and_axis)
        if kind == "gyro" and turn in _TURN_AXES and (len(turn) == 1) == (turn == stem_and_axis):
            return _TURN_STEM, _TURN_AXES[turn], unit
        *stem, last = stem_and_axis.split("_")
        if stem and (last in _AXES or last in _DIRECTIONS):
            return "_".join(stem), last, unit
        if match := re.fullmatch(r"(.*[a-z])([xyz123])", last):
            return "_".join([*stem, match[1]]), match[2], unit
        if len(stem) > 1 and (stem[-1] in _AXES or stem[-1] in _DIRECTIONS):  # as in acc_x_raw
            return "_".join([*stem[:-1], last]), stem[-1], unit
    return None


def _make_triad(stem: str, unit: str, columns: dict[str, str]) -> Triad | None:
    """Return the triad of columns by axis; None if one is missing."""
    increments = bool(re.search(r"delta|^d_?(v|theta|ang)|_d(v|theta)", stem))
    by_direction = {
        _DIRECTIONS[axis]: name for axis, name in columns.items() if axis in _DIRECTIONS
    }
    for order in _ORDERS:
        if set(by_direction) == set(order):
            x, y, z = (by_direction[direction] for direction in order)
            return Triad((x, y, z), unit, order, increments)
    letters = {letter: columns[letter] for letter in "xyz123" if letter in columns}
    for axes in ("xyz", "123"):
        if set(axes) <= set(letters):
            x, y, z = (letters[axis] for axis in axes)
            return Triad((x, y, z), unit, find_axes_order([stem]), increments)
    return None
