"""Keys of a study that its methods do not use, which are dropped or listed in one line.

A change of the method drops the keys that the new one does not read. Keys without effect stay, and
are listed before the study runs.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from sinsjax.errors import InputError
from sinsjax.methods.description import INITIAL_KEYS
from sinsjax.methods.registry import METHODS, unread_keys
from sinsjax.study.changes import copy_tables
from sinsjax.study.keys import (
    COARSE_KEYS,
    SECTION_OF,
    SECTIONS,
    SWEEPABLE,
    TomlTable,
    deciding_keys,
    effect_conditions,
    has_effect,
    leaf_info,
    reading_methods,
)
from sinsjax.study.study import COARSE_START, Study

_AMPLITUDES = tuple(f"{angle}_amplitude_deg" for angle in ("pitch", "roll", "yaw"))
_MAX_LISTED_VALUES = 3  # of a key in one line
_VARIABLES = "[tune.variables]"

Table = dict[str, Any]
Listing = dict[str, list[str]]
"""Keys by the table, in brackets, that gives them."""


def drop_unread_keys(
    before: Mapping[str, Any], after: TomlTable, changes: Mapping[str, Any], source: str
) -> tuple[TomlTable, list[str]]:
    """Drop keys that the methods of a changed study do not read, if the methods have changed.

    Args:
        before: the study's tables without the changes.
        after: its tables with the changes, left as they are.
        changes: values by place; a key that is given here stays, whatever the method.
        source: name of the study in messages.

    Returns:
        The remaining tables, and lines for the user about the dropped keys.

    Raises:
        InputError: no tuned key would remain.
    """
    methods = _method_names(after)
    if methods == _method_names(before) or not methods <= METHODS.keys():
        return after, []
    given_keys = {_leaf_key(place) for place, value in changes.items() if value != {}}
    tables: TomlTable = copy_tables(after)
    dropped, tuned = _drop_keys(
        tables, _unread_keys(methods, recorded="record" in tables) - given_keys
    )
    method_text = _format_methods(methods)
    if tuned and not tables["tune"]["variables"]:
        raise InputError(
            f"{source}: {_VARIABLES}: {method_text} reads none of {', '.join(tuned)} (tune other"
            " keys, --set tune.variables.KEY.low=..., or drop the section, --set tune={})"
        )
    repeats = _remove_repeated_rows(before, tables)
    parts = []
    if dropped:
        verb = "does" if len(methods) == 1 else "do"
        parts.append(f"Dropped, as {method_text} {verb} not read them: {', '.join(dropped)}")
    if repeats:
        first = "left" if parts else "Left"
        parts.append(f"{first} out, as they now repeat others: {', '.join(repeats)}")
    lines = ["; ".join(parts)] if parts else []
    if "judged_from" not in given_keys and (name := _method_without_floor(tables, methods)):
        value = tables["study"].pop("judged_from")
        lines.append(
            f"Dropped, as method {name} has no bias floor of heading on this base: [study]"
            f" judged_from = '{value}'; success is judged from the truth"
        )
    return tables, [f"{line}." for line in lines]


def list_idle_keys(study: Study, tables: Mapping[str, Any]) -> list[str]:
    """List the given keys that have no effect on any run of a study, in one line if there are any.

    Args:
        study: checked study.
        tables: tables of the study. If they give every key, as those of a resolved study do, only
            keys that differ from their defaults count as given.
    """
    resolved = _lists_every_key(study, tables)
    idle_by_reason: dict[str, Listing] = {}  # by the reason
    for place, table, keys in _iter_tables(tables):
        for key in keys:
            by_default = resolved and place[1:-1] in SECTIONS and _is_default(key, table[key])
            if by_default or SECTION_OF.get(key) not in SWEEPABLE:
                continue
            if reason := _idle_reason(study, key, tuned=place.startswith("[tune")):
                idle_keys = idle_by_reason.setdefault(reason, {}).setdefault(place, [])
                idle_keys.extend([key] if key not in idle_keys else [])
    parts = []
    for reason, listing in idle_by_reason.items():
        verb = "has" if sum(map(len, listing.values())) == 1 else "have"
        parts.append(f"{', '.join(_format_listing(listing))} {verb} no effect {reason}")
    return [f"{'; '.join(parts)}."] if parts else []


def _iter_tables(tables: Mapping[str, Any]) -> Iterator[tuple[str, Table, list[str]]]:
    """Yield each table whose keys may differ between runs: name in brackets, table, keys."""
    axes, cases, tune = (tables.get(name) for name in ("axes", "cases", "tune"))
    places = [(f"[{name}]", tables.get(name)) for name in SWEEPABLE]
    zips = axes.items() if isinstance(axes, Mapping) else ()
    places += [("[axes]", axes), *((f"[axes.{name}]", table) for name, table in zips)]
    places += [("[cases]", row) for row in (cases if isinstance(cases, list | tuple) else ())]
    places += [("[drawn]", tables.get("drawn"))]
    tune_tables = tune if isinstance(tune, Mapping) else {}
    places += [
        (_VARIABLES, tune_tables.get("variables")),
        ("[tune.baseline]", tune_tables.get("baseline")),
    ]
    for place, table in places:
        if isinstance(table, dict):
            zipped = place == "[axes]"  # a zip may have the name of a key
            yield place, table, [k for k, v in table.items() if not (zipped and _is_table(v))]


def _is_table(value: Any) -> bool:
    return isinstance(value, Mapping)


def _leaf_key(place: str) -> str:
    """Return the leaf key that a change names."""
    section, *path = place.split(".")
    if section == "axes":
        return path[-1] if path else ""
    return (path[1:] or [""])[0] if section == "tune" else (path or [""])[0]


def _key_values(tables: Mapping[str, Any], key: str) -> list[Any]:
    """Return the values of a key in the tables; None for a drawn key."""
    swept: list[Any] = []
    fixed: list[Any] = []
    for place, table, keys in _iter_tables(tables):
        if key not in keys or place.startswith("[tune"):
            continue
        if place == "[drawn]":
            swept.append(None)
        elif place.startswith("[axes"):
            swept += table[key] if isinstance(table[key], list | tuple) else []
        else:
            (swept if place == "[cases]" else fixed).append(table[key])
    return swept or fixed


def _method_names(tables: Mapping[str, Any]) -> set[str]:
    default = SECTIONS["alignment"].model_fields["method"].default
    return {str(value) for value in _key_values(tables, "method") or [default]}


def _format_methods(methods: Iterable[str]) -> str:
    """Return some methods as text for a message."""
    first, *others = sorted(methods)
    if not others:
        return f"method {first}"
    return f"methods {', '.join([first, *others[:-1]])} and {others[-1]}"


def _unread_keys(methods: Iterable[str], *, recorded: bool) -> set[str]:
    """Return the keys that some methods do not read, and the keys that all of them refuse."""
    refused = set.intersection(*({*METHODS[name].refuses} for name in methods))
    if recorded:  # every method may follow a coarse alignment
        refused -= {*COARSE_KEYS}
    return unread_keys(methods) | refused


def _drop_keys(tables: TomlTable, unread: set[str]) -> tuple[list[str], list[str]]:
    """Drop keys from all tables, and tables that become empty.

    Returns:
        The dropped keys as text for a message, and the tuned keys among them.
    """
    dropped: Listing = {}
    for place, table, keys in _iter_tables(tables):
        for key in unread.intersection(keys):
            del table[key]
        listed = dropped.setdefault(place, [])
        listed.extend(key for key in keys if key in unread and key not in listed)
    dropped = {place: keys for place, keys in dropped.items() if keys}
    for place in dropped:
        name, _, below = place[1:-1].partition(".")
        if name == "cases" and not any(map(_has_keys, tables["cases"])):
            del tables["cases"]
        elif name == "drawn" and tables["drawn"].keys() <= {"sampling"}:
            del tables["drawn"]
        elif below and place != _VARIABLES and not tables[name][below]:
            del tables[name][below]
        elif name not in ("alignment", "axes", "cases", "drawn", "tune") and not tables[name]:
            del tables[name]
    if not tables.get("axes", True):
        del tables["axes"]
    listed = _format_listing(
        {p: [] if _is_missing(tables, p) else keys for p, keys in dropped.items()}
    )
    return listed, dropped.get(_VARIABLES, [])


def _has_keys(case: Any) -> bool:
    """Return whether a case has keys in addition to its label."""
    return not isinstance(case, dict) or bool(case.keys() - {"case"})


def _is_missing(tables: TomlTable, place: str) -> bool:
    """Return whether a table does not exist any more."""
    name, _, below = place[1:-1].partition(".")
    return name not in tables or bool(below) and below not in tables[name]


def _format_listing(keys: Listing) -> list[str]:
    """Return each table with its keys as text; the table alone if it has none."""
    return [" ".join(filter(None, (place, ", ".join(listed)))) for place, listed in keys.items()]


def _remove_repeated_rows(before: Mapping[str, Any], tables: TomlTable) -> list[str]:
    """Leave out cases and points of zips that have become equal; return text with their numbers."""
    lines = []
    cases = tables.get("cases")
    if isinstance(cases, list) and all(map(_is_table, cases)):
        kept_rows = _first_occurrences(_case_rows(before.get("cases")), _case_rows(cases))
        lines += _format_removed_count(kept_rows, cases, "[cases]")
        tables["cases"] = [cases[i] for i in kept_rows]
    earlier, axes = (
        table if isinstance(table, dict) else {}
        for table in (before.get("axes"), tables.get("axes"))
    )
    for name, table in axes.items():
        if _is_table(table) and _is_table(earlier.get(name)):
            rows = _zip_rows(table)
            kept_rows = _first_occurrences(_zip_rows(earlier[name]), rows)
            lines += _format_removed_count(kept_rows, rows, f"points of [axes.{name}]")
            if len(kept_rows) < len(rows):
                table |= {key: [values[i] for i in kept_rows] for key, values in table.items()}
    return lines


def _case_rows(cases: Any) -> list[Any]:
    """Return the values of each case, without its label."""
    return [_to_hashable({key: row[key] for key in row if key != "case"}) for row in cases or ()]


def _zip_rows(table: Mapping[str, Any]) -> list[Any]:
    """Return the values of each point of a zip; empty if its lists differ in length."""
    columns = [v if isinstance(v, list | tuple) else () for v in table.values()]
    same_length = len({*map(len, columns)}) == 1
    return [*map(_to_hashable, zip(*columns, strict=True))] if same_length else []


def _first_occurrences(before: Sequence[Any], after: Sequence[Any]) -> list[int]:
    """Return the indices of all rows, except of those that have become equal to an earlier one."""
    if len(before) != len(after) or len({*before}) < len(before):
        return [*range(len(after))]
    first: dict[Any, int] = {}
    return [i for i, row in enumerate(after) if first.setdefault(row, i) == i]


def _format_removed_count(kept_rows: Sequence[int], rows: Sequence[Any], label: str) -> list[str]:
    return (
        [f"{len(rows) - len(kept_rows)} of {len(rows)} {label}"]
        if len(kept_rows) < len(rows)
        else []
    )


def _to_hashable(value: Any) -> Any:
    """Return a value in a hashable form."""
    if isinstance(value, Mapping):
        return frozenset((key, _to_hashable(entry)) for key, entry in value.items())
    return tuple(map(_to_hashable, value)) if isinstance(value, list | tuple) else value


def _method_without_floor(tables: TomlTable, methods: set[str]) -> str | None:
    """Return a method without a bias floor if the study is judged from it, else None."""
    settings = tables.get("study")
    judged = settings.get("judged_from") if isinstance(settings, Mapping) else None
    if judged in (None, "truth") or "record" in tables:
        return None
    moves = any(value != 0 for key in _AMPLITUDES for value in _key_values(tables, key))
    for name in sorted(methods):
        if not METHODS[name].has_floor or (METHODS[name].gyro_bias_keys and moves):
            return name
    return None


def _lists_every_key(study: Study, tables: Mapping[str, Any]) -> bool:
    for name in SWEEPABLE:
        if study.has(name):
            values = dict(getattr(study, name)).items()
            given_keys = {key for key, value in values if value is not None} - {*study.drawn_keys}
            if not given_keys <= tables.get(name, {}).keys():
                return False
    return True


def _is_default(key: str, value: Any) -> bool:
    default = leaf_info(key).default
    field_default = SECTIONS[SECTION_OF[key]].model_fields[key].default
    return _to_hashable(value) == _to_hashable(field_default if default is None else default)


def _idle_reason(study: Study, key: str, *, tuned: bool) -> str | None:
    """Return the reason why a key has no effect on any run, as text; None if it has an effect."""
    varied = {*study.tune.variables, *study.tune.baseline} if study.tune else set()
    if "method" not in varied and {*study.methods}.isdisjoint(reading_methods(key)):
        return f"with {_format_methods(study.methods)}"
    if tuned or not varied.isdisjoint(deciding_keys(key)) or not study.has(SECTION_OF[key]):
        return None
    coarse = COARSE_START if key in INITIAL_KEYS and study.coarse else ()
    points = list(study.combinations(*dict.fromkeys((*deciding_keys(key), *coarse))))
    if coarse:
        points = [p for p in points if not study.has_coarse_stage(*(p[k] for k in coarse))]
        if not points:
            return "with coarse alignment"
    if any(has_effect(key, point) for point in points):
        return None
    for condition in effect_conditions(key):
        values = {given: {point[given] for point in points} for given in condition.given}
        if not any(condition.acts(*(p[given] for given in condition.given)) for p in points):
            return f"with {', '.join(_format_values(*entry) for entry in values.items())}"
    return "in any variant"


def _format_values(key: str, values: set[Any]) -> str:
    """Return the values of a key as a condition in a message."""
    if len(values) > _MAX_LISTED_VALUES:
        return f"these values of {key}"
    if values == {None}:
        return f"no {key}"
    shown = [f"{v:g}" if isinstance(v, float) else str(v) for v in sorted(values, key=str)]
    return f"{key} = {' or '.join(shown)}"
