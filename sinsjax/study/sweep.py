"""Reading the tables that vary a study: [axes] with their zips, [[cases]], [drawn], [tune].

Every value is checked as a value of its key. Errors name all wrong values by their index, from 0:
``[axes] phi_u0_deg[3]``, ``[axes.level] phi_e0_deg[0]``, ``[drawn] phi_u0_deg.values[2]``,
``[tune.variables] reset_times_s[1].low``.
"""

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin

from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from sinsjax import gone
from sinsjax.errors import ErrorCollector, InputError
from sinsjax.messages import describe_broken_rule, explain_error, format_list_index, suggest_closest
from sinsjax.study.keys import (
    SECTION_OF,
    SECTIONS,
    SIMULATED_ONLY,
    SWEEPABLE,
    TUNABLE,
    TomlTable,
    alternative_keys,
    leaf_info,
    unknown_key_error,
)
from sinsjax.study.resolved import Dimension
from sinsjax.study.schema import INITIAL_NUMBERS, NUMBERS_DRAWN, Distribution, DrawnSection, Range
from sinsjax.value_types import Name

TIMES, COUNT = "reset_times_s", "reset_count"
"""If both are variables, the second is the number of ranges of the first that are used."""

Ranges = dict[str, Range | tuple[Range, ...]]

_LAW_NAMES = tuple(Distribution.model_fields)
_LAW_MEANINGS = {
    name: Distribution.model_fields[name].description for name in ("normal", "uniform")
}
_LAW_FORMS = ", ".join(f"{name} = {meaning}" for name, meaning in _LAW_MEANINGS.items())
_RANGE_KEYS = tuple(Range.model_fields)
_VARIABLES, _BASELINE = "[tune.variables]", "[tune.baseline]"
_TUNING_DRAWS = {key: leaf_info(key).in_simulation for key in ("tune_draws", "evaluation_draws")}
_GONE_SETTINGS = ("evolution_screen", "evolution_steps", "feedback_phases")
"""Settings of [tune] of the search 'covariance' of version 1.0."""

_STRICT = ConfigDict(strict=True, allow_inf_nan=False)


def sweep_dimensions(
    cases: Sequence[TomlTable], zips: Iterable[Dimension], axes: Dimension
) -> list[Dimension]:
    """Return the dimensions of a sweep: tables of values by key, whose product is the sweep.

    Args:
        cases: one table per case.
        zips: values by key of each zip.
        axes: values by key, one dimension per key.

    Returns:
        The cases first, since they vary most slowly, with the label before their keys; then the
        zips; then the axes.
    """
    keys = sorted(cases[0] if cases else (), key=lambda key: key != "case")
    joint = {key: tuple(case[key] for case in cases) for key in keys}
    return [*([joint] if joint else ()), *zips, *({key: axes[key]} for key in axes)]


class Sweep(NamedTuple):
    """The variation of a study, with attributes of the same name as in `Study`."""

    axes: Dimension
    zips: dict[str, Dimension]
    cases: tuple[TomlTable, ...]
    drawn: DrawnSection | None

    @property
    def key_tables(self) -> dict[str, str]:
        """The table, in brackets, of every key that is swept or drawn."""
        return {
            **dict.fromkeys(self.axes, "[axes]"),
            **{key: f"[axes.{name}]" for name, keys in self.zips.items() for key in keys},
            **dict.fromkeys(self.cases[0] if self.cases else (), "[cases]"),
            **dict.fromkeys(self.drawn.laws if self.drawn else (), "[drawn]"),
        }

    def values(self, key: str) -> set[Any]:
        """Return the values over which a key is swept; empty if it is not swept."""
        dimensions = sweep_dimensions(self.cases, self.zips.values(), self.axes)
        return {value for dimension in dimensions for value in dimension.get(key, ())}


def read_sweep(tables: TomlTable) -> Sweep:
    """Return the axes, zips, cases and drawn keys of a study.

    Args:
        tables: tables of the file, with tuples for lists.

    Raises:
        InputError: ``[table] key: what is wrong (hint)``.
    """
    errors, swept = ErrorCollector(), Sweep({}, {}, (), None)
    with errors.collect():
        axes, zips = _read_axes(tables)
        swept = swept._replace(axes=axes, zips=zips)
    with errors.collect():
        swept = swept._replace(cases=_read_cases(tables, _axis_keys(tables)))
    key_tables = {key: f"[{name}]" for name in SWEEPABLE for key in tables.get(name, ())}
    with errors.collect():
        swept = swept._replace(drawn=_read_drawn(tables, key_tables | swept.key_tables))
    errors.raise_all()
    return swept


def check_value(value: Any, key: str, place: str) -> Any:
    """Return a value of a key, as a study has it.

    Args:
        value: value to check.
        key: leaf key, or ``case``.
        place: place that an error names.

    Raises:
        InputError: the key does not accept the value.
    """
    if value is None:
        raise InputError(f"{place}: None is not a value")
    name = f"{SECTION_OF.get(key)}.{key}"
    try:
        return _validator(key)(value)
    except ValidationError as error:
        raise InputError(
            *(
                f"{place}{format_list_index(detail)}: {explain_error(detail, name)}"
                for detail in correctable_errors(error)
            )
        ) from None


def correctable_errors(error: ValidationError) -> list[ErrorDetails]:
    """Return the errors of values that a user can correct.

    Consequences of these errors are left out: a list too short without its wrong entries, and a
    default that depends on a wrong value.
    """
    errors = [detail for detail in error.errors() if detail["type"] != "default_factory_not_called"]
    with_entries = {
        _location_without_indices(detail) for detail in errors if format_list_index(detail)
    }
    return [
        detail
        for detail in errors
        if format_list_index(detail) or detail["loc"] not in with_entries
    ]


def _location_without_indices(error: ErrorDetails) -> tuple[int | str, ...]:
    return tuple(part for part in error["loc"] if not isinstance(part, int))


def value_error(value: Any, key: str) -> str | None:
    """Return the rule that a value of a leaf key breaks; None for a valid value."""
    try:
        _validator(key)(value)
    except ValidationError as error:
        return describe_broken_rule(error.errors()[0])
    return None


def check_values(values: Iterable[Any], key: str, place: str) -> tuple[Any, ...]:
    """Return the entries of a list as values of a key, see `check_value`.

    Raises:
        InputError: some are not valid; a line per value.
    """
    errors, checked = ErrorCollector(), []
    for i, value in enumerate(values):
        with errors.collect():
            checked.append(check_value(value, key, f"{place}[{i}]"))
    errors.raise_all()
    return tuple(checked)


def _read_axes(tables: TomlTable) -> tuple[Dimension, dict[str, Dimension]]:
    """Return the single axes and the zips."""
    axes, zips, errors = {}, {}, ErrorCollector()
    for key, values in tables.get("axes", {}).items():
        with errors.collect():
            if isinstance(values, Mapping):
                zips[key] = _read_zip(tables, key, values)
            else:
                axes[key] = _read_axis("axes", key, values, "record" in tables)
                _check_distinct(axes[key], f"[axes] {key}")
    used_keys = set(axes)
    for name, keys in zips.items():
        with errors.collect():
            for key in keys:
                if key in used_keys:
                    raise InputError(f"[axes.{name}] {key}: is an axis already (drop one of them)")
        used_keys |= keys.keys()
    errors.raise_all()
    return axes, zips


def _axis_keys(tables: TomlTable) -> set[str]:
    """Return the keys of all axes, with right or wrong values."""
    axes = tables.get("axes", {})
    zipped = {key for values in axes.values() if isinstance(values, Mapping) for key in values}
    return zipped | {key for key, values in axes.items() if not isinstance(values, Mapping)}


def _read_zip(tables: TomlTable, name: str, keys: Mapping[str, Any]) -> Dimension:
    """Return the axes of a table, which vary together."""
    table = f"axes.{name}"
    if not keys:
        raise InputError(f"[{table}]: must not be empty")
    joint, errors = {}, ErrorCollector()
    for key, values in keys.items():
        with errors.collect():
            joint[key] = _read_axis(table, key, values, "record" in tables)
    errors.raise_all()
    first = next(iter(joint))
    for key, values in joint.items():
        if len(values) != len(joint[first]):
            text = f"has {len(values)} values, but {first} has {len(joint[first])}"
            raise InputError(f"[{table}] {key}: {text} (give as many, since they vary together)")
    _check_distinct(list(zip(*joint.values(), strict=True)), f"[{table}] {', '.join(joint)}")
    return joint


def _read_axis(table: str, key: str, values: Any, recorded: bool) -> tuple[Any, ...]:
    _check_sweepable(table, key, recorded)
    if not isinstance(values, tuple):
        raise InputError(f"[{table}] {key}: must be a list of values, not {values!r}")
    if not values:
        raise InputError(f"[{table}] {key}: must not be empty")
    return check_values(values, key, f"[{table}] {key}")


def _read_cases(tables: TomlTable, axes: set[str]) -> tuple[TomlTable, ...]:
    """Return the cases, with no key that is an axis too."""
    rows = tables.get("cases", ())
    if not isinstance(rows, tuple) or not all(isinstance(row, Mapping) for row in rows):
        raise InputError("[cases]: must be tables, each under a line [[cases]]")
    if "cases" in tables and not any(rows):
        raise InputError("[cases]: must not be empty")
    keys = list(rows[0]) if rows else []
    errors = ErrorCollector()
    for key in keys:
        with errors.collect():
            if key != "case":
                _check_sweepable("cases", key, "record" in tables)
            if key in axes:
                raise InputError(f"[cases] {key}: is an axis already (drop one of them)")
    for i, row in enumerate(rows):
        for key in dict.fromkeys((*keys, *row)):
            if key not in row or key not in keys:
                raise InputError(
                    f"[cases] {key}[{i}]: is not in every case (give it in all of them)"
                )
    errors.raise_all()
    columns = {}
    for key in keys:
        with errors.collect():
            columns[key] = check_values([row[key] for row in rows], key, f"[cases] {key}")
    errors.raise_all()
    cases = tuple({key: columns[key][i] for key in keys} for i in range(len(rows)))
    values = [key for key in keys if key != "case"]
    place = f"[cases] {', '.join(values) or 'case'}"
    _check_distinct([tuple(case[key] for key in values) for case in cases], place)
    if "case" in keys:
        _check_distinct([case["case"] for case in cases], "[cases] case")
    return cases


def _read_drawn(tables: TomlTable, key_tables: Mapping[str, str]) -> DrawnSection | None:
    """Return the distributions of the drawn keys, none of which is given elsewhere."""
    if "drawn" not in tables:
        return None
    table = dict(tables["drawn"])
    sampling = {"sampling": table.pop("sampling")} if "sampling" in table else {}
    if not table:
        raise InputError("[drawn]: has no key to draw (drop it)")
    laws, errors = {}, ErrorCollector()
    for key, law in table.items():
        with errors.collect():
            _check_drawable(key, "record" in tables)
            if key in key_tables:
                raise InputError(
                    f"[drawn] {key}: is in {key_tables[key]} already (drop one of them)"
                )
            laws[key] = _read_law(key, law)
    errors.raise_all()
    try:
        return DrawnSection.model_validate(sampling | laws)
    except ValidationError as error:
        raise InputError(f"[drawn] sampling: {explain_error(error.errors()[0])}") from None


def _read_law(key: str, table: Any) -> Distribution:
    """Return the distribution of a key, with all list entries checked as its values."""
    if not isinstance(table, Mapping):
        example = f"{key} = {{ uniform = [0, 1] }}"
        raise InputError(f"[drawn] {key}: must be a table such as {example}, not {table!r}")
    for name in table:
        if name not in _LAW_NAMES:
            hint = suggest_closest(name, _LAW_NAMES) or f" (use {_LAW_FORMS}, values or grid)"
            raise InputError(f"[drawn] {key}.{name}: unknown key{hint}")
    if len(table) != 1:
        given = " and ".join(table) or "none"
        raise InputError(f"[drawn] {key}: needs one of {', '.join(_LAW_NAMES)}, not {given}")
    ((name, value),) = table.items()
    place = f"[drawn] {key}.{name}"
    if value is None:
        raise InputError(f"{place}: None is not a value")
    try:
        law = Distribution.model_validate({name: value})
    except ValidationError as error:
        first = error.errors()[0]
        text = f"{place}{format_list_index(first)}: {explain_error(first)}"
        if first["type"] in ("tuple_type", "missing", "too_long") and name in _LAW_MEANINGS:
            text += f" (use {name} = {_LAW_MEANINGS[name]})"
        raise InputError(text) from None
    if name not in ("values", "grid"):
        return law
    return Distribution.model_validate({name: check_values(value, key, place)})


def _check_sweepable(table: str, key: str, recorded: bool) -> None:
    section = SECTION_OF.get(key)
    if key == "start_s":
        reason = "cannot be swept (list the start times in [record], one draw each)"
    elif key == "attitude_file":
        reason = "cannot be swept (use one study per file)"
    elif section is None:
        sweepable = [name for name, home in SECTION_OF.items() if home in SWEEPABLE]
        reason = unknown_key_error(key, sweepable)
    elif section == "study":
        reason = "cannot be swept (all runs share [study]: use one study per value)"
    elif section not in SWEEPABLE:
        reason = f"cannot be swept (it is a key of [{section}])"
    elif recorded and section in SIMULATED_ONLY:
        reason = f"does not apply to a recorded study (drop it, [{section}] is for simulations)"
    else:
        return
    raise InputError(f"[{table}] {key}: {reason}")


def _check_drawable(key: str, recorded: bool) -> None:
    section = SECTION_OF.get(key)
    if section is None:
        reason = unknown_key_error(key, NUMBERS_DRAWN)
    elif key not in NUMBERS_DRAWN:
        kinds = "latitude_deg, keys of [motion] and [sensors]"
        reason = f"cannot be drawn (possible: {kinds}, {', '.join(INITIAL_NUMBERS)})"
    elif recorded and section in SIMULATED_ONLY:
        reason = f"does not apply to a recorded study (drop it, [{section}] is for simulations)"
    elif recorded and key not in INITIAL_NUMBERS:
        reason = f"cannot be drawn in a recorded study (possible: {', '.join(INITIAL_NUMBERS)})"
    else:
        return
    raise InputError(f"[drawn] {key}: {reason}")


def _check_distinct(values: Sequence[Any], place: str) -> None:
    seen: dict[Any, int] = {}
    for i, value in enumerate(values):
        if seen.setdefault(value, i) < i:
            raise InputError(f"{place}[{i}]: repeats [{seen[value]}] (drop one of them)")


@functools.cache
def _validator(key: str) -> Callable[[Any], Any]:
    annotation: Any = Name
    if key != "case":
        field = SECTIONS[SECTION_OF[key]].model_fields[key]
        annotation = Annotated[field.annotation, field]
    strict = ConfigDict(strict=True, allow_inf_nan=False)
    return TypeAdapter(annotation, config=strict).validate_python


def read_tune_section(table: TomlTable, swept: Mapping[str, str], *, recorded: bool) -> TomlTable:
    """Return the section [tune] with checked ranges and values, and default numbers of draws.

    Args:
        table: table of the file, with tuples for lists.
        swept: the table, in brackets, of each key that is swept or drawn.
        recorded: whether the study reads a record.

    Raises:
        InputError: ``[table] key: what is wrong (hint)``.
    """
    table, errors = dict(table), ErrorCollector()
    for key, default in _TUNING_DRAWS.items():
        if not recorded:
            table.setdefault(key, default)
        elif key in table:
            text = "does not apply to a recorded study (drop it: tuning uses the start times)"
            errors.add(f"[tune] {key}: {text}")
    for key, read in (("variables", _read_ranges), ("baseline", _read_baseline)):
        with errors.collect():
            if key in table and not isinstance(table[key], Mapping):
                raise InputError(f"[tune] {key}: must be a table of keys")
            if key in table:
                table[key] = read(table[key], swept)
    errors.raise_all()
    return table


def without_gone_settings(tables: TomlTable) -> TomlTable:
    """Return a study's sections without settings that version 1.0 wrote into every [tune].

    They have no effect: the search that read them is refused.
    """
    tune = tables.get("tune")
    if not isinstance(tune, Mapping):
        return tables
    return tables | {"tune": {k: v for k, v in tune.items() if k not in _GONE_SETTINGS}}


def describe_gone_settings(tables: TomlTable) -> list[str]:
    """Return a line about the settings that `without_gone_settings` takes out, if there are any."""
    found = [key for key in _GONE_SETTINGS if key in tables.get("tune", ())]
    text = gone.LINE.format("drop it: only the search 'covariance' read it")
    return [f"[tune] {', '.join(found)}: {text}."] if found else []


def _read_baseline(table: TomlTable, swept: Mapping[str, str]) -> TomlTable:
    values, errors = {}, ErrorCollector()
    remaining = dict.fromkeys(table, _BASELINE)
    for key, value in table.items():
        del remaining[key]
        with errors.collect():
            _check_tunable(key, swept, _BASELINE)
            _check_alternatives(key, remaining, _BASELINE)
            values[key] = check_value(value, key, f"{_BASELINE} {key}")
    errors.raise_all()
    return values


def _read_ranges(table: TomlTable, swept: Mapping[str, str]) -> Ranges:
    if not table:
        raise InputError(f"{_VARIABLES}: has no key to tune (give one with its range)")
    ranges: Ranges = {}
    errors = ErrorCollector()
    for key, value in table.items():
        with errors.collect():
            _check_tunable(key, swept, _VARIABLES)
            ranges[key] = _read_key_range(key, value)
    errors.raise_all()
    times, count = ranges.get(TIMES), ranges.get(COUNT)
    key_tables = dict.fromkeys(ranges, _VARIABLES)
    if isinstance(times, tuple) and isinstance(count, Range):
        for number in count.candidates or (count.fixed,):
            if number > len(times):
                text = f"{number} are more than the {len(times)} ranges of {TIMES} (add ranges)"
                raise InputError(f"{_VARIABLES} {COUNT}: {text}")
        del key_tables[COUNT]
    for key in key_tables:
        _check_alternatives(key, key_tables, _VARIABLES)
    return ranges


def _check_tunable(key: str, swept: Mapping[str, str], place: str) -> None:
    """Refuse a key that is unknown, that cannot be tuned, or that the study varies."""
    section = SECTION_OF.get(key)
    if section is None:
        known = [name for name, home in SECTION_OF.items() if home in TUNABLE]
        raise InputError(f"{place} {key}: {unknown_key_error(key, known)}")
    if section not in TUNABLE:
        raise InputError(f"{place} {key}: cannot be tuned (it is a key of [{section}])")
    if key in swept:
        raise InputError(f"{place} {key}: is in {swept[key]} already (drop one of them)")
    _check_alternatives(key, swept, place)


def _check_alternatives(key: str, key_tables: Mapping[str, str], place: str) -> None:
    for alternative in sorted(alternative_keys(key) & key_tables.keys()):
        text = f"conflicts with {alternative} in {key_tables[alternative]} (give one of them)"
        raise InputError(f"{place} {key}: {text}")


def _read_key_range(key: str, value: Any) -> Range | tuple[Range, ...]:
    """Return the range of a key: of its number, of each entry of its list, or its candidates."""
    place, entries = (
        f"{_VARIABLES} {key}",
        _entry_types(SECTIONS[SECTION_OF[key]].model_fields[key].annotation),
    )
    if not isinstance(value, tuple):
        key_range = _read_range(place, key, value)
        if key_range.is_free and entries:
            raise InputError(f"{place}: needs a list with one range per entry, not one range")
        if key_range.is_free:
            for name in ("low", "high"):
                _refuse_whole_number(check_value(value[name], key, f"{place}.{name}"), place)
        return key_range
    if not entries:
        raise InputError(f"{place}: needs one range, not a list (the key is one number)")
    if not value:
        raise InputError(f"{place}: must not be empty")
    if Ellipsis not in entries and len(value) != len(entries):
        raise InputError(f"{place}: must have {len(entries)} ranges, not {len(value)}")
    errors, ranges = ErrorCollector(), []
    for i, entry_range in enumerate(value):
        with errors.collect():
            ranges.append(_read_entry_range(f"{place}[{i}]", entry_range, entries[0]))
    errors.raise_all()
    return tuple(ranges)


def _read_entry_range(place: str, value: Any, entry_type: Any) -> Range:
    """Return the range of one entry of a list, whose entries have a given type."""
    entry_range = _read_range(place, None, value)
    if entry_range.candidates is not None:
        raise InputError(f"{place}.candidates: must be of the whole key, not of one entry")
    for name in ("low", "high") if entry_range.is_free else ("fixed",):
        try:
            end = TypeAdapter(entry_type, config=_STRICT).validate_python(value[name])
        except ValidationError as error:
            raise InputError(f"{place}.{name}: {explain_error(error.errors()[0])}") from None
        if entry_range.is_free:
            _refuse_whole_number(end, place)
    return entry_range


def _read_range(place: str, key: str | None, value: Any) -> Range:
    """Return a range of the file, with its values checked as those of a key, if any."""
    if not isinstance(value, Mapping):
        raise InputError(f"{place}: must be a table such as {{ low = 0, high = 1 }}, not {value!r}")
    for name in value:
        if name not in _RANGE_KEYS:
            raise InputError(f"{place}.{name}: unknown key{suggest_closest(name, _RANGE_KEYS)}")
    try:
        value_range = Range.model_validate(
            ({"scale": "linear"} if "low" in value else {}) | dict(value)
        )
    except ValidationError as error:
        first = error.errors()[0]
        name = first["loc"][0] if first["loc"] else first.get("ctx", {}).get("key")
        suffix = f".{name}{format_list_index(first)}" if name else ""
        raise InputError(f"{place}{suffix}: {explain_error(first)}") from None
    if key is None:
        return value_range
    if value_range.fixed is not None:
        return value_range.model_copy(
            update={"fixed": check_value(value_range.fixed, key, f"{place}.fixed")}
        )
    if value_range.candidates is not None:
        suffix = f"{place}.candidates"
        values = check_values(value_range.candidates, key, suffix)
        if len(set(values)) < len(values):
            raise InputError(f"{suffix}: repeats a value (drop one)")
        return value_range.model_copy(update={"candidates": values})
    return value_range


def _refuse_whole_number(end: Any, place: str) -> None:
    if isinstance(end, int):
        raise InputError(f"{place}: must be whole numbers (list them as candidates)")


def _entry_types(annotation: Any) -> tuple[Any, ...]:
    """Return the types of the entries of a list key; empty for other keys."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is tuple:
        return arguments
    if origin is Annotated:
        return _entry_types(arguments[0])
    if origin in (Union, UnionType):
        return next((types for part in arguments if (types := _entry_types(part))), ())
    return ()
