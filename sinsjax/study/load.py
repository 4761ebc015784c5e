"""Reading and writing studies: one TOML file, checked in full before anything runs.

A file either gives a `Study` or raises `InputError` with a line for every mistake in it,
``FILE: [section] key: what is wrong (way on)``. The tables that vary a study are read in `sweep`,
the rules between keys are those of `rules`. Values stay in the units of the file.
"""

import difflib
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from sinsjax.alignment.methods import BROKEN, METHODS, SECTIONS_OF_METHODS, keys_unread, unusable
from sinsjax.errors import ErrorCollector, InputError, StudyWarning
from sinsjax.messages import escape_controls, explained, index, near
from sinsjax.study import changes as changing
from sinsjax.study import dropping, files, rules, search_space
from sinsjax.study.keys import (
    EARTH_CONSTANTS,
    SECTION_OF,
    SECTIONS,
    SIMULATED_ONLY,
    TomlTable,
    info,
    rivals,
    unknown_key,
)
from sinsjax.study.mistakes import build_or_report
from sinsjax.study.study import Study
from sinsjax.study.sweep import Sweep, errors_of, read_sweep, read_tuning

__all__ = [
    "Study",
    "load_study",
    "study_from_dict",
    "study_to_toml",
    "tables_of",
    "with_point",
]

_DEFAULT_DRAWS = 64
_DEFAULT_SAMPLES = 256
_FILLED = EARTH_CONSTANTS | {
    "draws": _DEFAULT_DRAWS,
    "estimate_samples": _DEFAULT_SAMPLES,
    "height_m": 0.0,
    **{white: 0.0 for white, _ in SECTIONS["sensors"].exclusive},
}
"""Defaults of keys that depend on other keys, or on whether the study is recorded."""
_FEEDBACK = "feedback_interval_s"
_SWEEPS = ("axes", "cases", "drawn")
_DROPPED = {
    "report": "every study has the same report",
    "statements": "pages of studies judge their own statements",
    "unscented": "sigma_point_alpha is 0.5",
}
"""Sections of 0.5 and 0.6, and why a study has them no more."""


def load_study(path: str | Path, changes: Mapping[str, Any] | None = None) -> Study:
    """Reads and checks a study file.

    Args:
        path: the file, or the name of a shipped study, see `files.found`.
        changes: values by ``section.key`` that take the place of the file's, see `changes`.

    Raises:
        InputError: the file cannot be read, is no TOML or is no study; a line for each mistake.

    Warns:
        StudyWarning: the changes drop what another method does not read.
    """
    data, dropped = _read(path, changes)
    study = study_from_dict(data, str(files.found(path)))
    for line in dropped:
        warnings.warn(line, StudyWarning, stacklevel=2)
    return study


def load_with_notes(path: str | Path, changes: Mapping[str, Any]) -> tuple[Study, list[str]]:
    """Read and check a study file as `load_study`.

    Returns:
        The study, and what the user should know of keys that its methods do not use, in lines.

    Raises:
        InputError: as `load_study`.
    """
    data, dropped = _read(path, changes)
    study = study_from_dict(data, str(files.found(path)))
    return study, [*dropped, *dropping.keys_without_effect(study, data)]


def _read(path: str | Path, changes: Mapping[str, Any] | None) -> tuple[TomlTable, list[str]]:
    data = files.read_tables(path)
    return change_tables(data, changes, str(path)) if changes else (data, [])


def change_tables(
    data: TomlTable, changes: Mapping[str, Any], source: str
) -> tuple[TomlTable, list[str]]:
    """Change some values of a study's tables, and drop what another method does not read.

    Returns:
        The tables, and lines that tell the user what was dropped.

    Raises:
        InputError: a change names no key, or is nested too deeply.
    """
    try:
        out = changing.changed(data, changes)
    except InputError as error:
        raise error.named(source) from None
    files.require_shallow(out, source)
    return dropping.drop_unread(data, out, changes, source)


def study_from_dict(data: TomlTable, source: str = "study") -> Study:
    """Check a study given as nested dictionaries, as a TOML parser returns it.

    Args:
        data: sections by name; left as it is.
        source: name of the study in messages; its stem is the default of ``study.name``.

    Raises:
        InputError: the study is not valid; a line for each mistake in it.
    """
    try:
        return _checked_study(data, escape_controls(Path(source).stem))
    except InputError as error:
        raise error.named(source) from None
    except RecursionError:
        raise InputError(f"{source}: {files.TOO_DEEP}") from None


def tables_of(study: Study) -> TomlTable:
    """The resolved study as nested dictionaries: `study_from_dict` makes an equal study of them."""
    content = study.model_dump(exclude_none=True)
    for key in study.drawn_keys:
        content[SECTION_OF[key]].pop(key, None)
    content["axes"] |= content.pop("zips")
    names = (*SECTIONS, *_SWEEPS)
    return {name: content[name] for name in names if content.get(name)}


def study_to_toml(study: Study) -> str:
    """The resolved study as TOML, all defaults filled in; loading it gives an equal study."""
    text = tomli_w.dumps(tables_of(study))
    return "# The resolved study: every value, defaults filled in.\n" + text


def with_point(study: Study, point: TomlTable) -> Study:
    """A study with the values of some keys put in their places, and without [tune].

    Args:
        study: checked study, left as it is; none of the keys is swept or drawn.
        point: values by leaf key. What says the same in another way goes: a study with
            ``reset_times_s`` has no ``reset_count``.

    Raises:
        InputError: that is no study.
    """
    return study_from_dict(search_space.put(tables_of(study), point), study.name)


def replaced(study: Study, changes: Mapping[str, Any]) -> Study:
    """A study with some values changed; defaults that depend on other keys are made anew.

    Args:
        study: checked study, left as it is.
        changes: values by ``section.key``, as ``{"alignment.phi_u0_deg": 12.0}``; each takes the
            place of whatever the study says of the key, an axis included.

    Raises:
        InputError: that is no study.

    Warns:
        StudyWarning: the changes drop what another method does not read.
    """
    filled = _FILLED | _feedback_each_sample(study.study.rate_hz)
    tables = changing.without_defaults(tables_of(study), filled)
    tables, dropped = change_tables(tables, changes, study.name)
    made = study_from_dict(tables, study.name)
    for line in dropped:
        warnings.warn(line, StudyWarning, stacklevel=3)
    return made


def one_variant(study: Study, variant: int) -> Study:
    """The study of one variant alone.

    Args:
        study: a simulated study.
        variant: its number.
    """
    point = {key: values[variant] for key, values in study.variant_values().items()}
    return study.model_copy(update={"axes": {}, "zips": {}, "cases": (point,) if point else ()})


def with_rate(study: Study, rate_hz: float) -> Study:
    """A recorded study at the rate of its record, where it leaves its own out.

    Raises:
        InputError: at this rate it is none.
    """
    if study.study.rate_hz:
        return study
    tables = tables_of(study)
    settings = tables["study"] | {"rate_hz": rate_hz}
    return study_from_dict(tables | {"study": settings}, study.name)


Study.rebuild = staticmethod(replaced)


def _checked_study(data: TomlTable, name: str) -> Study:
    """Return the study that tables make, points of its tuning included; or report every mistake."""
    _check_usable(data)

    def build(tables: TomlTable) -> Study:
        study = _built(tables, name)
        if study.tune and study.study.rate_hz:
            _check_points(study)
        return study

    return build_or_report(build, data)


def _built(data: TomlTable, name: str) -> Study:
    """Return the study that tables make, with all rules checked, but not the points of [tune]."""
    tables = _known_tables(_with_tuples(data))
    errors, sweep = ErrorCollector(), Sweep({}, {}, (), None)
    with errors.collect():
        sweep = read_sweep(tables)
    where = {key: f"[{name}]" for name in SECTIONS for key in tables.get(name, ())}
    where |= sweep.where
    with errors.collect():
        _check_rivals(where)
    sections, of_tuning = _filled(tables, sweep, where, name), ErrorCollector()
    if "tune" in sections:
        given = sections["tune"]
        sections["tune"] = given | {"variables": {}, "baseline": {}}  # in case these are wrong
        with of_tuning.collect():
            sections["tune"] = read_tuning(given, sweep.where, recorded="record" in tables)
    with errors.collect():
        study = _validated(sections)
    if errors.lines:
        raise InputError(*errors.lines, *of_tuning.lines)
    if lines := (*of_tuning.lines, *rules.failures(study, where)):
        raise InputError(*lines)
    return study


def _check_points(study: Study) -> None:
    """Refuse a [tune] whose points make no study."""
    assert study.tune is not None
    tables, baseline = tables_of(study), study.tune.baseline

    def at(place: str, point: TomlTable) -> Study:
        try:
            return _built(search_space.put(tables, point), study.name)
        except InputError as error:
            raise InputError(f"{place}: {error.lines[0]}") from None

    corners = {f"[tune.variables] {text}": point for text, point in search_space.corners(study)}
    for place, point in corners.items():
        at(place, point)
    search_space.comparable(study, at("[tune.baseline]", baseline), corners)


def _check_usable(data: Any) -> None:
    """Refuse a study with a method that cannot be used, whose sections and keys are unknown."""
    for name in sorted({*_methods(data)} & (BROKEN.keys() - METHODS.keys())):
        raise InputError(f"[alignment] method: {name!r} cannot be used: {BROKEN[name]}")


def _methods(data: Any, key: str = "") -> Iterator[str]:
    """Return all words under keys called ``method``, be they values, axes or cases."""
    if isinstance(data, Mapping):
        for name, value in data.items():
            yield from _methods(value, name)
    elif isinstance(data, list | tuple):
        for value in data:
            yield from _methods(value, key)
    elif key == "method" and isinstance(data, str):
        yield data


def _with_tuples(value: Any) -> Any:
    """The same data with tuples for lists, so that the frozen study is frozen all the way."""
    if isinstance(value, Mapping):
        return {key: _with_tuples(entry) for key, entry in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list | tuple) else value


def _known_tables(data: TomlTable) -> TomlTable:
    """Return the data, once every section and key in it is known."""
    errors = ErrorCollector()
    for name, table in data.items():
        with errors.collect():
            _check_table(name, table)
    for name in SIMULATED_ONLY:
        with errors.collect():
            if name in data and "record" in data:
                text = "does not apply to a recorded study (drop it or [record])"
                raise InputError(f"[{name}]: {text}")
    with errors.collect():
        study = data.get("study")
        if "record" in data and isinstance(study, Mapping) and "draws" in study:
            text = "does not apply to a recorded study (one draw a start time)"
            raise InputError(f"[study] draws: {text}")
    errors.raise_all()
    return data


def _check_table(name: str, table: Any) -> None:
    """Refuse a table that is no section, and keys that its section has not."""
    names = (*SECTIONS, *_SWEEPS)
    if name in SECTION_OF and name not in SECTIONS:
        raise InputError(f"{name}: belongs in [{SECTION_OF[name]}]")
    if name in _DROPPED:
        raise InputError(f"[{name}]: was dropped, {_DROPPED[name]} (remove the section)")
    if name not in names:
        hint = near(name, names, "[{}]") + unusable()
        hint = hint or " (of a method whose package is not installed?)"
        raise InputError(f"[{name}]: unknown section{hint}")
    if name == "cases":
        return
    if not isinstance(table, Mapping):
        raise InputError(f"[{name}]: must be a table of keys")
    errors = ErrorCollector()
    for key, value in table.items():
        with errors.collect():
            if name in SECTIONS and key not in SECTIONS[name].model_fields:
                raise InputError(f"[{name}] {key}: {_unknown_key(key, name)}")
            if value is None:
                raise InputError(f"[{name}] {key}: None is no value (leave the key out)")
    errors.raise_all()


def _unknown_key(key: str, section: str) -> str:
    """Return what is wrong with a key of a section: its home, what replaced it, or a hint."""
    if key in SECTION_OF:
        return f"unknown key (it belongs in [{SECTION_OF[key]}])"
    here = unknown_key(key, SECTIONS[section].model_fields)
    found = difflib.get_close_matches(str(key), list(SECTION_OF), n=1)
    if here == "unknown key" and found:
        return f"{here} (did you mean {found[0]} in [{SECTION_OF[found[0]]}]?)"
    return here


def _check_rivals(where: rules.Where) -> None:
    """Refuse two keys that are alternatives."""
    lines: list[str] = []
    reported: set[str] = set()
    for one, other in (pair for section in SECTIONS.values() for pair in section.exclusive):
        if one in where and other in where and reported.isdisjoint((one, other)):
            text = f"conflicts with {other} in {where[other]} (give one of them)"
            lines.append(f"{where[one]} {one}: {text}")
            reported |= {one, other}
    if lines:
        raise InputError(*lines)


def _filled(tables: TomlTable, sweep: Sweep, where: rules.Where, name: str) -> TomlTable:
    """The sections that apply, with the defaults that depend on other keys."""
    recorded = "record" in tables
    unused: tuple[str, ...] = SIMULATED_ONLY if recorded else ("record",)
    unread = keys_unread(_values_of("method", tables, sweep) & METHODS.keys())
    given = {SECTION_OF.get(key) for key in where}
    optional = {"passes", "stop_when", "tune"} | (set() if recorded else {"coarse"})
    unused += tuple(optional - given - tables.keys())
    unused += tuple(
        name
        for name, section in SECTIONS_OF_METHODS.items()
        if name not in given and unread.issuperset(section.model_fields)
    )
    sections = {key: dict(tables.get(key, {})) for key in SECTIONS if key not in unused}
    sections["study"].setdefault("name", name)
    if not recorded:
        if sections["study"].get("estimate") == "covariance":
            sections["study"].setdefault("check_linearity", True)
            sections["study"].setdefault("estimate_samples", _DEFAULT_SAMPLES)
        sections["study"].setdefault("draws", _DEFAULT_DRAWS)
        sections["earth"].setdefault("height_m", 0.0)
        for white, density in SECTIONS["sensors"].exclusive:
            if white not in where and density not in where:
                sections["sensors"][white] = 0.0
    for section, values in sections.items():
        for key in SECTIONS[section].model_fields.keys() - unread:
            about = info(key)
            if about.default is None or not where.keys().isdisjoint(rivals(key)):
                continue
            if about.beside is None or (
                key not in where and _values_of(about.beside, tables, sweep) - {None, "none"}
            ):
                values.setdefault(key, about.default)
    if _FEEDBACK not in where and _FEEDBACK not in unread:
        sections["alignment"] |= _feedback_each_sample(sections["study"].get("rate_hz"))
    if "constants" in _values_of("earth", tables, sweep):
        sections["earth"] = EARTH_CONSTANTS | sections["earth"]
    return sections | sweep._asdict()


def _feedback_each_sample(rate_hz: Any) -> TomlTable:
    """Return the default of ``feedback_interval_s``; none until the rate is known and right."""
    known = isinstance(rate_hz, int | float) and 1e-12 <= rate_hz <= 1e12
    return {_FEEDBACK: 1 / rate_hz} if known else {}


def _values_of(key: str, tables: TomlTable, sweep: Sweep) -> set[Any]:
    """The values that a key takes over the variants, its section's default where none is given."""
    section = SECTION_OF[key]
    default = SECTIONS[section].model_fields[key].default
    given = tables.get(section, {}).get(key, default)
    # What is no word is refused where all values are checked.
    return sweep.values(key) or {given if isinstance(given, str) else default}


def _validated(sections: TomlTable) -> Study:
    try:
        return Study.model_validate(sections)
    except ValidationError as error:
        raise InputError(*map(_value_error, errors_of(error))) from None


def _value_error(error: ErrorDetails) -> str:
    """Return the line of a value that its key does not take, or of a key that is missing."""
    section = str(error["loc"][0])
    key = error["loc"][1] if len(error["loc"]) > 1 else error["ctx"]["key"]
    hint = ""
    if error["type"] == "missing" and len(error["loc"]) == 2:
        hint = f" ({SECTIONS[section].model_fields[str(key)].description})"
    return f"[{section}] {key}{index(error)}: {explained(error)}{hint}"
