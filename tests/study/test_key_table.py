"""The table of keys and the schema for editors agree with the sections."""

import json
import tomllib
from pathlib import Path

import jsonschema
import pytest

from sinsjax.methods.registry import METHODS
from sinsjax.study import files, json_schema, key_table, keys

ROOT = Path(__file__).parents[2]
WITHOUT_START = [name for name, method in METHODS.items() if "phi_u0_deg" in method.without_effect]


def test_keys_page_is_up_to_date():
    assert (ROOT / "docs" / "keys.md").read_text(encoding="utf-8") == key_table.keys_page()


def test_json_schema_is_up_to_date():
    stored = (ROOT / "configs" / "schema.json").read_text(encoding="utf-8")
    assert json.loads(stored) == json_schema.study_schema()


@pytest.mark.parametrize(
    ("key", "unit", "default", "read_by"),
    [
        ("phi_u0_deg", "deg", "0", f"all but {', '.join(WITHOUT_START)}"),
        ("gravity_m_per_s2", "m/s^2", "9.8", "all"),
        ("feedback_interval_s", "s", "one sample", None),
        ("window_s", "s", "the last third of the duration", "all"),
        ("duration_s", "s", "required", "all"),
        ("level_sigma_per_s", "1/s", None, "compass"),
    ],
)
def test_key_table_shows_unit_default_and_methods(key, unit, default, read_by):
    (told,) = key_table.find_keys(key)
    assert told.unit == unit
    assert default is None or told.default == default
    assert read_by is None or told.readers_text == read_by


def test_section_has_the_keys_of_its_tables():
    names = [key.name for key in key_table.find_keys("drawn")]
    assert names == ["sampling", "uniform", "normal", "values", "grid"]


def test_about_method_separates_read_keys_from_ignored_keys():
    _, _, reads, silent = key_table.describe_method("inertial")
    assert reads.endswith("keys of [alignment] and [passes]: nothing")
    assert silent.startswith("    keys without effect: phi_e0_deg, phi_n0_deg, phi_u0_deg, ")
    _, _, reads = key_table.describe_method("compass")
    assert "[passes]: phi_e0_deg, " in reads


def test_key_meaning_names_all_accepted_words():
    for key in key_table.find_keys():
        words = keys.accepted_words(keys.TABLES[key.section].model_fields[key.name].annotation)
        assert all(f"'{word}'" in key.meaning or f'"{word}"' in key.meaning for word in words)


def test_key_meaning_does_not_repeat_the_unit():
    (key,) = key_table.find_keys("duration_s")
    assert key.meaning.startswith("length of each run. ")


def test_every_key_has_a_meaning():
    assert all(key.meaning for key in key_table.find_keys())


def test_schema_accepts_shipped_studies_and_rejects_mistakes():
    known = jsonschema.Draft7Validator(json_schema.study_schema())
    for path in (*files.shipped_studies().values(), *files.template_files().values()):
        assert not list(known.iter_errors(tomllib.loads(path.read_text("utf-8")))), path.name
    for wrong in ({"alignment": {"phi": 1}}, {"filtr": {}}, {"axes": {"phi_u0_deg": ["x"]}}):
        assert not known.is_valid(wrong)
