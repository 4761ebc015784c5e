"""Keys of triggers, reset values and scales: what is refused, filled in and kept."""

from typing import Any

import pytest
from support.plain_studies import build_study, refusal_line
from support.refusals import assert_named, refused

from sinsjax.methods.filters.keys import any_trigger
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import study_from_dict, study_to_tables
from sinsjax.study.variants import Variants

TRIGGER = {"reset_trigger": "innovation", "trigger_threshold": 9.0}
OF_TRIGGERS: dict[str, float] = {
    "trigger_threshold": 2.0,
    "trigger_window_s": 3.0,
    "trigger_refractory_s": 4.0,
    "trigger_most": 5,
    "trigger_until_s": 600.0,
}
GIVEN: dict[str, dict[str, Any]] = {
    "filter": {"q_scale": 2.0, "r_scale": 3.0},
    "resets": {
        "reset_velocity_m_per_s": 0.2,
        "reset_level_deg": 1.0,
        "reset_yaw_deg": 10.0,
        "reset_gyro_bias_deg_per_h": 0.05,
        "reset_accel_bias_ug": 50.0,
        "reset_trigger": "innovation",
        **OF_TRIGGERS,
    },
}


@refused("""
resets.reset_trigger = "innovation"    -> [resets] trigger_threshold: reset_trigger 'innovation'
axes.reset_trigger = ["none", "innovation"]    -> [resets] trigger_threshold: 'innovation'
cases = [{reset_trigger = "none"}, {reset_trigger = "innovation"}]
    -> [resets] trigger_threshold: 'innovation'
""")
def test_reset_trigger_without_threshold_is_refused(refusal):
    refusal.check(refusal_line(**refusal.tables))


@pytest.mark.parametrize("trigger", [{}, {"reset_trigger": "none"}])
def test_trigger_keys_without_reset_trigger_are_refused(trigger):
    for key, value in OF_TRIGGERS.items():
        line = refusal_line(resets=trigger | {key: value})
        assert_named(line, f"[resets] {key}", "reset_trigger")
        line = refusal_line(resets=trigger, axes={key: [value, 2 * value]})
        assert_named(line, f"[axes] {key}", "reset_trigger")
        assert build_study(resets=trigger) and build_study(resets=TRIGGER | {key: value})


@refused("""
resets.reset_trigger = "cusum"               -> [resets] reset_trigger: 'cusum'
resets.trigger_threshold = -1.0              -> [resets] trigger_threshold: -1.0
resets.trigger_window_s = 0.0                -> [resets] trigger_window_s: 0.0
resets.trigger_most = 0                      -> [resets] trigger_most: 1 0
resets.trigger_most = 1.5                    -> [resets] trigger_most: 1.5
resets.reset_velocity_m_per_s = 0.0          -> [resets] reset_velocity_m_per_s: 0.0
""")
def test_invalid_reset_values_are_refused(refusal):
    refusal.check(refusal_line(resets=TRIGGER | refusal.tables["resets"]))


def test_reset_trigger_may_be_swept_together_with_none():
    for tables in (
        {"resets": {"trigger_threshold": 9.0}, "axes": {"reset_trigger": ["none", "innovation"]}},
        {"axes": {"reset_trigger": ["none", "innovation"], "trigger_threshold": [1.0, 9.0]}},
        {"axes": {"a": {"reset_trigger": ["none", "innovation"], "trigger_threshold": [0.0, 9.0]}}},
    ):
        study = build_study(**tables)
        assert any_trigger(Variants.all_of(study))
        assert set(study.values("reset_trigger")) == {"none", "innovation"}
        assert study.values("trigger_most") == [10] * study.n_variants
    for with_trigger, study in (
        (False, build_study(axes={"reset_trigger": ["none"]})),
        (False, build_study()),
        (True, build_study(resets=TRIGGER)),
    ):
        assert any_trigger(Variants.all_of(study)) == with_trigger


@pytest.mark.parametrize(
    "tables",
    [
        GIVEN,
        {"resets": TRIGGER | {"trigger_until_s": 50.0, "reset_count": 2, "reset_cycle_s": 3.0}},
        {"resets": {"trigger_threshold": 9.0}, "axes": {"reset_trigger": ["none", "innovation"]}},
        {"cases": [TRIGGER, TRIGGER | {"reset_trigger": "none"}]},
    ],
    ids=["values", "schedule", "axis", "cases"],
)
def test_resolved_study_loads_equal(tables):
    study = build_study(**tables)
    again = study_from_dict(study_to_tables(study), study.name)
    assert again == study and fingerprint(again) == fingerprint(study)
