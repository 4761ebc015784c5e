"""Another method for a study: unread keys are dropped, idle keys are listed."""

import re
import tomllib
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from support.refusals import assert_named
from support.studies import BASE, small_study, small_tables

from sinsjax import InputError, StudyWarning, load_study
from sinsjax.errors import StudyInterrupted
from sinsjax.execution.prepare import prepare_job
from sinsjax.execution.run import run
from sinsjax.methods.registry import METHODS
from sinsjax.study import files
from sinsjax.study.keys import SECTION_OF, SECTIONS, accepted_words
from sinsjax.study.load import load_with_notes, study_to_tables
from sinsjax.study.reset_schedules import LAW_METHODS
from sinsjax.study.study import Study
from sinsjax.study.unused_keys import drop_unread_keys, list_idle_keys

SHIPPED = {**files.shipped_studies(), **files.template_files()}
FULL = {
    **BASE,
    "alignment": {"method": "kalman5", "phi_e0_deg": 5.0, "specific_force": "measured"},
    "filter": {"p0_yaw_deg": 60.0},
    "resets": {"reset_kind": "yaw"},
    "axes": {"reset_times_s": [[2.0], [3.0]], "phi_u0_deg": [10.0, 30.0]},
}
"""A study with a section, an axis and keys that not every method reads."""


def change_study(
    changes: dict[str, Any], tables: dict[str, Any], tmp_path: Path
) -> tuple[Study, list[str]]:
    """A study file after some changes, and the lines about it."""
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
    if study.tune and new.keys.isdisjoint(study.tune.variables):
        return "reads none of"  # nothing is left to tune
    if study.is_recorded and "filter" in new.sections and not study.has("filter"):
        return "a record does not give the noise of its"  # nor does the study
    if study.is_recorded and "gravity_fit" in new.sections and not study.has("gravity_fit"):
        return "required with a record"  # for the same reason
    if study.has("resets") and "resets" in new.sections and method not in LAW_METHODS:
        if "law" in study.values("schedule"):
            return "'law' holds for"
    if "coarse_method" in new.refuses and study.passes:
        return "reads a record once"  # without passes it would read more data than the others
    return None


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


@pytest.mark.nightly
@pytest.mark.optimised(False)
@pytest.mark.parametrize("method", METHODS)
def test_reset_sweep_runs_with_any_method(method):
    job = prepare_job("reset_sweep", {"alignment.method": method, "study.draws": 2})
    few = {"phi_u0_deg": [0, 30]}
    if "reset_count" in job.study.axes:
        few |= {"reset_count": [0, 2], "reset_cycle_s": [10, 20]}
    short = {"study.duration_s": 150.0, "study.window_s": [100, 150]}
    study = job.study.replace(short | {f"axes.{key}": values for key, values in few.items()})
    summary = run(study).summary
    assert summary.num_rows == 2 * study.n_variants
    error = "phi_u_arcmin" if METHODS[method].finds_heading else "phi_e_arcmin"
    assert np.isfinite(summary[error].to_numpy()).all()


def test_line_lists_dropped_sections_keys_and_axes(tmp_path):
    study, notes = change_study({"alignment.method": "inertial"}, FULL, tmp_path)
    assert (study.filter, study.resets, list(study.axes)) == (None, None, ["phi_u0_deg"])
    dropped, silent = map(places, notes)
    assert dropped == ["[alignment] specific_force", "[filter]", "[resets]", "[axes] reset_times_s"]
    assert silent == ["[alignment] phi_e0_deg", "[axes] phi_u0_deg"]


def test_replace_and_load_study_warn_of_dropped_keys(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(tomli_w.dumps(FULL), encoding="utf-8")
    with pytest.warns(StudyWarning, match=r"\[filter\], \[resets\], \[axes\] ") as by:
        load_study(path).replace({"alignment.method": "compass"})
    assert len(by) == 1
    with pytest.warns(StudyWarning, match=r"compass .*\[filter\], \[resets\]") as by:
        study = load_study(path, {"alignment.method": "compass"})
    assert len(by) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        study.replace({"alignment.method": "compass", "alignment.phi_e0_deg": 1.0})
        study.replace({"alignment.method": "kalman5"})  # which reads whatever compass does not


def test_key_given_for_method_that_does_not_read_it_is_refused(tmp_path):
    to_inertial = {"alignment.method": "inertial"}
    line = refusal_of_change(to_inertial | {"filter.p0_yaw_deg": 9.0}, FULL, tmp_path)
    assert_named(line, "[filter] p0_yaw_deg", "inertial")
    line = refusal_of_change(to_inertial | {"axes.reset_count": [0, 1]}, FULL, tmp_path)
    assert_named(line, "[axes] reset_count", "inertial")


def test_unread_keys_of_unchanged_method_are_refused(tmp_path):
    tables = FULL | {"compass": {"level_time_s": 9.0}}
    for changes in ({}, {"study.draws": 4}, {"alignment.method": "kalman5"}):
        line = refusal_of_change(changes, tables, tmp_path)
        assert_named(line, "[compass] level_time_s", "kalman5")


def test_misspelt_method_drops_nothing(tmp_path):
    line = refusal_of_change({"alignment.method": "inertail"}, FULL, tmp_path)
    assert_named(line, "[alignment] method", "'inertail'", "inertial")


def test_axis_of_methods_drops_keys_that_none_reads(tmp_path):
    study, notes = change_study({"axes.method": ["inertial", "compass"]}, FULL, tmp_path)
    assert study.filter is None and list(study.axes) == ["phi_u0_deg", "method"]
    (note,) = notes
    assert places(note) == [
        *["[alignment] specific_force", "[filter]", "[resets]"],
        "[axes] reset_times_s",
    ]
    study, notes = change_study({"axes.method": ["inertial", "kalman5"]}, FULL, tmp_path)
    assert study.filter and study.n_variants == 8 and not notes
    zipped = {"axes.both.method": ["inertial", "compass"], "axes.both.phi_u0_deg": [1.0, 2.0]}
    assert change_study(zipped, FULL, tmp_path)[0].filter is None
    _, notes = change_study(
        {"axes": {}, "filter": {}, "alignment.method": "compass"}, FULL, tmp_path
    )
    assert [places(note) for note in notes] == [["[alignment] specific_force", "[resets]"]]


def test_cases_and_zips_that_become_equal_are_left_out(tmp_path):
    cases = [
        {"case": "a", "method": "kalman5", "p0_yaw_deg": 10.0, "ve0_m_per_s": 0.0},
        {"case": "b", "method": "kalman10", "p0_yaw_deg": 10.0, "ve0_m_per_s": 0.0},
        {"case": "c", "method": "compass", "p0_yaw_deg": 20.0, "ve0_m_per_s": 1.0},
    ]
    zips = {"policy": {"q_scale": [1.0, 2.0, 3.0], "phi_u0_deg": [5.0, 5.0, 7.0]}}
    tables = {**BASE, "cases": cases, "axes": zips}
    study, notes = change_study({"alignment.method": "compass"}, tables, tmp_path)
    assert study.cases == (
        {"case": "a", "ve0_m_per_s": 0.0},
        {"case": "c", "ve0_m_per_s": 1.0},
    )
    assert study.zips == {"policy": {"phi_u0_deg": (5.0, 7.0)}}
    (note,) = notes
    dropped, left_out = note.split(";")
    assert places(dropped) == ["[axes.policy] q_scale", "[cases] p0_yaw_deg"]
    assert "1 of 3 [cases]" in left_out and places(left_out) == ["[cases]", "[axes.policy]"]
    study, notes = change_study({"alignment.method": "kalman5"}, tables, tmp_path)
    assert study.n_variants == 6
    assert len(notes) == 1 and "1 of 3 [cases]" in notes[0]
    bare = [{key: case[key] for key in ("case", "method", "p0_yaw_deg")} for case in cases]
    study, notes = change_study(
        {"alignment.method": "compass"}, {**BASE, "cases": bare, "axes": zips}, tmp_path
    )
    assert not study.cases and "[cases];" in notes[0]


def test_empty_zip_and_draws_are_dropped():
    before = small_tables(
        axes={"policy": {"q_scale": [1.0, 2.0]}}, drawn={"p0_yaw_deg": {"uniform": [1.0, 2.0]}}
    )
    after = before | {"alignment": before["alignment"] | {"method": "compass"}}
    out, notes = drop_unread_keys(before, after, {"alignment.method": "compass"}, "study")
    assert out == small_tables(alignment={"method": "compass"})
    (note,) = notes
    dropped = ["[alignment] feedback_interval_s", "[filter]", "[axes.policy]", "[drawn]"]
    assert places(note) == dropped
    assert "policy" in after["axes"]


def test_tuned_keys_are_dropped_while_one_is_left(tmp_path):
    template = tomllib.loads(files.shipped_text("tune"))
    variables, ranges = template["tune"]["variables"], {"low": 0.1, "high": 9.0}
    to_compass = {"alignment.method": "compass"}
    line = refusal_of_change(to_compass, template, tmp_path)
    assert_named(line, "[tune.variables]", "compass", "reset_times_s", "p0_yaw_deg")
    assert change_study(to_compass | {"tune": {}}, template, tmp_path)[0].tune is None
    variables["ve0_m_per_s"] = ranges
    study, notes = change_study(to_compass, template, tmp_path)
    assert study.tune and list(study.tune.variables) == ["ve0_m_per_s"]
    assert not study.tune.baseline
    assert "[tune.variables] reset_times_s, p0_yaw_deg, [tune.baseline]" in notes[0]
    del variables["ve0_m_per_s"]
    study, notes = change_study({"alignment.method": "kalman_sincos"}, template, tmp_path)
    assert study.tune and list(study.tune.variables) == ["reset_times_s", "p0_yaw_deg"]
    assert any("[tune.variables] p0_yaw_deg" in places(note) for note in notes)


def test_keys_that_method_refuses_are_dropped(tmp_path):
    trigger = {"reset_trigger": "nis", "trigger_threshold": 9.0}
    tables = FULL | {"resets": trigger, "coarse": {"coarse_duration_s": 1.0}}
    study, notes = change_study({"alignment.method": "kalman_surge"}, tables, tmp_path)
    assert study.resets and study.resets.reset_trigger is None and study.coarse
    assert "[resets]" in notes[0]
    study, notes = change_study({"alignment.method": "optimisation"}, tables, tmp_path)
    assert study.coarse is None and "[coarse]" in notes[0]
    recorded = load_study(SHIPPED["car_test"])
    with pytest.warns(StudyWarning, match="Dropped"):
        assert recorded.replace({"alignment.method": "inertial"}).coarse


def test_judging_from_floor_is_dropped_for_method_without_floor(tmp_path):
    limited = FULL | {"study": FULL["study"] | {"judged_from": "floor"}}
    to_ten = {"alignment.method": "kalman10"}
    study, notes = change_study(to_ten, limited, tmp_path)
    assert study.study.judged_from is None
    assert [places(note) for note in notes] == [["[study] judged_from"]]
    study, notes = change_study(to_ten | {"study.judged_from": "floor"}, limited, tmp_path)
    assert study.study.judged_from == "floor" and not notes
    still = {f"{angle}_amplitude_deg": 0.0 for angle in ("pitch", "roll", "yaw")}
    parked = limited | {"motion": limited["motion"] | still}
    assert change_study(to_ten, parked, tmp_path)[0].study.judged_from == "floor"
    rocked = parked | {"axes": {"pitch_amplitude_deg": [0.0, 1.0]}}
    assert change_study(to_ten, rocked, tmp_path)[0].study.judged_from is None


# Keys without effect


@pytest.mark.parametrize("method", METHODS)
def test_line_names_every_given_key_that_is_silent(method, tmp_path):
    tables: dict[str, Any] = {**BASE, "alignment": {"method": method, "phi_u0_deg": 20.0}}
    silent = {*METHODS[method].without_effect}
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


def test_keys_of_resolved_study_are_named_only_with_other_values():
    study = small_study()
    assert list_idle_keys(study, study_to_tables(study)) == []
    study = small_study(resets={"reset_yaw_deg": 5.0}, alignment={"method": "kalman_sincos"})
    (note,) = list_idle_keys(study, study_to_tables(study))
    assert places(note) == ["[resets] reset_yaw_deg"] and "kalman_sincos" in note


def test_functions_of_python_warn_of_keys_without_effect(monkeypatch):
    def stopped(*_: Any) -> None:
        raise StudyInterrupted("before the first run")

    monkeypatch.setattr("sinsjax.execution.run._run_to_results", stopped)
    study = small_study(alignment={"method": "inertial"})
    with pytest.warns(StudyWarning, match="phi_u0_deg .*inertial"), pytest.raises(StudyInterrupted):
        run(study)
