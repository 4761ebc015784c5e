"""Keys that have no effect are listed, also after a change of the method."""

import re
import tomllib
import warnings
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from support import plain_studies
from support.refusals import assert_named
from support.studies import BASE, small_study, small_tables

from sinsjax import InputError, StudyWarning, load_study
from sinsjax.errors import StudyInterrupted
from sinsjax.execution.run import run
from sinsjax.methods.filters.keys import any_trigger
from sinsjax.methods.method import INITIAL_KEYS
from sinsjax.methods.registry import METHODS, unread_keys
from sinsjax.study import files
from sinsjax.study.keys import SECTION_OF, SECTIONS, accepted_words
from sinsjax.study.load import load_with_notes, study_from_dict, study_to_tables
from sinsjax.study.reset_schedules import LAW_METHODS
from sinsjax.study.study import Study
from sinsjax.study.unused_keys import list_idle_keys
from sinsjax.study.variants import Variants

SHIPPED = {**files.shipped_studies(), **files.template_files()}
FULL = {
    **BASE,
    "alignment": {"method": "kalman5", "phi_e0_deg": 5.0, "specific_force": "measured"},
    "filter": {"p0_yaw_deg": 60.0},
    "resets": {"reset_kind": "yaw"},
    "axes": {"reset_times_s": [[2.0], [3.0]], "phi_u0_deg": [10.0, 30.0]},
}
"""A study with a section, an axis and keys that not every method reads."""

COMPASS = {"method": "compass"}


def change_study(
    changes: dict[str, Any], tables: dict[str, Any], tmp_path: Path
) -> tuple[Study, list[str]]:
    """Return a study file after some changes, and the lines about it."""
    path = tmp_path / "study.toml"
    path.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return load_with_notes(path, changes)


def refusal_of_change(changes: dict[str, Any], tables: dict[str, Any], tmp_path: Path) -> str:
    """Return the error line of changes of a study file."""
    with pytest.raises(InputError) as caught:
        change_study(changes, tables, tmp_path)
    return str(caught.value).removeprefix(f"{tmp_path / 'study.toml'}: ")


def places(note: str) -> list[str]:
    """Return the sections and keys that a note lists, of several keys of a section the first."""
    return re.findall(r"\[[\w.]+\](?: [a-z0-9]+_\w+)?", note)


def expected_refusal(study: Study, method: str) -> str | None:
    """Return the reason why a shipped study cannot use another method; None if it can."""
    new = METHODS[method]
    if any(map(repeats_without_method, study.dimensions)):
        return "repeats"
    tuned = study.tune.variables if study.tune else {}
    if unread_keys([method]) & tuned.keys():
        return "does not apply to method"
    if study.is_recorded and "filter" in new.sections and not study.has("filter"):
        return "a record does not give the noise of its"  # nor does the study
    if study.is_recorded and "gravity_fit" in new.sections and not study.has("gravity_fit"):
        return "required with a record"  # for the same reason
    if study.has("resets") and "resets" in new.sections and method not in LAW_METHODS:
        if "law" in study.values("schedule"):
            return "'law' holds for"
    if {*INITIAL_KEYS} <= {*new.idle_keys}:  # it needs no start
        if study.passes:
            return "reads a record once"  # without passes it would read more data than the others
        if study.coarse_stages:
            return "needs no coarse alignment"
    if method == "kalman_surge" and study.has("resets") and any_trigger(Variants.all_of(study)):
        return "does not apply to method kalman_surge"
    return None


def repeats_without_method(dimension: dict[str, Any]) -> bool:
    """Return whether cases or zips differ in their method alone."""
    others = [values for key, values in dimension.items() if key not in ("case", "method")]
    rows = [*zip(*others, strict=True)]
    labels_alone = "case" in dimension and not others
    return "method" in dimension and (labels_alone or len({*rows}) < len(rows))


@pytest.mark.nightly(fast=("reset_sweep", "paper2_static", "tune_large", "car_test"))
@pytest.mark.parametrize("name", SHIPPED)
def test_method_of_shipped_study_can_be_changed(name):
    path = SHIPPED[name]
    study = load_study(path)
    for method in METHODS:
        reason = expected_refusal(study, method)
        if reason is None:
            made, _ = load_with_notes(path, {"alignment.method": method})
            assert made.methods == (method,)
            continue
        with pytest.raises(InputError, match=reason):
            load_with_notes(path, {"alignment.method": method})


def test_line_lists_keys_that_no_method_reads(tmp_path):
    study, notes = change_study({"alignment.method": "inertial"}, FULL, tmp_path)
    assert study.filter and study.resets and study.n_variants == 4
    (note,) = notes
    assert note.endswith("have no effect with method inertial.")
    assert places(note) == [
        *["[alignment] phi_e0_deg", "[filter] p0_yaw_deg", "[resets] reset_kind"],
        "[axes] reset_times_s",
    ]
    assert "phi_u0_deg" in note
    study, notes = change_study({"axes.method": ["inertial", "kalman5"]}, FULL, tmp_path)
    assert study.n_variants == 8 and not notes
    study, notes = change_study({"axes.method": ["inertial", "compass"]}, FULL, tmp_path)
    assert study.n_variants == 8 and "with method compass or inertial" in notes[0]


@pytest.mark.parametrize(
    ("tables", "place"),
    [
        ({"compass": {"level_time_s": 1}}, "[compass] level_time_s"),
        ({"axes": {"sigma_factors": [[2.0]]}}, "[axes] sigma_factors"),
        ({"passes": {"stored_s": 80, "turn": "keep"}}, "[passes] turn"),
        ({"alignment": COMPASS, "filter": {"p0_yaw_deg": 1}}, "[filter] p0_yaw_deg"),
        ({"alignment": COMPASS | {"feedback_interval_s": 2}}, "[alignment] feedback_interval_s"),
        ({"alignment": COMPASS, "axes": {"trigger_threshold": [1]}}, "[axes] trigger_threshold"),
        ({"alignment": COMPASS, "cases": [{"turn_inflation": 3.0}]}, "[cases] turn_inflation"),
        ({"alignment": COMPASS, "axes": {"a": {"p0_yaw_deg": [3]}}}, "[axes.a] p0_yaw_deg"),
    ],
)
def test_key_that_no_method_reads_is_listed_with_its_table(tables, place):
    study = plain_studies.build_study(**tables)
    assert study_from_dict(study_to_tables(study)) == study
    method = study.methods[0]
    assert list_idle_keys(study) == [f"{place} has no effect with method {method}."]


def test_keys_of_changed_method_remain_for_the_next_change(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        study = study_from_dict(FULL)
        other = study.replace({"alignment.method": "compass"})
        assert other.replace({"alignment.method": "kalman5"}) == study
        path = tmp_path / "study.toml"
        path.write_text(tomli_w.dumps(FULL), encoding="utf-8")
        assert load_study(path, {"alignment.method": "compass"}).filter == study.filter


def test_tuned_key_that_no_method_reads_is_refused(tmp_path):
    template = tomllib.loads(files.shipped_text("tune"))
    to_compass = {"alignment.method": "compass"}
    line = refusal_of_change(to_compass, template, tmp_path)
    assert_named(line, "[tune.variables] p0_yaw_deg", "compass")
    assert change_study(to_compass | {"tune": {}}, template, tmp_path)[0].tune is None
    study, notes = change_study({"alignment.method": "kalman_sincos"}, template, tmp_path)
    assert study.tune and list(study.tune.variables) == ["reset_times_s", "p0_yaw_deg"]
    assert any("[tune.variables] p0_yaw_deg" in places(note) for note in notes)


# Keys without effect


@pytest.mark.parametrize("method", METHODS)
def test_line_names_every_given_key_that_is_silent(method, tmp_path):
    tables: dict[str, Any] = {**BASE, "alignment": {"method": method, "phi_u0_deg": 20.0}}
    silent = {*METHODS[method].idle_keys}
    for key in silent:
        words = accepted_words(SECTIONS[SECTION_OF[key]].model_fields[key].annotation)
        tables.setdefault(SECTION_OF[key], {})[key] = words[-1] if words else 20.0
    if "resets" in METHODS[method].sections:
        tables.setdefault("resets", {})["reset_times_s"] = [2.0]
    _, notes = change_study({}, tables, tmp_path)
    assert len(notes) == bool(silent)
    for line in notes:
        assert {*re.findall(r"\w+", line)} & SECTION_OF.keys() - {"method"} == silent


def test_line_names_keys_whose_condition_does_not_hold(tmp_path):
    tables = small_tables(
        motion={"pitch_amplitude_deg": None, "surge_time_s": 3.0},
        resets={"reset_kind": "scale", "reset_yaw_deg": 10.0, "reset_times_s": [2.0]},
        coarse={"coarse_duration_s": 2.0, "coarse_then": "replay"},
    )
    _, notes = change_study({}, tables, tmp_path)
    (note,) = notes
    reasons = {places(reason)[0]: reason for reason in note.split("; ")}
    assert "pitch_amplitude_deg = 0" in reasons["[motion] pitch_period_s"]
    assert "surge_m_per_s = 0" in reasons["[motion] surge_time_s"]
    assert "phi_n0_deg, phi_u0_deg" in reasons["[alignment] phi_e0_deg"]
    assert "reset_kind = scale" in reasons["[resets] reset_yaw_deg"] and len(reasons) == 4
    tables["axes"] = {"pitch_amplitude_deg": [0.0, 1.0], "reset_kind": ["scale", "yaw"]}
    tables["axes"] |= {"coarse_method": ["none", "inertial"], "surge_m_per_s": [0.0, 0.1]}
    assert change_study({}, tables, tmp_path)[1] == []


def test_key_acts_if_its_condition_is_tuned(tmp_path):
    template = tomllib.loads(files.shipped_text("tune"))
    template["resets"] = {"reset_kind": "yaw"}
    assert change_study({}, template, tmp_path)[1] == []


def test_keys_at_their_defaults_are_not_listed():
    study = small_study()
    assert list_idle_keys(study) == []
    study = small_study(resets={"reset_yaw_deg": 5.0}, alignment={"method": "kalman_sincos"})
    (note,) = list_idle_keys(study)
    assert places(note) == ["[resets] reset_yaw_deg"] and "kalman_sincos" in note


def test_functions_of_python_warn_of_keys_without_effect(monkeypatch):
    def stopped(*_: Any) -> None:
        raise StudyInterrupted("before the first run")

    monkeypatch.setattr("sinsjax.execution.run._run_to_results", stopped)
    study = small_study(alignment={"method": "inertial"})
    with pytest.warns(StudyWarning, match="phi_u0_deg .*inertial"), pytest.raises(StudyInterrupted):
        run(study)
