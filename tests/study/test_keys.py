"""Keys: what each must satisfy, which methods read it, and how keys without effect are told.

What holds for every key is read from the schema for editors: a new key adds nothing here.
"""

import json
import math
import re
import tomllib
import warnings
from pathlib import Path
from typing import Any

import jax
import jsonschema
import numpy as np
import pytest
import tomli_w
from support.batches import run_chunks
from support.refusals import assert_named
from support.studies import BASE, small_study, small_tables

from docs.studies import keys_page
from sinsjax import InputError, load_study, study_from_dict
from sinsjax.engine.scenario import Scenario
from sinsjax.methods.registry import METHODS
from sinsjax.study import files
from sinsjax.study.load import fingerprint
from sinsjax.study.rules import describe_idle_keys
from sinsjax.study.study import Study
from sinsjax.units import split_unit

ROOT = Path(__file__).parents[2]
SCHEMA = json.loads((ROOT / "configs" / "schema.json").read_text(encoding="utf-8"))
DEFINED: dict[str, dict[str, Any]] = SCHEMA["definitions"]
SECTIONS = {
    section: [*table["properties"]]
    for section, table in SCHEMA["properties"].items()
    if section not in ("tune", "axes", "cases", "drawn", "advise")
}
KEYS = [(section, key) for section, keys in SECTIONS.items() for key in keys]
SECTION_OF = {key: section for section, key in KEYS if section != "record"}
SWEPT = [key for key in SCHEMA["properties"]["axes"]["properties"] if key in SECTION_OF]


def forms(section: str, key: str) -> list[dict[str, Any]]:
    """Return what a value of a key may be."""
    told = DEFINED[f"{section}.{key}"]
    return told.get("oneOf") or told.get("anyOf") or [told]


def words_of(section: str, key: str) -> list[str]:
    return [word for form in forms(section, key) for word in form.get("enum", ())]


def test_page_of_keys_and_schema_for_editors_have_every_key():
    page = (ROOT / "docs" / "keys.md").read_text(encoding="utf-8")
    assert page == keys_page.keys_page() and keys_page.study_schema() == SCHEMA
    assert all(f"`{key}`" in page for _, key in KEYS)
    assert len(SECTION_OF) == sum(section != "record" for section, _ in KEYS)  # else no axis


def test_schema_accepts_shipped_studies_and_rejects_mistakes():
    known = jsonschema.Draft7Validator(SCHEMA)
    for path in (*files.shipped_studies().values(), *files.template_files().values()):
        assert not list(known.iter_errors(tomllib.loads(path.read_text("utf-8")))), path.name
    for wrong in ({"alignment": {"phi": 1}}, {"filtr": {}}, {"axes": {"phi_u0_deg": ["x"]}}):
        assert not known.is_valid(wrong)


def lines_by_place(tables: dict[str, Any]) -> dict[str, str]:
    with pytest.raises(InputError) as caught:
        study_from_dict(tables, "s.toml")
    assert all(line.startswith("s.toml: ") for line in caught.value.lines)
    return {line.split(": ")[1]: line.split(": ", 2)[2] for line in caught.value.lines}


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, True, "1"], ids=repr)
def test_every_number_refuses_what_is_no_finite_number(value):
    """In its section, as an axis, in a zip, and in cases."""
    numbers = [
        place
        for place in KEYS
        if any(f.get("type") in ("number", "integer") for f in forms(*place))
    ]
    assert len(numbers) > 90
    tables: dict[str, dict[str, Any]] = {}
    for section, key in numbers:
        tables.setdefault(section, {})[key] = value
    recorded = {"study": {"duration_s": 9.0}, "record": tables.pop("record")}
    swept = [key for _, key in numbers if key in SWEPT]
    lists = {key: [value] for key in swept}
    base = {"study": {"duration_s": 9.0, "rate_hz": 1.0}}
    for some, expected in (
        (tables, {f"[{section}] {key}" for section, key in numbers if section != "record"}),
        (recorded, {f"[record] {key}" for key in recorded["record"]}),
        (base | {"axes": lists}, {f"[axes] {key}[0]" for key in swept}),
        (base | {"axes": {"some": lists}}, {f"[axes.some] {key}[0]" for key in swept}),
        (base | {"cases": [dict.fromkeys(swept, value)]}, {f"[cases] {key}[0]" for key in swept}),
    ):
        told = lines_by_place(some)
        assert expected <= told.keys()
        assert all(str(value) in told[place] or "finite" in told[place] for place in expected)


def test_every_word_refuses_other_words_and_names_its_own():
    for section, key in KEYS:
        if words_of(section, key):
            told = lines_by_place({section: {key: "zzz"}})[f"[{section}] {key}"]
            accepted = (f"'{word}'" for word in words_of(section, key))
            assert_named(f"x: {told}", "x", "'zzz'", *accepted)


def test_every_key_but_those_that_compute_nothing_is_part_of_the_fingerprint():
    study = small_study(compass={}, passes={"stored_s": 3.0}, coarse={"coarse_duration_s": 2.0})
    for section, key in KEYS:
        if (given := getattr(study, section)) is not None:
            changed = study.model_copy(update={section: given.model_copy(update={key: __file__})})
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that is a value of hardly any key
                differs = fingerprint(changed) != fingerprint(study)
            assert differs != (key in ("name", "unchecked")), f"[{section}] {key}"


def test_absurd_value_of_every_key_with_a_unit_is_refused():
    for section, key in KEYS:
        told = json.dumps(forms(section, key))
        bounds = [float(bound) for bound in re.findall(r'[mM]aximum": ([\d.]+)', told)]
        if not split_unit(key)[1] or (bounds and max(bounds) <= 360):
            continue  # such bounds are no wider than a turn
        tables: dict[str, Any] = {"study": {"duration_s": 9.0, "rate_hz": 100.0}}
        tables |= {"alignment": {"method": "inertial"}, "earth": {"latitude_deg": 1.0}}
        tables |= (
            {"record": {"format": "psins"}}
            if section == "record"
            else {"motion": {"yaw_center_deg": 1.0}}
        )
        value = [9e11] if told.startswith('[{"description"') and "items" in told else 9e11
        tables[section] = tables.get(section, {}) | {key: value}
        with pytest.raises(InputError, match=key):
            study_from_dict(tables)


# Keys without effect

RESET = "resets = {reset_count = 1, reset_cycle_s = 1.37%s} & axes."
INACTIVE = [
    "resets.reset_count = 0 & axes.reset_cycle_s = [1.0, 2.0]",
    "resets = {reset_count = 1, reset_first_s = 2.0} & axes.reset_cycle_s = [1.0, 2.0]",
    RESET % "" + "reset_scale = [2.0, 3.0]",
    RESET % ", reset_at_feedback = true" + "reset_restarts_feedback = [false, true]",
    "passes = {stored_s = 3.0} & alignment.method = 'compass' & axes.turn_inflation = [2.0, 3.0]",
    "motion.yaw_amplitude_deg = 0.0 & axes.yaw_period_s = [3.0, 4.0]",
    "alignment = {phi_e0_deg = 0, phi_n0_deg = 0, phi_u0_deg = 0}"
    " & axes.misalignment = ['vector', 'euler']",
]
ACTIVE = [
    "resets.reset_count = 1 & axes.reset_cycle_s = [1.0, 2.0]",
    RESET % ", reset_kind = 'scale'" + "reset_scale = [2.0, 3.0]",
    RESET % "" + "reset_restarts_feedback = [false, true]",
    "resets = {reset_trigger = 'linearisation', trigger_threshold = 0.0, reset_at_feedback = true,"
    " trigger_refractory_s = 2.37} & axes.reset_restarts_feedback = [false, true]",
    "passes.stored_s = 3.0 & alignment.method = 'compass' & axes.turn_smoothing_s = [1.0, 2.0]",
    "axes.yaw_period_s = [3.0, 4.0]",
    "axes.misalignment = ['vector', 'euler']",
]


def outcomes(study: Study) -> list[list[np.ndarray]]:
    """Return every number of the outcome of the first draw, for each variant."""
    found: dict[int, list[np.ndarray]] = {}
    scenario = Scenario(study, curves=True)
    for number, ids in enumerate(scenario.variant_ids):
        for chunk in run_chunks(scenario.batch(number, range(1))):
            leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(chunk.outcome)]
            for row, place in enumerate(chunk.variant):
                found[int(ids[place])] = [leaf[row] for leaf in leaves]
    return [found[variant] for variant in range(study.n_variants)]


def are_equal(one: list[np.ndarray], other: list[np.ndarray]) -> bool:
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))


@pytest.mark.optimised(False)
@pytest.mark.nightly(fast=(INACTIVE[0], INACTIVE[-1], ACTIVE[0], ACTIVE[-1]))
@pytest.mark.parametrize("text", [*INACTIVE, *ACTIVE], ids=str)
def test_key_changes_outcomes_unless_it_is_inactive(text):
    study = small_study(**tomllib.loads(text.replace(" & ", "\n")))
    assert (len({*study.duplicate_of}) == 1) == (text in INACTIVE)
    assert are_equal(*outcomes(study)) == (text in INACTIVE)


@pytest.mark.optimised(False)
@pytest.mark.nightly
@pytest.mark.parametrize("method", METHODS)
def test_idle_keys_of_a_method_are_those_that_change_no_bit_of_a_run(method):
    def two_values(key: str) -> list[Any]:
        return words_of(SECTION_OF[key], key)[:2] or [5.0, 20.0]

    idle_somewhere = {key for some in METHODS.values() for key in some.idle_keys}
    keys = sorted(idle_somewhere & {*METHODS[method].keys, "position"})
    tables: dict[str, Any] = {"alignment": {"method": method} | dict.fromkeys(BASE["alignment"])}
    if "resets" in METHODS[method].sections:
        tables["resets"] = {"reset_times_s": [2.37]}
    first = {key: two_values(key)[0] for key in keys}
    cases = [first, *(first | {key: two_values(key)[1]} for key in keys)]
    before, *after = outcomes(small_study(**tables, cases=cases))
    silent = {key for key, other in zip(keys, after, strict=True) if are_equal(before, other)}
    assert silent == {*METHODS[method].idle_keys}


@pytest.fixture
def load(tmp_path):
    """Return a function that changes a study file, and gives the study and the lines about it."""

    def changed(tables: dict[str, Any], changes: dict[str, Any] | None = None) -> Any:
        (tmp_path / "study.toml").write_text(tomli_w.dumps(tables), encoding="utf-8")
        study = load_study(tmp_path / "study.toml", changes)
        return study, describe_idle_keys(study)

    return changed


def places(note: str) -> list[str]:
    """Return the sections and keys that a note lists, of several keys of a section the first."""
    return re.findall(r"\[[\w.]+\](?: [a-z0-9]+_\w+)?", note)


def test_line_lists_keys_that_no_method_reads(load):
    tables = small_tables(
        filter={"p0_yaw_deg": 60.0},
        resets={"reset_kind": "yaw"},
        axes={"reset_times_s": [[2.0], [3.0]], "z": {"phi_n0_deg": [1.0, 3.0]}},
        alignment={"phi_n0_deg": None},
    )
    study, (note,) = load(tables, {"alignment.method": "inertial"})
    assert study.filter and study.resets and study.n_variants == 4
    assert note.endswith("have no effect with method inertial.") and "phi_u0_deg" in note
    expected = {"[resets] reset_kind", "[axes] reset_times_s", "[axes.z] phi_n0_deg"}
    assert expected <= {*places(note)}
    assert not load(tables, {"axes.method": ["inertial", "kalman5"]})[1]
    _, notes = load(tables, {"axes.method": ["inertial", "compass"]})
    assert "with method compass or inertial" in notes[0]
    # They remain for the next change.
    before = study_from_dict(tables)
    after = before.replace({"alignment.method": "compass"})
    assert after.replace({"alignment.method": "kalman5"}) == before


def test_line_names_keys_whose_condition_does_not_hold(load):
    tables = small_tables(
        motion={"pitch_amplitude_deg": None, "surge_time_s": 3.0},
        resets={"reset_kind": "scale", "reset_yaw_deg": 10.0, "reset_times_s": [2.0]},
        coarse={"coarse_duration_s": 2.0, "coarse_then": "replay"},
    )
    _, (note,) = load(tables)
    reasons = {places(reason)[0]: reason for reason in note.split("; ")}
    assert "pitch_amplitude_deg" in reasons["[motion] pitch_period_s"]
    assert "surge_m_per_s" in reasons["[motion] surge_time_s"]
    assert "phi_n0_deg, phi_u0_deg" in reasons["[alignment] phi_e0_deg"]
    assert "reset_kind" in reasons["[resets] reset_yaw_deg"] and len(reasons) == 4
    tables["axes"] = {"pitch_amplitude_deg": [0.0, 1.0], "reset_kind": ["scale", "yaw"]}
    tables["axes"] |= {"coarse_method": ["none", "inertial"], "surge_m_per_s": [0.0, 0.1]}
    assert load(tables)[1] == [] == load(small_tables())[1]


def test_tuned_key_that_no_method_reads_is_refused(load):
    template = tomllib.loads(files.shipped_text("tune", Path("tune.toml")))
    to_compass = {"alignment.method": "compass"}
    with pytest.raises(InputError, match=r"\[tune.variables\] p0_yaw_deg: .*compass"):
        load(template, to_compass)
    assert load(template, to_compass | {"tune": {}})[0].tune is None
    _, notes = load(template, {"alignment.method": "kalman_sincos"})
    assert any("[tune.variables] p0_yaw_deg" in places(note) for note in notes)
    # A key acts if its condition is tuned.
    assert load(template | {"resets": {"reset_kind": "yaw"}})[1] == []
