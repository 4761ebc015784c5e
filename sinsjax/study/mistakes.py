"""Every mistake in a study at once.

A study is built in stages, each of which reports all of its errors, but the later stages need
values that the earlier ones have accepted. After an error the study is therefore built again
without the wrong keys, until no new error is found.
"""

import re
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from sinsjax.errors import InputError
from sinsjax.methods.filters.section import Q_DENSITIES, WHITE_NOISE
from sinsjax.study.changes import copy_tables
from sinsjax.study.keys import SECTION_OF, SECTIONS, TomlTable, alternative_keys, deciding_keys
from sinsjax.study.study import Study

_PLACE = re.compile(r"\[(?P<table>[^\]]+)\](?: (?P<key>[^\s:.\[]+))?|(?P<top>[^\s:]+):")
_PLACEHOLDERS = (1e5, 100.0, 45.0, 1.0, 1, "psd")
"""Values for a wrong required key, such as a duration, a rate, a latitude or the unit of Q."""
_MAX_ROUNDS = 20

StudyBuilder = Callable[[TomlTable], Study]


class Place(NamedTuple):
    """The place of an error: a table with dots, and a key in it; empty without a key."""

    table: str
    key: str = ""


def build_or_report(build: StudyBuilder, data: TomlTable) -> Study:
    """Return the study that a function builds from tables, or report every mistake.

    Args:
        build: function that raises `InputError` with lines that begin ``[table] key``.
        data: sections by name; left as they are.

    Raises:
        InputError: a line per mistake, without possible consequences of other mistakes.
    """
    reported: dict[str, None] = {}
    counts: Counter[Place] = Counter()
    left_out: set[str] = set()
    for _ in range(_MAX_ROUNDS):
        try:
            study = build(data)
        except InputError as error:
            lines = {line: _parse_place(line) for line in error.lines}
        else:
            if not reported:
                return study
            break
        reported |= {
            line: None
            for line, location in lines.items()
            if not _is_consequence(location, left_out)
        }
        places = {*lines.values()}
        counts.update(places)
        left_out |= {place.key or place.table for place in places} | _keys_of_cases(data, places)
        if "record" in left_out:  # without its record it would be a simulation
            break
        for place in (place for place in places if counts[place] == 1):
            data = _remove_place(data, place)
        repeated = [place for place in places if counts[place] == 2 and place.table in SECTIONS]
        for place in repeated:
            data = _insert_placeholder(build, data, place)
        if not repeated and all(counts[place] > 1 for place in places):
            break
    raise InputError(*reported)


def _parse_place(line: str) -> Place:
    match = _PLACE.match(line)
    return Place(match["table"] or match["top"], match["key"] or "") if match else Place("")


def _is_consequence(place: Place, left_out: set[str]) -> bool:
    """Return whether an error may be a consequence of earlier ones, whose keys are left out."""
    related = {place.key, place.table, *alternative_keys(place.key)}
    related |= {key for key in SECTION_OF if place.key in deciding_keys(key)}
    if not place.key:  # a whole section, which no method reads once a wrong one is left out
        related.add("method")
    if place.key in WHITE_NOISE:  # the default of Q
        related |= {"sensors", *WHITE_NOISE[place.key][:2]}
    if place.key == "q_reading":  # its numbers may be left out
        related |= {form for key, forms in Q_DENSITIES.items() for form in (key, *forms)}
    if place.key in SECTION_OF:
        related |= {*deciding_keys(place.key)}
    return not left_out.isdisjoint(related)


def _keys_of_cases(data: TomlTable, places: set[Place]) -> set[str]:
    """Return the keys of all cases if one has an error, since cases are left out together."""
    rows = data.get("cases")
    if all(place.table != "cases" for place in places) or not isinstance(rows, list | tuple):
        return set()
    return {key for row in rows if isinstance(row, Mapping) for key in row}


def _remove_place(data: TomlTable, place: Place) -> TomlTable:
    """Return tables without a place; for one in cases or below [tune], without all of it."""
    tables = copy_tables(data)
    path = [*place.table.split("."), *([place.key] if place.key else [])]
    if path[0] == "cases" or place.table.startswith("tune."):
        path = path[:1]
    *tops, last = path
    table: Any = tables
    for part in tops:
        table = table.get(part) if isinstance(table, dict) else None
    if isinstance(table, dict):
        table.pop(last, None)
        # Remove axes and draws that vary nothing any more.
        if tops and tops[0] in ("axes", "drawn") and not table.keys() - {"sampling"}:
            return _remove_place(tables, Place(".".join(tops)))
    return tables


def _insert_placeholder(build: StudyBuilder, data: TomlTable, place: Place) -> TomlTable:
    """Return tables with the first stand-in for a missing key that is not an error itself.

    Without one, a section that a study need not have is left out.
    """
    table = data.get(place.table, {})
    for value in _PLACEHOLDERS if isinstance(table, dict) and place.key else ():
        unit = {"q_reading": "psd"} if place.key in WHITE_NOISE else {}
        changed = data | {place.table: unit | table | {place.key: value}}
        try:
            build(changed)
        except InputError as error:
            if place in map(_parse_place, error.lines):
                continue
        return changed
    if place.table in ("stop_when", "tune"):
        return {name: table for name, table in data.items() if name != place.table}
    return data
