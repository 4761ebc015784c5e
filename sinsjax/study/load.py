"""Reading and writing studies: one TOML file, checked in full before anything runs; its identity.

A file either gives a `Study` or raises `InputError` with a line for each mistake that the first
stage with any finds: names of sections and keys, values, rules (see `rules`), points of [tune].
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from sinsjax.errors import ErrorCollector, InputError
from sinsjax.messages import escape_controls, explain_error, shorten, suggest_closest
from sinsjax.methods.registry import BROKEN, register_external
from sinsjax.study import files, rules, search_space
from sinsjax.study.changes import apply_changes, copy_tables
from sinsjax.study.keys import (
    KEYS,
    SECTION_OF,
    SECTIONS,
    SIMULATED_ONLY,
    GivenKeys,
    TomlTable,
    key_summary,
    unknown_key_error,
    values_of_omitted_keys,
)
from sinsjax.study.motion import attitude_digest
from sinsjax.study.study import Study, study_to_tables
from sinsjax.study.sweep import (
    Sweep,
    correctable_errors,
    read_sweep,
    read_tune_section,
    refuse_alternatives_given_together,
    without_gone_settings,
)

SHEET_TABLES = ("study", "earth", "motion", "sensors", "drawn", "advise")
"""Sections of a sheet, which `sinsjax.advise` reads."""


def load_study(source: str | Path | Study, changes: Mapping[str, Any] | None = None) -> Study:
    """Read and check a study.

    Every function with a study argument accepts the same.

    Args:
        source: file, or else name of a shipped study (``sinsjax init --list``), or study.
        changes: values by ``section.key`` that replace those of the study, see `Study.replace`.

    Raises:
        InputError: the file cannot be read, is not TOML or not a valid study; a line per mistake.

    Examples:
        >>> sinsjax.load_study("reset_sweep", {"study.draws": 2})
        Study reset_sweep
          runs    448 variants x 2 draws = 896 runs
          axes    reset_count (7); reset_cycle_s (8); phi_u0_deg (8)
          method  kalman5
          length  900 s at 100 Hz
    """
    if isinstance(source, Study):
        return source.replace(changes) if changes else source
    return build_study(files.read_tables(source), files.source_name(source), changes or {})


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
          axes    phi_u0_deg (3)
          method  kalman5
          length  60 s at 100 Hz
    """
    return build_study(data, source)


def study_to_toml(study: Study) -> str:
    """Return the resolved study as TOML with all defaults; loading it gives an equal study."""
    text = tomli_w.dumps(study_to_tables(study))
    return "# The resolved study: every value, defaults filled in.\n" + text


def with_point(study: Study, point: TomlTable) -> Study:
    """Return a study with other values of some keys, and without [tune].

    None of the keys is swept or drawn. Alternatives to them are dropped: a study with
    ``reset_times_s`` has no ``reset_count``.
    """
    return build_study(search_space.insert_point(study_to_tables(study), point), study.name)


def with_rate(study: Study, rate_hz: float) -> Study:
    """Return a recorded study with the rate of its record, unless it gives a rate itself."""
    return study if study.study.rate_hz else study.replace({"study.rate_hz": rate_hz})


def build_study(data: TomlTable, source: str, changes: Mapping[str, Any] | None = None) -> Study:
    """Return the study of some tables with changes, of which every error names the source."""
    try:
        tables = apply_changes(data, changes) if changes else data
        study = _read_study(tables, escape_controls(Path(source).stem))
        if study.tune and study.study.rate_hz:
            _check_tuning_points(study)
        return study
    except InputError as error:
        raise error.with_source(source) from None


Study.from_tables = staticmethod(build_study)


def _read_study(data: TomlTable, name: str) -> Study:
    """Return the study of some tables: names, sweep, defaults, values, rules."""
    tables, errors = without_gone_settings(copy_tables(data, tuple)), ErrorCollector()
    _check_tables(tables)
    _register_external(tables)
    sweep = read_sweep(tables, errors)
    in_cases = {*sweep.cases[0]} if sweep.cases else set()
    given = {
        section: {key: value for key, value in table.items() if key not in in_cases}
        for section, table in tables.items()
        if section in SECTIONS
    }
    table_of = {key: f"[{name}]" for name in given for key in tables[name]}
    with errors.collect():
        refuse_alternatives_given_together(table_of)  # also those of which each case has one
        refuse_alternatives_given_together(table_of | sweep.table_of)
    defaults = values_of_omitted_keys(GivenKeys(given, sweep.values_varied))
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
    try:
        if isinstance(names, tuple):  # else refused with the other values
            register_external(name for name in names if isinstance(name, str))
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

    corners = search_space.lowest_and_highest_points(study)
    for place, point in corners.items():
        build_point(place, point)
    search_space.add_baseline_of_same_keys(study, build_point("[tune.baseline]", baseline), corners)


def _check_tables(data: TomlTable) -> None:
    """Refuse unknown sections and keys, and those that a recorded study cannot have."""
    names, recorded = (*SECTIONS, "axes", "cases", "drawn"), "record" in data
    errors = ErrorCollector()
    for name, table in data.items():
        if name == "advise":
            errors.add("[advise]: is read by `sinsjax advise` alone (drop it from a study)")
        elif name in SECTION_OF and name not in SECTIONS:
            errors.add(f"{name}: a key of [{SECTION_OF[name]}] (move it there)")
        elif name not in names:
            reason = "; ".join(BROKEN.values()) or "is its method not installed?"
            hint = suggest_closest(name, names, "[{}]") or f" ({reason})"
            errors.add(f"[{name}]: unknown section{hint}")
        elif name == "cases":
            continue
        elif not isinstance(table, Mapping):
            errors.add(f"[{name}]: must be a table of keys")
        elif recorded and name in SIMULATED_ONLY:
            errors.add(f"[{name}]: does not apply to a recorded study (drop it or [record])")
        else:
            for key, value in table.items():
                if value == files.OPEN:
                    way = f"answer it, see its comment, or give --set {name}.{key}=VALUE"
                    errors.add(f"[{name}] {key}: an open question ({way})")
                elif name in SECTIONS and key not in SECTIONS[name].model_fields:
                    text = unknown_key_error(key, SECTIONS[name].model_fields)
                    errors.add(f"[{name}] {key}: {text}")
                elif value is None:
                    errors.add(f"[{name}] {key}: None is not a value (leave the key out)")
                elif recorded and name in SECTIONS and KEYS[name, key].info.in_simulation:
                    reason = "does not apply to a recorded study (drop it: one draw per start time)"
                    errors.add(f"[{name}] {key}: {reason}")
    errors.raise_all()


def _format_error(error: ErrorDetails) -> str:
    """Return the error line of an invalid value or of a missing key."""
    section = str(error["loc"][0])
    key = error["loc"][1] if len(error["loc"]) > 1 else error["ctx"]["key"]
    hint = ""
    if error["type"] == "missing" and len(error["loc"]) == 2:
        hint = f" ({key_summary(section, str(key))})"
    text = explain_error(error, f"{section}.{key}")
    index = "".join(f"[{part}]" for part in error["loc"] if isinstance(part, int))
    return f"[{section}] {key}{index}: {text}{hint}"


NOT_COMPUTED: Any = {"tune": True, "study": {"name", "unchecked"}}
"""Keys without effect on the rows of a sweep."""


def fingerprint(study: Study) -> str:
    """Return 16 hex digits that identify the results of a study.

    The content of a file of the base's attitude counts, its name too. The name of the study and the
    order of keys in a section have no effect. The order of the axes, of the zips
    and of the drawn keys has: it numbers the variants and the points of a design.
    """
    content = study.model_dump(mode="json", exclude=NOT_COMPUTED, exclude_none=True)
    for name in ("axes", "zips", "drawn"):
        content[name] = list(content.get(name, {}).items())
    if attitude := attitude_digest(study):
        content["attitude"] = attitude
    content["zips"] = [keys for _, keys in content["zips"]]  # names have no effect
    text = json.dumps(content, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def with_draws(study: Study, draws: int) -> Study:
    """Return a simulated study with another number of draws, unchecked."""
    return study.model_copy(update={"study": study.study.model_copy(update={"draws": draws})})


def sections_to_json(study: Study) -> dict[str, Any]:
    """Return the sections of a resolved study as JSON values, as a manifest stores them."""
    return study.model_dump(mode="json", exclude_none=True)


def describe_differences(
    old: Study | Mapping[str, Any],
    new: Study | Mapping[str, Any],
    labels: tuple[str, str] = ("there", "here"),
) -> list[str]:
    """Return the keys that affect results and differ between two studies, with both values.

    A study may be the sections of a manifest; the labels are words for the places of both.
    """
    before, after = _values_by_section_and_key(old), _values_by_section_and_key(new)
    return [
        f"{key}: {shorten(str(before.get(key, 'none')), 60)} {labels[0]},"
        f" {shorten(str(after.get(key, 'none')), 60)} {labels[1]}"
        for key in before | after
        if before.get(key) != after.get(key)
    ] or ["the order of its keys, or the content of [motion] attitude_file"]


def _values_by_section_and_key(study: Study | Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a study by section and key of its file."""
    tables = dict(sections_to_json(study) if isinstance(study, Study) else study)
    zips, cases = tables.pop("zips", {}), tables.pop("cases", ())
    tables |= {f"axes.{name}": keys for name, keys in zips.items()}
    tables |= {f"cases {number}": case for number, case in enumerate(cases)}
    names = {f"[study] {key}" for key in NOT_COMPUTED["study"]}
    return {
        place: value
        for name, table in tables.items()
        if name != "tune" and isinstance(table, Mapping)
        for key, value in table.items()
        if (place := f"[{name}] {key}") not in names
    }
