"""What the names of columns say: sensor, axis, unit, and the directions of axes.

Names are compared in lower case, word by word: ``GyroX [deg/s]`` is gyro, x and deg/s. What they do
not say is asked, see `sinsjax.records.propose`.
"""

import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

_SENSORS = (
    ("gyro", r"gyr|omega|ang(ular)?_?(vel|rate)|rot(ation)?_?rate|(d|delta)_?(theta|ang)"),
    ("accel", r"acc|force|d_?vel|delta_?v|(^|_)d_?v(_|$)"),
    ("gyro", r"(^|_)(w|g|om|rate)($|_)"),
    ("accel", r"(^|_)(a|f)($|_)"),
)
"""Patterns of the words for a sensor; the first one that fits counts."""
_OTHERS = re.compile(
    r"cov|accuracy|bias|std|sigma|temp|mag|var$|status|valid"
    r"|(^|_)(ned|enu|nwu|nav|navigation|world|earth|global|ecef|level(l?ed)?)(_|$)"
)
"""Words for columns that are no sensors in their own axes."""
_INCREMENTS = re.compile(r"delta|^d_?(v|theta|ang)|_d(v|theta)|incr")
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
    """Return the triads of ``"gyro"`` or ``"accel"`` among a file's columns, in its order.

    Args:
        names: of the columns.
        sensor: of the triads.
        units: in words by name, from a row of units.
    """
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for name in names:
        stem, axis, unit = _parse_name(name, sensor, units.get(name, ""))
        kinds = (kind for kind, words in _SENSORS if re.search(words, stem))
        if axis and not _OTHERS.search(stem) and next(kinds, "") == sensor:
            groups.setdefault((stem, unit), {}).setdefault(axis, name)
    return [
        Triad(tuple(columns[axis] for axis in axes), unit, bool(_INCREMENTS.search(stem)))
        for (stem, unit), columns in groups.items()
        if (axes := next((axes for axes in ("xyz", "012", "123") if {*axes} <= {*columns}), ""))
    ]


def _parse_name(name: str, sensor: str, stated_unit: str) -> _Name:
    """Return the parts of a name, whose axis is "" if it has none."""
    unit, axis = parse_unit(stated_unit, sensor), ""
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", name)
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
