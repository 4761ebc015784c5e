"""Changes to a study by key: ``--set`` of the command line, and `Study.replace`.

A changed key replaces every value of that key, also an axis, a key of the cases or a drawn key, and
the alternatives to it. An empty table as the value drops a section, an axis or a drawn key.
"""

import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any

from sinsjax.errors import InputError
from sinsjax.messages import print_warning
from sinsjax.study.files import TOO_DEEP
from sinsjax.study.keys import SECTION_OF, SECTIONS, TomlTable, alternative_keys

_EXAMPLE = "such as alignment.phi_u0_deg"
_WORD = re.compile(r"[+-]?[A-Za-z_][\w+-]*")  # also an order of axes, as -y-xz
_MAX_NESTING = 50  # a study has at most five


class SetOptions(dict[str, Any]):
    """The values of ``--set`` by place; a warning names what else they drop."""


_print_warning_once = cache(print_warning)  # a command may read its study twice


def parse_changes(texts: Iterable[str] | None) -> SetOptions:
    """Return the values of texts ``PLACE=VALUE`` by place, none for None.

    Values are written as in TOML; a single word needs no quotes.
    """
    changes = SetOptions()
    for text in texts or ():
        place, equals, value = (part.strip() for part in text.partition("="))
        if not (place and equals and value):
            raise InputError(f"--set {text}: must be SECTION.KEY=VALUE, {_EXAMPLE}=12")
        try:
            changes[place] = tomllib.loads(f"value = {value}")["value"]
        except RecursionError:
            raise InputError(f"--set {place}: {TOO_DEEP}") from None
        except ValueError:
            if not _WORD.fullmatch(value):
                hint = "write text in quotes, a list as [1, 5]"
                raise InputError(f"--set {text}: {value} is not a TOML value ({hint})") from None
            changes[place] = value
    return changes


def apply_changes(tables: Mapping[str, Any], changes: Mapping[str, Any]) -> TomlTable:
    """Return a study's tables with some values changed; both arguments are left as they are.

    A place is ``section.key``, ``axes.key``, ``axes.NAME.key``, ``drawn.key`` or deeper, such as
    ``tune.variables.p0_yaw_deg.low``; or ``cases`` for all of them. For `SetOptions` the
    alternatives that a key replaces are printed.
    """
    result: TomlTable = copy_tables(tables)
    places: dict[str, str] = {}  # by key
    for place, value in changes.items():
        dropped = _set_value_and_drop_alternatives(result, place, copy_tables(value), places)
        if dropped and isinstance(changes, SetOptions):
            _print_warning_once(f"--set {place} replaces {', '.join(dropped)}.")
    return result


def _set_value_and_drop_alternatives(
    tables: TomlTable, place: str, value: Any, places: dict[str, str]
) -> list[str]:
    """Change a value in tables, and return the alternatives to it that were there."""
    *above, name = place.split(".")
    table: Any = tables
    is_drop = value == {}
    if not (is_drop or place == "cases" or (above and all(above) and name)):
        hint = f"{SECTION_OF[place]}.{place}" if place in SECTION_OF else _EXAMPLE
        raise InputError(f"{place}: must name a section and a key ({hint})")
    for part in above:
        if isinstance(table, dict):
            table = table.get(part) if is_drop else table.setdefault(part, {})
    if is_drop:
        if not isinstance(table, dict) or name not in table:
            raise InputError(f"{place}: cannot be dropped, as the study does not have it (omit it)")
        del table[name]
        return []
    if not isinstance(table, dict):
        raise InputError(f"{place}: is below a value, not in a table (name the value itself)")
    table[name] = value
    section, *path = *above, name
    if section in SECTIONS and len(path) > 1 or section not in (*SECTIONS, "axes", "drawn"):
        return []
    key, kept = (name, table) if section == "axes" else (path[0], tables[section])
    for other in alternative_keys(key) & places.keys():
        raise InputError(f"{place}: conflicts with {places[other]} (give one of them)")
    places[key] = place
    return _drop_alternatives_and_key_elsewhere(tables, key, kept)


def copy_tables(
    value: Any, sequence: Callable[[Iterable[Any]], Any] = list, depth: int = _MAX_NESTING
) -> Any:
    """Return a deep copy of tables, with all lists and tuples as one of both."""
    if not isinstance(value, Mapping | list | tuple):
        return value
    if not depth:
        raise InputError(TOO_DEEP)
    if isinstance(value, Mapping):
        return {key: copy_tables(entry, sequence, depth - 1) for key, entry in value.items()}
    return sequence(copy_tables(entry, sequence, depth - 1) for entry in value)


def _drop_alternatives_and_key_elsewhere(tables: TomlTable, key: str, kept: TomlTable) -> list[str]:
    """Remove a key from all tables but one, and its alternatives from all.

    The alternatives that were there are returned, each after its table in brackets. An empty zip is
    removed, and so is [drawn] if it does not draw a key any more.
    """
    axes, cases, drawn = (tables.get(name) for name in ("axes", "cases", "drawn"))
    zips = list(axes.items()) if isinstance(axes, dict) else []
    places = [(f"[{name}]", tables.get(name)) for name in (*SECTIONS, "axes", "drawn")]
    places += [(f"[axes.{name}]", table) for name, table in zips]
    places += [("[cases]", row) for row in (cases if isinstance(cases, list) else ())]
    dropped: dict[str, None] = {}
    for place, table in places:
        if isinstance(table, dict) and place != "[tune]":
            if table is not kept:
                table.pop(key, None)
            for other in sorted(alternative_keys(key) & table.keys()):
                del table[other]
                dropped[f"{place} {other}"] = None
    for name in (name for name, table in zips if table == {}):
        del tables["axes"][name]
    if isinstance(drawn, dict) and drawn is not kept and drawn.keys() <= {"sampling"}:
        del tables["drawn"]
    return list(dropped)
