"""Changes to a study by key: ``--set`` of the command line, and `Study.replace`.

A changed key replaces every value of that key in the study, also an axis, a key of the cases or a
drawn key, and the alternatives to it. An empty table as the value drops a section, an axis or a
drawn key.
"""

import re
import tomllib
from collections.abc import Iterable, Mapping
from typing import Any

from sinsjax.errors import InputError
from sinsjax.study.files import TOO_DEEP
from sinsjax.study.keys import SECTION_OF, SECTIONS, TomlTable, alternative_keys

_SWEEP_TABLES = ("axes", "drawn")
_EXAMPLE = "such as alignment.phi_u0_deg"
_WORD = re.compile(r"[+-]?[A-Za-z_][\w+-]*")  # also an order of axes, as -y-xz
_COMMA = re.compile(r"[+-]?\d+,\d+")


class SetOptions(dict[str, Any]):
    """The values of ``--set`` by place, whose user is told what else they drop."""

    def __init__(self) -> None:
        """Begin without changes."""
        super().__init__()
        self._told = set[str]()

    def tell(self, line: str) -> None:
        """Print a line on the standard error, once."""
        if line not in self._told:
            from sinsjax.console import print_warning

            print_warning(line)
            self._told.add(line)


def parse_changes(texts: Iterable[str]) -> SetOptions:
    """Return the values of some texts ``PLACE=VALUE`` by place.

    Values are written as in TOML; a single word needs no quotes.

    Raises:
        InputError: a text has no place or no value, or a value is nested too deeply.
    """
    changes = SetOptions()
    for text in texts:
        place, equals, value = (part.strip() for part in text.partition("="))
        if not (place and equals and value):
            raise InputError(f"--set {text}: must be SECTION.KEY=VALUE, {_EXAMPLE}=12")
        try:
            changes[place] = tomllib.loads(f"value = {value}")["value"]
        except ValueError:
            if _COMMA.fullmatch(value):
                hint = f"decimal point: {value.replace(',', '.')}; list: [{value}]"
                raise InputError(f"--set {text}: {value} is not a TOML value ({hint})") from None
            if not _WORD.fullmatch(value):
                raise InputError(
                    f"--set {text}: {value} is not a TOML value (quote text)"
                ) from None
            changes[place] = value
        except RecursionError:
            raise InputError(f"--set {place}: {TOO_DEEP}") from None
    return changes


def apply_changes(tables: Mapping[str, Any], changes: Mapping[str, Any]) -> TomlTable:
    """Return a study's tables with some values changed; both arguments are left as they are.

    The user of `SetOptions` is told the alternatives to a key that it replaces.

    Args:
        tables: sections by name.
        changes: values by place: ``section.key``, ``axes.key``, ``axes.NAME.key``, ``drawn.key`` or
            deeper, such as ``tune.variables.p0_yaw_deg.low``; or all cases by ``cases``. An empty
            table drops the section, key, axis or table of that name.

    Raises:
        InputError: a place does not name a section and a key, there is nothing to drop, or two
            changes are alternatives.
    """
    result: TomlTable = copy_tables(tables)
    places: dict[str, str] = {}  # by key
    for place, value in changes.items():
        section, *path = place.split(".")
        if value == {}:
            _delete_place(result, place)
            continue
        if place == "cases":
            result[place] = copy_tables(value)
            continue
        if not path or not all(path):
            owner = SECTION_OF.get(place)
            hint = f"{owner}.{place}" if owner else _EXAMPLE
            raise InputError(f"{place}: must name a section and a key ({hint})")
        if section == "cases":
            raise InputError(f"{place}: the entries of cases cannot be changed (edit the file)")
        table = result.setdefault(section, {})
        for name in path[:-1]:
            table = table.setdefault(name, {}) if isinstance(table, dict) else None
        if not isinstance(table, dict):
            raise InputError(f"{place}: is below a value, not in a table (name the value itself)")
        table[path[-1]] = value
        key = path[0] if section != "axes" else path[-1]
        if section in _SWEEP_TABLES or (section in SECTIONS and len(path) == 1):
            for other in alternative_keys(key) & places.keys():
                raise InputError(f"{place}: conflicts with {places[other]} (give one of them)")
            places[key] = place
            kept = table if section == "axes" else result[section]
            dropped = _remove_key_from_others(result, key, kept)
            if dropped and isinstance(changes, SetOptions):
                changes.tell(f"--set {place} replaces {', '.join(dropped)}.")
    return result


def _delete_place(tables: TomlTable, place: str) -> None:
    """Drop the section, key, axis or table at a place."""
    *path, name = place.split(".")
    table: Any = tables
    for part in path:
        table = table.get(part) if isinstance(table, dict) else None
    if not isinstance(table, dict) or name not in table:
        raise InputError(f"{place}: cannot be dropped, as the study does not have it (omit it)")
    del table[name]


def copy_tables(value: Any) -> Any:
    """Return a deep copy of tables and lists, which may be changed."""
    if isinstance(value, Mapping):
        return {key: copy_tables(entry) for key, entry in value.items()}
    return [copy_tables(entry) for entry in value] if isinstance(value, list | tuple) else value


def _remove_key_from_others(tables: TomlTable, key: str, kept_table: TomlTable) -> list[str]:
    """Remove a key and its alternatives from all tables that give or vary them.

    The table ``kept_table`` retains the key itself, in its position. An empty zip is removed, and
    so is [drawn] if it does not draw a key any more.

    Returns:
        The alternatives that are gone, each after its table in brackets.
    """
    axes, cases = (tables.get(name) for name in ("axes", "cases"))
    axes = axes if isinstance(axes, dict) else {}
    given = {
        f"[{name}]": tables.get(name) for name in (*SECTIONS, *_SWEEP_TABLES) if name != "tune"
    }
    given |= {f"[axes.{name}]": table for name, table in axes.items()}
    rows = [("[cases]", row) for row in (cases if isinstance(cases, list) else ())]
    dropped: dict[str, None] = {}
    for name, table in (*given.items(), *rows):
        if not isinstance(table, dict):
            continue
        if table is not kept_table:
            table.pop(key, None)
        for other in sorted(alternative_keys(key) & table.keys()):
            del table[other]
            dropped[f"{name} {other}"] = None
    for name in [name for name, table in axes.items() if table == {}]:
        del axes[name]
    drawn = tables.get("drawn")
    if isinstance(drawn, dict) and drawn is not kept_table and drawn.keys() <= {"sampling"}:
        del tables["drawn"]
    return list(dropped)
