"""The keys of a study: `KEYS` has one object per key, which the rules, messages and pages read.

The end of the file says what a key means that a study, or one of its cases, leaves out.
"""

import json
from collections.abc import Collection, Iterable, Mapping
from difflib import get_close_matches
from functools import cache
from typing import Any, NamedTuple

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from sinsjax import messages
from sinsjax.errors import InputError
from sinsjax.messages import suggest_closest
from sinsjax.methods.method import INITIAL_KEYS
from sinsjax.methods.registry import (
    BROKEN,
    METHODS,
    PACKAGES,
    SECTIONS_OF_METHODS,
    external_names,
    move_clashing_plugins_to_broken,
    unread_keys,
)
from sinsjax.study import schema
from sinsjax.units import split_unit
from sinsjax.value_types import KeyCondition, KeyInfo, Section, key_info

_SECTIONS_BEFORE: dict[str, type[Section]] = {
    "study": schema.StudySection,
    "earth": schema.EarthSection,
    "motion": schema.MotionSection,
    "sensors": schema.SensorsSection,
    "alignment": schema.AlignmentSection,
}
_SECTIONS_AFTER: dict[str, type[Section]] = {
    "passes": schema.PassesSection,
    "record": schema.RecordSection,
    "coarse": schema.CoarseSection,
    "stop_when": schema.StopWhenSection,
    "tune": schema.TuneSection,
}
_SWEEPS = dict.fromkeys(("axes", "cases", "drawn"), Section)
move_clashing_plugins_to_broken(_SECTIONS_BEFORE | _SECTIONS_AFTER | _SWEEPS)

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

COARSE_KEYS = tuple(schema.CoarseSection.model_fields)
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
    """A key of a table in a study file."""

    section: str
    name: str
    unit: str
    default: str  # as a file writes it, a description, or "required"; empty without one
    meaning: str
    info: KeyInfo
    methods: tuple[str, ...]  # that read it
    depends_on: tuple[str, ...]  # keys whose values decide whether it has an effect

    @property
    def readers_text(self) -> str:
        """The methods that read it, as text."""
        left_out = {*self.methods, *external_names(METHODS)}
        others = [name for name in METHODS if name not in left_out]
        if len(others) < len(self.methods):
            return f"all but {', '.join(others)}" if others else "all"
        return ", ".join(self.methods)


def unknown_key_error(key: str, known: Iterable[str]) -> str:
    """Return the error text of a key that is gone, in the wrong section, or unknown."""
    for place, text in messages.GONE_KEYS.items():
        if place.partition(".")[2] == key:
            return messages.GONE_LINE.format(text)
    if key in SECTION_OF:
        return f"unknown key (it belongs in [{SECTION_OF[key]}])"
    for names in (known, SECTION_OF):
        for close in get_close_matches(str(key), list(names), n=1):
            section = f" in [{SECTION_OF[close]}]" if close in SECTION_OF else ""
            return f"unknown key (did you mean {close}{section}?)"
    return "unknown key"


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
    return tuple(c for c in SECTIONS[SECTION_OF[key]].conditions if key in c.keys)


@cache
def deciding_keys(key: str) -> tuple[str, ...]:
    """Return the keys whose values decide whether a key has an effect."""
    method = () if len(reading_methods(key)) == len(METHODS) else ("method",)
    return tuple(dict.fromkeys([*method, *(k for c in effect_conditions(key) for k in c.given)]))


def reading_methods(key: str) -> tuple[str, ...]:
    """Return the methods on which a key has an effect: those that read it, or all if none does."""
    methods = METHODS.values()
    readers = [method for method in methods if key in method.keys] or methods
    return tuple(method.name for method in readers if key not in method.idle_keys)


def has_effect(key: str, values: Mapping[str, Any]) -> bool:
    """Return whether a key has an effect, by the values of its `deciding_keys`; None if drawn."""
    if "method" in deciding_keys(key) and values["method"] not in reading_methods(key):
        return False
    return all(condition.acts_at([values]) for condition in effect_conditions(key))


def _build_key(section: str, name: str, field: FieldInfo) -> Key:
    is_leaf = SECTION_OF.get(name) == section
    methods = reading_methods(name) if is_leaf else tuple(METHODS)
    depends_on = deciding_keys(name) if is_leaf else ()
    unit, info = split_unit(name)[1], key_info(field)
    default, text = _format_default(field, info), field.description or ""
    return Key(section, name, unit, default, text, info, methods, depends_on)


def _format_default(field: FieldInfo, info: KeyInfo) -> str:
    """Return the default of a key in its words, or as a file writes it; empty without one."""
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
    if isinstance(value, bool | str):
        return json.dumps(value)
    return "" if isinstance(value, dict) else f"{value:.12g}"


KEYS: dict[tuple[str, str], Key] = {
    (section, name): _build_key(section, name, field)
    for section, model in TABLES.items()
    for name, field in model.model_fields.items()
}
"""Keys of a study file by table and name."""


def find_keys(name: str | None = None) -> list[Key]:
    """Return all keys, or those of a section with its tables, of a method, or of a name.

    Any other text finds the keys whose name contains it; an `InputError` if there is none.
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
    found = [
        key
        for (section, leaf), key in KEYS.items()
        if name in (section, section.partition(".")[0], leaf, f"{section}.{leaf}")
    ] or [key for key in KEYS.values() if name and name in key.name]
    if not found:
        hint = suggest_closest(name, [*SECTIONS, *SECTION_OF, *METHODS])
        hint = hint or " (`sinsjax keys` lists all keys)"
        raise InputError(f"{name}: unknown section, key or method{hint}")
    return found


def describe_method_if_known(method_name: str) -> list[str]:
    """Return the description of a method in lines; empty for another name."""
    if method_name not in METHODS:
        return []
    method, package = METHODS[method_name], " ".join(PACKAGES.get(method_name, ()))
    sections = ", ".join(f"[{name}]" for name in method.sections) or "none"
    read = [key for key in (*INITIAL_KEYS, *method.reads) if key not in method.idle_keys]
    facts = {
        "source": method.source,
        "package": package,
        "sections": f"{sections}; keys of [alignment] and [passes]: {', '.join(read) or 'nothing'}",
        "keys without effect": ", ".join(method.idle_keys),
    }
    lines = (f"    {fact}: {text}" for fact, text in facts.items() if text)
    return [f"{method_name}: {method.summary}", *lines]


class GivenKeys(NamedTuple):
    """The keys that a study gives, or one of its cases: sections by name, and values that vary."""

    tables: TomlTable
    varied: Mapping[str, Collection[Any]]

    @property
    def is_recorded(self) -> bool:
        """Return whether the sensor data are those of a record."""
        return "record" in self.tables

    def gives(self, key: str) -> bool:
        """Return whether a key is given, in its section or by what varies it."""
        return key in self.varied or key in self.tables.get(SECTION_OF[key], ())

    def words(self, key: str) -> set[Any]:
        """Return the values of a key of words, or the default of its field."""
        if key in self.varied:
            return {*self.varied[key]}
        default = SECTIONS[SECTION_OF[key]].model_fields[key].default
        value = self.tables.get(SECTION_OF[key], {}).get(key, default)
        return {value if isinstance(value, str) else default}  # others are refused later


_WHITE_NOISE = {white for white, _ in SECTIONS["sensors"].exclusive}


def _sample_time(given: GivenKeys) -> float | None:
    """Return the time between two samples, s; None until a valid rate is known."""
    rate_hz = given.tables.get("study", {}).get("rate_hz")
    known = isinstance(rate_hz, int | float) and 1e-12 <= rate_hz <= 1e12
    return 1 / rate_hz if known else None


def dependent_default(key: str, given: GivenKeys) -> Any:
    """Return the default of a key that its field does not have; None if it has none.

    A key has no default beside an alternative to it. Some have none either where others give them.
    """
    info, others = leaf_info(key), alternative_keys(key)
    if info.beside or key in ("feedback_interval_s", *_WHITE_NOISE):
        others = {key, *others}
    if any(map(given.gives, others)):
        return None
    if info.in_simulation is not None:
        return None if given.is_recorded else info.in_simulation
    if key == "feedback_interval_s":
        return _sample_time(given)
    if key in _WHITE_NOISE:
        return 0.0
    applies = info.beside is None or given.words(info.beside) - {None, "none"}
    return info.default if applies else None


def values_of_omitted_keys(given: GivenKeys) -> dict[str, TomlTable]:
    """Return the values of the keys that a study leaves out, by the sections that it has.

    Keys that only other methods read, or other models of the Earth, stay without a value.
    """
    tables, varied_sections = given.tables, {SECTION_OF.get(key) for key in given.varied}
    unread = unread_keys(given.words("method") & METHODS.keys())
    if "constants" not in given.words("earth"):
        unread |= schema.EARTH_CONSTANTS.keys()
    absent = SIMULATED_ONLY if given.is_recorded else ("record",)
    optional = {"passes", "stop_when", "tune"} | (set() if given.is_recorded else {"coarse"})
    found: dict[str, TomlTable] = {}
    for name, section in SECTIONS.items():
        keys, is_given = section.model_fields.keys(), name in varied_sections or tables.get(name)
        is_idle = name in SECTIONS_OF_METHODS and keys <= unread
        if name in absent or not is_given and (is_idle or name in optional - tables.keys()):
            continue
        if is_idle:  # complete, as if another variant read it
            unread -= {*keys, "feedback_interval_s"}
        found[name] = {}
    for name, values in found.items():
        for key in SECTIONS[name].model_fields.keys() - tables.get(name, {}).keys() - unread:
            default = dependent_default(key, given) if SECTION_OF[key] == name else None
            if default is not None:
                values[key] = default
    return found
