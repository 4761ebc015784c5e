"""What every key of a study must satisfy, read from the schema: a new key adds nothing here."""

import json
import math
import re
import tomllib
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from support.refusals import assert_named
from support.studies import small_study

from sinsjax.errors import InputError
from sinsjax.methods.registry import METHODS
from sinsjax.study import files, rules
from sinsjax.study.identity import fingerprint
from sinsjax.study.keys import (
    KEYS,
    SECTION_OF,
    SECTIONS,
    SWEEPABLE,
    TABLES,
    Key,
    accepted_words,
    deciding_keys,
    find_keys,
    keys_page,
    study_schema,
)
from sinsjax.study.load import study_from_dict
from sinsjax.units import split_unit
from sinsjax.value_types import Section

ROOT = Path(__file__).parents[2]
LEAVES = [(section, name) for section, name in KEYS if section in SECTIONS]
BOUND = re.compile(r'"(?:exclusiveM|m)(?:in|ax)imum": (-?[\d.]+)')


def field_of(section: str, name: str) -> Any:
    return TABLES[section].model_fields[name]


def takes_one_number(section: str, name: str) -> bool:
    """Whether a value of it is a number, or a number for all axes."""
    annotation = str(field_of(section, name).annotation)
    return "float" in annotation and ("tuple" not in annotation or "Tag" in annotation)


# Names, units, defaults and descriptions


def test_unit_is_that_of_the_name_and_is_not_repeated_in_the_meaning():
    for (_, name), key in KEYS.items():
        assert key.unit == split_unit(name)[1]
        if key.unit:
            assert f", {key.unit}." not in f"{key.meaning}.", name


def test_every_key_has_a_meaning_that_names_the_words_it_accepts():
    for (section, name), key in KEYS.items():
        assert key.meaning, name
        for word in accepted_words(field_of(section, name).annotation):
            assert f"'{word}'" in key.meaning or f'"{word}"' in key.meaning, name


def test_number_with_a_unit_has_a_usual_range_or_bounds_within_a_turn():
    for (section, name), key in KEYS.items():
        if key.unit and section in SECTIONS and not key.info.usual_range:
            schema = json.dumps(SECTIONS[section].model_json_schema()["properties"][name])
            bounds = [float(bound) for bound in BOUND.findall(schema)]
            assert len(bounds) >= 2 and max(map(abs, bounds)) <= 360, f"[{section}] {name}"


def test_default_lies_in_the_usual_range():
    for section, name in LEAVES:
        for default in (field_of(section, name).default, KEYS[section, name].info.default):
            assert rules.describe_implausible(name, default) is None, name


def test_leaf_key_names_one_section():
    counts = Counter(name for _, name in LEAVES)
    for name in counts:
        # What [record] takes for plausible is no axis, and has the name that it has in [sensors].
        sections = {section for section, key in LEAVES if key == name} - {"record"} or {"record"}
        assert sections == {SECTION_OF[name]}, name


def test_conditions_and_alternatives_name_keys_of_their_section():
    for section in SECTIONS.values():
        assert issubclass(section, Section)
        named = {key for condition in section.conditions for key in condition.keys}
        named |= {key for condition in section.conditions for key in condition.given}
        named |= {key for pair in section.exclusive for key in pair}
        assert named <= section.model_fields.keys()
    for method in METHODS.values():
        assert {*method.idle_keys} <= {*method.keys, "position"}


# Where a key appears


def test_every_key_is_found_by_its_name_its_section_and_its_methods():
    for (section, name), key in KEYS.items():
        for asked in (None, name, section, section.partition(".")[0], f"{section}.{name}"):
            assert key in find_keys(asked)
        for method in METHODS:
            if section in METHODS[method].sections:
                assert (key in find_keys(method)) == (method in key.methods)


def test_page_of_keys_and_schema_for_editors_have_every_key():
    assert (ROOT / "docs" / "keys.md").read_text(encoding="utf-8") == keys_page()
    stored = (ROOT / "configs" / "schema.json").read_text(encoding="utf-8")
    assert json.loads(stored) == study_schema()
    for section, name in KEYS:
        assert f"`{name}`" in keys_page() and f'"{section}.{name}"' in stored


def test_schema_accepts_shipped_studies_and_rejects_mistakes():
    known = jsonschema.Draft7Validator(study_schema())
    for path in (*files.shipped_studies().values(), *files.template_files().values()):
        assert not list(known.iter_errors(tomllib.loads(path.read_text("utf-8")))), path.name
    for wrong in ({"alignment": {"phi": 1}}, {"filtr": {}}, {"axes": {"phi_u0_deg": ["x"]}}):
        assert not known.is_valid(wrong)


def test_methods_that_read_a_key_are_those_on_which_it_acts():
    def readers(name: str) -> tuple[Key, set[str]]:
        (told,) = find_keys(name)
        return told, {*told.methods}

    heading, methods = readers("phi_u0_deg")
    silent = {name for name, method in METHODS.items() if "phi_u0_deg" in method.idle_keys}
    assert methods == METHODS.keys() - silent and {"inertial", "level"} <= silent
    assert heading.readers_text == f"all but {', '.join(m for m in METHODS if m in silent)}"
    assert readers("level_sigma_per_s")[0].readers_text == "compass"
    assert readers("latitude_deg")[0].readers_text == "all"
    assert deciding_keys("level_damping") == ("method", "level_gains")


def test_every_key_but_those_that_compute_nothing_is_part_of_the_fingerprint():
    study = small_study()
    for section, name in LEAVES:
        given = getattr(study, section) or SECTIONS[section].model_construct()
        changed = study.model_copy(update={section: given.model_copy(update={name: __file__})})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that is a value of hardly any key
            differs = fingerprint(changed) != fingerprint(study)
        computes_nothing = section == "tune" or (section, name) in (
            ("study", "name"),
            ("study", "unchecked"),
        )
        assert differs != computes_nothing, f"[{section}] {name}"


# What a key refuses


def places_refused(tables: dict[str, Any], value: Any) -> set[str]:
    """Return the places that a study is refused for, each with the value or what it must be."""
    with pytest.raises(InputError) as caught:
        study_from_dict(tables, "s.toml")
    places = set()
    for line in caught.value.lines:
        name, place, told = line.split(": ", 2)
        assert name == "s.toml" and "\n" not in line
        if told.startswith("must be "):
            assert str(value) in told or "finite" in told
            places.add(place)
    return places


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, True, "1"], ids=repr)
def test_every_number_refuses_what_is_no_finite_number(value):
    """In its section, as an axis, in a zip, and in cases."""
    numbers = [place for place in LEAVES if takes_one_number(*place)]
    assert len(numbers) > 100
    tables: dict[str, dict[str, Any]] = {}
    for section, name in numbers:
        tables.setdefault(section, {})[name] = value
    recorded = {"study": {"duration_s": 9.0}, "record": tables.pop("record")}
    for some in (tables, recorded):
        some.setdefault("study", {})
        expected = {
            f"[{s}] {name}" for s, keys in some.items() for name in keys if keys[name] is value
        }
        assert expected <= places_refused(some, value)
    swept = [name for section, name in numbers if section in SWEEPABLE]
    lists = {name: [value] for name in swept}
    base = {"study": {"duration_s": 9.0, "rate_hz": 1.0}}
    for place, axes in (("axes", lists), ("axes.some", {"some": lists})):
        expected = {f"[{place}] {name}[0]" for name in swept}
        assert expected <= places_refused(base | {"axes": axes}, value)
    expected = {f"[cases] {name}[0]" for name in swept}
    assert expected <= places_refused(base | {"cases": [dict.fromkeys(swept, value)]}, value)


def test_every_word_refuses_other_words_and_names_its_own():
    words = {
        place: accepted_words(field_of(*place).annotation)
        for place in LEAVES
        if "tuple" not in str(field_of(*place).annotation)
    }
    for (section, name), accepted in words.items():
        if accepted:
            with pytest.raises(InputError) as caught:
                study_from_dict({section: {name: "zzz"}}, "s.toml")
            (line,) = (one for one in caught.value.lines if f"[{section}] {name}:" in one)
            told = (f"'{word}'" for word in accepted)
            assert_named(line, f"s.toml: [{section}] {name}", "'zzz'", *told)
