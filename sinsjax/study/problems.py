"""All errors of a study at once.

Reading stops at the first error. Here the key in error is left out, or replaced where it is
required, and the study is read again, until there are no more.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sinsjax.errors import InputError
from sinsjax.study.changes import copied
from sinsjax.study.files import found, read_tables
from sinsjax.study.keys import SECTIONS, TomlTable
from sinsjax.study.load import study_from_dict, with_changes

_PLACE = re.compile(
    r"\[(?P<table>[^\]]+)\](?: (?P<key>[^\s:.\[]+)(?:\[(?P<entry>\d+)\])?)?|(?P<top>[^\s:]+):"
)
_STAND_INS = (1e5, 100.0, 45.0, 1.0, 1)
"""Values for a required key in error: those of a duration, a rate and a latitude among them."""
_MOST = 100
_HUGE = 1e12


class Place(NamedTuple):
    """Where an error is: a table, a key in it, an entry of the key's list; empty without one."""

    table: str
    key: str = ""
    entry: int | None = None


def problems(path: Path, changes: Mapping[str, Any]) -> list[str]:
    """Every error of a study file, one line each; none if it can be run.

    Args:
        path: of the file, or the name of a shipped study.
        changes: values by ``section.key`` that take the place of the file's.

    Raises:
        InputError: the file cannot be read, is no TOML or lacks what a change names.
    """
    data = with_changes(read_tables(path), changes, str(path))
    return list(_errors(data, str(found(path))))


def _errors(data: TomlTable, source: str) -> Iterator[str]:
    seen: Counter[Place] = Counter()
    for _ in range(_MOST):
        error = _first(data, source)
        if error is None:
            return
        place = _place(error, source)
        seen[place] += 1
        if seen[place] == 1:
            yield error
            data = _without(data, place)
        elif seen[place] == 2 and place.key:
            required = place.table in SECTIONS
            whole = Place(place.table, place.key)
            data = _stood_in(data, source, place) if required else _without(data, whole)
        else:
            return


def _first(data: TomlTable, source: str) -> str | None:
    """The first error of a study; None without one."""
    try:
        study_from_dict(data, source)
    except InputError as error:
        return str(error)
    return None


def _place(error: str, source: str) -> Place:
    """The place that an error names, in the form that `load` tells."""
    match = _PLACE.match(error.removeprefix(f"{source}: "))
    if match is None:
        return Place("")
    entry = match["entry"]
    return Place(
        match["table"] or match["top"], match["key"] or "", None if entry is None else int(entry)
    )


def _without(data: TomlTable, place: Place) -> TomlTable:
    """The study without what is at a place; an entry of a list takes the value of another."""
    out = copied(data)
    *path, last = [*place.table.split("."), *([place.key] if place.key else [])]
    table: Any = out
    for part in path:
        table = table.get(part, {}) if isinstance(table, dict) else {}
    if place.entry is not None and place.table.partition(".")[0] in ("axes", "cases"):
        of_case = isinstance(table, list)
        values = [case.get(last) for case in table] if of_case else table[last]
        other = _other(values, place.entry)
        if other is not None:
            if of_case:
                table[place.entry][last] = other
            else:
                values[place.entry] = other
            return out
    rows = [row for row in (table if isinstance(table, list) else [table]) if isinstance(row, dict)]
    for row in rows:
        row.pop(last, None)
    if (
        place.key
        and path[0] in ("axes", "cases")
        and not any(row.keys() - {"case"} for row in rows)
    ):
        return _without(out, Place(place.table))  # a zip, or cases, with nothing left to vary
    return out


def _other(values: Any, entry: int) -> Any:
    """A value for an entry of a list, from another entry but not equal to it; None without one."""
    others = [values[at] for at in range(len(values)) if at != entry]
    numbers = [v for v in others if type(v) in (int, float) and abs(v) < _HUGE]
    if not numbers:
        return next(iter(others), None)
    return min(numbers, key=abs) + 1e-6 * (entry + 1)


def _stood_in(data: TomlTable, source: str, place: Place) -> TomlTable:
    """The study with the first stand-in for a required key that is no error itself."""
    table = data.get(place.table, {})
    for value in _STAND_INS:
        out = data | {place.table: table | {place.key: value}}
        error = _first(out, source)
        if error is None or _place(error, source) != place:
            return out
    return data
