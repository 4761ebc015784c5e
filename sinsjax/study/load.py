"""Reading and writing studies: one TOML file, checked in full before anything runs.

A file either gives a `Study` or raises `InputError` with a line for each of its mistakes that the
first stage with any finds, ``FILE: [section] key: what is wrong (way on)``. The stages are names of
sections and keys, values, rules (`rules.STAGES`), and points of [tune]. `sweep` reads the
tables that vary a study. Values stay in the units of the file.
"""

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from sinsjax.errors import ErrorCollector, InputError
from sinsjax.messages import escape_controls, explain_error, format_list_index, suggest_closest
from sinsjax.methods.registry import BROKEN, METHODS, register_external
from sinsjax.study import files, rules, search_space
from sinsjax.study.changes import apply_changes, copy_tables
from sinsjax.study.defaults import GivenKeys, filled_in
from sinsjax.study.keys import (
    KEYS,
    SECTION_OF,
    SECTIONS,
    SIMULATED_ONLY,
    TomlTable,
    key_summary,
    unknown_key_error,
)
from sinsjax.study.questions import reject_open_questions
from sinsjax.study.study import Study, study_to_tables
from sinsjax.study.sweep import (
    Sweep,
    check_alternatives,
    correctable_errors,
    read_sweep,
    read_tune_section,
    without_gone_settings,
)

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
    return _build(files.read_tables(source), files.source_name(source), changes or {}, source)


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
    return _build(data, source, {})


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


def with_rate(study: Study, rate_hz: float) -> Study:
    """Return a recorded study with the rate of its record, unless it gives a rate itself.

    Raises:
        InputError: the study is not valid at this rate.
    """
    return study if study.study.rate_hz else study.replace({"study.rate_hz": rate_hz})


def _build(
    data: TomlTable, source: str, changes: Mapping[str, Any], path: str | Path | None = None
) -> Study:
    """Return the study of some tables with changes, whose file shows why a question is open."""
    try:
        tables = apply_changes(data, changes) if changes else data
        reject_open_questions(tables, path)
        study = _read_study(tables, escape_controls(Path(source).stem))
        if study.tune and study.study.rate_hz:
            _check_tuning_points(study)
        return study
    except InputError as error:
        lines = error.with_source(source).lines
        if path and "sensors" in data and data.keys() <= {*SHEET_TABLES}:
            hint = f"`sinsjax advise {path} --study FILE` writes a study of a data sheet"
            lines = (*lines, f"{source}: has no [alignment] ({hint})")
        raise InputError(*lines) from None


Study.from_tables = staticmethod(_build)


def _read_study(data: TomlTable, name: str) -> Study:
    """Return the study of some tables: names, sweep, defaults, values, rules."""
    tables, errors = without_gone_settings(copy_tables(data, tuple)), ErrorCollector()
    _check_methods_usable(tables)
    _check_tables(tables)
    _register_external(tables)
    sweep, inherited = read_sweep(tables, errors)
    given = {  # the cases have the others
        section: {key: value for key, value in table.items() if key not in inherited}
        for section, table in tables.items()
        if section in SECTIONS
    }
    tables_of_keys = {key: f"[{section}]" for section, keys in given.items() for key in keys}
    with errors.collect():
        check_alternatives(tables_of_keys | sweep.table_of)
    defaults = filled_in(GivenKeys(given, sweep.values_varied))
    sections = {section: values | given.get(section, {}) for section, values in defaults.items()}
    sections["study"].setdefault("name", name)
    if "tune" in sections:
        sections["tune"] = read_tune_section(sections["tune"], tables, sweep.table_of, errors)
    try:
        varied = {name: getattr(sweep, name) for name in Sweep.model_fields}
        study = Study.model_validate(sections | varied)
    except ValidationError as error:
        for detail in correctable_errors(error):
            errors.add(_format_error(detail))
    errors.raise_all()
    for section, values in defaults.items():  # which the file does not give
        getattr(study, section).model_fields_set.difference_update(values)
    rules.check_rules(study)
    return study


def _register_external(tables: TomlTable) -> None:
    """Make the programs known whose results a study has, before its methods are checked."""
    names = tables.get("study", {}).get("external", ())
    if not isinstance(names, tuple):
        return  # refused with the other values
    try:
        register_external([name for name in names if isinstance(name, str)])
    except InputError as error:
        raise InputError(f"[study] external: {error}") from None


def _check_tuning_points(study: Study) -> None:
    """Refuse a [tune] whose points are not valid studies."""
    assert study.tune is not None
    tables, baseline = study_to_tables(study), study.tune.baseline

    def build_point(place: str, point: TomlTable) -> Study:
        try:
            return _read_study(search_space.insert_point(tables, point), study.name)
        except InputError as error:
            raise InputError(f"{place}: {error.lines[0]}") from None

    corners = {
        f"[tune.variables] {text}": point for text, point in search_space.corner_points(study)
    }
    for place, point in corners.items():
        build_point(place, point)
    search_space.comparable_points(study, build_point("[tune.baseline]", baseline), corners)


def _check_methods_usable(data: Any, key: str = "") -> None:
    """Refuse a word under a key ``method`` that names a method that cannot be used."""
    if isinstance(data, Mapping):
        for name, value in data.items():
            _check_methods_usable(value, name)
    elif isinstance(data, tuple):
        for value in data:
            _check_methods_usable(value, key)
    elif key == "method" and isinstance(data, str) and data in BROKEN.keys() - METHODS.keys():
        raise InputError(f"[alignment] method: {data!r} cannot be used: {BROKEN[data]}")


def _check_tables(data: TomlTable) -> None:
    """Refuse unknown sections and keys, and those that a recorded study cannot have."""
    names, recorded = (*SECTIONS, *_SWEEP_TABLES), "record" in data
    errors = ErrorCollector()
    for name, table in data.items():
        if name == "advise":
            errors.add("[advise]: is read by `sinsjax advise` alone (drop it from a study)")
        elif name in SECTION_OF and name not in SECTIONS:
            errors.add(f"{name}: a key of [{SECTION_OF[name]}] (move it there)")
        elif name not in names:
            hint = suggest_closest(name, names, "[{}]") or " (is its method not installed?)"
            errors.add(f"[{name}]: unknown section{hint}")
        elif name != "cases" and not isinstance(table, Mapping):
            errors.add(f"[{name}]: must be a table of keys")
        elif recorded and name in SIMULATED_ONLY:
            errors.add(f"[{name}]: does not apply to a recorded study (drop it or [record])")
        elif name != "cases":
            for key, value in table.items():
                if name in SECTIONS and key not in SECTIONS[name].model_fields:
                    errors.add(f"[{name}] {key}: {_unknown_key_text(key, name)}")
                elif value is None:
                    errors.add(f"[{name}] {key}: None is not a value (leave the key out)")
                elif recorded and name in SECTIONS and KEYS[name, key].info.in_simulation:
                    reason = "does not apply to a recorded study (drop it: one draw per start time)"
                    errors.add(f"[{name}] {key}: {reason}")
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


def _format_error(error: ErrorDetails) -> str:
    """Return the error line of an invalid value or of a missing key."""
    section = str(error["loc"][0])
    key = error["loc"][1] if len(error["loc"]) > 1 else error["ctx"]["key"]
    hint = ""
    if error["type"] == "missing" and len(error["loc"]) == 2:
        hint = f" ({key_summary(section, str(key))})"
    text = explain_error(error, f"{section}.{key}")
    return f"[{section}] {key}{format_list_index(error)}: {text}{hint}"
