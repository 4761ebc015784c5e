"""All errors of a study at once.

Reading stops at the first error. Here the key in error is left out, or replaced where it is
required, and the study is read again, until there are no more.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sinsjax.errors import InputError
from sinsjax.messages import one_line
from sinsjax.study.changes import copied
from sinsjax.study.files import found, read_tables
from sinsjax.study.keys import SECTIONS, TomlTable
from sinsjax.study.load import study_from_dict, with_changes
from sinsjax.study.usable import check_usable

_PLACE = re.compile(
    r"\[(?P<table>[^\]]+)\](?: (?P<key>[^\s:.\[]+)(?P<below>[^\s:]*))?|(?P<top>[^\s:]+):"
)
_BELOW = re.compile(r"\[(\d+)\]|\.(\w+)")
_CHOICE = re.compile(r"'(\w+)'")
_STAND_INS = (1e5, 100.0, 45.0, 1.0, 1)
"""Values for a required key in error: those of a duration, a rate and a latitude among them."""
_MOST = 100
_HUGE = 1e12


class Place(NamedTuple):
    """Where an error is: a table, a key in it, and where below the key; empty without one.

    Attributes:
        table: name, with dots.
        key: of the table.
        below: entries of lists, and keys of a table that is the key's value.
    """

    table: str
    key: str = ""
    below: tuple[int | str, ...] = ()

    @property
    def whole(self) -> "Place":
        """The key with all that is below it."""
        return Place(self.table, self.key)

    @property
    def of_entry(self) -> bool:
        """Whether it is an entry of a list."""
        return bool(self.below) and isinstance(self.below[-1], int)


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
    try:
        check_usable(data)
    except InputError as unusable:  # its sections and keys are unknown, and no errors
        yield one_line(f"{source}: {unusable}")
        return
    seen: Counter[Place] = Counter()
    stood_in: set[Place] = set()  # keys with entries that are not the study's own
    for _ in range(_MOST):
        error = _first(data, source)
        if error is None:
            return
        place = _place(error, source)
        seen[place] += 1
        if seen[place] == 1:
            if place.below or place not in stood_in:
                yield error
            stood_in |= {place.whole} if place.of_entry else set()
            mended = _with_other_entry(data, source, place, error) if place.of_entry else None
            data = _without(data, place.whole) if mended is None else mended
        elif seen[place] == 2 and place.key:
            required = place.table in SECTIONS
            data = _stood_in(data, source, place) if required else _without(data, place.whole)
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
    below = (int(entry) if entry else key for entry, key in _BELOW.findall(match["below"] or ""))
    return Place(match["table"] or match["top"], match["key"] or "", tuple(below))


def _without(data: TomlTable, place: Place) -> TomlTable:
    """The study without what is at a place."""
    out = copied(data)
    *path, last = [*place.table.split("."), *([place.key] if place.key else [])]
    table = _reached(out, path)
    rows = [row for row in (table if isinstance(table, list) else [table]) if isinstance(row, dict)]
    for row in rows:
        row.pop(last, None)
    # A zip, cases or draws with nothing left to vary.
    varies = place.key and path[0] in ("axes", "cases", "drawn")
    if varies and not any(row.keys() - {"case"} for row in rows):
        return _without(out, Place(place.table))
    return out


def _with_other_entry(data: TomlTable, source: str, place: Place, error: str) -> TomlTable | None:
    """The study with a value for an entry of a list that is no error there; None without one."""
    *path, last = _path(place)
    beside = _reached(data, path)
    if place.table == "cases" and last == place.key:
        beside = [case.get(last) for case in _reached(data, ["cases"]) if isinstance(case, dict)]
    if not isinstance(beside, list):
        return None
    rule, _, _ = error.rpartition(", not ")
    values = [*_others(beside, int(place.below[-1])), *_CHOICE.findall(rule)]
    # A repeated entry may be an error of its own.
    for value in sorted(values, key=lambda value: value in beside):
        out = copied(data)
        table = _reached(out, path)
        if isinstance(last, int):  # which may be one that the list lacks
            table[last : last + 1] = [value]
        else:
            table[last] = value
        found = _first(out, source)
        if found is None or _place(found, source) != place:
            return out
    return None


def _path(place: Place) -> list[str | int]:
    """The way to a value, table by table: a case's number comes before its key."""
    if place.table == "cases":
        return ["cases", place.below[0], place.key, *place.below[1:]]
    return [*place.table.split("."), place.key, *place.below]


def _reached(tables: Any, path: Sequence[int | str]) -> Any:
    """What stands at the end of a path of keys and entries; an empty table where nothing does."""
    for part in path:
        if isinstance(part, int):
            tables = tables[part] if isinstance(tables, list) and part < len(tables) else {}
        else:
            tables = tables.get(part, {}) if isinstance(tables, dict) else {}
    return tables


def _others(values: list[Any], entry: int) -> Iterator[Any]:
    """Values that may stand for an entry of a list, none equal to another entry if it is a number.

    The other entries first, as they are what the key may be, if not in error themselves.
    """
    others = [value for at, value in enumerate(values) if at != entry]
    numbers = [value for value in others if type(value) in (int, float) and abs(value) < _HUGE]
    nudge = 1e-6 * (entry + 1)
    for number in sorted(numbers, key=abs)[:3]:
        yield number + nudge
    yield from [value for value in others if value not in numbers][:3]
    yield from (number + nudge for number in _STAND_INS)
    yield from (number + entry for number in (1, 2))


def _stood_in(data: TomlTable, source: str, place: Place) -> TomlTable:
    """The study with the first stand-in for a required key that is no error itself."""
    table = data.get(place.table, {})
    for value in _STAND_INS:
        out = data | {place.table: table | {place.key: value}}
        error = _first(out, source)
        if error is None or _place(error, source) != place:
            return out
    return data
