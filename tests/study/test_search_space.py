"""Search spaces of a tuning: errors with their place, and round trips of points."""

import tomllib
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.refusals import refusal_line, refused
from support.studies import PAPER, small_study

from sinsjax.errors import InputError
from sinsjax.study import search_space
from sinsjax.study.load import study_from_dict, study_to_toml, with_point
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study

TIMES = [{"low": 1.0, "high": 3.0}, {"low": 2.0, "high": 5.0}]
YAW = {"low": 10.0, "high": 90.0}


def tuned_study(given: dict[str, Any], *, changes: Any = None, **tune: Any) -> Study:
    """Return a small study with some variables, for searches of any dimension."""
    tune = {"searches": ["sobol"], "variables": given} | tune
    return small_study(tune=tune, **(changes or {}))


@refused("""
gyro_bias_deg_per_h = {low = 10, high = 90}  -> gyro_bias_deg_per_h: [sensors]
p0_yaw_deg = {fixed = 1.0, scale = "log"}    -> p0_yaw_deg.scale: low high
reset_times_s = [{low = 1, high = 3}, {low = 3, high = 3}]    -> reset_times_s[1].high: 3
feedback_time_constant_s = {low = 0.0, high = 1.0, scale = "log"}
    -> feedback_time_constant_s.scale: 'log' low 0
reset_times_s = {candidates = [[1.0], [2.0, 1.0]]}    -> reset_times_s.candidates[1]: increase
reset_times_s = [{candidates = [1.0, 2.0]}]  -> reset_times_s[0].candidates: whole
reset_count = {low = 1, high = 3}            -> reset_count: candidates
reset_times_s = [{low = 1, high = 3}] & reset_cycle_s = {low = 10, high = 90}
    -> reset_times_s: reset_cycle_s [tune.variables]
reset_times_s = [{low = 1, high = 3}] & reset_count = {candidates = [1, 3]}
    -> reset_count: 3 1 reset_times_s
# Values that make no study together are named with what is wrong in it.
reset_times_s = [{low = 1.0, high = 7.0}]    -> with every range at its high end: reset_times_s 7 6
reset_trigger = {candidates = ["innovation"]}
    -> with these values: trigger_threshold 'innovation'
""")
def test_invalid_tuning_variables_are_refused_with_place(refusal):
    line = refusal_line(small_study, tune={"searches": ["sobol"], "variables": refusal.tables})
    refusal.check(line.removeprefix("[tune.variables] "))


@refused("""
tune.variables.reset_times_s = [{low = 1, high = 3}, {low = 2, high = 5}]
    -> [tune] searches: 'grid' 2 3
tune = {variables.p0_yaw_deg = {fixed = 1.0}, searches = ["gradient"]}
    -> [tune] searches: 'gradient' low high
tune.variables.reset_times_s = [{low = 1, high = 3}] & axes.reset_count = [0, 1]
    & resets.reset_cycle_s = 1.0             -> [tune.variables] reset_times_s: reset_count [axes]
tune.baseline = {reset_times_s = [1.0], reset_count = 1}
    -> [tune.baseline] reset_times_s: reset_count [tune.baseline]
tune.variables = {reset_first_s = {low = 1.0, high = 2.0}, reset_count = {fixed = 1}}
    -> [tune.baseline] reset_first_s: required
tune.baseline.trigger_until_s = 3.0
    & resets = {reset_trigger = "innovation", trigger_threshold = 9.0}
    -> [tune.baseline] trigger_until_s
alignment.method = "compass"
    & tune.variables = {level_gains = [{low = 0.1, high = 1.0}, {low = 0.1, high = 1.0}]}
    -> [tune.variables] level_gains: 3 2
""")
def test_invalid_tune_sections_are_refused_with_place(refusal):
    tune = {"variables": {"p0_yaw_deg": YAW}, "searches": ["grid"]}
    told = refusal.tables.get("tune", {})
    if "variables" in told and "level_gains" not in told["variables"]:
        told["variables"] = tune["variables"] | told["variables"]
    refusal.check(refusal_line(small_study, **refusal.tables | {"tune": tune | told}))


def test_recorded_tuning_uses_start_times_as_draws():
    tune: dict[str, Any] = {"variables": {"p0_yaw_deg": YAW}, "searches": ["grid"]}
    base = {"study": {"duration_s": 2.0, "rate_hz": 100.0, "window_s": [0.0, 2.0]}, "filter": PAPER}
    base |= {"record": {"format": "psins", "start_s": [0.0, 1.0, 2.0]}, "tune": tune}
    study = study_from_dict(base)
    assert study.tune.tune_draws is None and study_from_dict(study.to_dict()) == study
    for changes, place in (
        ({"tune": tune | {"tune_draws": 3}}, r"\[tune\] tune_draws"),
        ({"record": {"format": "psins", "start_s": 0.0}}, r"\[record\] start_s"),
    ):
        with pytest.raises(InputError, match=rf"study: {place}: .*start"):
            study_from_dict(base | changes)


EVERYTHING: dict[str, Any] = {
    "reset_times_s": [*TIMES, {"fixed": 4.0}],
    "reset_count": {"candidates": [0, 1, 3]},
    "feedback_time_constant_s": {"low": 0.1, "high": 10.0, "scale": "log"},
    "reset_kind": {"candidates": ["full", "yaw"]},
    "p0_yaw_deg": {"fixed": 70.0},
}


SPACE = SearchSpace.from_study(tuned_study(EVERYTHING))


def test_variables_and_combinations_keep_written_order():
    names = ["reset_times_s[0]", "reset_times_s[1]", "feedback_time_constant_s"]
    assert [variable.name for variable in SPACE.variables] == names
    told = [(c["reset_count"], c["reset_kind"], c["p0_yaw_deg"]) for c in SPACE.combinations]
    assert told == [(n, kind, 70.0) for n in (0, 1, 3) for kind in ("full", "yaw")]
    used = [SPACE.used_variables(combination) for combination in SPACE.combinations[::2]]
    assert used == [[2], [0, 2], [0, 1, 2]]
    study = tuned_study(EVERYTHING, baseline={"reset_times_s": [1.0]}, objective="settle_quantile")
    assert study_from_dict(tomllib.loads(study_to_toml(study))) == study
    assert (study.tune.tune_draws, study.tune.evaluation_draws) == (16, 64)


@given(box=st.lists(st.floats(0, 1), min_size=3, max_size=3))
def test_box_and_values_round_trip(box):
    values = SPACE.to_values(box)
    assert SPACE.to_box(values) == pytest.approx(box, abs=1e-12)
    for variable, value in zip(SPACE.variables, values, strict=True):
        assert variable.low * (1 - 1e-12) <= value <= variable.high * (1 + 1e-12)
    assert values[2] == pytest.approx(10 ** (2 * box[2] - 1))
    many = SPACE.to_values(np.array([box, box]).T)
    np.testing.assert_allclose(np.array(many)[:, 0], values, rtol=1e-15)


def test_point_has_ascending_reset_times_on_samples():
    last = SPACE.combinations[-1]
    assert SPACE.make_point([2.9999, 2.123456, 11.0], last) == {
        "reset_times_s": (2.12, 3.0, 4.0),
        "feedback_time_constant_s": 10.0,
        "reset_kind": "yaw",
        "p0_yaw_deg": 70.0,
    }
    assert SPACE.make_point([2.501, 2.499, 1.0], last)["reset_times_s"] == (2.5, 4.0)
    assert SPACE.make_point([2.5, 2.6, 1.0], SPACE.combinations[2])["reset_times_s"] == (2.5,)
    assert SPACE.make_point([2.5, 2.6, 1.0], SPACE.combinations[0])["reset_times_s"] == ()


def test_times_of_a_point_never_coincide_and_lengths_are_rounded():
    given = {"sigma_times_s": [{"low": 1.0, "high": 3.0}] * 2}
    given |= {"sigma_factors": {"fixed": [4.0, 2.0, 1.0]}}
    baseline = {"sigma_times_s": [1.0, 2.0], "sigma_factors": [1] * 3}
    changes = {"alignment": {"method": "compass", "phi_u0_deg": 1.0}}
    space = SearchSpace.from_study(tuned_study(given, changes=changes, baseline=baseline))
    assert space.make_point([2.0, 2.0], space.combinations[0])["sigma_times_s"] == (2.0, 2.01)
    given = {"feedback_interval_s": {"low": 0.1, "high": 1}, "stored_s": {"low": 1, "high": 3}}
    study = tuned_study(given, changes={"passes": {"stored_s": 3.0}})
    space = SearchSpace.from_study(study)
    point = space.make_point([0.3333, 2.4], space.combinations[0])
    assert point == {"feedback_interval_s": 0.33, "stored_s": 2.0}


def test_comparable_lists_same_keys_for_baseline_and_points():
    baseline = {"reset_count": 2, "reset_cycle_s": 2.0, "r_velocity_m_per_s": 0.3}
    study = tuned_study(
        {"reset_times_s": TIMES, "reset_yaw_deg": YAW, "q_scale": {"low": 0.1, "high": 2.0}},
        baseline=baseline,
    )
    points = {"grid": {"reset_times_s": (3.0,), "reset_yaw_deg": 20.0, "q_scale": 0.5}}
    told = search_space.add_baseline_of_same_keys(study, with_point(study, baseline), points)
    defaults = {"reset_times_s": (2.0, 4.0), "reset_yaw_deg": 80.0, "q_scale": 1.0}
    assert told == {
        "baseline": defaults | {"r_velocity_m_per_s": 0.3},
        "grid": points["grid"] | {"r_velocity_m_per_s": 0.1},
    }
