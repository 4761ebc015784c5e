"""The keys of a study: `KEYS` has one object per key, with all its metadata.

The key table, the JSON schema, the messages and the rules read it.
"""

import re
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, Literal, NamedTuple, get_args, get_origin

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from sinsjax import gone
from sinsjax.messages import suggest_closest
from sinsjax.methods.method import INITIAL_KEYS
from sinsjax.methods.plugins import exclude_clashing
from sinsjax.methods.registry import METHODS, REGISTRY, SECTIONS_OF_METHODS, external_names
from sinsjax.study.alignment import AlignmentSection, CoarseSection, PassesSection
from sinsjax.study.schema import (
    AdviseSection,
    Distribution,
    DrawnSection,
    EarthSection,
    MotionSection,
    Range,
    RecordSection,
    SensorsSection,
    StopWhenSection,
    StudySection,
    TuneSection,
)
from sinsjax.units import split_unit
from sinsjax.value_types import KeyCondition, KeyInfo, Section, key_info

_SECTIONS_BEFORE: dict[str, type[Section]] = {
    "study": StudySection,
    "earth": EarthSection,
    "motion": MotionSection,
    "sensors": SensorsSection,
    "alignment": AlignmentSection,
}
_SECTIONS_AFTER: dict[str, type[Section]] = {
    "passes": PassesSection,
    "record": RecordSection,
    "coarse": CoarseSection,
    "stop_when": StopWhenSection,
    "tune": TuneSection,
}

_TABLES_OF_SWEEPS = dict.fromkeys(("axes", "cases", "drawn"), Section)
exclude_clashing(REGISTRY, _SECTIONS_BEFORE | _SECTIONS_AFTER | _TABLES_OF_SWEEPS)

SECTIONS = _SECTIONS_BEFORE | SECTIONS_OF_METHODS | _SECTIONS_AFTER
"""Sections of leaf keys by their name in the file."""

TUNABLE = ("alignment", *SECTIONS_OF_METHODS, "passes")
"""Sections whose keys may be tuned."""

SWEEPABLE = ("earth", "motion", "sensors", "coarse", *TUNABLE)
"""Sections whose keys may be swept."""

SIMULATED_ONLY = ("motion", "sensors", "stop_when")
"""Sections that a recorded study cannot have."""

SECTION_OF = {key: name for name, model in SECTIONS.items() for key in model.model_fields} | {
    key: "sensors" for key in SensorsSection.model_fields
}
"""Section of each leaf key; of the bias keys that [record] has too, it is [sensors]."""

EARTH_CONSTANTS = {
    "gravity_m_per_s2": 9.8,
    "radius_m": 6378137.0,
    "earth_rate_deg_per_h": 15.041067,
}
"""Keys of [earth] that only ``earth = "constants"`` has, with their defaults."""

PASS_KEYS = ("stored_s", "passes", "ending", "direction")
"""Keys that determine the number of updates and the sample of the stored record that each reads."""

COARSE_KEYS = tuple(CoarseSection.model_fields)
"""Keys of coarse alignment."""

TomlTable = dict[str, Any]


TABLES: dict[str, type[Section]] = {
    **SECTIONS,
    "drawn": DrawnSection,
    "drawn.KEY": Distribution,
    "tune.variables.KEY": Range,
    "advise": AdviseSection,
}
"""Tables of a study file that have keys."""

_DEFAULT_TEXT = re.compile(r"[;,] default:? (?P<default>[^;()]+)$")


class Key(NamedTuple):
    """A key of a study file.

    Attributes:
        section: table that it belongs to.
        name: leaf key.
        unit: unit of its numbers; empty without one.
        default: value as a file writes it, a description, or ``required``; empty without a default.
        meaning: description without unit and default, with the words that the key accepts.
        info: usual range, and dependence of the default on other keys.
        methods: methods that read it.
        depends_on: keys whose values decide whether it has an effect.
    """

    section: str
    name: str
    unit: str
    default: str
    meaning: str
    info: KeyInfo
    methods: tuple[str, ...]
    depends_on: tuple[str, ...]

    @property
    def readers_text(self) -> str:
        """The methods that read it, as text."""
        left_out = {*self.methods, *external_names(METHODS)}
        others = [name for name in METHODS if name not in left_out]
        if len(others) < len(self.methods):
            return f"all but {', '.join(others)}" if others else "all"
        return ", ".join(self.methods)


def unknown_key_error(key: str, known: Iterable[str]) -> str:
    """Return the error text of a key that is gone, or of an unknown one with the closest key."""
    for place, text in gone.KEYS.items():
        if place.partition(".")[2] == key:
            return gone.LINE.format(text)
    return f"unknown key{suggest_closest(key, known)}"


def leaf_info(key: str) -> KeyInfo:
    """Return the usual range and default of a leaf key."""
    return KEYS[SECTION_OF[key], key].info


def key_meaning(key: str) -> str:
    """Return the description of a leaf key in its section."""
    if key not in SECTION_OF:
        return "label of the case"
    return SECTIONS[SECTION_OF[key]].model_fields[key].description or ""


def key_summary(section: str, key: str) -> str:
    """Return the first sentence of a key's description, as a hint in messages."""
    description = SECTIONS[section].model_fields[key].description or ""
    return _split_default(description)[0].partition(". ")[0]


def alternative_keys(key: str) -> set[str]:
    """Return the keys that are alternatives to a key."""
    pairs = SECTIONS[SECTION_OF[key]].exclusive if key in SECTION_OF else ()
    return {other for pair in pairs if key in pair for other in pair} - {key}


def is_condition_key(key: str) -> bool:
    """Whether a key describes the conditions of a run: site, motion, sensors, initial errors."""
    return key in INITIAL_KEYS or SECTION_OF.get(key) in ("earth", "motion", "sensors")


def is_method_setting(key: str) -> bool:
    """Return whether a key is a setting of a method, which a user may choose."""
    return SECTION_OF.get(key) in SECTIONS_OF_METHODS


@cache
def effect_conditions(key: str) -> tuple[KeyCondition, ...]:
    """Return the conditions under which a key has an effect."""
    section = SECTIONS[SECTION_OF[key]]
    return tuple(condition for condition in section.conditions if key in condition.keys)


@cache
def deciding_keys(key: str) -> tuple[str, ...]:
    """Return the keys whose values decide whether a key has an effect."""
    conditional = (given for condition in effect_conditions(key) for given in condition.given)
    everywhere = len(reading_methods(key)) == len(METHODS)
    return tuple(dict.fromkeys([*([] if everywhere else ["method"]), *conditional]))


def reading_methods(key: str) -> tuple[str, ...]:
    """Return the methods on which a key has an effect: those that read it, or all if none does."""
    methods = METHODS.values()
    is_read = any(key in method.keys for method in methods)
    return tuple(
        m.name for m in methods if (key in m.keys or not is_read) and key not in m.idle_keys
    )


def has_effect(key: str, values: Mapping[str, Any]) -> bool:
    """Return whether a key has an effect on a run.

    Args:
        key: leaf key.
        values: values of the keys that `deciding_keys` lists; None for a drawn key.
    """
    if "method" in deciding_keys(key) and values["method"] not in reading_methods(key):
        return False
    return all(c.acts(*(values[given] for given in c.given)) for c in effect_conditions(key))


def accepted_words(annotation: Any) -> tuple[str, ...]:
    """Return the words that a key accepts; empty for a key of numbers or of free text."""
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    return next(filter(None, map(accepted_words, get_args(annotation))), ())


def _build_key(section: str, name: str, field: FieldInfo) -> Key:
    text, default_text = _split_default(field.description or "")
    unit, words = split_unit(name)[1], accepted_words(field.annotation)
    text = _drop_unit(text, unit)
    choices = ", ".join(map(format_toml, words))
    is_leaf = SECTION_OF.get(name) == section
    is_required = default_text.startswith("required")  # its own default is never used
    return Key(
        section,
        name,
        unit,
        default_text if is_required else _format_default(name, field) or default_text,
        f"{text} ({choices})" if choices and not _names_all(text, words) else text,
        key_info(field),
        reading_methods(name) if is_leaf else tuple(METHODS),
        deciding_keys(name) if is_leaf else (),
    )


def _drop_unit(text: str, unit: str) -> str:
    """Return a description without the unit, which `Key.unit` gives."""
    return re.sub(rf", {re.escape(unit)}(?=[.;:,]|$)", "", text, count=1) if unit else text


def _names_all(text: str, words: Iterable[str]) -> bool:
    """Return whether a description explains each word that the key accepts."""
    return all(f"'{word}'" in text for word in words)


def _split_default(description: str) -> tuple[str, str]:
    """Split a description into its text and the default at its end."""
    match = _DEFAULT_TEXT.search(description)
    return (description[: match.start()], match["default"]) if match else (description, "")


def _format_default(name: str, field: FieldInfo) -> str:
    """Return the default of a key as a file writes it; empty if it is not a fixed value."""
    if (default := key_info(field).default) is not None:
        return format_toml(default)
    if name in EARTH_CONSTANTS:
        return format_toml(EARTH_CONSTANTS[name])
    if field.default_factory is not None or field.default in (None, PydanticUndefined):
        required = field.is_required() and not _split_default(field.description or "")[1]
        return "required" if required else ""
    return format_toml(field.default)


def format_toml(value: Any) -> str:
    """Return a value as a study file writes it."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(format_toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return ""
    return f'"{value}"' if isinstance(value, str) else f"{value:.12g}"


KEYS: dict[tuple[str, str], Key] = {
    (section, name): _build_key(section, name, field)
    for section, model in TABLES.items()
    for name, field in model.model_fields.items()
}
"""Keys of a study file by table and name."""
