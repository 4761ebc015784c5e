"""Reading and writing studies: one TOML file, checked in full before anything runs.

A file either gives a `Study` or raises `InputError` with one line,
``FILE: [section] key: what is wrong (hint)``. A value of an axis or a case is named by its place,
from 0: ``[axes] phi_u0_deg[3]``. Values stay in the units of the file; `scenario` turns them into
arrays.
"""

import difflib
import functools
import hashlib
import json
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tomli_w
from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from sinsjax.fields import Name
from sinsjax.rules import Where, check_study, keys_unread
from sinsjax.studies import (
    EARTH_CONSTANTS,
    SECTION_OF,
    SECTIONS,
    SIMULATED_ONLY,
    SWEEPABLE,
    Study,
)
from sinsjax.types import InputError

__all__ = ["Study", "fingerprint", "load_study", "study_from_dict", "study_to_toml"]

Table = dict[str, Any]

_NOISES = (
    ("gyro_noise_deg_per_h", "gyro_arw_deg_per_sqrt_h"),
    ("accel_noise_ug", "accel_vrw_ug_per_sqrt_hz"),
)
_EXCLUSIVE = (
    *_NOISES,
    ("reset_times_s", "reset_count"),
    ("reset_times_s", "reset_cycle_s"),
    ("level_gains", "level_sigma_per_s"),
    ("level_gains", "level_adjustment_s"),
    ("level_adjustment_s", "level_sigma_per_s"),
    ("level_passes", "level_time_s"),
    ("azimuth_gains", "azimuth_sigma_per_s"),
    ("azimuth_gains", "azimuth_adjustment_s"),
    ("azimuth_adjustment_s", "azimuth_sigma_per_s"),
    ("sigma_passes", "sigma_times_s"),
)
_DEFAULTS: dict[str, dict[str, Any]] = {
    "alignment": {
        "specific_force": "measured",
        "feedback_interval_s": 1.0,
        "feedback_time_constant_s": 0.0,
    },
    "resets": {"reset_count": 0},
    "compass": {"level_sigma_per_s": 0.02, "level_time_s": 150.0, "azimuth_sigma_per_s": 0.01},
    "passes": {
        "turn": "reflect",
        "turn_smoothing_s": 5.0,
        "turn_covariance": "carried",
        "turn_inflation": 10.0,
    },
}
"""Values of keys that apply: to a method of the study, and where none of their rivals is given."""
_DEFAULT_DRAWS = 64
_MISFITS = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "bool_type": "must be true or false",
    "string_type": "must be text",
    "tuple_type": "must be a list",
    "finite_number": "must be finite",
    "string_too_short": "must not be empty",
    "too_short": "must not be empty",
}


def load_study(path: str | Path) -> Study:
    """Reads and checks a study file.

    Raises:
        InputError: the file cannot be read, is no TOML or is no study; one line says why.
    """
    try:
        data = tomllib.loads(Path(path).read_text("utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is no UTF-8 text") from None
    except ValueError as error:
        raise InputError(f"{path}: is no TOML: {error}") from None
    return study_from_dict(data, str(path))


def study_from_dict(data: Table, source: str = "study") -> Study:
    """Checks a study given as nested dictionaries, as a TOML parser returns it.

    Args:
        data: sections by name; left as it is.
        source: what error messages call the study; its stem is the default of ``study.name``.

    Raises:
        InputError: the study is not valid; one line says why.
    """
    try:
        tables = _tables(_with_tuples(data))
        axes, cases = _axes(tables), _cases(tables)
        where = {key: f"[{name}]" for name in SECTIONS for key in tables.get(name, ())}
        where |= dict.fromkeys(axes, "[axes]") | {key: "[cases]" for case in cases for key in case}
        _check_forms(where)
        parts = tables | {"axes": axes, "cases": cases}
        study = _validated(_filled(parts, where, Path(source).stem))
        check_study(study, where)
    except InputError as error:
        raise InputError(" ".join(f"{source}: {error}".splitlines())) from None
    return study


def study_to_toml(study: Study) -> str:
    """The resolved study as TOML, all defaults filled in; loading it gives an equal study."""
    content = {key: table for key, table in study.model_dump(exclude_none=True).items() if table}
    return "# The resolved study: every value, defaults filled in.\n" + tomli_w.dumps(content)


def fingerprint(study: Study) -> str:
    """16 hex digits that tell what a study computes, whatever its name, report or key order.

    The order of the axes counts, as it numbers the variants.
    """
    content = study.model_dump(exclude={"report": True, "statements": True, "study": {"name"}})
    content["axes"] = list(study.axes.items())
    text = json.dumps(content, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _with_tuples(value: Any) -> Any:
    """The same data with tuples for lists, so that the frozen study is frozen all the way."""
    if isinstance(value, Mapping):
        return {key: _with_tuples(entry) for key, entry in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list | tuple) else value


def _tables(data: Table) -> Table:
    """The data, once every section and key in it is known."""
    names = (*SECTIONS, "axes", "cases")
    for name, table in data.items():
        if name in SECTION_OF and name not in SECTIONS:
            raise InputError(f"{name}: belongs in [{SECTION_OF[name]}]")
        if name not in names:
            raise InputError(f"[{name}]: unknown section{_near(name, names, '[{}]')}")
        if name == "cases":
            continue
        if not isinstance(table, Mapping):
            raise InputError(f"[{name}]: must be a table of keys")
        for key, value in table.items():
            if name != "axes" and key not in SECTIONS[name].model_fields:
                raise InputError(f"[{name}] {key}: unknown key{_hint(key, name)}")
            if value is None:
                raise InputError(f"[{name}] {key}: None is no value (leave the key out)")
    for name in SIMULATED_ONLY:
        if name in data and "record" in data:
            raise InputError(f"[{name}]: has no place in a recorded study (drop it or [record])")
    if "coarse" in data and "record" not in data:
        raise InputError("[coarse]: only a recorded study has one ([record] is missing)")
    if "record" in data and "draws" in data.get("study", {}):
        raise InputError("[study] draws: has no place in a recorded study (one draw a start time)")
    return data


def _near(word: str, words: Iterable[str], form: str = "{}") -> str:
    near = difflib.get_close_matches(str(word), list(words), n=1)
    return f" (did you mean {form.format(near[0])}?)" if near else ""


def _hint(key: str, section: str) -> str:
    """Where an unknown key of a section belongs, or the nearest known key."""
    if key in SECTION_OF:
        return f" (it belongs in [{SECTION_OF[key]}])"
    if here := _near(key, SECTIONS[section].model_fields):
        return here
    near = difflib.get_close_matches(str(key), list(SECTION_OF), n=1)
    return f" (did you mean {near[0]} in [{SECTION_OF[near[0]]}]?)" if near else ""


def _axes(tables: Table) -> dict[str, tuple[Any, ...]]:
    """The axes with every value checked as the key it stands for."""
    axes = {}
    for key, values in tables.get("axes", {}).items():
        _check_sweepable("axes", key, "record" in tables)
        if not isinstance(values, tuple):
            raise InputError(f"[axes] {key}: must be a list of values, not {values!r}")
        if not values:
            raise InputError(f"[axes] {key}: must not be empty")
        axes[key] = tuple(
            _value(value, key, f"[axes] {key}[{i}]") for i, value in enumerate(values)
        )
        _refuse_repeated(axes[key], f"[axes] {key}")
    return axes


def _cases(tables: Table) -> tuple[Table, ...]:
    """The cases with every value checked as the key it stands for."""
    rows = tables.get("cases", ())
    if not isinstance(rows, tuple) or not all(isinstance(row, Mapping) for row in rows):
        raise InputError("[cases]: must be tables that each begin with [[cases]]")
    if "cases" in tables and not any(rows):
        raise InputError("[cases]: must not be empty")
    keys = list(rows[0]) if rows else []
    for key in keys:
        if key != "case":
            _check_sweepable("cases", key, "record" in tables)
        if key in tables.get("axes", {}):
            raise InputError(f"[cases] {key}: is an axis already (drop one of them)")
    for i, row in enumerate(rows):
        for key in (*keys, *row):
            if key not in row or key not in keys:
                raise InputError(f"[cases] {key}[{i}]: all cases must set the same keys")
    cases = tuple(
        {key: _value(row[key], key, f"[cases] {key}[{i}]") for key in keys}
        for i, row in enumerate(rows)
    )
    values = [key for key in keys if key != "case"]
    place = f"[cases] {', '.join(values) or 'case'}"
    _refuse_repeated([tuple(case[key] for key in values) for case in cases], place)
    if "case" in keys:
        _refuse_repeated([case["case"] for case in cases], "[cases] case")
    return cases


def _refuse_repeated(values: Sequence[Any], place: str) -> None:
    seen: dict[Any, int] = {}
    for i, value in enumerate(values):
        if seen.setdefault(value, i) < i:
            raise InputError(f"{place}[{i}]: repeats what [{seen[value]}] says")


def _check_sweepable(table: str, key: str, recorded: bool) -> None:
    section = SECTION_OF.get(key)
    if key == "start_s":
        reason = "is no axis (list the start times in [record]: one draw each)"
    elif section is None:
        sweepable = [name for name, home in SECTION_OF.items() if home in SWEEPABLE]
        reason = f"unknown key{_near(key, sweepable)}"
    elif section == "study":
        reason = "cannot be swept (all runs of a study share [study])"
    elif section not in SWEEPABLE:
        reason = f"cannot be swept (it is a key of [{section}])"
    elif recorded and section in SIMULATED_ONLY:
        reason = f"has no place in a recorded study ([{section}] is the simulation's)"
    else:
        return
    raise InputError(f"[{table}] {key}: {reason}")


@functools.cache
def _validator(key: str) -> Callable[[Any], Any]:
    annotation: Any = Name
    if key != "case":
        field = SECTIONS[SECTION_OF[key]].model_fields[key]
        annotation = Annotated[field.annotation, field]
    strict = ConfigDict(strict=True, allow_inf_nan=False)
    return TypeAdapter(annotation, config=strict).validate_python


def _value(value: Any, key: str, place: str) -> Any:
    if value is None:
        raise InputError(f"{place}: None is no value")
    try:
        return _validator(key)(value)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{place}{_index(first)}: {_explained(first)}") from None


def _check_forms(where: Where) -> None:
    """Refuses two keys that say the same thing in two ways."""
    for one, other in _EXCLUSIVE:
        if one in where and other in where:
            raise InputError(
                f"{where[one]} {one}: cannot go with {other} in {where[other]} (give one of them)"
            )


def _filled(parts: Table, where: Where, name: str) -> Table:
    """The sections that apply, with the defaults that depend on other keys."""
    recorded = "record" in parts
    unused: tuple[str, ...] = SIMULATED_ONLY if recorded else ("record", "coarse")
    methods = _values_of("method", parts)
    unread = keys_unread(methods)
    given = {SECTION_OF.get(key) for key in where}
    if "passes" not in given | parts.keys():
        unused += ("passes",)
    unused += tuple(
        name
        for name in ("filter", "resets", "compass")
        if name not in given and unread.issuperset(SECTIONS[name].model_fields)
    )
    sections = {key: dict(parts.get(key, {})) for key in SECTIONS if key not in unused}
    sections["study"].setdefault("name", name)
    if not recorded:
        sections["study"].setdefault("draws", _DEFAULT_DRAWS)
        sections["earth"].setdefault("height_m", 0.0)
        for white, density in _NOISES:
            if white not in where and density not in where:
                sections["sensors"][white] = 0.0
    for section, defaults in _DEFAULTS.items():
        for key, value in defaults.items() if section in sections else ():
            if key not in unread and where.keys().isdisjoint(_rivals(key)):
                sections[section].setdefault(key, value)
    if "constants" in _values_of("earth", parts):
        sections["earth"] = EARTH_CONSTANTS | sections["earth"]
    return sections | {"axes": parts["axes"], "cases": parts["cases"]}


def _values_of(key: str, parts: Table) -> set[Any]:
    """The values that a key takes over the variants, its section's default where none is given."""
    swept = [*parts["axes"].get(key, ()), *(case[key] for case in parts["cases"] if key in case)]
    section = SECTION_OF[key]
    default = SECTIONS[section].model_fields[key].default
    return set(swept) or {parts.get(section, {}).get(key, default)}


def _rivals(key: str) -> set[str]:
    """The keys that say in another way what a key says."""
    return {other for pair in _EXCLUSIVE if key in pair for other in pair} - {key}


def _validated(sections: Table) -> Study:
    try:
        return Study.model_validate(sections)
    except ValidationError as error:
        first = error.errors()[0]
        section = str(first["loc"][0])
        key = first["loc"][1] if len(first["loc"]) > 1 else first["ctx"]["key"]
        hint = ""
        if first["type"] == "missing" and len(first["loc"]) == 2:
            hint = f" ({SECTIONS[section].model_fields[str(key)].description})"
        place = f"[{section}] {key}{_index(first)}"
        raise InputError(f"{place}: {_explained(first)}{hint}") from None


def _index(error: ErrorDetails) -> str:
    return "".join(f"[{part}]" for part in error["loc"] if isinstance(part, int))


def _explained(error: ErrorDetails) -> str:
    kind = error["type"]
    if kind == "misfit":
        return error["msg"]
    if kind == "missing":
        return "required"
    if kind == "too_long":
        return f"must have {error['ctx']['max_length']} values, not {error['ctx']['actual_length']}"
    text = _MISFITS.get(kind, error["msg"].replace("Input should be", "must be"))
    given = error["input"]
    value = repr(list(given) if isinstance(given, tuple) else given)
    return f"{text}, not {value if len(value) <= 60 else value[:57] + '...'}"
