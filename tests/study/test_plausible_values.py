"""Implausible values are refused wherever they are given, by the usual range of each key."""

import copy
from typing import Any

import pytest
from support.memory import limit_memory_mb
from support.refusals import assert_named, refused
from support.studies import BASE, refusal_line, small_study

from sinsjax.errors import InputError
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study


def unchecked_study(**tables: Any) -> Study:
    return small_study(**tables | {"study": tables.get("study", {}) | {"unchecked": True}})


@pytest.mark.parametrize("draws", [4_100_000, 4_300_000, 40_000_000])
def test_many_draws_are_accepted_unless_law_exceeds_usual_range(draws):
    def of(deviation: float) -> Study:
        data = copy.deepcopy(BASE) | {"drawn": {"phi_u0_deg": {"normal": [0, deviation]}}}
        del data["alignment"]["phi_u0_deg"]
        data["study"]["draws"] = draws
        return study_from_dict(data)

    assert of(25).n_draws == draws
    with pytest.raises(InputError, match=r"phi_u0_deg: .*(draw \d+ gives|may give)"):
        of(60)


@refused("""
earth.radius_m = 1.0                         -> [earth] radius_m: 1 6e+06 7e+06 unchecked
sensors.gyro_bias_deg_per_h = 1e12           -> [sensors] gyro_bias_deg_per_h: 1e+12
motion.roll_period_s = 1e-6                  -> [motion] roll_period_s: 1e-06
sensors.gyro_bias_deg_per_h = [0, 1e9, 0]    -> [sensors] gyro_bias_deg_per_h[1]: 1000000000
axes.radius_m = [6.4e6, 1.0]                 -> [axes] radius_m[1]: 1
axes.z = {radius_m = [6.4e6, 1.0], phi_u0_deg = [1, 2]}     -> [axes.z] radius_m[1]: 1
cases = [{radius_m = 6.4e6}, {radius_m = 1.0}]              -> [cases] radius_m[1]: 1
axes.accel_noise_ug = [1.0, [0, 0, 1e9]]     -> [axes] accel_noise_ug[1][2]: 1000000000
# Also where others before it are given twice.
axes.z = {height_m = [0, 0, 1e12], ve0_m_per_s = [1, 2, 3]} -> [axes.z] height_m[2]: 1e+12
alignment.method = "compass" & compass.level_gains = [1.0, 9e11, 0.0]
    -> [compass] level_gains[1]: 900000000000
""")
def test_unusual_value_is_refused_unless_unchecked(refusal):
    refusal.check(refusal_line(**refusal.tables))
    unchecked_study(**refusal.tables)


def test_random_walk_in_another_unit_is_refused():
    """12 deg/h/sqrt(Hz) is 0.2 deg/sqrt(h)."""
    walk = {"gyro_noise_deg_per_h": None, "gyro_arw_deg_per_sqrt_h": 12.0}
    assert_named(refusal_line(sensors=walk), "[sensors] gyro_arw_deg_per_sqrt_h", "12", "3")


def test_reset_before_the_first_sample_is_refused():
    assert_named(refusal_line(resets={"reset_times_s": [1e-12, 1.0]}), "[resets] reset_times_s")


@pytest.mark.parametrize(
    "law",
    [
        {"uniform": [0, 1e9]},
        {"normal": [0, 1e9]},
        {"values": [0, 1e9]},
        {"grid": [0, 1e9]},
        {"values": [0, [0, 1e9, 0]]},
    ],
)
def test_unusual_drawn_value_is_refused_unless_unchecked(law):
    tables = {"drawn": {"accel_bias_ug": law}, "sensors": {}}
    data = {name: dict(table) for name, table in BASE.items()} | {"drawn": tables["drawn"]}
    del data["sensors"]["accel_bias_ug"]
    with pytest.raises(InputError, match=r"\[drawn\] accel_bias_ug: draw \d gives .* outside"):
        study_from_dict(data)
    data["study"]["unchecked"] = True
    assert study_from_dict(data).drawn


@pytest.mark.parametrize(
    ("law", "text"),
    [({"normal": [0, 1.0]}, None), ({"normal": [0, 2e4]}, "one of 896000000 draws")],
)
def test_law_of_huge_draw_count_is_checked_without_listing_draws(law, text):
    tables = {"study": {"draws": 896_000_000}, "drawn": {"vn0_m_per_s": law}}
    with limit_memory_mb(100):  # a list of the draws is 7,000
        if text is None:
            small_study(**tables)
        else:
            assert text in refusal_line(**tables)


@pytest.mark.parametrize(
    "kind", [{"low": 1.0, "high": 1e6}, {"fixed": 1e6}, {"candidates": [1.0, 1e6]}]
)
def test_unusual_tuning_value_is_refused_unless_unchecked(kind):
    tune = {"variables": {"p0_yaw_deg": kind}, "searches": ["grid"]}
    assert_named(
        refusal_line(tune=tune).replace(" with", ":", 1),
        "[tune.variables]",
        "p0_yaw_deg",
        "1000000",
    )
    unchecked_study(tune=tune)


def test_feedback_interval_longer_than_run_is_refused_unless_unchecked():
    longer = {"feedback_interval_s": 7.0}
    assert_named(refusal_line(alignment=longer), "[alignment] feedback_interval_s", "7", "6")
    unchecked_study(alignment=longer)
    small_study(alignment={"feedback_interval_s": 6.0})


@pytest.mark.parametrize("earth", ["constants", "wgs84"])
def test_height_below_earth_centre_is_always_refused(earth):
    line = refusal_line(earth={"height_m": -6378137.0, "earth": earth}, study={"unchecked": True})
    assert_named(line, "[earth] height_m", "-6378137")
