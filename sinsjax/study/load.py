"""Reading and writing studies: one TOML file, checked in full before anything runs.

A file either gives a `Study` or raises `InputError` with a line for each of its mistakes that the
first stage with any finds, ``FILE: [section] key: what is wrong (way on)``. The stages are names of
sections and keys, values, rules (`rules.broken_rules`), and points of [tune]. `sweep` reads the
tables that vary a study. Values stay in the units of the file.
"""

import difflib
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from sinsjax.errors import ErrorCollector, InputError, StudyWarning
from sinsjax.messages import escape_controls, explain_error, format_list_index, suggest_closest
from sinsjax.methods.registry import (
    BROKEN,
    METHODS,
    SECTIONS_OF_METHODS,
    register_external,
    unread_keys,
)
from sinsjax.study import changes as changing
from sinsjax.study import files, rules, search_space
from sinsjax.study.keys import (
    KEYS,
    SECTION_OF,
    SECTIONS,
    SIMULATED_ONLY,
    TomlTable,
    alternative_keys,
    key_summary,
    unknown_key_error,
)
from sinsjax.study.questions import reject_open_questions
from sinsjax.study.schema import EARTH_CONSTANTS
from sinsjax.study.study import Study
from sinsjax.study.sweep import (
    Sweep,
    correctable_errors,
    describe_gone_settings,
    read_sweep,
    read_tune_section,
    without_gone_settings,
)
from sinsjax.study.unused_keys import list_idle_keys

__all__ = [
    "Study",
    "load_study",
    "study_from_dict",
    "study_to_toml",
    "study_to_tables",
    "with_point",
]

_DEFAULT_DRAWS = KEYS["study", "draws"].info.in_simulation
_DEPENDENT_DEFAULTS = EARTH_CONSTANTS | {
    "draws": _DEFAULT_DRAWS,
    "height_m": 0.0,
    **{white: 0.0 for white, _ in SECTIONS["sensors"].exclusive},
}
"""Defaults that depend on other keys, or on whether the study is recorded."""
_FEEDBACK_KEY = "feedback_interval_s"
_SWEEP_TABLES = ("axes", "cases", "drawn")
SHEET_TABLES = ("study", "earth", "motion", "sensors", "drawn", "advise")
"""Sections of a sheet, which `sinsjax.advise` reads."""


def load_study(source: str | Path | Study, changes: Mapping[str, Any] | None = None) -> Study:
    """Read and check a study.

    All functions that take a study take what this one takes.

    Args:
        source: file, or else name of a shipped study (``sinsjax init --list``), or study.
        changes: values by ``section.key`` that replace those of the study, see `Study.replace`.

    Raises:
        InputError: the file cannot be read, is not TOML or not a valid study; a line per mistake.

    Warns:
        StudyWarning: an edited local file has the name of a shipped study.

    Examples:
        >>> sinsjax.load_study("reset_sweep", {"study.draws": 2})
        Study reset_sweep
          runs    448 variants x 2 draws = 896 runs
          axes    reset_count 0..6 (7); reset_cycle_s 10..100 (8); phi_u0_deg 0..90 (8)
          method  kalman5
          length  900 s at 100 Hz
    """
    if isinstance(source, Study):
        return source.replace(changes) if changes else source
    study, _ = _load(source, changes)
    for line in files.describe_shadowed_study(source):
        warnings.warn(line, StudyWarning, stacklevel=2)
    return study


def load_with_notes(path: str | Path, changes: Mapping[str, Any]) -> tuple[Study, list[str]]:
    """Read and check a study file like `load_study`.

    Returns:
        The study, and lines for the user about keys that have no effect.

    Raises:
        InputError: see `load_study`.
    """
    study, tables = _load(path, changes)
    return study, [*describe_gone_settings(tables), *list_idle_keys(study)]


def _load(path: str | Path, changes: Mapping[str, Any] | None) -> tuple[Study, TomlTable]:
    """Read and check a study file; also return its tables."""
    name = files.source_name(path)
    data = files.read_tables(path)
    if changes:
        data = change_tables(data, changes, name)
    try:
        reject_open_questions(data, path)
    except InputError as error:
        raise error.with_source(name) from None
    try:
        return study_from_dict(data, name), data
    except InputError as error:
        if "sensors" in data and data.keys() <= {*SHEET_TABLES}:
            hint = f"`sinsjax advise {path} --study FILE` writes a study of a data sheet"
            raise InputError(*error.lines, f"{name}: has no [alignment] ({hint})") from None
        raise


def change_tables(data: TomlTable, changes: Mapping[str, Any], source: str) -> TomlTable:
    """Return a study's tables with some values changed.

    Raises:
        InputError: a change does not name a key, or is nested too deeply.
    """
    try:
        changed = changing.apply_changes(data, changes)
    except InputError as error:
        raise error.with_source(source) from None
    files.check_nesting(changed, source)
    return changed


def study_from_dict(data: TomlTable, source: str = "study") -> Study:
    """Check a study given as nested dictionaries, as a TOML parser returns it.

    Args:
        data: sections by name; left as it is.
        source: name of the study in messages; its stem is the default of ``study.name``.

    Raises:
        InputError: the study is not valid; a line per mistake.

    Examples:
        >>> tables = {
        ...     "study": {"duration_s": 60.0, "rate_hz": 100.0, "draws": 8},
        ...     "earth": {"latitude_deg": 45.0},
        ...     "motion": {"yaw_center_deg": 0.0},
        ...     "sensors": {"gyro_arw_deg_per_sqrt_h": 0.002, "accel_vrw_ug_per_sqrt_hz": 20.0},
        ...     "axes": {"phi_u0_deg": [1.0, 10.0, 30.0]},
        ... }
        >>> sinsjax.study_from_dict(tables, "mine")
        Study mine
          runs    3 variants x 8 draws = 24 runs
          axes    phi_u0_deg 1, 10, 30
          method  kalman5
          length  60 s at 100 Hz
    """
    try:
        reject_open_questions(data)
        return _build_checked_study(data, escape_controls(Path(source).stem))
    except InputError as error:
        raise error.with_source(source) from None
    except RecursionError:
        raise InputError(f"{source}: {files.TOO_DEEP}") from None


def study_to_tables(study: Study) -> TomlTable:
    """Return the resolved study as nested dictionaries, the inverse of `study_from_dict`."""
    content = study.model_dump(exclude_none=True)
    for key in study.drawn_keys:
        content[SECTION_OF[key]].pop(key, None)
    content["axes"] |= content.pop("zips")
    names = (*SECTIONS, *_SWEEP_TABLES)
    return {name: content[name] for name in names if content.get(name)}


def non_default_tables(study: Study) -> TomlTable:
    """Return a study as tables and lists, without the keys that have their defaults."""
    filled = _DEPENDENT_DEFAULTS | _default_feedback(study.study.rate_hz)
    tables = changing.copy_tables(changing.remove_defaults(study_to_tables(study), filled))
    return {name: table for name, table in tables.items() if table}


def study_to_toml(study: Study) -> str:
    """Return the resolved study as TOML with all defaults; loading it gives an equal study."""
    text = tomli_w.dumps(study_to_tables(study))
    return "# The resolved study: every value, defaults filled in.\n" + text


def with_point(study: Study, point: TomlTable) -> Study:
    """Return a study with other values of some keys, and without [tune].

    Args:
        study: checked study, left as it is; none of the keys is swept or drawn.
        point: values by leaf key. Alternatives to these keys are dropped: a study with
            ``reset_times_s`` has no ``reset_count``.

    Raises:
        InputError: the result is not a valid study.
    """
    return study_from_dict(search_space.insert_point(study_to_tables(study), point), study.name)


def replace_values(study: Study, changes: Mapping[str, Any]) -> Study:
    """Return a study with some values changed: the body of `Study.replace`."""
    tables = change_tables(non_default_tables(study), changes, study.name)
    return study_from_dict(tables, study.name)


def with_rate(study: Study, rate_hz: float) -> Study:
    """Return a recorded study with the rate of its record, unless it gives a rate itself.

    Raises:
        InputError: the study is not valid at this rate.
    """
    if study.study.rate_hz:
        return study
    tables = study_to_tables(study)
    settings = tables["study"] | {"rate_hz": rate_hz}
    return study_from_dict(tables | {"study": settings}, study.name)


Study.rebuild = staticmethod(replace_values)
Study.tables = staticmethod(non_default_tables)


def _build_checked_study(data: TomlTable, name: str) -> Study:
    """Return the study of some tables, points of [tune] checked.

    Raises:
        InputError: the mistakes of the first stage with any, since later ones need its values.
    """
    _check_methods_usable(data)
    study = _build_study(data, name)
    if study.tune and study.study.rate_hz:
        _check_tuning_points(study)
    return study


def _build_study(data: TomlTable, name: str) -> Study:
    """Return the study of some tables with all rules checked, but not the points of [tune]."""
    tables = without_gone_settings(_lists_to_tuples(data))
    _check_tables(tables)
    _register_external(tables)
    errors, sweep = ErrorCollector(), Sweep({}, {}, (), None)
    with errors.collect():
        sweep = read_sweep(tables)
    key_tables = {key: f"[{name}]" for name in SECTIONS for key in tables.get(name, ())}
    key_tables |= sweep.key_tables
    with errors.collect():
        _check_alternatives(key_tables)
    sections = _fill_defaults(tables, sweep, key_tables, name)
    if "tune" in sections:
        given = sections["tune"]
        sections["tune"] = given | {"variables": {}, "baseline": {}}  # in case these are wrong
        with errors.collect():
            sections["tune"] = read_tune_section(
                given, sweep.key_tables, recorded="record" in tables
            )
    with errors.collect():
        study = _validate_sections(sections)
    errors.raise_all()
    if lines := rules.broken_rules(study, key_tables):
        raise InputError(*lines)
    return study


def _register_external(tables: TomlTable) -> None:
    """Make the programs known whose results a study has, before its methods are checked."""
    names = tables.get("study", {}).get("external", ())
    if not isinstance(names, tuple) or not all(isinstance(name, str) for name in names):
        return  # refused with the other values
    try:
        register_external(names)
    except InputError as error:
        raise InputError(f"[study] external: {error}") from None


def _check_tuning_points(study: Study) -> None:
    """Refuse a [tune] whose points are not valid studies."""
    assert study.tune is not None
    tables, baseline = study_to_tables(study), study.tune.baseline

    def build_point(place: str, point: TomlTable) -> Study:
        try:
            return _build_study(search_space.insert_point(tables, point), study.name)
        except InputError as error:
            raise InputError(f"{place}: {error.lines[0]}") from None

    corners = {
        f"[tune.variables] {text}": point for text, point in search_space.corner_points(study)
    }
    for place, point in corners.items():
        build_point(place, point)
    search_space.comparable_points(study, build_point("[tune.baseline]", baseline), corners)


def _check_methods_usable(data: Any) -> None:
    """Refuse a study with a method that cannot be used, whose sections and keys are unknown."""
    for name in sorted({*_iter_method_names(data)} & (BROKEN.keys() - METHODS.keys())):
        raise InputError(f"[alignment] method: {name!r} cannot be used: {BROKEN[name]}")


def _iter_method_names(data: Any, key: str = "") -> Iterator[str]:
    """Yield all words under keys called ``method``, of sections, axes and cases."""
    if isinstance(data, Mapping):
        for name, value in data.items():
            yield from _iter_method_names(value, name)
    elif isinstance(data, list | tuple):
        for value in data:
            yield from _iter_method_names(value, key)
    elif key == "method" and isinstance(data, str):
        yield data


def _lists_to_tuples(value: Any) -> Any:
    """Replace lists by tuples, since a study is immutable."""
    if isinstance(value, Mapping):
        return {key: _lists_to_tuples(entry) for key, entry in value.items()}
    return tuple(map(_lists_to_tuples, value)) if isinstance(value, list | tuple) else value


def _check_tables(data: TomlTable) -> None:
    """Refuse unknown sections and keys, and those that a recorded study cannot have."""
    errors = ErrorCollector()
    for name, table in data.items():
        with errors.collect():
            _check_table(name, table)
    for name in SIMULATED_ONLY:
        if name in data and "record" in data:
            errors.add(f"[{name}]: does not apply to a recorded study (drop it or [record])")
    study = data.get("study")
    if "record" in data and isinstance(study, Mapping) and "draws" in study:
        reason = "does not apply to a recorded study (drop it: there is one draw per start time)"
        errors.add(f"[study] draws: {reason}")
    errors.raise_all()


def _check_table(name: str, table: Any) -> None:
    """Refuse an unknown table, and unknown keys in a table."""
    names = (*SECTIONS, *_SWEEP_TABLES)
    if name in SECTION_OF and name not in SECTIONS:
        raise InputError(f"{name}: a key of [{SECTION_OF[name]}] (move it there)")
    if name == "advise":
        raise InputError("[advise]: is read by `sinsjax advise` alone (drop it from a study)")
    if name not in names:
        hint = suggest_closest(name, names, "[{}]")
        hint = hint or " (is it of a method whose package is not installed?)"
        raise InputError(f"[{name}]: unknown section{hint}")
    if name == "cases":
        return
    if not isinstance(table, Mapping):
        raise InputError(f"[{name}]: must be a table of keys")
    errors = ErrorCollector()
    for key, value in table.items():
        if name in SECTIONS and key not in SECTIONS[name].model_fields:
            errors.add(f"[{name}] {key}: {_unknown_key_text(key, name)}")
        elif value is None:
            errors.add(f"[{name}] {key}: None is not a value (leave the key out)")
    errors.raise_all()


def _unknown_key_text(key: str, section: str) -> str:
    """Return the error text of a key in the wrong section, or unknown."""
    if key in SECTION_OF:
        return f"unknown key (it belongs in [{SECTION_OF[key]}])"
    text = unknown_key_error(key, SECTIONS[section].model_fields)
    similar = difflib.get_close_matches(str(key), list(SECTION_OF), n=1)
    if text == "unknown key" and similar:
        return f"{text} (did you mean {similar[0]} in [{SECTION_OF[similar[0]]}]?)"
    return text


def _check_alternatives(key_tables: rules.KeyTables) -> None:
    """Refuse two keys that are alternatives."""
    lines: list[str] = []
    reported: set[str] = set()
    for first, second in (pair for section in SECTIONS.values() for pair in section.exclusive):
        if first in key_tables and second in key_tables and reported.isdisjoint((first, second)):
            text = f"conflicts with {second} in {key_tables[second]} (give one of them)"
            lines.append(f"{key_tables[first]} {first}: {text}")
            reported |= {first, second}
    if lines:
        raise InputError(*lines)


def _fill_defaults(
    tables: TomlTable, sweep: Sweep, key_tables: rules.KeyTables, name: str
) -> TomlTable:
    """Return the sections that apply, with the defaults that depend on other keys."""
    recorded = "record" in tables
    unused: tuple[str, ...] = SIMULATED_ONLY if recorded else ("record",)
    unread = unread_keys(_values_over_variants("method", tables, sweep) & METHODS.keys())
    given = {SECTION_OF.get(key) for key in key_tables}
    idle = {
        name
        for name, section in SECTIONS_OF_METHODS.items()
        if unread.issuperset(section.model_fields)
    }
    optional = {"passes", "stop_when", "tune"} | (set() if recorded else {"coarse"})
    unused += tuple(optional - given - tables.keys())
    unused += tuple(idle - given)
    for section in idle & given:  # complete, as if another variant read it
        unread -= {*SECTIONS[section].model_fields, _FEEDBACK_KEY}
    sections = {key: dict(tables.get(key, {})) for key in SECTIONS if key not in unused}
    sections["study"].setdefault("name", name)
    if not recorded:
        sections["study"].setdefault("draws", _DEFAULT_DRAWS)
        sections["earth"].setdefault("height_m", 0.0)
        for white, density in SECTIONS["sensors"].exclusive:
            if white not in key_tables and density not in key_tables:
                sections["sensors"][white] = 0.0
    for section, values in sections.items():
        for key in SECTIONS[section].model_fields.keys() - unread:
            key_info = KEYS[section, key].info
            if key_info.default is None or not key_tables.keys().isdisjoint(alternative_keys(key)):
                continue
            if key_info.beside is None or (
                key not in key_tables
                and _values_over_variants(key_info.beside, tables, sweep) - {None, "none"}
            ):
                values.setdefault(key, key_info.default)
    if _FEEDBACK_KEY not in key_tables and _FEEDBACK_KEY not in unread:
        sections["alignment"] |= _default_feedback(sections["study"].get("rate_hz"))
    if "constants" in _values_over_variants("earth", tables, sweep):
        sections["earth"] = EARTH_CONSTANTS | sections["earth"]
    return sections | sweep._asdict()


def _default_feedback(rate_hz: Any) -> TomlTable:
    """Return the default of ``feedback_interval_s``; empty until a valid rate is known."""
    known = isinstance(rate_hz, int | float) and 1e-12 <= rate_hz <= 1e12
    return {_FEEDBACK_KEY: 1 / rate_hz} if known else {}


def _values_over_variants(key: str, tables: TomlTable, sweep: Sweep) -> set[Any]:
    """Return the values of a key over the variants, or the default of its section."""
    section = SECTION_OF[key]
    default = SECTIONS[section].model_fields[key].default
    given = tables.get(section, {}).get(key, default)
    # Values that are not text are refused when all values are checked.
    return sweep.values(key) or {given if isinstance(given, str) else default}


def _validate_sections(sections: TomlTable) -> Study:
    try:
        return Study.model_validate(sections)
    except ValidationError as error:
        raise InputError(*map(_format_error, correctable_errors(error))) from None


def _format_error(error: ErrorDetails) -> str:
    """Return the error line of an invalid value or of a missing key."""
    section = str(error["loc"][0])
    key = error["loc"][1] if len(error["loc"]) > 1 else error["ctx"]["key"]
    hint = ""
    if error["type"] == "missing" and len(error["loc"]) == 2:
        hint = f" ({key_summary(section, str(key))})"
    text = explain_error(error, f"{section}.{key}")
    return f"[{section}] {key}{format_list_index(error)}: {text}{hint}"
