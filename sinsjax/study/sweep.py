"""Reading the tables that vary a study: [axes] with their zips, [[cases]], [drawn], [tune].

Every value is checked as a value of its key. Errors name all wrong values by their index, from 0:
``[axes] phi_u0_deg[3]``, ``[axes.level] phi_e0_deg[0]``, ``[drawn] phi_u0_deg.values[2]``,
``[tune.variables] reset_times_s[1].low``.
"""

import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
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

_VARIABLES = "[tune.variables]"
_GONE_SETTINGS = ("evolution_screen", "evolution_steps", "feedback_phases")
"""Settings of [tune] of the search 'covariance' of version 1.0."""

_Forms = Mapping[str, str]


def _forms(table: type[BaseModel]) -> _Forms:
    """Return how the keys of a table are written, for the user."""
    texts = {name: field.description or "" for name, field in table.model_fields.items()}
    return {name: f"{name} = {text}" if text[0] == "[" else name for name, text in texts.items()}


_LAWS, _RANGES, _NO_FORMS = _forms(Distribution), _forms(Range), _forms(BaseModel)
_STRICT = ConfigDict(strict=True, allow_inf_nan=False)
_INSTEAD = {
    "start_s": "list the start times in [record], one draw each",
    "attitude_file": "use one study per file",
} | dict.fromkeys(SECTIONS["study"].model_fields, "all runs share [study]: use one study per value")
"""What to do instead of varying a key over the variants."""


class Sweep(BaseModel):
    """What varies in a study.

    Attributes:
        axes: values of single axes by leaf key, in the order of the file.
        zips: axes that vary together by the name of their table: values by leaf key, all of the
            same length.
        cases: one table of leaf keys per case, all with the same keys; ``case`` is the label.
        drawn: distributions of keys whose value differs between draws; no section, axis or case
            has these keys.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    axes: Dimension = {}
    zips: dict[str, Dimension] = {}
    cases: tuple[TomlTable, ...] = ()
    drawn: DrawnSection | None = None

    @property
    def dimensions(self) -> list[Dimension]:
        """Tables of values by key, whose product is the sweep.

        The cases are the first, since they vary most slowly, with the label before their keys; then
        the zips; then the axes, one by one.
        """
        keys = sorted(self.cases[0] if self.cases else (), key=lambda key: key != "case")
        cases = {key: tuple(case[key] for case in self.cases) for key in keys}
        axes = ({key: values} for key, values in self.axes.items())
        return [*([cases] if cases else ()), *self.zips.values(), *axes]

    @property
    def axis_keys(self) -> tuple[str, ...]:
        """Keys that vary over the variants, in the order of the dimensions: cases, zips, axes.

        The label ``case``, if any, is the first.
        """
        return tuple(key for dimension in self.dimensions for key in dimension)

    @property
    def drawn_keys(self) -> tuple[str, ...]:
        """Keys whose value differs between draws, in the order of the file."""
        return tuple(self.drawn.laws) if self.drawn else ()

    @property
    def table_of(self) -> dict[str, str]:
        """The table, in brackets, of every key that is swept or drawn."""
        return {
            **dict.fromkeys(self.axes, "[axes]"),
            **{key: f"[axes.{name}]" for name, keys in self.zips.items() for key in keys},
            **dict.fromkeys(self.cases[0] if self.cases else (), "[cases]"),
            **dict.fromkeys(self.drawn_keys, "[drawn]"),
        }

    @property
    def values_varied(self) -> dict[str, tuple[Any, ...]]:
        """The values of every key that is swept; none of keys that are drawn."""
        swept = {key: values for dimension in self.dimensions for key, values in dimension.items()}
        return dict.fromkeys(self.drawn_keys, ()) | swept


def read_sweep(tables: TomlTable) -> tuple[Sweep, frozenset[str]]:
    """Return what varies in a study.

    Args:
        tables: tables of the file, with tuples for lists.

    Returns:
        Axes, zips, cases and drawn keys; and the keys that some cases have from their sections,
        where they do not count any more.

    Raises:
        InputError: ``[table] key: what is wrong (hint)``.
    """
    errors, sweep, inherited = ErrorCollector(), Sweep(), frozenset[str]()
    with errors.collect():
        axes, zips = _read_axes(tables)
        sweep = Sweep(axes=axes, zips=zips)
    with errors.collect():
        cases, inherited = _read_cases(tables, sweep.values_varied)
        sweep = sweep.model_copy(update={"cases": cases})
    table_of = {key: f"[{name}]" for name in SWEEPABLE for key in tables.get(name, ())}
    with errors.collect():
        drawn = _read_drawn(tables, table_of | sweep.table_of)
        sweep = sweep.model_copy(update={"drawn": drawn})
    errors.raise_all()
    return sweep, inherited


def check_value(value: Any, key: str, place: str, *, many: bool = False) -> Any:
    """Return a value of a key, as a study has it.

    Args:
        value: value to check.
        key: leaf key, or ``case``.
        place: place that an error names.
        many: whether it is a list of values instead.

    Raises:
        InputError: the key does not accept the value; a line per wrong entry.
    """
    return _check(_validator(key, many), value, place, f"{SECTION_OF.get(key)}.{key}")


def value_error(value: Any, key: str) -> str | None:
    """Return the rule that a value of a leaf key breaks; None for a valid value."""
    try:
        _validator(key)(value)
    except ValidationError as error:
        return describe_broken_rule(error.errors()[0])
    return None


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


def _check(
    validate: Callable[[Any], Any],
    value: Any,
    place: str,
    name: str = "",
    forms: _Forms = _NO_FORMS,
) -> Any:
    """Return a value as a function of pydantic returns it; an error names its place in a table."""

    def line(detail: ErrorDetails) -> str:
        kind, path, hint = detail["type"], "", f" (use {', '.join(forms.values())})"
        parts = (*detail["loc"], *filter(None, [detail.get("ctx", {}).get("key")]))
        for part in parts:
            if isinstance(part, int):
                path += f"[{part}]"
            elif part in forms or kind == "extra_forbidden":
                path += f".{part}"
        text = explain_error(detail, name)
        if kind == "extra_forbidden":
            text = f"unknown key{suggest_closest(str(parts[0]), forms) or hint}"
        elif forms and kind in ("model_type", "tuple_type", "missing", "too_long"):
            text += f" (use {forms[str(parts[0])]})" if parts else hint
        return f"{place}{path}: {text}"

    try:
        return validate(value)
    except ValidationError as error:
        raise InputError(*map(line, correctable_errors(error))) from None


@functools.cache
def _validator(key: str, many: bool = False) -> Callable[[Any], Any]:
    kind: Any = Name if key == "case" else _type_of(key)
    return TypeAdapter(tuple[kind, ...] if many else kind, config=_STRICT).validate_python


def _type_of(key: str) -> Any:
    """Return the type of the values of a leaf key, without None."""
    field = SECTIONS[SECTION_OF[key]].model_fields[key]
    kinds: Any = (field.annotation,)
    if get_origin(field.annotation) in (Union, UnionType):
        kinds = tuple(kind for kind in get_args(field.annotation) if kind is not NoneType)
    return Annotated[Union[kinds], *field.metadata] if field.metadata else Union[kinds]  # noqa: UP007


def _check_varies(place: str, key: str, sections: Sequence[str], how: str, recorded: bool) -> None:
    """Refuse a key that is unknown or cannot vary, such as one that cannot be swept or tuned."""
    section = SECTION_OF.get(key)
    if section is None:
        reason = unknown_key_error(key, [k for k, home in SECTION_OF.items() if home in sections])
    elif section not in sections or key in _INSTEAD:
        reason = f"cannot be {how} ({_INSTEAD.get(key, f'it is a key of [{section}]')})"
    elif recorded and section in SIMULATED_ONLY:
        reason = f"does not apply to a recorded study (drop it, [{section}] is for simulations)"
    else:
        return
    raise InputError(f"{place} {key}: {reason}")


def _check_distinct(rows: Sequence[Any], place: str) -> None:
    first: dict[Any, int] = {}
    for i, row in enumerate(rows):
        if first.setdefault(row, i) < i:
            raise InputError(f"{place}[{i}]: repeats [{first[row]}] (drop one of them)")


def _read_axes(tables: TomlTable) -> tuple[Dimension, dict[str, Dimension]]:
    """Return the single axes and the zips."""
    axes, zips, errors = Dimension(), dict[str, Dimension](), ErrorCollector()
    given, table_of = tables.get("axes", {}), dict[str, str]()
    for name in sorted(given, key=lambda name: isinstance(given[name], Mapping)):
        is_zip = isinstance(given[name], Mapping)
        table, keys = f"[axes.{name}]" if is_zip else "[axes]", given[name]
        with errors.collect():
            dimension = _read_dimension(table, keys if is_zip else {name: keys}, tables)
            for key in dimension:
                if table_of.setdefault(key, table) != table:
                    raise InputError(f"{table} {key}: is an axis already (drop one of them)")
            zips |= {name: dimension} if is_zip else {}
            axes |= {} if is_zip else dimension
    errors.raise_all()
    return axes, zips


def _read_dimension(table: str, keys: Mapping[str, Any], tables: TomlTable) -> Dimension:
    """Return the values of an axis, or of the axes that a table varies together."""
    if not keys:
        raise InputError(f"{table}: must not be empty")
    joint, errors = Dimension(), ErrorCollector()
    for key, values in keys.items():
        with errors.collect():
            _check_varies(table, key, SWEEPABLE, "swept", "record" in tables)
            if not isinstance(values, tuple):
                raise InputError(f"{table} {key}: must be a list of values, not {values!r}")
            if not values:
                raise InputError(f"{table} {key}: must not be empty")
            joint[key] = check_value(values, key, f"{table} {key}", many=True)
    errors.raise_all()
    first = next(iter(joint))
    for key, values in joint.items():
        if len(values) != len(joint[first]):
            text = f"has {len(values)} values, but {first} has {len(joint[first])}"
            raise InputError(f"{table} {key}: {text} (give as many, since they vary together)")
    _check_distinct(list(zip(*joint.values(), strict=True)), f"{table} {', '.join(joint)}")
    return joint


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
    keys = dict.fromkeys(key for row in rows for key in row)
    given = tables.get("axes", {})
    zipped = {key for table in given.values() if isinstance(table, Mapping) for key in table}
    errors, cases = ErrorCollector(), list[TomlTable]()
    for key in keys:
        with errors.collect():
            if key != "case":
                _check_varies("[cases]", key, SWEEPABLE, "swept", "record" in tables)
            if key in zipped or not isinstance(given.get(key, {}), Mapping):
                raise InputError(f"[cases] {key}: is an axis already (drop one of them)")
    errors.raise_all()
    for i, row in enumerate(rows):
        cases.append({})
        for key, value in row.items():
            with errors.collect():
                cases[i][key] = check_value(value, key, f"[cases] {key}[{i}]")
                for other in sorted(alternative_keys(key) & row.keys()):
                    text = f"conflicts with {other} in the same case (give one of them)"
                    raise InputError(f"[cases] {key}[{i}]: {text}")
        if "case" in keys and "case" not in row:
            errors.add(f"[cases] case[{i}]: is not in every case (give it in all of them)")
    errors.raise_all()
    inherited = [key for key in keys if any(key not in row for row in rows)]
    # What a case without a key has in its place differs from case to case too.
    acting = [
        other
        for key in inherited
        for other in sorted(alternative_keys(key))
        if other in tables.get(SECTION_OF[other], ())
        or (other != COUNT and dependent_default(other, GivenKeys(tables, {})) is not None)
    ]
    keys |= dict.fromkeys(acting)
    with errors.collect():
        for case in cases:
            varied = GivenKeys(tables, {**axes, **{key: (value,) for key, value in case.items()}})
            case |= {key: _inherited_value(key, varied) for key in keys if key not in case}
    errors.raise_all()
    names = [key for key in keys if key != "case"]
    rows = [tuple(case[key] for key in names) for case in cases]
    _check_distinct(rows, f"[cases] {', '.join(names) or 'case'}")
    if "case" in keys:
        _check_distinct([case["case"] for case in cases], "[cases] case")
    ordered = tuple({key: case[key] for key in keys} for case in cases)
    return ordered, frozenset((*inherited, *acting))


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
    table, errors = dict(tables["drawn"]), ErrorCollector()
    sampling = {"sampling": table.pop("sampling")} if "sampling" in table else {}
    if not table:
        raise InputError("[drawn]: has no key to draw (drop it)")
    for key in table:
        with errors.collect():
            _check_drawable(key, "record" in tables)
            if key in table_of:
                raise InputError(f"[drawn] {key}: is in {table_of[key]} already (drop one of them)")
            place = f"[drawn] {key}"
            law = _check(Distribution.model_validate, table[key], place, forms=_LAWS)
            for name in ("values", "grid"):
                if entries := getattr(law, name):
                    entries = check_value(entries, key, f"{place}.{name}", many=True)
                    law = law.model_copy(update={name: entries})
            table[key] = law
    with errors.collect():
        _check(DrawnSection.model_validate, sampling, "[drawn] sampling")
    errors.raise_all()
    return DrawnSection.model_validate(sampling | table)


def _check_drawable(key: str, recorded: bool) -> None:
    """Refuse a key that is unknown or cannot be drawn."""
    section, initial = SECTION_OF.get(key), ", ".join(INITIAL_NUMBERS)
    if section is None:
        reason = unknown_key_error(key, NUMBERS_DRAWN)
    elif key not in NUMBERS_DRAWN:
        kinds = f"latitude_deg, keys of [motion] and [sensors], {initial}"
        reason = f"cannot be drawn (possible: {kinds})"
    elif recorded and section in SIMULATED_ONLY:
        reason = f"does not apply to a recorded study (drop it, [{section}] is for simulations)"
    elif recorded and key not in INITIAL_NUMBERS:
        reason = f"cannot be drawn in a recorded study (possible: {initial})"
    else:
        return
    raise InputError(f"[drawn] {key}: {reason}")


def read_tune_section(table: TomlTable, varied: Mapping[str, str], *, recorded: bool) -> TomlTable:
    """Return the section [tune] with checked ranges and values.

    Args:
        table: table of the file, with tuples for lists.
        varied: the table, in brackets, of each key that is swept or drawn.
        recorded: whether the study reads a record.

    Raises:
        InputError: ``[table] key: what is wrong (hint)``.
    """
    table, errors = dict(table), ErrorCollector()
    for key in table if recorded else ():
        if leaf_info(key).in_simulation is not None:
            text = "does not apply to a recorded study (drop it: tuning uses the start times)"
            errors.add(f"[tune] {key}: {text}")
    for name, read in (("variables", _read_range), ("baseline", check_value)):
        given, place = table.get(name, {}), f"[tune.{name}]"
        if not isinstance(given, Mapping):
            errors.add(f"[tune] {name}: must be a table of keys")
            continue
        later = dict.fromkeys(given, place)
        if name == "variables" and {TIMES, COUNT} <= given.keys():
            del later[COUNT]
        for key, value in given.items():
            with errors.collect():
                later.pop(key, None)
                _check_varies(place, key, TUNABLE, "tuned", recorded)
                if key in varied:
                    raise InputError(
                        f"{place} {key}: is in {varied[key]} already (drop one of them)"
                    )
                others = {**varied, **later}
                for other in sorted(alternative_keys(key) & others.keys()):
                    text = f"conflicts with {other} in {others[other]} (give one of them)"
                    raise InputError(f"{place} {key}: {text}")
                table[name] = table[name] | {key: read(value, key, f"{place} {key}")}
    if "variables" in table and not table["variables"]:
        errors.add(f"{_VARIABLES}: has no key to tune (give one with its range)")
    errors.raise_all()
    times, count = (table.get("variables", {}).get(key) for key in (TIMES, COUNT))
    for number in (count.candidates or (count.fixed,)) if count and times else ():
        if isinstance(times, tuple) and number > len(times):
            text = f"{number} are more than the {len(times)} ranges of {TIMES} (add ranges)"
            raise InputError(f"{_VARIABLES} {COUNT}: {text}")
    return table


def _read_range(value: Any, key: str, place: str) -> Range | tuple[Range, ...]:
    """Return the range of a key: of its number, of each entry of its list, or its candidates."""
    kind = _type_of(key)
    entries = _entry_types(kind)
    if not isinstance(value, tuple):
        if entries and isinstance(value, Mapping) and value.keys() & {"low", "high"}:
            raise InputError(f"{place}: needs a list with one range per entry, not one range")
        return _check_range(value, kind, place)
    if not entries:
        raise InputError(f"{place}: needs one range, not a list (the key is one number)")
    if not value:
        raise InputError(f"{place}: must not be empty")
    if Ellipsis not in entries and len(value) != len(entries):
        raise InputError(f"{place}: must have {len(entries)} ranges, not {len(value)}")
    errors, ranges = ErrorCollector(), list[Range]()
    for i, entry in enumerate(value):
        with errors.collect():
            ranges.append(_check_range(entry, entries[0], f"{place}[{i}]"))
            if ranges[-1].candidates is not None:
                text = "must be of the whole key, not of one entry"
                raise InputError(f"{place}[{i}].candidates: {text}")
    errors.raise_all()
    return tuple(ranges)


def _check_range(value: Any, kind: Any, place: str) -> Range:
    """Return a range with values of a type."""
    range_of: Any = Range
    found = _check(range_of[kind, kind].model_validate, value, place, forms=_RANGES)
    return Range.model_construct(**dict(found))  # a class that other processes have


def _entry_types(kind: Any) -> tuple[Any, ...]:
    """Return the types of the entries of a list key; empty for other keys."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is tuple:
        return arguments
    if origin is Annotated:
        return _entry_types(arguments[0])
    if origin in (Union, UnionType):
        return next(filter(None, map(_entry_types, arguments)), ())
    return ()


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
