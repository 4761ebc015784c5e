"""What varies in a study: the reading of [axes], [[cases]], [drawn] and [tune], and its columns.

A sweep repeats few values many times: a column has the distinct ones, and a code per variant.
Every value is checked as a value of its key. Errors name wrong values by their index, from 0:
``[axes.level] phi_e0_deg[0]``, ``[tune.variables] reset_times_s[1].low``.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from itertools import product
from types import NoneType, UnionType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from sinsjax.errors import ErrorCollector, InputError
from sinsjax.messages import describe_broken_rule, explain_error, format_count, suggest_closest
from sinsjax.study.keys import (
    SECTION_OF,
    SECTIONS,
    SIMULATED_ONLY,
    SWEEPABLE,
    TUNABLE,
    GivenKeys,
    TomlTable,
    alternative_keys,
    dependent_default,
    unknown_key_error,
)
from sinsjax.study.schema import INITIAL_NUMBERS, NUMBERS_DRAWN, Distribution, DrawnSection, Range
from sinsjax.value_types import Name

Dimension = dict[str, tuple[Any, ...]]
"""Values by key, which vary together; a sweep is the product of its dimensions."""


class CodedColumn(NamedTuple):
    """A column as a code per variant, (variants,), and the distinct values, in the file's units."""

    codes: np.ndarray
    choices: tuple[Any, ...]

    def __eq__(self, other: object) -> bool:
        """Return whether a column has the same values; studies that cache columns are compared."""
        if not isinstance(other, CodedColumn):
            return False
        return self.choices == other.choices and np.array_equal(self.codes, other.codes)

    def map(self, function: Callable[[Any], Any]) -> "CodedColumn":
        """Return the column of a function of the values."""
        return type(self)(self.codes, tuple(map(function, self.choices)))

    def expand(self, dtype: Any = float) -> np.ndarray:
        """Return the values as an array, (variants, ...)."""
        values = np.asarray(self.choices, dtype)
        if len(values) == 1:  # most columns
            return np.broadcast_to(values[0], (len(self.codes), *values.shape[1:]))
        return values[self.codes]

    def compute(self, function: Callable[[Any], Any], dtype: Any = float) -> np.ndarray:
        """Return a function of the values, called once per distinct value; (variants, ...)."""
        return self.map(function).expand(dtype)

    def take(self, ids: np.ndarray) -> "CodedColumn":
        """Return the column of some variants, without choices that none of them has."""
        codes = self.codes[ids]
        present = np.flatnonzero(np.bincount(codes, minlength=len(self.choices)))
        code_of = np.zeros(len(self.choices), np.int32)
        code_of[present] = np.arange(len(present))
        return CodedColumn(code_of[codes], tuple(self.choices[code] for code in present))

    def merged(self) -> "CodedColumn":
        """Return the column with one code for equal choices."""
        code_of = {choice: code for code, choice in enumerate(dict.fromkeys(self.choices))}
        merged = np.array([code_of[choice] for choice in self.choices], np.int32)
        return CodedColumn(merged[self.codes], tuple(code_of))

    def to_list(self) -> list[Any]:
        """Return the values, one per variant."""
        return list(map(self.choices.__getitem__, self.codes.tolist()))


def iter_points(dimensions: Sequence[Dimension], keys: Collection[str]) -> Iterator[dict[str, Any]]:
    """Yield the distinct combinations of some keys in a product, the last dimension fastest."""
    parts = []
    for dimension in dimensions:
        present = [key for key in dimension if key in keys]
        rows = dict.fromkeys(_rows(dimension, keys))
        parts.append([dict(zip(present, row, strict=True)) for row in rows])
    for combination in product(*parts):
        yield {key: value for part in combination for key, value in part.items()}


def point_codes(dimensions: Sequence[Dimension], keys: Collection[str]) -> np.ndarray:
    """Return the index in `iter_points` of the combination of each variant; (variants,)."""
    codes = np.zeros(1, np.int32)
    for dimension in dimensions:
        rows = _rows(dimension, keys)
        code_of = {row: code for code, row in enumerate(dict.fromkeys(rows))}
        of_rows = np.array([code_of[row] for row in rows], np.int32)
        codes = np.add.outer(codes * len(code_of), of_rows).ravel()
    return codes


def _rows(dimension: Dimension, keys: Collection[str]) -> list[tuple[Any, ...]]:
    """Return the values of the keys that a dimension has, a row for each of its points."""
    present = [values for key, values in dimension.items() if key in keys]
    return list(zip(*present, strict=True)) or [()] * len(next(iter(dimension.values())))


TIMES, COUNT = "reset_times_s", "reset_count"
"""If both are variables, the second is the number of ranges of the first that are used."""

Ranges = dict[str, Range | tuple[Range, ...]]

_GONE_SETTINGS = ("evolution_screen", "evolution_steps", "feedback_phases")
_STRICT = ConfigDict(strict=True, allow_inf_nan=False)
_VARYING = {
    "swept": [k for k, name in SECTION_OF.items() if name in SWEEPABLE and k != "attitude_file"],
    "tuned": [key for key, name in SECTION_OF.items() if name in TUNABLE],
    "drawn": [*NUMBERS_DRAWN],
}
"""Keys that may vary, by how."""


class Sweep(BaseModel):
    """What varies in a study.

    Attributes:
        axes: values of single axes by leaf key, in the order of the file.
        zips: axes that vary together by the name of their table: values by leaf key.
        cases: one table of leaf keys per case, all with the same keys; ``case`` is the label.
        drawn: distributions of keys, which no section, axis or case has.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    axes: Dimension = {}
    zips: dict[str, Dimension] = {}
    cases: tuple[TomlTable, ...] = ()
    drawn: DrawnSection | None = None

    @cached_property
    def dimensions(self) -> list[Dimension]:
        """Tables of values by key, whose product is the sweep.

        Cases vary most slowly, with the label before their keys; then the zips; then the axes.
        """
        keys = sorted(self.cases[0] if self.cases else (), key=lambda key: key != "case")
        cases = {key: tuple(case[key] for case in self.cases) for key in keys}
        axes = ({key: values} for key, values in self.axes.items())
        return [*([cases] if cases else ()), *self.zips.values(), *axes]

    @cached_property
    def axis_keys(self) -> tuple[str, ...]:
        """Keys that vary over the variants, in the order of the dimensions; ``case`` is first."""
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


def read_sweep(tables: TomlTable, errors: ErrorCollector) -> Sweep:
    """Return what varies in a study, whose tables have tuples; what is wrong goes to errors."""
    reader, axes, zips = _Reader(tables, {}, errors), Dimension(), dict[str, Dimension]()
    for name, given in tables.get("axes", {}).items():
        if isinstance(given, Mapping):
            zips[name] = reader.read_axes(f"[axes.{name}]", given)
        else:
            axes |= reader.read_axes("[axes]", {name: given})
    cases, drawn = tuple[TomlTable, ...](), None
    with errors.collect():
        cases = _read_cases(reader, Sweep(axes=axes, zips=zips).values_varied)
    fixed = {key: f"[{name}]" for name in SWEEPABLE for key in tables.get(name, ())}
    reader.table_of = fixed | reader.table_of
    with errors.collect():
        drawn = _read_drawn(tables["drawn"], reader) if "drawn" in tables else None
    return Sweep(axes=axes, zips=zips, cases=cases, drawn=drawn)


def check_value(value: Any, key: str, place: str, *, many: type | None = None) -> Any:
    """Return a value of a leaf key or ``case``; an error has a line per wrong entry.

    ``many`` is ``tuple`` or ``dict`` for several values, in a tuple or by their numbers.
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
    """Return the errors of values that a user can correct, without their consequences.

    Those are a list too short without its wrong entries, and a default that depends on one.
    """
    errors = [detail for detail in error.errors() if detail["type"] != "default_factory_not_called"]
    wholes = {detail["loc"][:end] for detail in errors for end in range(len(detail["loc"]))}
    return [detail for detail in errors if detail["loc"] not in wholes]


def refuse_alternatives_given_together(table_of: Mapping[str, str]) -> None:
    """Refuse two keys that are alternatives, by the tables of all keys; each case may have one."""
    errors, reported = ErrorCollector(), set[str]()
    for first, second in (pair for section in SECTIONS.values() for pair in section.exclusive):
        tables = {table_of.get(first), table_of.get(second)}
        if None in tables or tables == {"[cases]"} or not reported.isdisjoint((first, second)):
            continue
        text = f"conflicts with {second} in {table_of[second]} (give one of them)"
        errors.add(f"{table_of[first]} {first}: {text}")
        reported |= {first, second}
    errors.raise_all()


def _check(
    validate: Callable[[Any], Any],
    value: Any,
    place: str,
    name: str = "",
    fields: Collection[str] = (),
) -> Any:
    """Return a value as a function of pydantic returns it; an error names its place in a table.

    It is a value of the key ``section.key``, which is its name, or a table with some fields.
    """

    def line(detail: ErrorDetails) -> str:
        is_unknown, path = detail["type"] == "extra_forbidden", ""
        for part in (*detail["loc"], *filter(None, [detail.get("ctx", {}).get("key")])):
            if isinstance(part, int):
                path += f"[{part}]"
            elif part in fields or is_unknown:
                path += f".{part}"
        text, hint = explain_error(detail, name), f" (use {', '.join(fields)})"
        if is_unknown:
            text = f"unknown key{suggest_closest(str(detail['loc'][0]), fields) or hint}"
        return f"{place}{path}: {text}{hint if detail['type'] == 'model_type' else ''}"

    try:
        return validate(value)
    except ValidationError as error:
        raise InputError(*map(line, correctable_errors(error))) from None


@cache
def _validator(key: str, many: type | None = None) -> Callable[[Any], Any]:
    one: Any = Name if key == "case" else _type_of(key)
    listed = Annotated[tuple[one, ...], Field(min_length=1)]
    kinds: dict[Any, Any] = {None: one, tuple: listed, dict: dict[int, one]}
    return TypeAdapter(kinds[many], config=_STRICT).validate_python


def _type_of(key: str) -> Any:
    """Return the type of the values of a leaf key, without None."""
    field = SECTIONS[SECTION_OF[key]].model_fields[key]
    kinds: Any = (field.annotation,)
    if get_origin(field.annotation) in (Union, UnionType):
        kinds = tuple(kind for kind in get_args(field.annotation) if kind is not NoneType)
    return Annotated[Union[kinds], *field.metadata] if field.metadata else Union[kinds]  # noqa: UP007


@dataclass
class _Reader:
    """The keys that vary, while their tables are read.

    ``table_of`` has the table, in brackets, of each key so far, which is in one of them.
    """

    tables: TomlTable
    table_of: dict[str, str]
    errors: ErrorCollector

    def read(
        self, table: str, how: str, given: Mapping[str, Any], read: Callable[[Any, str, str], Any]
    ) -> TomlTable:
        """Return a function of the value, key and place of each key that may vary in a table."""
        found = TomlTable()
        for key, value in given.items():
            with self.errors.collect():
                if key != "case" or table != "[cases]":
                    self._refuse_key_that_cannot_vary(table, how, key)
                found[key] = read(value, key, f"{table} {key}")
        return found

    def read_axes(self, table: str, given: Mapping[str, Any]) -> Dimension:
        """Return the values of an axis, or of the axes that a table varies together."""
        joint = self.read(table, "swept", given, partial(check_value, many=tuple))
        if joint.keys() < given.keys():
            return {}
        if not given:
            self.errors.add(f"{table}: must not be empty")
            return {}
        first = next(iter(joint))
        for key, values in joint.items():
            if len(values) != len(joint[first]):
                text = f"has {len(values)} values, but {first} has {len(joint[first])}"
                self.errors.add(f"{table} {key}: {text} (give as many, since they vary together)")
                return {}
        with self.errors.collect():
            _check_distinct(list(zip(*joint.values(), strict=True)), f"{table} {', '.join(joint)}")
        return joint

    def _refuse_key_that_cannot_vary(self, table: str, how: str, key: str) -> None:
        """Refuse a key that is unknown, cannot vary like this or is in another table too."""
        section, possible, recorded = SECTION_OF.get(key), _VARYING[how], "record" in self.tables
        if section is None:
            reason = unknown_key_error(key, possible)
        elif key not in possible:
            reason = f"cannot be {how} (give it in [{section}])"
        elif recorded and section in SIMULATED_ONLY:
            reason = f"does not apply to a recorded study (drop it, [{section}] is for simulations)"
        elif recorded and how == "drawn" and key not in INITIAL_NUMBERS:
            kinds = ", ".join(INITIAL_NUMBERS)
            reason = f"cannot be drawn in a recorded study (possible: {kinds})"
        elif (other := self.table_of.setdefault(key, table)) != table:
            reason = f"is in {other} already (drop one: a key has a value, an axis or a law)"
        else:
            return
        raise InputError(f"{table} {key}: {reason}")


def _check_distinct(rows: Sequence[Any], place: str) -> None:
    first: dict[Any, int] = {}
    for i, row in enumerate(rows):
        if first.setdefault(row, i) < i:
            raise InputError(f"{place}[{i}]: repeats [{first[row]}] (drop one of them)")


def _read_cases(reader: _Reader, axes: Mapping[str, Collection[Any]]) -> tuple[TomlTable, ...]:
    """Return the cases, each with the same keys.

    A key that a case leaves out has the value of its section, or its default; None if an
    alternative to it is given instead.
    """
    tables, errors = reader.tables, ErrorCollector()
    rows = tables.get("cases", ())
    if not isinstance(rows, tuple) or not all(isinstance(row, Mapping) for row in rows):
        raise InputError("[cases]: must be tables, each under a line [[cases]]")
    if "cases" in tables and not any(rows):
        raise InputError("[cases]: must not be empty")
    keys = dict.fromkeys(key for row in rows for key in row)
    columns = {key: {i: row[key] for i, row in enumerate(rows) if key in row} for key in keys}
    read = reader.read("[cases]", "swept", columns, partial(check_value, many=dict))
    if read.keys() < keys.keys():
        return ()
    for i, row in enumerate(rows):
        for key in row:
            for other in sorted(alternative_keys(key) & row.keys()):
                text = f"conflicts with {other} in the same case (give one of them)"
                errors.add(f"[cases] {key}[{i}]: {text}")
        if "case" in keys and "case" not in row:
            errors.add(f"[cases] case[{i}]: is not in every case (give it in all of them)")
    errors.raise_all()
    # What a case without a key has in its place differs from case to case too.
    for key in [key for key in keys if any(key not in row for row in rows)]:
        for other in sorted(alternative_keys(key)):
            default = other != COUNT and dependent_default(other, GivenKeys(tables, {}))
            if other in tables.get(SECTION_OF[other], ()) or default not in (None, False):
                keys.setdefault(other)
    cases = []
    for i, row in enumerate(rows):
        case = {key: read[key][i] for key in row}
        given = GivenKeys(tables, {**axes, **{key: (value,) for key, value in case.items()}})
        with errors.collect():
            cases.append({k: case[k] if k in row else _omitted_case_value(k, given) for k in keys})
    errors.raise_all()
    names = [key for key in keys if key != "case"]
    place = f"[cases] {', '.join(names) or 'case'}"
    _check_distinct([tuple(case[key] for key in names) for case in cases], place)
    if "case" in keys:
        _check_distinct([case["case"] for case in cases], "[cases] case")
    return tuple(cases)


def _omitted_case_value(key: str, given: GivenKeys) -> Any:
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


def _read_drawn(given: TomlTable, reader: _Reader) -> DrawnSection:
    """Return the distributions of the drawn keys, none of which is given elsewhere."""
    keys = {key: law for key, law in given.items() if key != "sampling"}
    if not keys:
        raise InputError("[drawn]: has no key to draw (drop it)")
    laws = reader.read("[drawn]", "drawn", keys, _read_law)
    sampling = {"sampling": given["sampling"]} if "sampling" in given else {}
    _check(DrawnSection.model_validate, sampling, "[drawn] sampling")
    return DrawnSection.model_validate(sampling | laws)


def _read_law(value: Any, key: str, place: str) -> Distribution:
    fields = Distribution.model_fields
    law: Distribution = _check(Distribution.model_validate, value, place, fields=fields)
    if law.values:
        entries = check_value(law.values, key, f"{place}.values", many=tuple)
        law = law.model_copy(update={"values": entries})
    return law


def read_tune_section(
    table: TomlTable, tables: TomlTable, varied: Mapping[str, str], errors: ErrorCollector
) -> TomlTable:
    """Return [tune] with checked ranges and values; ``varied`` has the table of each varied key."""
    table = dict(table)
    for name, read in (("variables", _read_tuning_range), ("baseline", check_value)):
        given, place = table.get(name), f"[tune.{name}]"
        if isinstance(given, Mapping):
            table[name] = _Reader(tables, dict(varied), errors).read(place, "tuned", given, read)
            own = dict.fromkeys(given, place)
            if name == "variables" and TIMES in own:
                own.pop(COUNT, None)
            with errors.collect():
                refuse_alternatives_given_together({**varied, **own})
            if name == "variables" and not given:
                errors.add(f"{place}: has no key to tune (give one with its range)")
    variables = table["variables"] if isinstance(table.get("variables"), dict) else {}
    times, count = variables.get(TIMES), variables.get(COUNT)
    for number in (count.candidates or (count.fixed,)) if count and times else ():
        if isinstance(times, tuple) and number > len(times):
            text = f"{number} are more than the {len(times)} ranges of {TIMES} (add ranges)"
            errors.add(f"[tune.variables] {COUNT}: {text}")
    return table


def _read_tuning_range(value: Any, key: str, place: str) -> Range | tuple[Range, ...]:
    """Return the range of a key: of its number, of each entry of its list, or its candidates."""
    kind = _type_of(key)
    entries = next((get_args(k) for k in _iter_types(kind) if get_origin(k) is tuple), ())
    if not isinstance(value, tuple):
        return _check_range(value, kind, place)
    if not entries:
        raise InputError(f"{place}: needs one range, not a list (the key is one number)")
    if len(value) != (count := len(value) or 1 if Ellipsis in entries else len(entries)):
        raise InputError(f"{place}: must have {format_count(count, 'range')}, not {len(value)}")
    ranges = list[Range]()
    for i, entry in enumerate(value):
        ranges.append(_check_range(entry, entries[0], f"{place}[{i}]"))
        if ranges[i].candidates is not None:
            raise InputError(f"{place}[{i}].candidates: must be of the whole key, not of one entry")
    return tuple(ranges)


def _check_range(value: Any, kind: Any, place: str) -> Range:
    """Return a range with values of a type."""
    range_of: Any = Range
    found = _check(range_of[kind, kind].model_validate, value, place, fields=Range.model_fields)
    return Range.model_construct(**dict(found))  # a class that other processes have


def _iter_types(kind: Any) -> Iterator[Any]:
    """Yield a type, and all types within it."""
    yield kind
    for part in get_args(kind):
        yield from _iter_types(part)


def without_gone_settings(tables: TomlTable) -> TomlTable:
    """Return sections without settings of a gone search that 1.0 wrote into every [tune]."""
    tune = tables.get("tune")
    if not isinstance(tune, Mapping):
        return tables
    return tables | {"tune": {k: v for k, v in tune.items() if k not in _GONE_SETTINGS}}
