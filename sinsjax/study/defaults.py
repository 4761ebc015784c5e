"""What a key means that a study, or one of its cases, leaves out, if other keys decide it."""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

from sinsjax.methods.registry import METHODS, SECTIONS_OF_METHODS, unread_keys
from sinsjax.study.keys import (
    SECTION_OF,
    SECTIONS,
    SIMULATED_ONLY,
    TomlTable,
    alternative_keys,
    leaf_info,
)
from sinsjax.study.schema import EARTH_CONSTANTS


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


def filled_in(given: GivenKeys) -> dict[str, TomlTable]:
    """Return the values of the keys that a study leaves out, by the sections that it has.

    Keys that only other methods read, or other models of the Earth, stay without a value.
    """
    tables, varied_sections = given.tables, {SECTION_OF.get(key) for key in given.varied}
    unread = unread_keys(given.words("method") & METHODS.keys())
    if "constants" not in given.words("earth"):
        unread |= EARTH_CONSTANTS.keys()
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
