"""The keys of a study: `KEYS` has one object per key, which the rules, messages and pages read."""

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, Literal, NamedTuple, get_args, get_origin

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from sinsjax import gone
from sinsjax.errors import InputError
from sinsjax.messages import suggest_closest
from sinsjax.methods.method import INITIAL_KEYS
from sinsjax.methods.registry import (
    BROKEN,
    METHODS,
    PACKAGES,
    SECTIONS_OF_METHODS,
    drop_clashing_plugins,
    external_names,
)
from sinsjax.study import alignment, schema
from sinsjax.units import split_unit
from sinsjax.value_types import KeyCondition, KeyInfo, Section, key_info

_SECTIONS_BEFORE: dict[str, type[Section]] = {
    "study": schema.StudySection,
    "earth": schema.EarthSection,
    "motion": schema.MotionSection,
    "sensors": schema.SensorsSection,
    "alignment": alignment.AlignmentSection,
}
_SECTIONS_AFTER: dict[str, type[Section]] = {
    "passes": alignment.PassesSection,
    "record": schema.RecordSection,
    "coarse": alignment.CoarseSection,
    "stop_when": schema.StopWhenSection,
    "tune": schema.TuneSection,
}
_TABLES_OF_SWEEPS = dict.fromkeys(("axes", "cases", "drawn"), Section)
drop_clashing_plugins(_SECTIONS_BEFORE | _SECTIONS_AFTER | _TABLES_OF_SWEEPS)

SECTIONS = _SECTIONS_BEFORE | SECTIONS_OF_METHODS | _SECTIONS_AFTER
"""Sections of leaf keys by their name in the file."""

TUNABLE = ("alignment", *SECTIONS_OF_METHODS, "passes")
"""Sections whose keys may be tuned."""

SWEEPABLE = ("earth", "motion", "sensors", "coarse", *TUNABLE)
"""Sections whose keys may be swept."""

SIMULATED_ONLY = ("motion", "sensors", "stop_when")
"""Sections that a recorded study cannot have."""

SECTION_OF = {key: name for name, model in SECTIONS.items() for key in model.model_fields} | {
    key: "sensors" for key in schema.SensorsSection.model_fields
}
"""Section of each leaf key; of the bias keys that [record] has too, it is [sensors]."""

PASS_KEYS = ("stored_s", "passes", "ending")
"""Keys that determine the number of updates and the sample of the stored record that each reads."""

COARSE_KEYS = tuple(alignment.CoarseSection.model_fields)
"""Keys of coarse alignment."""

TABLES: dict[str, type[Section]] = {
    **SECTIONS,
    "drawn": schema.DrawnSection,
    "drawn.KEY": schema.Distribution,
    "tune.variables.KEY": schema.Range,
    "advise": schema.AdviseSection,
}
"""Tables of a study file that have keys."""

TomlTable = dict[str, Any]

VARYING = (
    "`[axes] KEY = [...]` sweeps a key, `[axes.NAME]` several together, `[[cases]]`"
    " lists values and a label (`case`) per case"
)
"""How a file varies keys, as a sentence."""


class Key(NamedTuple):
    """A key of a study file.

    Attributes:
        section: table that it belongs to.
        name: leaf key.
        unit: unit of its numbers; empty without one.
        default: value as a file writes it, a description, or ``required``; empty without a default.
        meaning: description, with the words that the key accepts.
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
    """Return the meaning of a leaf key, or of the label of cases."""
    return KEYS[SECTION_OF[key], key].meaning if key in SECTION_OF else "label of the case"


def key_summary(section: str, key: str) -> str:
    """Return the first sentence of a key's description with its unit, as a hint in messages."""
    entry = KEYS[section, key]
    return ", ".join(filter(None, (entry.meaning.partition(". ")[0], entry.unit)))


def alternative_keys(key: str) -> set[str]:
    """Return the keys that are alternatives to a key."""
    pairs = SECTIONS[SECTION_OF[key]].exclusive if key in SECTION_OF else ()
    return {other for pair in pairs if key in pair for other in pair} - {key}


def is_condition_key(key: str) -> bool:
    """Whether a key describes the conditions of a run: site, motion, sensors, initial errors."""
    return key in INITIAL_KEYS or SECTION_OF.get(key) in ("earth", "motion", "sensors")


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
    text, words = field.description or "", accepted_words(field.annotation)
    if not all(f"'{word}'" in text for word in words):
        text = f"{text} ({', '.join(map(format_toml, words))})"
    is_leaf = SECTION_OF.get(name) == section
    return Key(
        section,
        name,
        split_unit(name)[1],
        _format_default(field),
        text,
        key_info(field),
        reading_methods(name) if is_leaf else tuple(METHODS),
        deciding_keys(name) if is_leaf else (),
    )


def _format_default(field: FieldInfo) -> str:
    """Return the default of a key in its words, or as a file writes it; empty without one."""
    info = key_info(field)
    if isinstance(info.otherwise, str):
        return info.otherwise
    if info.in_simulation is not None:
        return f"{info.in_simulation} in a simulation"
    for value in (info.otherwise, info.default, info.same_as, field.default):
        if value not in (None, PydanticUndefined):
            return format_toml(value)
    return "required" if field.is_required() else ""


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


def find_keys(name: str | None = None) -> list[Key]:
    """Return all keys of a study, or those of a section, a method or a name.

    Args:
        name: section, key, ``section.key``, or a method for the keys of its sections; None for
            all keys; a section has those of its tables. Any other text finds the keys whose name
            contains it.

    Raises:
        InputError: nothing has this name.
    """
    if name in METHODS:
        sections = METHODS[name].sections
        return [key for key in KEYS.values() if key.section in sections and name in key.methods]
    if name in BROKEN:
        raise InputError(BROKEN[name])
    if name in ("axes", "cases"):
        raise InputError(f"[{name}]: has the keys of other sections ({VARYING})")
    if name is None:
        return [*KEYS.values()]
    names = {text: None for s, key in KEYS for text in (s, s.partition(".")[0], key, f"{s}.{key}")}
    found = [
        key
        for (section, leaf), key in KEYS.items()
        if name in (section, leaf, f"{section}.{leaf}") or section.startswith(f"{name}.")
    ] or [key for key in KEYS.values() if name and name in key.name]
    if not found:
        hint = suggest_closest(name, [*names, *METHODS]) or " (`sinsjax keys` lists all keys)"
        raise InputError(f"{name}: unknown section, key or method{hint}")
    return found


def describe_method(method_name: str | None) -> list[str]:
    """Return the description of a method in lines; empty for another name."""
    if method_name not in METHODS:
        return []
    method = METHODS[method_name]
    package, version = PACKAGES.get(method_name, ("", ""))
    sections = ", ".join(f"[{name}]" for name in method.sections) or "none"
    read = (key for key in (*INITIAL_KEYS, *method.reads) if key not in method.idle_keys)
    reads = ", ".join(read) or "nothing"
    return [
        f"{method_name}: {method.summary}",
        f"    source: {method.source}",
        *([f"    package: {package} {version}"] if package else []),
        f"    sections: {sections}; keys of [alignment] and [passes]: {reads}",
        *([f"    keys without effect: {', '.join(method.idle_keys)}"] if method.idle_keys else []),
    ]
