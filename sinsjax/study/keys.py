"""The keys of a study: the section of each, its meaning, its marks, and where it may stand."""

from collections.abc import Iterable
from functools import cache
from typing import Any

from sinsjax.alignment.description import INITIAL_KEYS
from sinsjax.alignment.methods import (
    BROKEN,
    METHODS,
    PACKAGES,
    SECTIONS_OF_METHODS,
    from_package,
)
from sinsjax.alignment.sections import AlignmentSection, CoarseSection, PassesSection
from sinsjax.messages import near
from sinsjax.study.distributions import StopWhenSection
from sinsjax.study.ranges import TuneSection
from sinsjax.study.recorded import RecordSection
from sinsjax.study.schema import (
    EarthSection,
    MotionSection,
    SensorsSection,
    StudySection,
)
from sinsjax.value_types import Marks, Section, mark

_BEFORE: dict[str, type[Section]] = {
    "study": StudySection,
    "earth": EarthSection,
    "motion": MotionSection,
    "sensors": SensorsSection,
    "alignment": AlignmentSection,
}
_AFTER: dict[str, type[Section]] = {
    "passes": PassesSection,
    "record": RecordSection,
    "coarse": CoarseSection,
    "stop_when": StopWhenSection,
    "tune": TuneSection,
}


def _of_all() -> dict[str, type[Section]]:
    """Those of every study about those of methods.

    A method of another package cannot be used with a section, or a key, that every study has, nor
    if it reads keys that there are not.
    """
    common = _BEFORE | _AFTER
    taken = {key: name for name, section in common.items() for key in section.model_fields}
    for name, section in list(SECTIONS_OF_METHODS.items()):
        keys = sorted(section.model_fields.keys() & taken.keys())
        if name not in common and not keys:
            continue
        why = f"[{name}] is a section of every study"
        if name not in common:
            why = f"[{name}] {keys[0]} is a key of [{taken[keys[0]]}]"
        for method in [one.name for one in METHODS.values() if name in one.sections]:
            _refuse(method, why)
    sections: list[type[Section]] = [AlignmentSection, PassesSection, *SECTIONS_OF_METHODS.values()]
    known = {key for section in sections for key in section.model_fields}
    for one in [*METHODS.values()]:
        if strange := sorted({*one.reads} - known):
            hint = near(strange[0], sorted(known))
            why = f"reads: {strange[0]!r} is no key of [alignment] or [passes]{hint}"
            _refuse(one.name, why)
    return _BEFORE | SECTIONS_OF_METHODS | _AFTER


def _refuse(method: str, why: str) -> None:
    """Take a method of another package out, with the sections that no other one has."""
    BROKEN[method] = f"{from_package(method)}: {why}"
    del METHODS[method]
    PACKAGES.pop(method, None)
    left = {name for one in METHODS.values() for name in one.sections}
    for name in SECTIONS_OF_METHODS.keys() - left:
        del SECTIONS_OF_METHODS[name]


SECTIONS = _of_all()
"""Every section of leaf keys by its name in the file."""

TUNABLE = ("alignment", *SECTIONS_OF_METHODS, "passes")
"""The sections whose keys may be tuned."""

SWEEPABLE = ("earth", "motion", "sensors", "coarse", *TUNABLE)
"""The sections whose keys may be axes."""

SIMULATED_ONLY = ("motion", "sensors", "stop_when")
"""The sections that have no place in a recorded study."""

SECTION_OF = {key: name for name, model in SECTIONS.items() for key in model.model_fields} | {
    key: "sensors" for key in SensorsSection.model_fields
}
"""The section of every leaf key; two of [record]'s, on what sensors may do, are [sensors]'s too."""

EARTH_CONSTANTS = {
    "gravity_m_per_s2": 9.8,
    "radius_m": 6378137.0,
    "earth_rate_deg_per_h": 15.041067,
}
"""The keys of [earth] that only ``earth = "constants"`` has, with their defaults."""

PASS_KEYS = ("stored_s", "passes", "ending", "direction")
"""The keys that decide which sample of the stored record an update reads, and how many."""

RENAMED = {"tape_s": "stored_s"}
"""New names of keys that older studies have."""

COARSE_KEYS = tuple(CoarseSection.model_fields)
"""The keys of coarse alignment."""

TomlTable = dict[str, Any]


def unknown(key: str, known: Iterable[str]) -> str:
    """What is wrong with a key that is none: its new name, or a hint at the closest known one."""
    if key in RENAMED:
        return f"was renamed to {RENAMED[key]}"
    return f"unknown key{near(key, known)}"


def meaning(key: str) -> str:
    """What a key says, in the words of its section; ``case`` is the label of a case."""
    if key not in SECTION_OF:
        return "label of the case"
    return SECTIONS[SECTION_OF[key]].model_fields[key].description or ""


@cache
def marked(key: str, kind: type[Marks]) -> Marks | None:
    """The mark of some kind beside a leaf key's type, see `value_types`; None without one."""
    return mark(SECTIONS[SECTION_OF[key]].model_fields[key], kind)


def rivals(key: str) -> set[str]:
    """The keys that say in another way what a key says."""
    pairs = SECTIONS[SECTION_OF[key]].exclusive if key in SECTION_OF else ()
    return {other for pair in pairs if key in pair for other in pair} - {key}


def is_given(key: str) -> bool:
    """Whether a key says what a run is faced with: site, motion, sensors, initial errors."""
    return key in INITIAL_KEYS or SECTION_OF.get(key) in ("earth", "motion", "sensors")


def is_chosen(key: str) -> bool:
    """Whether a user chooses the values of a key, so that one can be best."""
    return SECTION_OF.get(key) in SECTIONS_OF_METHODS
