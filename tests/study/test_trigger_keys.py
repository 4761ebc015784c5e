"""Keys of triggers, reset values and scales: defaults, errors and fingerprints."""

import copy
import tomllib
from typing import Any

import pytest
from support.studies import with_paper_values

from sinsjax.errors import InputError
from sinsjax.methods.triggers.config import any_trigger
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import study_from_dict, study_to_toml
from sinsjax.study.study import Study

BASE: dict[str, Any] = {
    "study": {"duration_s": 900, "rate_hz": 100},
    "earth": {"latitude_deg": 32.0},
    "motion": {"yaw_center_deg": 0},
}
NIS = {"reset_trigger": "nis", "trigger_threshold": 9.0}
OF_TRIGGERS: dict[str, float] = {
    "trigger_threshold": 2.0,
    "trigger_window_s": 3.0,
    "trigger_refractory_s": 4.0,
    "trigger_most": 5,
    "trigger_until_s": 600.0,
}
NEW: dict[str, dict[str, Any]] = {
    "filter": {"q_scale": 2.0, "r_scale": 3.0},
    "resets": {
        "reset_velocity_m_per_s": 0.2,
        "reset_level_deg": 1.0,
        "reset_yaw_deg": 10.0,
        "reset_gyro_bias_deg_per_h": 0.05,
        "reset_accel_bias_ug": 50.0,
        "reset_trigger": "nis",
        **OF_TRIGGERS,
    },
}
"""Every key that came with triggers, and a value."""

OF_SUCCESS = (
    *("judged_from", "success_band_arcmin", "level_band_arcmin", "dwell_s", "diverged_deg"),
    *("report_times_s", "estimate_samples", "check_linearity"),
)
"""Keys of [study] that came later still."""

DISTURBANCES = {
    *("surge_m_per_s", "surge_time_s", "surge_bandwidth_hz", "surge_model", "lever_arm_m"),
    *("vibration_ug_rms", "vibration_deg_per_h_rms", "vibration_hz", "vibration_damping"),
    *("gyro_instability_deg_per_h", "gyro_instability_time_s", "gyro_rrw_deg_per_h_per_sqrt_h"),
    *("accel_instability_ug", "accel_instability_time_s", "accel_rrw_ug_per_sqrt_h"),
    *("gyro_quantisation_arcsec", "accel_quantisation_um_per_s"),
}
"""Keys of the base and of the sensors that came later still, each with a default."""

OF_FEEDBACK = {"reset_at_feedback", "reset_restarts_feedback"}
"""Keys of [resets] that came last, each with a default."""


def build_study(**tables: Any) -> Study:
    data = copy.deepcopy(BASE)
    for name, table in tables.items():
        data[name] = data.get(name, {}) | table if isinstance(table, dict) else table
    return study_from_dict(with_paper_values(data), "s.toml")


def refusal_line(**tables: Any) -> str:
    """Return the line of the error without the file's name, which must begin it."""
    with pytest.raises(InputError) as caught:
        build_study(**tables)
    line = str(caught.value)
    assert len(line.splitlines()) == 1 and line.startswith("s.toml: ")
    return line.removeprefix("s.toml: ")


# What is refused


@pytest.mark.parametrize(
    "tables",
    [
        {"resets": {"reset_trigger": "nis"}},
        {"resets": {"reset_trigger": "nis", "trigger_window_s": 3.0}},
        {"axes": {"reset_trigger": ["none", "nis"]}},
        {"cases": [{"reset_trigger": "none"}, {"reset_trigger": "nis"}]},
    ],
)
def test_reset_trigger_without_threshold_is_refused(tables: dict[str, Any]) -> None:
    line = "[resets] trigger_threshold: required with reset_trigger = 'nis'"
    assert refusal_line(**tables) == line


@pytest.mark.parametrize("key", OF_TRIGGERS)
@pytest.mark.parametrize("trigger", [{}, {"reset_trigger": "none"}])
def test_trigger_keys_without_reset_trigger_are_refused(key: str, trigger: dict[str, str]) -> None:
    value = OF_TRIGGERS[key]
    told = f"{key}: requires a reset_trigger (give one, or drop this)"
    assert refusal_line(resets=trigger | {key: value}) == f"[resets] {told}"
    assert refusal_line(resets=trigger, axes={key: [value, 2 * value]}) == f"[axes] {told}"
    assert build_study(resets=trigger) and build_study(resets=NIS | {key: value})


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("reset_trigger", "cusum"),
        ("trigger_threshold", -1.0),
        ("trigger_window_s", 0.0),
        ("trigger_refractory_s", -0.1),
        ("trigger_most", 0),
        ("trigger_most", 1.5),
        ("trigger_until_s", 0.0),
        *((key, 0.0) for key in NEW["resets"] if key.startswith("reset_") and "_trig" not in key),
    ],
)
def test_invalid_reset_values_are_refused(key: str, value: Any) -> None:
    assert refusal_line(resets=NIS | {key: value}).startswith(f"[resets] {key}: must be ")


@pytest.mark.parametrize("key", ["q_scale", "r_scale"])
def test_zero_q_and_r_scales_are_refused(key: str) -> None:
    assert refusal_line(filter={key: 0.0}).startswith(f"[filter] {key}: must be ")


@pytest.mark.parametrize("section", NEW)
def test_filter_and_reset_keys_are_refused_for_compass(section: str) -> None:
    for key, value in NEW[section].items():
        line = refusal_line(alignment={"method": "compass"}, **{section: {key: value}})
        assert line == f"[{section}] {key}: does not apply to method compass (drop it)"
    # Beside a filter they are the filter's.
    assert build_study(axes={"method": ["kalman5", "compass"]}, **NEW)


# What is filled in


def test_trigger_keys_have_defaults() -> None:
    resets = build_study(resets=NIS).resets
    assert resets is not None
    assert (resets.trigger_window_s, resets.trigger_refractory_s) == (10.0, 5.0)
    assert (resets.trigger_most, resets.trigger_until_s) == (10, None)
    for tables in ({}, {"resets": {"reset_trigger": "none"}}):
        alone = build_study(**tables).resets
        assert alone is not None
        assert {getattr(alone, key) for key in OF_TRIGGERS} == {None}


def test_given_reset_and_trigger_values_are_kept() -> None:
    resets = build_study(resets=NEW["resets"]).resets
    assert resets is not None
    assert {key: getattr(resets, key) for key in NEW["resets"]} == NEW["resets"]
    swept = build_study(resets=NIS, axes={"trigger_window_s": [1.0, 2.0]})
    assert swept.resets is not None
    assert (swept.resets.trigger_window_s, swept.resets.trigger_most) == (None, 10)


def test_reset_trigger_may_be_swept_together_with_none() -> None:
    for tables in (
        {"resets": {"trigger_threshold": 9.0}, "axes": {"reset_trigger": ["none", "nis"]}},
        {"axes": {"reset_trigger": ["none", "nis"], "trigger_threshold": [1.0, 9.0]}},
        {"axes": {"a": {"reset_trigger": ["none", "nis"], "trigger_threshold": [0.0, 9.0]}}},
    ):
        study = build_study(**tables)
        assert any_trigger(study) and set(study.values("reset_trigger")) == {"none", "nis"}
        assert study.values("trigger_most") == [10] * study.n_variants
    assert not any_trigger(build_study(axes={"reset_trigger": ["none"]}))
    assert not any_trigger(build_study()) and any_trigger(build_study(resets=NIS))


@pytest.mark.parametrize(
    "tables",
    [
        {},
        NEW,
        {"resets": NIS},
        {"resets": NIS | {"trigger_until_s": 50.0, "reset_count": 2, "reset_cycle_s": 3.0}},
        {"resets": {"trigger_threshold": 9.0}, "axes": {"reset_trigger": ["none", "nis"]}},
        {"axes": {"reset_yaw_deg": [10.0, 20.0], "q_scale": [1.0, 2.0]}},
        {"cases": [NIS, NIS | {"reset_trigger": "none"}]},
    ],
)
def test_resolved_study_loads_equal(tables: dict[str, Any]) -> None:
    study = build_study(**tables)
    text = study_to_toml(study)
    again = study_from_dict(tomllib.loads(text))
    assert again == study and study_to_toml(again) == text
    assert fingerprint(again) == fingerprint(study)


# Fingerprint


def test_each_trigger_reset_and_scale_key_changes_fingerprint() -> None:
    studies = [build_study(), build_study(resets=NIS)]
    for section, keys in NEW.items():
        for key, value in keys.items():
            other = {"reset_trigger": "innovation"} if key == "reset_trigger" else {key: value}
            base = NIS if "trigger" in key else {}
            studies.append(build_study(**{section: base | other}))
    assert len({fingerprint(study) for study in studies}) == len(studies)
