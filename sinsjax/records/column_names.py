"""Interpretation of column names: gyros, accelerometers and time, with axes and units.

Names are compared in lower case, word by word: ``GyroX [deg/s]`` is gyro, x and deg/s.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

_SENSOR_WORDS = {
    "gyro": re.compile(
        r"gyr|omega|ang(ular)?_?(vel|rate)|rot(ation)?_?rate|d_?theta|delta_?(angle|theta)|d_?ang"
    ),
    "accel": re.compile(r"acc|force|d_?vel|delta_?v|(^|_)d_?v(_|$)"),
}
_SENSOR_LETTERS = {"gyro": ("w", "g", "om", "rate"), "accel": ("a", "f")}
_EXCLUDED_WORDS = re.compile(r"cov|accuracy|bias|std|sigma|temp|mag|var$|status|valid|raw_?count")
_MINUS = re.compile(r"^\s*(-|(minus|neg(ative)?)[-_ ])\s*", re.IGNORECASE)
_INCREMENT_WORDS = re.compile(r"delta|^d_?(v|theta|ang)|_d(v|theta)|incr")
_TIME = re.compile(
    r"time|stamp|epoch|clock|^(t|tow|sow|utc|date|[mun]?secs?|(milli|micro|nano)?sec(ond)?s?)$"
)
_AXES = {
    **{letter: number for number, letter in enumerate("xyz")},
    **{letter: number for number, letter in enumerate("0123")},
}
_DIRECTIONS = {
    "right": "r", "left": "l", "front": "f", "forward": "f", "fwd": "f", "up": "u", "down": "d",
    "rgt": "r", "lft": "l", "frt": "f", "dn": "d", "dwn": "d", "back": "b", "rear": "b", "aft": "b",
    "r": "r", "l": "l", "f": "f", "u": "u", "d": "d",
}  # fmt: skip
TURNS = {"roll": 1, "pitch": 0, "yaw": 2, "heading": 2, "p": 1, "q": 0, "r": 2}
"""Body axis, right, front or up, of a turn's name, such as roll_rate, or p alone."""
_TURN_STEM = "turn_rate"
_NAVIGATION_WORDS = {
    *("n", "ned", "enu", "nwu", "nav", "navigation", "world", "earth", "global", "local", "ecef"),
    *("level", "leveled", "levelled"),
}
_BODY_WORDS = {"b", "body"}
_DIRECTION_GROUPS = ("rl", "fb", "ud")
"""Directions of three axes; of a pair, either one."""
_DIRECTION_NAMES = {
    "r": "right", "l": "left", "f": "front", "b": "back", "u": "up", "d": "down",
}  # fmt: skip
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
        ("rad_per_s", 1.0): ("rad/s", "rads", "rad_s", "rps", "x8005"),
        ("rad_per_s", 1e-3): ("mrad/s", "mrads", "mrad_s"),
        ("deg_per_s", 1.0): ("deg/s", "degs", "deg_s", "dps"),
        ("deg_per_s", 1e-3): ("mdeg/s", "mdegs", "mdeg_s", "mdps"),
        ("deg_per_h", 1.0): ("deg/h", "deg_h", "dph"),
        ("rad", 1.0): ("rad", "x8007"),
        ("rad", 1e-3): ("mrad",),
        ("rad", 1e-6): ("urad",),
        ("deg", 1.0): ("deg",),
        ("arcsec", 1.0): ("arcsec", "as", '"'),
    },
    "accel": {
        ("m_per_s2", 1.0): ("m/s2", "mps2", "ms2", "m_s2", "mss"),
        ("m_per_s2", 1e-2): ("cm/s2", "cm_s2", "gal"),
        ("m_per_s2", 1e-3): ("mm/s2", "mm_s2"),
        ("g", 1.0): ("g", "gs", "x8004"),
        ("mg", 1.0): ("mg",),
        ("ug", 1.0): ("ug",),
        ("m_per_s", 1.0): ("m/s", "mps", "m_s"),
        ("g_s", 1.0): ("g_s", "g.s", "x8008"),
        ("ug_s", 1.0): ("ug_s", "ugs"),
    },
    "time": {
        ("s", 1.0): ("s",),
        ("ms", 1.0): ("ms", "millis", "milliseconds"),
        ("us", 1.0): ("us", "micros", "microseconds"),
        ("ns", 1.0): ("ns", "nanos", "nanoseconds"),
        ("s", 1e-4): ("sampletimefine",),
    },
}  # fmt: skip
"""Spellings of units and their multiples, as `_spell` returns them; x8004 is MicroStrain's code."""

Unit = tuple[str, float]
"""A unit of `layout.GYRO_UNITS`, `ACCEL_UNITS` or `TIME_UNITS`, and a multiplier."""

NO_UNIT: Unit = ("", 1.0)


class Triad(NamedTuple):
    """Three columns of one sensor.

    Attributes:
        names: columns in the order of the record's x, y, z.
        unit: unit in the names with its multiplier; "" if none.
        signs: sign of each column.
        directions: directions of x, y and z in the names, such as "frd"; "" if none.
        are_increments: whether the names indicate increments.
        turns: body axis, right, front or up, of each column if they are named roll, pitch, yaw.
        words: of the names, without axes and units.
    """

    names: tuple[str, str, str]
    unit: Unit
    signs: tuple[float, float, float]
    directions: str = ""
    are_increments: bool = False
    turns: tuple[int, ...] = ()
    words: frozenset[str] = frozenset()


class Clock(NamedTuple):
    """A possible time column, its unit with a multiplier, "" if none, and the fraction's column."""

    name: str
    unit: Unit
    fraction: str = ""
    fraction_unit: str = "ns"


class _Name(NamedTuple):
    """A column's name: stem, axis, unit, and sign."""

    stem: str
    axis: str
    unit: Unit
    sign: float


_Group = dict[str, tuple[str, float]]
"""Column and sign by axis."""


def find_triads(
    names: Sequence[str], sensor: str, units: Mapping[str, str] | None = None
) -> list[Triad]:
    """Return the triads of ``"gyro"`` or ``"accel"`` among a file's columns, in its order.

    Args:
        names: of the columns.
        sensor: of the triads.
        units: in words by name, from a row of units.
    """
    groups = _group_columns(names, sensor, units or {}).items()
    candidates = [_make_triad(stem, unit, columns) for (stem, unit), columns in groups]
    return [triad for triad in candidates if triad is not None]


def find_incomplete_triad(names: Sequence[str], sensor: str) -> tuple[list[str], str] | None:
    """Return two columns of a triad, and the missing ending of the third one's name, if any."""
    for (stem, _), columns in _group_columns(names, sensor, {}).items():
        by_direction = {
            _DIRECTIONS[axis]: name for axis, name in columns.items() if axis in _DIRECTIONS
        }
        axes_sets: tuple[tuple[Mapping[str, object], tuple[str, ...]], ...] = (
            (columns, ("x", "y", "z")),
            (columns, ("0", "1", "2") if "0" in columns else ("1", "2", "3")),
            (by_direction, _DIRECTION_GROUPS),
        )
        if stem == _TURN_STEM:
            axes_sets = ((columns, ("roll", "pitch", "yaw")),)
        for present, axes in axes_sets:
            missing = [
                axis for axis in axes
                if not (axis in present or (axes is _DIRECTION_GROUPS and {*axis} & {*present}))
            ]  # fmt: skip
            if len(present) == 2 and len(missing) == 1:
                letters = missing[0] if axes is _DIRECTION_GROUPS else [missing[0]]
                wanted = " or ".join(_DIRECTION_NAMES.get(letter, letter) for letter in letters)
                return [name for name, _ in columns.values()], wanted
    return None


def named_turns(names: Sequence[str]) -> tuple[int, ...]:
    """Return the body axis of each gyro column if all are named roll, pitch, yaw; () if not."""
    parsed = [_parse_name(name, "gyro") for name in names]
    turns = [TURNS[name.axis] for name in parsed if name and name.stem == _TURN_STEM]
    return tuple(turns) if sorted(turns) == [0, 1, 2] else ()


def navigation_words(gyro: Triad, accel: Triad) -> frozenset[str]:
    """Return the words by which one of two triads is named as in a navigation frame."""
    return (gyro.words ^ accel.words) & _NAVIGATION_WORDS


def rank_pair(gyro: Triad, accel: Triad) -> tuple[int, int, int]:
    """Return how ill the names of two triads fit one sensor, from the most important on.

    Words of a navigation frame in one of them, words that they do not share, and words of a
    navigation frame in both.
    """
    return (
        len(navigation_words(gyro, accel)),
        len(gyro.words ^ accel.words),
        len(gyro.words & accel.words & _NAVIGATION_WORDS),
    )


def find_clocks(names: Sequence[str], units: Mapping[str, str] | None = None) -> list[Clock]:
    """Return the columns whose names indicate time, in the file's order, see `find_triads`."""
    clocks = []
    for name in names:
        stem, unit = _split_unit(name, "time")
        if found := parse_unit((units or {}).get(name, ""), "time"):
            unit = found
        if stem.replace("_", "") == "sampletimefine":
            unit = ("s", 1e-4)
        words = _normalise_name(name)
        if any(_TIME.search(part) for part in (stem, *stem.split("_"), *words.split("_"))):
            guess = ("s", 1.0) if re.search(r"sec|tow|sow", stem) else NO_UNIT
            clocks.append(Clock(name, unit if unit[0] else guess))
    return [_with_fraction(clock, clocks) for clock in clocks]


def _with_fraction(clock: Clock, clocks: list[Clock]) -> Clock:
    """Return a clock of seconds with the column of their fraction, as of ROS's secs and nsecs."""
    if clock.unit != ("s", 1.0):
        return clock
    stem = _fraction_stem(clock.name)
    for other in clocks:
        if other.unit[0] in ("ns", "us", "ms") and stem and _fraction_stem(other.name) == stem:
            return clock._replace(fraction=other.name, fraction_unit=other.unit[0])
    return clock


def _fraction_stem(name: str) -> str:
    """Return what the names of seconds and their fraction share; "" for another name."""
    stem, count = re.subn(r"(nano|micro|milli|[num])?_?s(ec(ond)?s?)?$", "", _normalise_name(name))
    return f"{stem.rstrip('_')}." if count else ""


def find_named_order(texts: Iterable[str]) -> str:
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
    return not words & {"time", "stamp"} and bool(
        words & {"index", "idx", "count", "counter", "sample", "seq", "n", "no", "packet"}
    )


def parse_unit(text: str, kind: str) -> Unit | None:
    """Return the unit of a ``"gyro"``, ``"accel"`` or ``"time"`` that a text spells, or None."""
    spelling = _spell(text)
    return next((unit for unit, forms in _UNIT_SPELLINGS[kind].items() if spelling in forms), None)


def _spell(text: str) -> str:
    """Return a unit in one spelling: rad/s for rad s^-1, RAD/SEC or rad_per_sec."""
    text = re.sub(r"[\s^·*()\[\]]+", "", text.lower()).replace("²", "2")
    text = text.replace("µ", "u").replace("μ", "u").replace("°", "deg").replace("_per_", "/")
    for pattern, word in (
        (r"degrees?", "deg"),
        (r"radians?", "rad"),
        (r"(milli|micro|nano)seconds?", r"\1seconds"),
        (r"(?<!milli)(?<!micro)(?<!nano)sec(ond)?s?", "s"),
        (r"h(ou)?rs?$", "h"),
        (r"^(.*[a-z])s-([12])$", r"\1/s\2"),
        (r"/s1$", "/s"),
        (r"/s/s$", "/s2"),
    ):
        text = re.sub(pattern, word, text)
    return text


def _group_columns(
    names: Sequence[str], sensor: str, units: Mapping[str, str]
) -> dict[tuple[str, Unit], _Group]:
    """Return the columns of ``"gyro"`` or ``"accel"`` by stem and unit, and by axis."""
    groups: dict[tuple[str, Unit], _Group] = {}
    for name in names:
        found = _parse_name(name, sensor)
        if found is None or _EXCLUDED_WORDS.search(found.stem):
            continue
        unit = parse_unit(units.get(name, ""), sensor) or found.unit
        other_unit = _split_unit(name, "accel" if sensor == "gyro" else "gyro")[1]
        if other_unit[0] and not unit[0] and not _SENSOR_WORDS[sensor].search(found.stem):
            continue  # as f_x (g), whose g is a unit
        if _is_sensor_name(sensor, found.stem, unit):
            groups.setdefault((found.stem, unit), {}).setdefault(found.axis, (name, found.sign))
    return groups


def _is_sensor_name(sensor: str, stem: str, unit: Unit) -> bool:
    """Return whether the words of a name without its axis denote the sensor."""
    other_sensor = "accel" if sensor == "gyro" else "gyro"
    if stem == _TURN_STEM:
        return sensor == "gyro"
    if _SENSOR_WORDS[sensor].search(stem):
        return not (sensor == "accel" and _SENSOR_WORDS[other_sensor].search(stem))
    if _SENSOR_WORDS[other_sensor].search(stem):
        return False
    first = stem.partition("_")[0]
    letters = _SENSOR_LETTERS[sensor]
    return stem.rpartition("_")[2] in letters or (bool(unit[0]) and first in letters)


def _normalise_name(name: str) -> str:
    """Return a name in lower case, with its words joined by underscores."""
    separated = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.strip())
    return re.sub(r"[^a-z0-9/°^²*µμ\"]+", "_", separated.lower()).strip("_")


def _split_unit(name: str, kind: str) -> tuple[str, Unit]:
    """Return the words of a name without its unit, and the unit; "" without one."""
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", name)
    if bracket and (unit := parse_unit(bracket[1], kind)):
        return _normalise_name(name[: bracket.start()]), unit
    return _split_unit_words(_normalise_name(name), kind)


def _split_unit_words(words: str, kind: str) -> tuple[str, Unit]:
    parts = words.split("_")
    for count in (3, 2, 1):
        if len(parts) > count and (unit := parse_unit("_".join(parts[-count:]), kind)):
            return "_".join(parts[:-count]), unit
    return words, NO_UNIT


def _parse_name(name: str, kind: str) -> _Name | None:
    """Return the parts of a name; None without an axis."""
    positive = _MINUS.sub("", name)
    sign, name = 1.0 if positive == name else -1.0, positive
    for words, unit in (_split_unit(name, kind), (_normalise_name(name), NO_UNIT)):
        turn = re.sub(r"_?(rate|vel(ocity)?)$", "", words)
        if kind == "gyro" and turn in TURNS and (len(turn) == 1) == (turn == words):
            return _Name(_TURN_STEM, turn, unit, sign)
        if (split := _split_axis(words)) is not None:
            stem, axis = split
            if not unit[0]:
                stem, unit = _split_unit_words(stem, kind)  # as in gyro_rad[0]
            return _Name(stem, axis, unit, sign)
    return None


def _split_axis(words: str) -> tuple[str, str] | None:
    """Return the stem and the axis of a name; None without an axis."""
    first, *rest = words.split("_")
    if not rest:
        match = re.fullmatch(r"(.*[a-z])([xyz0-3])", words)
        return (match[1], match[2]) if match else None
    *stem, last = first, *rest
    if len(stem) > 1 and stem[-1] in ("x", "y", "z") and last not in ("x", "y", "z"):
        return "_".join([*stem[:-1], last]), stem[-1]  # as in acc_x_raw or acc_x_0
    if last in _AXES or last in _DIRECTIONS:
        return "_".join(stem), last
    if match := re.fullmatch(r"(.*[a-z])([xyz0-3])", last):
        return "_".join([*stem, match[1]]), match[2]
    if len(stem) > 1 and (stem[-1] in _AXES or stem[-1] in _DIRECTIONS):  # as in acc_up_raw
        return "_".join([*stem[:-1], last]), stem[-1]
    if first in ("x", "y", "z") or (len(first) > 1 and first in _DIRECTIONS):  # as in X Accel
        return "_".join(rest), first
    return None


def _make_triad(stem: str, unit: Unit, columns: _Group) -> Triad | None:
    """Return the triad of columns by axis; None if one is missing."""
    increments = bool(_INCREMENT_WORDS.search(stem))

    def triad(axes: Sequence[str], by_axis: _Group, directions: str, turns: Sequence[int]) -> Triad:
        (x, sx), (y, sy), (z, sz) = (by_axis[axis] for axis in axes)
        words = frozenset(stem.split("_")) - _BODY_WORDS
        return Triad((x, y, z), unit, (sx, sy, sz), directions, increments, tuple(turns), words)

    if stem == _TURN_STEM:
        for axes in (("roll", "pitch", "yaw"), ("roll", "pitch", "heading"), ("p", "q", "r")):
            if set(axes) <= set(columns):
                turns = [TURNS[axis] for axis in axes]
                return triad(axes, columns, "", turns)._replace(words=frozenset(axes))
        return None
    by_direction = {
        _DIRECTIONS[axis]: column for axis, column in columns.items() if axis in _DIRECTIONS
    }
    for order in _ORDERS:
        if set(by_direction) == set(order):
            return triad(order, by_direction, order, ())
    groups = [[d for d in group if d in by_direction] for group in _DIRECTION_GROUPS]
    if all(len(group) == 1 for group in groups) and len(by_direction) == 3:
        signed = {
            d: (name, -sign if d in "lbd" else sign) for d, (name, sign) in by_direction.items()
        }
        return triad([group[0] for group in groups], signed, "rfu", ())
    numbered = next((axes for axes in ("xyz", "012", "123") if set(axes) <= set(columns)), None)
    return triad(numbered, columns, find_named_order([stem]), ()) if numbered else None
