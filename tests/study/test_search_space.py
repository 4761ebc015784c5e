"""Search spaces of a tuning: errors with their place, and round trips of points."""

import math
import tomllib
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.studies import PAPER, small_study

from sinsjax.errors import InputError
from sinsjax.study import search_space
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import study_from_dict, study_to_tables, study_to_toml, with_point
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study

TIMES = [{"low": 1.0, "high": 3.0}, {"low": 2.0, "high": 5.0}]
YAW = {"low": 10.0, "high": 90.0}
COMPASS: dict[str, Any] = {"alignment": {"method": "compass", "phi_u0_deg": 1.0}}
RECORDED: dict[str, Any] = {
    "study": {"duration_s": 2.0, "rate_hz": 100.0, "window_s": [0.0, 2.0]},
    "record": {"format": "psins", "start_s": [0.0, 1.0, 2.0]},
    "filter": PAPER,
}


def tuned_study(
    given: dict[str, Any], *, changes: dict[str, Any] | None = None, **tune: Any
) -> Study:
    """Return a small study with some variables, for searches of any dimension."""
    tune = {"searches": ["sobol"], "variables": given} | tune
    return small_study(tune=tune, **(changes or {}))


MISTAKES: dict[str, tuple[dict[str, Any], str]] = {
    "unknown key": (
        {"reset_time_s": TIMES},
        "[tune.variables] reset_time_s: unknown key (did you mean reset_times_s?)",
    ),
    "old name of a key": (
        {"tape_s": YAW},
        "[tune.variables] tape_s: was renamed to stored_s",
    ),
    "key of the truth": (
        {"gyro_bias_deg_per_h": YAW},
        "[tune.variables] gyro_bias_deg_per_h: cannot be tuned (it is a key of [sensors])",
    ),
    "no table": (
        {"p0_yaw_deg": 80.0},
        "[tune.variables] p0_yaw_deg: must be a table such as { low = 0, high = 1 }, not 80.0",
    ),
    "unknown word": (
        {"p0_yaw_deg": {"lo": 1.0, "high": 2.0}},
        "[tune.variables] p0_yaw_deg.lo: unknown key (did you mean low?)",
    ),
    "low alone": (
        {"p0_yaw_deg": {"low": 1.0}},
        "[tune.variables] p0_yaw_deg: needs low and high, or fixed, or candidates, not low",
    ),
    "nothing": (
        {"p0_yaw_deg": {}},
        "[tune.variables] p0_yaw_deg: needs low and high, or fixed, or candidates, not none",
    ),
    "too much": (
        {"reset_times_s": [YAW | {"fixed": 1.0}]},
        "[tune.variables] reset_times_s[0]: needs low and high, or fixed, or candidates, not low"
        " and high and fixed",
    ),
    "scale of one value": (
        {"p0_yaw_deg": {"fixed": 1.0, "scale": "log"}},
        "[tune.variables] p0_yaw_deg.scale: requires low and high",
    ),
    "ends in the wrong order": (
        {"reset_times_s": [TIMES[0], {"low": 3, "high": 3}]},
        "[tune.variables] reset_times_s[1].high: must be above low = 3, not 3",
    ),
    "logarithm of nothing": (
        {"feedback_time_constant_s": {"low": 0.0, "high": 1.0, "scale": "log"}},
        "[tune.variables] feedback_time_constant_s.scale: 'log' needs low > 0, not 0",
    ),
    "unknown scale": (
        {"p0_yaw_deg": YAW | {"scale": "square"}},
        "[tune.variables] p0_yaw_deg.scale: must be 'linear' or 'log', not 'square'",
    ),
    "no number": (
        {"reset_times_s": [{"low": "a", "high": 1.0}]},
        "[tune.variables] reset_times_s[0].low: must be a number, not 'a'",
    ),
    "end that the key does not take": (
        {"p0_yaw_deg": {"low": -1.0, "high": 1.0}},
        "[tune.variables] p0_yaw_deg.low: must be greater than 0, not -1.0",
    ),
    "end that an entry does not take": (
        {"reset_times_s": [TIMES[0], {"low": 0.0, "high": 3.0}]},
        "[tune.variables] reset_times_s[1].low: must be greater than 0, not 0.0",
    ),
    "fixed entry that it does not take": (
        {"reset_times_s": [{"fixed": -2.0}]},
        "[tune.variables] reset_times_s[0].fixed: must be greater than 0, not -2.0",
    ),
    "fixed value that the key does not take": (
        {"reset_kind": {"fixed": "half"}},
        "[tune.variables] reset_kind.fixed: must be 'full', 'yaw' or 'scale', not 'half'",
    ),
    "candidate that the key does not take": (
        {"reset_times_s": {"candidates": [[1.0], [2.0, 1.0]]}},
        "[tune.variables] reset_times_s.candidates[1]: must increase",
    ),
    "no candidates": (
        {"reset_kind": {"candidates": []}},
        "[tune.variables] reset_kind.candidates: must not be empty, not []",
    ),
    "candidate twice": (
        {"reset_kind": {"candidates": ["full", "full"]}},
        "[tune.variables] reset_kind.candidates: repeats a value (drop one)",
    ),
    "candidates of an entry": (
        {"reset_times_s": [{"candidates": [1.0, 2.0]}]},
        (
            "[tune.variables] reset_times_s[0].candidates: must be of the whole key, not of one"
            " entry"
        ),
    ),
    "range of whole numbers": (
        {"reset_count": {"low": 1, "high": 3}},
        "[tune.variables] reset_count: must be whole numbers (list them as candidates)",
    ),
    "range of a list": (
        {"reset_times_s": YAW},
        "[tune.variables] reset_times_s: needs a list with one range per entry, not one range",
    ),
    "ranges of a number": (
        {"p0_yaw_deg": [YAW]},
        "[tune.variables] p0_yaw_deg: needs one range, not a list (the key is one number)",
    ),
    "empty list": ({"reset_times_s": []}, "[tune.variables] reset_times_s: must not be empty"),
    "no key": ({}, "[tune.variables]: has no key to tune (give one with its range)"),
    "rivals": (
        {"reset_times_s": TIMES, "reset_cycle_s": YAW},
        "[tune.variables] reset_times_s: conflicts with reset_cycle_s in [tune.variables] (give one"
        " of them)",
    ),
    "count of times that are no ranges": (
        {"reset_times_s": {"fixed": [1.0]}, "reset_count": {"fixed": 1}},
        "[tune.variables] reset_times_s: conflicts with reset_count in [tune.variables] (give one"
        " of them)",
    ),
    "more resets than ranges": (
        {"reset_times_s": TIMES, "reset_count": {"candidates": [1, 3]}},
        (
            "[tune.variables] reset_count: 3 are more than the 2 ranges of reset_times_s (add"
            " ranges)"
        ),
    ),
    "after the end": (
        {"reset_times_s": [{"low": 1.0, "high": 7.0}]},
        "[tune.variables] with every range at its high end: [resets] reset_times_s: 7 s is"
        " after the end of the run (duration_s = 6)",
    ),
    "key of another method": (
        {"azimuth_sigma_per_s": {"low": 0.01, "high": 0.02}},
        "[tune.variables] with every range at its low end: [compass] azimuth_sigma_per_s: does"
        " not apply to method kalman5 (drop it)",
    ),
    "candidate that makes no study": (
        {"reset_trigger": {"candidates": ["nis"]}},
        "[tune.variables] with these values: [resets] trigger_threshold: required"
        " with reset_trigger = 'nis'",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_invalid_tuning_variables_are_refused_with_place(name: str) -> None:
    given, text = MISTAKES[name]
    with pytest.raises(InputError) as error:
        tuned_study(given)
    assert str(error.value) == f"study: {text}"


OTHERS: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "no variables": (
        {},
        {"objective": "final_error"},
        ("[tune] variables: required (tuned keys with their ranges, the table [tune.variables])"),
    ),
    "variables no table": ({}, {"variables": 3}, "[tune] variables: must be a table of keys"),
    "unknown key": (
        {},
        {"variables": {"p0_yaw_deg": YAW}, "draws": 3},
        "[tune] draws: unknown key (it belongs in [study])",
    ),
    "unknown search": (
        {},
        {"variables": {"p0_yaw_deg": YAW}, "searches": ["grid", "luck"]},
        "[tune] searches[1]: must be 'grid', 'sobol', 'random', 'gradient' or 'covariance',"
        " not 'luck'",
    ),
    "search twice": (
        {},
        {"variables": {"p0_yaw_deg": YAW}, "searches": ["grid", "grid"]},
        "[tune] searches: repeats a value (drop one)",
    ),
    "unknown band": (
        {},
        {"variables": {"p0_yaw_deg": YAW}, "objective_band_arcmin": 5.0},
        "[tune] objective_band_arcmin: 5 is not one of 60, 10, 3 (settle_bands_arcmin and"
        " success_band_arcmin)",
    ),
    "grid of three": (
        {},
        {"variables": {"p0_yaw_deg": YAW, "reset_times_s": TIMES}, "searches": ["grid"]},
        "[tune] searches: 'grid' is for up to 2 variables, not 3 (use 'sobol')",
    ),
    "gradient of nothing": (
        {},
        {"variables": {"p0_yaw_deg": {"fixed": 1.0}}, "searches": ["gradient"]},
        "[tune] searches: 'gradient' needs a variable with low and high (use 'grid')",
    ),
    "an axis": (
        {"axes": {"p0_yaw_deg": [1.0]}},
        {"variables": {"p0_yaw_deg": YAW}},
        "[tune.variables] p0_yaw_deg: is in [axes] already (drop one of them)",
    ),
    "a case": (
        {"cases": [{"p0_yaw_deg": 1.0}]},
        {"variables": {"p0_yaw_deg": YAW}},
        "[tune.variables] p0_yaw_deg: is in [cases] already (drop one of them)",
    ),
    "drawn": (
        {"alignment": {"phi_u0_deg": None}, "drawn": {"phi_u0_deg": {"uniform": [0.0, 9.0]}}},
        {"variables": {"phi_u0_deg": YAW}},
        "[tune.variables] phi_u0_deg: is in [drawn] already (drop one of them)",
    ),
    "rival of an axis": (
        {"resets": {"reset_cycle_s": 1.0}, "axes": {"reset_count": [0, 1]}},
        {"variables": {"reset_times_s": TIMES}},
        "[tune.variables] reset_times_s: conflicts with reset_count in [axes] (give one of them)",
    ),
    "baseline of an axis": (
        {"axes": {"p0_yaw_deg": [1.0]}},
        {"variables": {"reset_times_s": TIMES}, "baseline": {"p0_yaw_deg": 2.0}},
        "[tune.baseline] p0_yaw_deg: is in [axes] already (drop one of them)",
    ),
    "baseline that is no value": (
        {},
        {"variables": {"p0_yaw_deg": YAW}, "baseline": {"p0_yaw_deg": -1.0}},
        "[tune.baseline] p0_yaw_deg: must be greater than 0, not -1.0",
    ),
    "unknown key of the baseline": (
        {},
        {"variables": {"p0_yaw_deg": YAW}, "baseline": {"p0_yaw": 1.0}},
        "[tune.baseline] p0_yaw: unknown key (did you mean p0_yaw_deg?)",
    ),
    "baseline no table": (
        {},
        {"variables": {"p0_yaw_deg": YAW}, "baseline": 3},
        "[tune] baseline: must be a table of keys",
    ),
    "rivals in the baseline": (
        {},
        {
            "variables": {"p0_yaw_deg": YAW},
            "baseline": {"reset_times_s": [1.0], "reset_count": 1},
        },
        "[tune.baseline] reset_times_s: conflicts with reset_count in [tune.baseline] (give one of"
        " them)",
    ),
    "baseline that makes no study": (
        {},
        {"variables": {"p0_yaw_deg": YAW}, "baseline": {"reset_times_s": [9.0]}},
        (
            "[tune.baseline]: [resets] reset_times_s: 9 s is after the end of the run (duration_s ="
            " 6)"
        ),
    ),
    "baseline that lacks a variable": (
        {},
        {"variables": {"reset_first_s": {"low": 1.0, "high": 2.0}, "reset_count": {"fixed": 1}}},
        "[tune.baseline] reset_first_s: required, as the study has no value of it",
    ),
    "study that lacks a key of the baseline": (
        {},
        {"variables": {"p0_yaw_deg": YAW}, "baseline": {"trigger_until_s": 3.0}},
        (
            "[tune.baseline]: [resets] trigger_until_s: requires a reset_trigger (give one, or drop"
            " this)"
        ),
    ),
    "stop_when": (
        {"stop_when": {"statistic": "success_rate", "half_width": 0.1}},
        {"variables": {"p0_yaw_deg": YAW}, "searches": ["grid"]},
        "[stop_when]: conflicts with [tune], which fixes its draws (drop one)",
    ),
}


@pytest.mark.parametrize("name", OTHERS)
def test_invalid_tune_sections_are_refused_with_place(name: str) -> None:
    changes, tune, text = OTHERS[name]
    tables = {key: dict(table) for key, table in study_to_tables(small_study()).items() if table}
    for key, change in changes.items():
        if isinstance(change, dict):
            merged = tables.get(key, {}) | change
            tables[key] = {k: v for k, v in merged.items() if v is not None}
            if key == "resets":
                del tables[key]["reset_count"]
        else:
            tables[key] = change
    with pytest.raises(InputError) as error:
        study_from_dict(tables | {"tune": tune})
    assert str(error.value) == f"study: {text}"


def test_loop_gains_require_one_range_per_entry() -> None:
    gain = {"low": 0.1, "high": 1.0}
    with pytest.raises(InputError, match=r"level_gains: must have 3 ranges, not 2"):
        tuned_study({"level_gains": [gain, gain]}, changes=COMPASS)


@pytest.mark.parametrize("key", ["tune_draws", "evaluation_draws"])
def test_recorded_tuning_uses_start_times_as_draws(key: str) -> None:
    tune: dict[str, Any] = {"variables": {"p0_yaw_deg": YAW}, "searches": ["grid"]}
    study = study_from_dict(RECORDED | {"tune": tune})
    assert study.tune is not None and study.tune.tune_draws is None
    assert study_from_dict(tomllib.loads(study_to_toml(study))) == study
    with pytest.raises(InputError) as error:
        study_from_dict(RECORDED | {"tune": tune | {key: 3}})
    assert str(error.value) == (
        f"study: [tune] {key}: does not apply to a recorded study (drop it: tuning uses the start"
        " times)"
    )
    alone = RECORDED["record"] | {"start_s": 0.0}
    with pytest.raises(
        InputError, match=r"\[record\] start_s: tuning needs two start times or more"
    ):
        study_from_dict(RECORDED | {"tune": tune, "record": alone})


EVERYTHING: dict[str, Any] = {
    "reset_times_s": [*TIMES, {"fixed": 4.0}],
    "reset_count": {"candidates": [0, 1, 3]},
    "feedback_time_constant_s": {"low": 0.1, "high": 10.0, "scale": "log"},
    "reset_kind": {"candidates": ["full", "yaw"]},
    "p0_yaw_deg": {"fixed": 70.0},
}


def test_tuning_survives_toml_round_trip() -> None:
    study = tuned_study(EVERYTHING, baseline={"reset_times_s": [1.0]}, objective="settle_quantile")
    assert study_from_dict(tomllib.loads(study_to_toml(study))) == study
    assert study.tune is not None
    assert (study.tune.tune_draws, study.tune.evaluation_draws) == (16, 64)


def test_fingerprint_ignores_tuning_section() -> None:
    assert fingerprint(tuned_study(EVERYTHING)) == fingerprint(small_study())


def test_variables_and_combinations_keep_written_order() -> None:
    space = SearchSpace.from_study(tuned_study(EVERYTHING))
    names = ["reset_times_s[0]", "reset_times_s[1]", "feedback_time_constant_s"]
    assert [variable.name for variable in space.variables] == names
    told = [(c["reset_count"], c["reset_kind"], c["p0_yaw_deg"]) for c in space.combinations]
    assert told == [(n, kind, 70.0) for n in (0, 1, 3) for kind in ("full", "yaw")]
    used = [space.used_variables(combination) for combination in space.combinations[::2]]
    assert used == [[2], [0, 2], [0, 1, 2]]


def test_study_without_candidates_has_one_combination() -> None:
    assert SearchSpace.from_study(tuned_study({"p0_yaw_deg": YAW})).combinations == ({},)


@cache
def space_of_everything() -> SearchSpace:
    return SearchSpace.from_study(tuned_study(EVERYTHING))


@given(box=st.lists(st.floats(0, 1), min_size=3, max_size=3))
def test_box_and_values_round_trip(box: list[float]) -> None:
    space = space_of_everything()
    values = space.to_values(box)
    assert space.to_box(values) == pytest.approx(box, abs=1e-12)
    for variable, value in zip(space.variables, values, strict=True):
        assert variable.low * (1 - 1e-12) <= value <= variable.high * (1 + 1e-12)
    assert values[2] == pytest.approx(10 ** (2 * box[2] - 1))
    many = space.to_values(np.array([box, box]).T)
    np.testing.assert_allclose(np.array(many)[:, 0], values, rtol=1e-15)


def test_point_has_ascending_reset_times_on_samples() -> None:
    space = SearchSpace.from_study(tuned_study(EVERYTHING))
    last = space.combinations[-1]
    assert space.make_point([2.9999, 2.123456, 11.0], last) == {
        "reset_times_s": (2.12, 3.0, 4.0),
        "feedback_time_constant_s": 10.0,
        "reset_kind": "yaw",
        "p0_yaw_deg": 70.0,
    }
    assert space.make_point([2.501, 2.499, 1.0], last)["reset_times_s"] == (2.5, 4.0)
    assert space.make_point([2.5, 2.6, 1.0], space.combinations[2])["reset_times_s"] == (2.5,)
    assert space.make_point([2.5, 2.6, 1.0], space.combinations[0])["reset_times_s"] == ()


def test_sigma_times_never_coincide() -> None:
    given = {
        "sigma_times_s": [{"low": 1.0, "high": 3.0}] * 2,
        "sigma_factors": {"fixed": [4.0, 2.0, 1.0]},
    }
    space = SearchSpace.from_study(
        tuned_study(
            given, changes=COMPASS, baseline={"sigma_times_s": [1.0, 2.0], "sigma_factors": [1] * 3}
        )
    )
    assert space.make_point([2.0, 2.0], space.combinations[0])["sigma_times_s"] == (2.0, 2.01)


def test_tuned_lengths_are_rounded_to_samples_and_records() -> None:
    changes = {"passes": {"stored_s": 3.0}}
    study = tuned_study(
        {"feedback_interval_s": {"low": 0.1, "high": 1}, "stored_s": {"low": 1, "high": 3}},
        changes=changes,
    )
    space = SearchSpace.from_study(study)
    point = space.make_point([0.3333, 2.4], space.combinations[0])
    assert point == {"feedback_interval_s": 0.33, "stored_s": 2.0}


def test_with_point_applies_values_without_changing_study() -> None:
    study = tuned_study({"reset_times_s": TIMES}, changes={"resets": {"reset_cycle_s": 2.0}})
    before = study_to_toml(study)
    point = {"reset_times_s": (1.0, 2.5), "p0_yaw_deg": 33.0}
    told = small_study(resets={"reset_times_s": [1.0, 2.5]}, filter={"p0_yaw_deg": 33.0})
    assert with_point(study, point) == told
    assert with_point(study, {}) == small_study(resets={"reset_cycle_s": 2.0})
    assert study_to_toml(study) == before
    with pytest.raises(InputError, match=r"^study: \[resets\] reset_times_s: 9 s is after"):
        with_point(study, {"reset_times_s": (9.0,)})


def test_comparable_lists_same_keys_for_baseline_and_points() -> None:
    baseline = {"reset_count": 2, "reset_cycle_s": 2.0, "r_velocity_m_per_s": 0.3}
    study = tuned_study(
        {"reset_times_s": TIMES, "reset_yaw_deg": YAW, "q_scale": {"low": 0.1, "high": 2.0}},
        baseline=baseline,
    )
    points = {"grid": {"reset_times_s": (3.0,), "reset_yaw_deg": 20.0, "q_scale": 0.5}}
    told = search_space.comparable_points(study, with_point(study, baseline), points)
    assert told == {
        "baseline": {
            "reset_times_s": (2.0, 4.0),
            "reset_yaw_deg": 80.0,
            "q_scale": 1.0,
            "r_velocity_m_per_s": 0.3,
        },
        "grid": points["grid"] | {"r_velocity_m_per_s": 0.1},
    }


def test_baseline_only_key_requires_value_in_study() -> None:
    resets = {"reset_trigger": "nis", "trigger_threshold": 9.0}
    with pytest.raises(InputError) as error:
        tuned_study(
            {"p0_yaw_deg": YAW},
            changes={"resets": resets},
            baseline={"trigger_until_s": 3.0},
        )
    text = "[tune.baseline] trigger_until_s: needs a value in the study too, for the other points"
    assert str(error.value) == f"study: {text}"


def test_log_scale_variable_maps_logarithmically() -> None:
    variable = search_space.Variable("p0_yaw_deg", None, 1.0, 100.0, True)
    assert (variable.value(0.5), variable.position(10.0)) == pytest.approx((10.0, 0.5))
    assert math.isclose(variable._replace(log=False).value(0.5), 50.5)
