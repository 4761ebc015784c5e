"""What the names of columns say: sensor, axis or direction, sign, and unit.

Names are compared in lower case, word by word: ``GyroX [deg/s]`` is gyro, x and deg/s. What they do
not say is asked, see `sinsjax.records.propose`.
"""

import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

_SENSORS = {
    "gyro": re.compile(
        r"gyr|omega|ang(ular)?_?(vel|rate)|rot(ation)?_?rate|d_?theta|delta_?(angle|theta)|d_?ang"
    ),
    "accel": re.compile(r"acc|force|d_?vel|delta_?v|(^|_)d_?v(_|$)"),
}
_LETTERS = {"gyro": r"(^|_)(w|g|om|rate)($|_)", "accel": r"(^|_)(a|f)($|_)"}
_OTHERS = re.compile(r"cov|accuracy|bias|std|sigma|temp|mag|var$|status|valid")
_INCREMENTS = re.compile(r"delta|^d_?(v|theta|ang)|_d(v|theta)|incr")
_NAVIGATION = re.compile(
    r"(^|_)(ned|enu|nwu|nav|navigation|world|earth|global|ecef|level(l?ed)?)(_|$)"
)
_MINUS = {"neg", "negative", "minus"}
_DIRECTIONS = {
    "right": (0, 1.0), "rgt": (0, 1.0), "r": (0, 1.0), "left": (0, -1.0), "lft": (0, -1.0),
    "l": (0, -1.0), "front": (1, 1.0), "forward": (1, 1.0), "fwd": (1, 1.0), "frt": (1, 1.0),
    "f": (1, 1.0), "back": (1, -1.0), "rear": (1, -1.0), "aft": (1, -1.0), "up": (2, 1.0),
    "u": (2, 1.0), "down": (2, -1.0), "dn": (2, -1.0), "dwn": (2, -1.0), "d": (2, -1.0),
}  # fmt: skip
"""Body axis, right, front or up, and sign of a direction."""
_TURNS = {"pitch": 0, "roll": 1, "yaw": 2}
_ORDERS = {
    "right-front-up": "rfu", "right-forward-up": "rfu", "front-right-down": "frd",
    "forward-right-down": "frd", "front-left-up": "flu", "forward-left-up": "flu",
}  # fmt: skip
_SPELLINGS = {
    "gyro": {
        ("rad_per_s", 1.0): "rad/s rads rad_s rps x8005",
        ("rad_per_s", 1e-3): "mrad/s mrads mrad_s",
        ("deg_per_s", 1.0): "deg/s degs deg_s dps",
        ("deg_per_s", 1e-3): "mdeg/s mdegs mdeg_s mdps",
        ("deg_per_h", 1.0): "deg/h deg_h dph",
        ("rad", 1.0): "rad x8007",
        ("rad", 1e-3): "mrad",
        ("rad", 1e-6): "urad",
        ("deg", 1.0): "deg",
        ("arcsec", 1.0): "arcsec as",
    },
    "accel": {
        ("m_per_s2", 1.0): "m/s2 mps2 ms2 m_s2 mss",
        ("m_per_s2", 1e-2): "cm/s2 cm_s2 gal",
        ("m_per_s2", 1e-3): "mm/s2 mm_s2",
        ("g", 1.0): "g gs x8004",
        ("mg", 1.0): "mg",
        ("ug", 1.0): "ug",
        ("m_per_s", 1.0): "m/s mps m_s",
        ("g_s", 1.0): "g_s g.s x8008",
        ("ug_s", 1.0): "ug_s ugs",
    },
}
"""Spellings of units and their multiples, as `_spell` returns them; x8004 is MicroStrain's code."""

Unit = tuple[str, float]
"""A unit of `layout.GYRO_UNITS` or `ACCEL_UNITS`, "" for none, and a multiplier."""

NO_UNIT: Unit = ("", 1.0)


class Triad(NamedTuple):
    """Three columns of one sensor, and what their names or a row of units state."""

    names: tuple[str, ...]  # in the order x, y, z, or right, front, up if they are directions
    unit: Unit
    signs: tuple[float, ...]
    has_directions: bool = False  # as pitch, roll and yaw are of gyros
    are_increments: bool = False
    in_navigation_frame: bool = False


class _Name(NamedTuple):
    """The parts of a name: other words, axis, unit, and sign."""

    stem: str
    axis: str
    unit: Unit
    sign: float


def find_triads(
    names: Iterable[str], sensor: str, units: Mapping[str, str] | None = None
) -> list[Triad]:
    """Return the triads of ``"gyro"`` or ``"accel"`` among a file's columns, in its order.

    Args:
        names: of the columns.
        sensor: of the triads.
        units: in words by name, from a row of units.
    """
    groups: dict[tuple[str, Unit], dict[str, tuple[str, float]]] = {}
    for name in names:
        parts = _parse_name(name, sensor)
        if parts is None or _OTHERS.search(parts.stem):
            continue
        unit = parse_unit((units or {}).get(name, ""), sensor) or parts.unit
        if _is_of_sensor(parts._replace(unit=unit), sensor):
            groups.setdefault((parts.stem, unit), {}).setdefault(parts.axis, (name, parts.sign))
    triads = (_make_triad(stem, unit, columns) for (stem, unit), columns in groups.items())
    return [triad for triad in triads if triad is not None]


def find_named_order(texts: Iterable[str]) -> str:
    """Return the axes that texts name, one of `layout.NAMED_AXES`; "" if none or several."""
    orders = set()
    for text in texts:
        lower = re.sub(r"[\s/,_-]+", "-", text.lower())
        orders |= {order for words, order in _ORDERS.items() if words in lower}
        orders |= {"rfu", "frd", "flu"} & set(re.split(r"[^a-z]+", lower))
    return orders.pop() if len(orders) == 1 else ""


def parse_unit(text: str, sensor: str) -> Unit | None:
    """Return the unit of a ``"gyro"`` or ``"accel"`` that a text spells, or None."""
    spelling = _spell(text)
    found = (unit for unit, forms in _SPELLINGS[sensor].items() if spelling in forms.split())
    return next(found, None)


def _spell(text: str) -> str:
    """Return a unit in one spelling: rad/s for rad s^-1, RAD/SEC or rad_per_sec."""
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
    return text


def _is_of_sensor(name: _Name, sensor: str) -> bool:
    """Return whether the words of a name without its axis denote the sensor."""
    other = "accel" if sensor == "gyro" else "gyro"
    if name.axis in _TURNS:  # without the word or the unit of a rate these are an attitude
        is_rate = re.fullmatch(r"rates?|gyro(_rate)?|ang(ular)?_rate", name.stem) is not None
        return sensor == "gyro" and (is_rate or not name.stem and "_per_" in name.unit[0])
    if _SENSORS[sensor].search(name.stem):
        return sensor == "gyro" or not _SENSORS[other].search(name.stem)
    if _SENSORS[other].search(name.stem):
        return False
    return re.search(_LETTERS[sensor], name.stem) is not None


def _words(name: str) -> list[str]:
    separated = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.strip())
    return [w for w in re.split(r"[^a-z0-9/°^²*µμ]+", separated.lower()) if w]


def _parse_name(name: str, sensor: str) -> _Name | None:
    """Return the parts of a name; None without an axis."""
    sign = -1.0 if name.strip().startswith("-") else 1.0
    unit, text = NO_UNIT, name
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", name)
    if bracket and (found := parse_unit(bracket[1], sensor)):
        unit, text = found, name[: bracket.start()]
    words = _words(text)
    if _MINUS & {*words}:
        sign, words = -sign, [word for word in words if word not in _MINUS]
    words, unit = _split_unit(words, unit, sensor)
    if (split := _split_axis(words)) is None:
        return None
    stem, unit = _split_unit(split[0], unit, sensor)  # before the axis, as in gyro_rad[0]
    return _Name("_".join(stem), split[1], unit, sign)


def _split_unit(words: list[str], known: Unit, sensor: str) -> tuple[list[str], Unit]:
    """Return the words without a unit at their end, and that unit unless one is known."""
    for count in (3, 2, 1):
        if len(words) > count and (unit := parse_unit("_".join(words[-count:]), sensor)):
            return (words, known) if known[0] else (words[:-count], unit)
    return words, known


def _split_axis(words: list[str]) -> tuple[list[str], str] | None:
    """Return the words of a name without its axis, and the axis; None without one."""
    if turns := [word for word in words if word in _TURNS]:
        return [word for word in words if word != turns[0]], turns[0]
    last = len(words) - 1
    for place in (last, 0, last - 1) if last > 0 else ():  # also as in X Accel and acc_x_raw
        word = words[place]
        # Away from the end a single letter may be anything but x, y, z or a digit.
        is_direction = word in _DIRECTIONS and (place == last or len(word) > 1)
        if is_direction or word in {*"xyz0123"}:
            return [*words[:place], *words[place + 1 :]], word
    if words and (match := re.fullmatch(r"(.*[a-z])([xyz0-3])", words[-1])):
        return [*words[:-1], match[1]], match[2]
    return None


def _make_triad(stem: str, unit: Unit, columns: Mapping[str, tuple[str, float]]) -> Triad | None:
    """Return the triad of columns by axis; None if one is missing."""
    turns = {_TURNS[axis]: column for axis, column in columns.items() if axis in _TURNS}
    ways = {_DIRECTIONS[a]: column for a, column in columns.items() if a in _DIRECTIONS}
    signed = {axis: (name, sign * way) for (axis, way), (name, sign) in ways.items()}
    by_body = turns if len(turns) == 3 else signed if len(signed) == 3 == len(ways) else {}
    letters = next((axes for axes in ("xyz", "012", "123") if {*axes} <= {*columns}), "")
    found = [by_body[axis] for axis in range(3)] if by_body else [columns[a] for a in letters]
    if not found:
        return None
    (x, sx), (y, sy), (z, sz) = found
    increments, navigation = bool(_INCREMENTS.search(stem)), bool(_NAVIGATION.search(stem))
    return Triad((x, y, z), unit, (sx, sy, sz), bool(by_body), increments, navigation)
