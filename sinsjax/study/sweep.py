"""Reading the tables that vary a study: [axes] with their zips, [[cases]], [drawn], [tune].

Every value is checked as a value of its key. Errors name all wrong values by their index, from 0:
``[axes] phi_u0_deg[3]``, ``[axes.level] phi_e0_deg[0]``, ``[drawn] phi_u0_deg.values[2]``,
``[tune.variables] reset_times_s[1].low``.
"""

import functools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin

from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from sinsjax import gone
from sinsjax.errors import ErrorCollector, InputError
from sinsjax.messages import describe_broken_rule, explain_error, format_list_index, suggest_closest
from sinsjax.study.defaults import GivenKeys, dependent_default
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
from sinsjax.study.schema import INITIAL_NUMBERS, NUMBERS_DRAWN, Distribution, DrawnSection, Range
from sinsjax.study.sweep_columns import Dimension
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
_GONE_SETTINGS = ("evolution_screen", "evolution_steps", "feedback_phases")
"""Settings of [tune] of the search 'covariance' of version 1.0."""

_Check = Callable[[Any], Any]
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
    """The variation of a study.

    Attributes:
        axes: as in `Study`, like the next three.
        zips: see above.
        cases: see above.
        drawn: see above.
        inherited: keys that some cases have from their sections, where they do not count any more.
    """

    axes: Dimension = {}
    zips: dict[str, Dimension] = {}
    cases: tuple[TomlTable, ...] = ()
    drawn: DrawnSection | None = None
    inherited: frozenset[str] = frozenset()

    @property
    def table_of(self) -> dict[str, str]:
        """The table, in brackets, of every key that is swept or drawn."""
        return {
            **dict.fromkeys(self.axes, "[axes]"),
            **{key: f"[axes.{name}]" for name, keys in self.zips.items() for key in keys},
            **dict.fromkeys(self.cases[0] if self.cases else (), "[cases]"),
            **dict.fromkeys(self.drawn.laws if self.drawn else (), "[drawn]"),
        }

    @property
    def for_study(self) -> TomlTable:
        """The attributes of a `Study`."""
        return {name: value for name, value in self._asdict().items() if name != "inherited"}

    @property
    def values(self) -> dict[str, tuple[Any, ...]]:
        """The values of every key that is swept; none of keys that are drawn."""
        dimensions = sweep_dimensions(self.cases, self.zips.values(), self.axes)
        swept = {key: values for dimension in dimensions for key, values in dimension.items()}
        return dict.fromkeys(self.drawn.laws if self.drawn else (), ()) | swept


def read_sweep(tables: TomlTable) -> Sweep:
    """Return the axes, zips, cases and drawn keys of a study.

    Args:
        tables: tables of the file, with tuples for lists.

    Raises:
        InputError: ``[table] key: what is wrong (hint)``.
    """
    errors, swept = ErrorCollector(), Sweep()
    with errors.collect():
        axes, zips = _read_axes(tables)
        swept = swept._replace(axes=axes, zips=zips)
    with errors.collect():
        cases, inherited = _read_cases(tables, swept.values)
        swept = swept._replace(cases=cases, inherited=inherited)
    table_of = {key: f"[{name}]" for name in SWEEPABLE for key in tables.get(name, ())}
    with errors.collect():
        swept = swept._replace(drawn=_read_drawn(tables, table_of | swept.table_of))
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
    return _check_type(value, _validator(key), place, f"{SECTION_OF.get(key)}.{key}")


def _check_type(value: Any, validate: _Check, place: str, name: str = "") -> Any:
    try:
        return validate(value)
    except ValidationError as error:
        raise InputError(
            *(
                f"{place}{format_list_index(detail)}: {explain_error(detail, name)}"
                for detail in correctable_errors(error)
            )
        ) from None


@functools.cache
def _validator(key: str) -> _Check:
    annotation: Any = Name
    if key != "case":
        field = SECTIONS[SECTION_OF[key]].model_fields[key]
        annotation = Annotated[field.annotation, field]
    return TypeAdapter(annotation, config=_STRICT).validate_python


def correctable_errors(error: ValidationError) -> list[ErrorDetails]:
    """Return the errors of values that a user can correct.

    Consequences of these errors are left out: a list too short without its wrong entries, and a
    default that depends on a wrong value.
    """

    def of_whole(detail: ErrorDetails) -> tuple[int | str, ...]:
        return tuple(part for part in detail["loc"] if not isinstance(part, int))

    errors = [detail for detail in error.errors() if detail["type"] != "default_factory_not_called"]
    with_entries = {of_whole(detail) for detail in errors if format_list_index(detail)}
    return [d for d in errors if format_list_index(d) or d["loc"] not in with_entries]


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
    return _check_each(values, place, lambda value, at: check_value(value, key, at))


def _check_each(
    values: Iterable[Any], place: str, check: Callable[[Any, str], Any]
) -> tuple[Any, ...]:
    errors, checked = ErrorCollector(), []
    for i, value in enumerate(values):
        with errors.collect():
            checked.append(check(value, f"{place}[{i}]"))
    errors.raise_all()
    return tuple(checked)


def _read_axes(tables: TomlTable) -> tuple[Dimension, dict[str, Dimension]]:
    """Return the single axes and the zips."""
    axes, zips, errors, recorded = {}, {}, ErrorCollector(), "record" in tables
    for key, values in tables.get("axes", {}).items():
        with errors.collect():
            if isinstance(values, Mapping):
                zips[key] = _read_zip(f"[axes.{key}]", values, recorded)
            else:
                axes[key] = _read_axis("[axes]", key, values, recorded)
                _check_distinct(axes[key], f"[axes] {key}")
    used_keys = set(axes)
    for name, keys in zips.items():
        with errors.collect():
            for key in used_keys & keys.keys():
                raise InputError(f"[axes.{name}] {key}: is an axis already (drop one of them)")
        used_keys |= keys.keys()
    errors.raise_all()
    return axes, zips


def _axis_keys(tables: TomlTable) -> set[str]:
    """Return the keys of all axes, with right or wrong values."""
    axes = tables.get("axes", {})
    return {
        key
        for name, values in axes.items()
        for key in (values if isinstance(values, Mapping) else (name,))
    }


def _read_zip(table: str, keys: Mapping[str, Any], recorded: bool) -> Dimension:
    """Return the axes of a table, which vary together."""
    if not keys:
        raise InputError(f"{table}: must not be empty")
    joint, errors = {}, ErrorCollector()
    for key, values in keys.items():
        with errors.collect():
            joint[key] = _read_axis(table, key, values, recorded)
    errors.raise_all()
    first = next(iter(joint))
    for key, values in joint.items():
        if len(values) != len(joint[first]):
            text = f"has {len(values)} values, but {first} has {len(joint[first])}"
            raise InputError(f"{table} {key}: {text} (give as many, since they vary together)")
    _check_distinct(list(zip(*joint.values(), strict=True)), f"{table} {', '.join(joint)}")
    return joint


def _read_axis(table: str, key: str, values: Any, recorded: bool) -> tuple[Any, ...]:
    _check_sweepable(table, key, recorded)
    if not isinstance(values, tuple):
        raise InputError(f"{table} {key}: must be a list of values, not {values!r}")
    if not values:
        raise InputError(f"{table} {key}: must not be empty")
    return check_values(values, key, f"{table} {key}")


def _read_cases(
    tables: TomlTable, axes: Mapping[str, Collection[Any]]
) -> tuple[tuple[TomlTable, ...], frozenset[str]]:
    """Return the cases, each with the same keys, and the keys that some have from their sections.

    A key that a case leaves out has the value of its section, or its default; None if an
    alternative to it is given instead.
    """
    rows = tables.get("cases", ())
    if not isinstance(rows, tuple) or not all(isinstance(row, Mapping) for row in rows):
        raise InputError("[cases]: must be tables, each under a line [[cases]]")
    if "cases" in tables and not any(rows):
        raise InputError("[cases]: must not be empty")
    keys, swept = dict.fromkeys(key for row in rows for key in row), _axis_keys(tables)
    errors = ErrorCollector()
    for key in keys:
        with errors.collect():
            if key != "case":
                _check_sweepable("[cases]", key, "record" in tables)
            if key in swept:
                raise InputError(f"[cases] {key}: is an axis already (drop one of them)")
    errors.raise_all()
    rivals = {key: alternative_keys(key) & keys.keys() for key in keys}
    given: list[TomlTable] = []
    for i, row in enumerate(rows):
        given.append({})
        for key, value in row.items():
            with errors.collect():
                given[i][key] = check_value(value, key, f"[cases] {key}[{i}]")
                for other in sorted(rivals[key] & row.keys()):
                    text = f"conflicts with {other} in the same case (give one of them)"
                    raise InputError(f"[cases] {key}[{i}]: {text}")
        if "case" in keys and "case" not in row:
            errors.add(f"[cases] case[{i}]: is not in every case (give it in all of them)")
    errors.raise_all()
    inherited = [key for key in keys if any(key not in row for row in rows)]
    others = [other for key in inherited for other in sorted(alternative_keys(key))]
    # What a case without a key has in its place differs from case to case too.
    acting = [
        key
        for key in dict.fromkeys(others)
        if key in tables.get(SECTION_OF[key], ()) or _acts_by_default(key, tables)
    ]
    keys |= dict.fromkeys(acting)
    with errors.collect():
        cases = tuple(_complete_case(row, keys, tables, axes) for row in given)
    errors.raise_all()
    names = [key for key in keys if key != "case"]
    place = f"[cases] {', '.join(names) or 'case'}"
    _check_distinct([tuple(case[key] for key in names) for case in cases], place)
    if "case" in keys:
        _check_distinct([case["case"] for case in cases], "[cases] case")
    return cases, frozenset((*inherited, *acting))


def _acts_by_default(key: str, tables: TomlTable) -> bool:
    """Return whether a key that is left out, with its alternatives, acts by its default."""
    default = dependent_default(key, GivenKeys(tables, {}))
    return default is not None and key != "reset_count"


def _complete_case(
    row: TomlTable, keys: Iterable[str], tables: TomlTable, axes: Mapping[str, Collection[Any]]
) -> TomlTable:
    """Return a case with the values of some keys that it leaves out."""
    given = GivenKeys(tables, {})
    if any(key not in row for key in keys):
        given = GivenKeys(tables, {**axes, **{key: (value,) for key, value in row.items()}})
    return {key: row[key] if key in row else _inherited_value(key, given) for key in keys}


def _inherited_value(key: str, given: GivenKeys) -> Any:
    """Return the value of a key that a case leaves out."""
    name, alternatives = SECTION_OF[key], alternative_keys(key)
    section = given.tables.get(name, {})
    if not alternatives.isdisjoint(given.varied):
        return None
    if key in section:
        return check_value(section[key], key, f"[{name}] {key}")
    default = dependent_default(key, given)
    if default is None and alternatives.isdisjoint(section):
        default = SECTIONS[name].model_fields[key].get_default()
    return default


def _read_drawn(tables: TomlTable, table_of: Mapping[str, str]) -> DrawnSection | None:
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
            if key in table_of:
                raise InputError(f"[drawn] {key}: is in {table_of[key]} already (drop one of them)")
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
    """Refuse a key that is unknown or cannot be swept."""
    section = SECTION_OF.get(key)
    if key == "start_s":
        reason = "cannot be swept (list the start times in [record], one draw each)"
    elif key == "attitude_file":
        reason = "cannot be swept (use one study per file)"
    elif section is None:
        reason = unknown_key_error(key, [k for k, home in SECTION_OF.items() if home in SWEEPABLE])
    elif section == "study":
        reason = "cannot be swept (all runs share [study]: use one study per value)"
    elif section not in SWEEPABLE:
        reason = f"cannot be swept (it is a key of [{section}])"
    elif recorded and section in SIMULATED_ONLY:
        reason = f"does not apply to a recorded study (drop it, [{section}] is for simulations)"
    else:
        return
    raise InputError(f"{table} {key}: {reason}")


def _check_drawable(key: str, recorded: bool) -> None:
    """Refuse a key that is unknown or cannot be drawn."""
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


def read_tune_section(table: TomlTable, swept: Mapping[str, str], *, recorded: bool) -> TomlTable:
    """Return the section [tune] with checked ranges and values.

    Args:
        table: table of the file, with tuples for lists.
        swept: the table, in brackets, of each key that is swept or drawn.
        recorded: whether the study reads a record.

    Raises:
        InputError: ``[table] key: what is wrong (hint)``.
    """
    table, errors = dict(table), ErrorCollector()
    for key in table if recorded else ():
        if leaf_info(key).in_simulation is not None:
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
    tables = dict.fromkeys(ranges, _VARIABLES)
    if isinstance(times, tuple) and isinstance(count, Range):
        for number in count.candidates or (count.fixed,):
            if number > len(times):
                text = f"{number} are more than the {len(times)} ranges of {TIMES} (add ranges)"
                raise InputError(f"{_VARIABLES} {COUNT}: {text}")
        del tables[COUNT]
    for key in tables:
        _check_alternatives(key, tables, _VARIABLES)
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


def _check_alternatives(key: str, table_of: Mapping[str, str], place: str) -> None:
    for other in sorted(alternative_keys(key) & table_of.keys()):
        text = f"conflicts with {other} in {table_of[other]} (give one of them)"
        raise InputError(f"{place} {key}: {text}")


def _read_key_range(key: str, value: Any) -> Range | tuple[Range, ...]:
    """Return the range of a key: of its number, of each entry of its list, or its candidates."""
    place, field = f"{_VARIABLES} {key}", SECTIONS[SECTION_OF[key]].model_fields[key]
    entries = _entry_types(field.annotation)
    if not isinstance(value, tuple):
        found = _parse_range(place, value)
        if found.is_free and entries:
            raise InputError(f"{place}: needs a list with one range per entry, not one range")
        return _check_range(found, value, place, lambda one, at: check_value(one, key, at))
    if not entries:
        raise InputError(f"{place}: needs one range, not a list (the key is one number)")
    if not value:
        raise InputError(f"{place}: must not be empty")
    if Ellipsis not in entries and len(value) != len(entries):
        raise InputError(f"{place}: must have {len(entries)} ranges, not {len(value)}")
    validate: _Check = TypeAdapter(entries[0], config=_STRICT).validate_python

    def read_entry(entry: Any, at: str) -> Range:
        found = _parse_range(at, entry)
        if found.candidates is not None:
            raise InputError(f"{at}.candidates: must be of the whole key, not of one entry")
        return _check_range(found, entry, at, lambda one, end: _check_type(one, validate, end))

    return _check_each(value, place, read_entry)


def _parse_range(place: str, value: Any) -> Range:
    """Return a range of the file, whose values are not checked."""
    if not isinstance(value, Mapping):
        raise InputError(f"{place}: must be a table such as {{ low = 0, high = 1 }}, not {value!r}")
    for name in value:
        if name not in _RANGE_KEYS:
            raise InputError(f"{place}.{name}: unknown key{suggest_closest(name, _RANGE_KEYS)}")
    try:
        return Range.model_validate(({"scale": "linear"} if "low" in value else {}) | dict(value))
    except ValidationError as error:
        first = error.errors()[0]
        name = first["loc"][0] if first["loc"] else first.get("ctx", {}).get("key")
        suffix = f".{name}{format_list_index(first)}" if name else ""
        raise InputError(f"{place}{suffix}: {explain_error(first)}") from None


def _check_range(
    found: Range, given: TomlTable, place: str, check: Callable[[Any, str], Any]
) -> Range:
    """Return a range with its given values as a check of (value, place) returns them."""
    if found.candidates is not None:
        values = _check_each(given["candidates"], f"{place}.candidates", check)
        if len(set(values)) < len(values):
            raise InputError(f"{place}.candidates: repeats a value (drop one)")
        return found.model_copy(update={"candidates": values})
    ends = ("low", "high") if found.is_free else ("fixed",)
    checked = {name: check(given[name], f"{place}.{name}") for name in ends}
    if found.is_free and any(isinstance(end, int) for end in checked.values()):
        raise InputError(f"{place}: must be whole numbers (list them as candidates)")
    return found if found.is_free else found.model_copy(update=checked)


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
