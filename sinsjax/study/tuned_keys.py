"""The keys that are tuned: [tune.variables] and [tune.baseline], read and checked.

Every value is checked as the key that it stands for. One that is wrong is named by its place, from
0: ``[tune.variables] reset_times_s[1].low``.
"""

from collections.abc import Mapping
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import ConfigDict, TypeAdapter, ValidationError

from sinsjax.errors import InputError
from sinsjax.messages import explained, index, near
from sinsjax.study.axes import checked
from sinsjax.study.keys import SECTION_OF, SECTIONS, TUNABLE, TomlTable, rivals, unknown
from sinsjax.study.ranges import Range

TIMES, COUNT = "reset_times_s", "reset_count"
"""Of the ranges of the one, as many are used as the other says, where both are variables."""

_TABLE, _BASELINE = "[tune.variables]", "[tune.baseline]"
_DRAWS = {"tune_draws": 16, "evaluation_draws": 64}
_KINDS = tuple(Range.model_fields)
_STRICT = ConfigDict(strict=True, allow_inf_nan=False)

Ranges = dict[str, Range | tuple[Range, ...]]


def read(table: TomlTable, swept: Mapping[str, str], *, recorded: bool) -> TomlTable:
    """The section [tune] with its ranges and values checked, and the draws it leaves out.

    Args:
        table: of the file, lists as tuples.
        swept: the table, in brackets, of every key that is swept or drawn.
        recorded: whether the study reads a record.

    Raises:
        InputError: ``[table] key: what is wrong (hint)``.
    """
    table = dict(table)
    for key, default in _DRAWS.items():
        if not recorded:
            table.setdefault(key, default)
        elif key in table:
            text = "does not apply to a recorded study (its start times tune and judge in turn)"
            raise InputError(f"[tune] {key}: {text}")
    for key in ("variables", "baseline"):
        if key in table and not isinstance(table[key], Mapping):
            raise InputError(f"[tune] {key}: must be a table of keys")
    if "variables" in table:
        table["variables"] = _ranges(table["variables"], swept)
    if "baseline" in table:
        values = table["baseline"]
        _check_keys(values, swept, _BASELINE)
        for key in values:
            _check_rivals(key, dict.fromkeys(values, _BASELINE), _BASELINE)
        table["baseline"] = {
            key: checked(value, key, f"{_BASELINE} {key}") for key, value in values.items()
        }
    return table


def _ranges(table: TomlTable, swept: Mapping[str, str]) -> Ranges:
    if not table:
        raise InputError(f"{_TABLE}: names no key to tune")
    _check_keys(table, swept, _TABLE)
    ranges = {key: _kind(key, value) for key, value in table.items()}
    times, count = ranges.get(TIMES), ranges.get(COUNT)
    taken = dict.fromkeys(ranges, _TABLE)
    if isinstance(times, tuple) and isinstance(count, Range):
        for number in count.candidates or (count.fixed,):
            if number > len(times):
                text = f"{number} are more than the {len(times)} ranges of {TIMES}"
                raise InputError(f"{_TABLE} {COUNT}: {text}")
        del taken[COUNT]
    for key in taken:
        _check_rivals(key, taken, _TABLE)
    return ranges


def _check_keys(table: TomlTable, swept: Mapping[str, str], place: str) -> None:
    """Refuses keys that are none, that cannot be tuned, or that the study varies itself."""
    for key in table:
        section = SECTION_OF.get(key)
        if section is None:
            known = [name for name, home in SECTION_OF.items() if home in TUNABLE]
            raise InputError(f"{place} {key}: {unknown(key, known)}")
        if section not in TUNABLE:
            raise InputError(f"{place} {key}: cannot be tuned (it is a key of [{section}])")
        if key in swept:
            raise InputError(f"{place} {key}: is in {swept[key]} already (drop one of them)")
        _check_rivals(key, swept, place)


def _check_rivals(key: str, taken: Mapping[str, str], place: str) -> None:
    for other in sorted(rivals(key) & taken.keys()):
        text = f"conflicts with {other} in {taken[other]} (give one of them)"
        raise InputError(f"{place} {key}: {text}")


def _kind(key: str, value: Any) -> Range | tuple[Range, ...]:
    """The range of a number, the ranges of a list's entries, or the values that a key may have."""
    place, entries = (
        f"{_TABLE} {key}",
        _entry_types(SECTIONS[SECTION_OF[key]].model_fields[key].annotation),
    )
    if not isinstance(value, tuple):
        kind = _range(place, key, value)
        if kind.is_free and entries:
            raise InputError(f"{place}: needs a list of ranges, one an entry, not one range")
        if kind.is_free:
            for name in ("low", "high"):
                _check_end(checked(value[name], key, f"{place}.{name}"), place)
        return kind
    if not entries:
        raise InputError(f"{place}: is one number and needs one range, not a list")
    if not value:
        raise InputError(f"{place}: must not be empty")
    if Ellipsis not in entries and len(value) != len(entries):
        raise InputError(f"{place}: must have {len(entries)} ranges, not {len(value)}")
    return tuple(_entry(f"{place}[{i}]", own, entries[0]) for i, own in enumerate(value))


def _entry(place: str, value: Any, kind_of: Any) -> Range:
    """The range of one entry of a list whose entries have some type."""
    kind = _range(place, None, value)
    if kind.candidates is not None:
        raise InputError(f"{place}.candidates: are those of a whole key, not of one entry")
    for name in ("low", "high") if kind.is_free else ("fixed",):
        try:
            end = TypeAdapter(kind_of, config=_STRICT).validate_python(value[name])
        except ValidationError as error:
            raise InputError(f"{place}.{name}: {explained(error.errors()[0])}") from None
        if kind.is_free:
            _check_end(end, place)
    return kind


def _range(place: str, key: str | None, value: Any) -> Range:
    """A range as the file gives it; with a key, its values are checked as that key's."""
    if not isinstance(value, Mapping):
        raise InputError(f"{place}: must be a table such as {{ low = 0, high = 1 }}, not {value!r}")
    for name in value:
        if name not in _KINDS:
            raise InputError(f"{place}.{name}: unknown key{near(name, _KINDS)}")
    try:
        kind = Range.model_validate(({"scale": "linear"} if "low" in value else {}) | dict(value))
    except ValidationError as error:
        first = error.errors()[0]
        name = first["loc"][0] if first["loc"] else first.get("ctx", {}).get("key")
        at = f".{name}{index(first)}" if name else ""
        raise InputError(f"{place}{at}: {explained(first)}") from None
    if key is None:
        return kind
    if kind.fixed is not None:
        return kind.model_copy(update={"fixed": checked(kind.fixed, key, f"{place}.fixed")})
    if kind.candidates is not None:
        at = f"{place}.candidates"
        values = tuple(checked(v, key, f"{at}[{i}]") for i, v in enumerate(kind.candidates))
        if len(set(values)) < len(values):
            raise InputError(f"{at}: repeats a value")
        return kind.model_copy(update={"candidates": values})
    return kind


def _check_end(end: Any, place: str) -> None:
    if isinstance(end, int):
        raise InputError(f"{place}: takes whole numbers only (list them as candidates)")


def _entry_types(annotation: Any) -> tuple[Any, ...]:
    """What the entries of a list key are, as a tuple's type says it; nothing for other keys."""
    origin, inside = get_origin(annotation), get_args(annotation)
    if origin is tuple:
        return inside
    if origin is Annotated:
        return _entry_types(inside[0])
    if origin in (Union, UnionType):
        return next((found for part in inside if (found := _entry_types(part))), ())
    return ()
