"""What the names of a file's columns tell: which hold gyros, accelerometers and time, in what unit.

Names are compared in lower case, their words apart: ``GyroX [deg/s]`` is gyro, x and deg/s.
"""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

_WORDS_OF = {
    "gyro": re.compile(
        r"gyr|omega|ang(ular)?_?(vel|rate)|rot(ation)?_?rate|d_?theta|delta_?(angle|theta)|d_?ang"
    ),
    "accel": re.compile(r"acc|force|d_?vel|delta_?v|(^|_)d_?v(_|$)"),
}
_LETTERS_OF = {"gyro": ("w", "g", "om", "rate"), "accel": ("a", "f")}
_NOT = re.compile(r"cov|accuracy|bias|std|sigma|temp|mag|var$|status|valid|raw_?count")
_TIME = re.compile(r"time|stamp|epoch|clock|^(t|tow|sow|utc|date|secs?|seconds)$")
_AXES = {
    **{letter: number for number, letter in enumerate("xyz")},
    **{letter: number for number, letter in enumerate("123")},
}
_WAYS = {
    "right": "r", "left": "l", "front": "f", "forward": "f", "fwd": "f", "up": "u", "down": "d",
    "rgt": "r", "lft": "l", "frt": "f", "dn": "d", "dwn": "d",
    "r": "r", "l": "l", "f": "f", "u": "u", "d": "d",
}  # fmt: skip
_TURNS = {"roll": "x", "pitch": "y", "yaw": "z", "p": "x", "q": "y", "r": "z"}
"""Turns of an aircraft, roll_rate or p alone, by the record's axes."""
_TURN = "turn_rate"
_THREE = ("rl", "f", "ud")
"""Ways of three axes; of a pair either."""
_SHOWN = {"r": "right", "l": "left", "f": "front", "u": "up", "d": "down"}
_ORDERS = ("rfu", "frd", "flu")
_WORDED = {
    "right-front-up": "rfu",
    "right-forward-up": "rfu",
    "front-right-down": "frd",
    "forward-right-down": "frd",
    "front-left-up": "flu",
    "forward-left-up": "flu",
}
_UNITS = {
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
        names: in the record's x, y, z.
        unit: that the names tell, a key of `layout.GYRO_UNITS` or `ACCEL_UNITS`; "" if none.
        ways: where x, y and z point by the names, as "frd"; "" if they do not tell.
        increments: whether the names speak of increments.
    """

    names: tuple[str, str, str]
    unit: str
    ways: str
    increments: bool


class Clock(NamedTuple):
    """A column that may hold the time, and the unit that its name tells; "" if none."""

    name: str
    unit: str


def triads(names: Sequence[str], kind: str) -> list[Triad]:
    """The triads of ``"gyro"`` or ``"accel"`` among a file's columns, in the file's order."""
    grouped = _groups(names, kind).items()
    found = [_triad(stem, unit, columns) for (stem, unit), columns in grouped]
    return [triad for triad in found if triad is not None]


def incomplete(names: Sequence[str], kind: str) -> tuple[list[str], str] | None:
    """Two columns of ``"gyro"`` or ``"accel"``, and how the name of their third would end."""
    for (stem, _), columns in _groups(names, kind).items():
        ways = {_WAYS[axis]: name for axis, name in columns.items() if axis in _WAYS}
        named = dict(zip("xyz", ("roll", "pitch", "yaw"), strict=True)) if stem == _TURN else {}
        for of, axes in ((columns, ("x", "y", "z")), (columns, ("1", "2", "3")), (ways, _THREE)):
            lacking = [axis for axis in axes if not any(way in of for way in axis)]
            if len(of) == 2 and len(lacking) == 1:
                shown = " or ".join(_SHOWN.get(way, named.get(way, way)) for way in lacking[0])
                return list(of.values()), shown
    return None


def _groups(names: Sequence[str], kind: str) -> dict[tuple[str, str], dict[str, str]]:
    """Columns by axis, of each stem and unit of ``"gyro"`` or ``"accel"``."""
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for name in names:
        split = _split(name, kind)
        if split is None:
            continue
        stem, axis, unit = split
        if _is_of(kind, stem) and not _NOT.search(stem):
            groups.setdefault((stem, unit), {})[axis] = name
    return groups


def clocks(names: Sequence[str]) -> list[Clock]:
    """The columns whose names speak of time, in the file's order."""
    found = []
    for name in names:
        bare, unit = _without_unit(name, "time")
        if any(_TIME.search(part) for part in (bare, *bare.split("_"))):
            found.append(Clock(name, unit or ("s" if re.search(r"sec|tow|sow", bare) else "")))
    return found


def told_axes(texts: Iterable[str]) -> str:
    """The axes that comments or names speak of, one of `layout.NAMED_AXES`; "" if none or many."""
    found = set()
    for text in texts:
        lower = re.sub(r"[\s/,_-]+", "-", text.lower())
        found |= {order for words, order in _WORDED.items() if words in lower}
        found |= set(_ORDERS) & set(re.split(r"[^a-z]+", lower))
    return found.pop() if len(found) == 1 else ""


def is_counter(name: str) -> bool:
    """Whether a column counts samples."""
    words = set(_words(name).split("_"))
    return bool(words & {"index", "idx", "count", "counter", "sample", "seq", "n", "no", "packet"})


def _is_of(kind: str, stem: str) -> bool:
    """Whether the words of a name before its axis are those of gyros or accelerometers."""
    other = "accel" if kind == "gyro" else "gyro"
    if _WORDS_OF[kind].search(stem):
        return not (kind == "accel" and _WORDS_OF[other].search(stem))
    return stem.rpartition("_")[2] in _LETTERS_OF[kind] and not _WORDS_OF[other].search(stem)


def _words(name: str) -> str:
    """A name in lower case, its words joined by underscores."""
    apart = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.strip())
    return re.sub(r"[^a-z0-9/°^²*µμ\"]+", "_", apart.lower()).strip("_")


def _without_unit(name: str, kind: str) -> tuple[str, str]:
    """The words of a name without its unit, and the unit; "" if it tells none."""
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", name)
    if bracket and (unit := _unit(bracket[1], kind)):
        return _words(name[: bracket.start()]), unit
    parts = _words(name).split("_")
    for count in (3, 2, 1):
        if len(parts) > count and (unit := _unit("_".join(parts[-count:]), kind)):
            return "_".join(parts[:-count]), unit
    return "_".join(parts), ""


def _unit(text: str, kind: str) -> str:
    bare = text.lower().replace(" ", "")
    return next((unit for unit, forms in _UNITS[kind].items() if bare in forms), "")


def _split(name: str, kind: str) -> tuple[str, str, str] | None:
    """What comes before the axis in a name, the axis, and the unit; None without an axis."""
    for bare, unit in (_without_unit(name, kind), (_words(name), "")):
        turn = re.sub(r"_?(rate|vel(ocity)?)$", "", bare)
        if kind == "gyro" and turn in _TURNS and (len(turn) == 1) == (turn == bare):
            return _TURN, _TURNS[turn], unit
        *stem, last = bare.split("_")
        if stem and (last in _AXES or last in _WAYS):
            return "_".join(stem), last, unit
        if match := re.fullmatch(r"(.*[a-z])([xyz123])", last):
            return "_".join([*stem, match[1]]), match[2], unit
        if len(stem) > 1 and (stem[-1] in _AXES or stem[-1] in _WAYS):  # as in acc_x_raw
            return "_".join([*stem[:-1], last]), stem[-1], unit
    return None


def _triad(stem: str, unit: str, columns: dict[str, str]) -> Triad | None:
    """The triad of columns by axis; None where one is missing."""
    increments = bool(re.search(r"delta|^d_?(v|theta|ang)|_d(v|theta)", stem))
    ways = {_WAYS[axis]: name for axis, name in columns.items() if axis in _WAYS}
    for order in _ORDERS:
        if set(ways) == set(order):
            x, y, z = (ways[way] for way in order)
            return Triad((x, y, z), unit, order, increments)
    letters = {letter: columns[letter] for letter in "xyz123" if letter in columns}
    for axes in ("xyz", "123"):
        if set(axes) <= set(letters):
            x, y, z = (letters[axis] for axis in axes)
            return Triad((x, y, z), unit, told_axes([stem]), increments)
    return None
