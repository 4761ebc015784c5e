"""The comparison of usual ways to turn sensors."""

from functools import cache

import pytest

import sinsjax
from sinsjax.errors import InputError

MEMS = {
    "gyro_bias_deg_per_h": 1.0,
    "gyro_arw_deg_per_sqrt_h": 0.02,
    "accel_bias_ug": 500.0,
    "accel_vrw_ug_per_sqrt_hz": 50.0,
}
FOG = {
    "gyro_bias_deg_per_h": 0.1,
    "gyro_arw_deg_per_sqrt_h": 0.005,
    "accel_bias_ug": 200.0,
    "accel_vrw_ug_per_sqrt_hz": 30.0,
}
LASER = {
    "gyro_bias_deg_per_h": 0.003,
    "gyro_arw_deg_per_sqrt_h": 0.0005,
    "accel_bias_ug": 25.0,
    "accel_vrw_ug_per_sqrt_hz": 5.0,
}
WITH_SCALE = {"gyro_scale_ppm": 300.0, "gyro_misalignment_arcsec": 206.26}


def sigmas(sensors, duration_s, **changes):
    given = {"latitude_deg": 45.0, "duration_s": duration_s} | sensors | changes
    return {o.name: o.sigma_arcmin for o in planned(*given.items()).options}


@cache
def planned(*given):
    return sinsjax.plan_turns(**dict(given))


@pytest.mark.parametrize(
    ("sensors", "duration_s", "name", "expected"),
    [
        (MEMS, 300.0, "parked", 324),
        (MEMS, 300.0, "half turn", 24.05),
        (FOG, 300.0, "half turn", 6.602),
        (FOG, 600.0, "four positions", 4.191),
        (FOG | WITH_SCALE, 600.0, "four positions", 5.38),
        (FOG | WITH_SCALE, 600.0, "half turn", 5.74),
    ],
)
def test_options_have_published_bounds(sensors, duration_s, name, expected):
    assert sigmas(sensors, duration_s)[name] == pytest.approx(expected, rel=0.01)


def test_best_option_has_least_heading_error_and_is_marked():
    choice = sinsjax.plan_turns(**MEMS, latitude_deg=45.0, duration_s=300.0)
    assert choice.pays
    assert choice.best.sigma_arcmin == min(o.sigma_arcmin for o in choice.options)
    (line,) = (line for line in repr(choice).splitlines() if line.endswith("best"))
    assert choice.best.name in line


def test_turn_of_good_laser_does_not_pay_within_a_minute():
    choice = sinsjax.plan_turns(**LASER, latitude_deg=45.0, duration_s=60.0)
    assert not choice.pays
    assert choice.best.motion == {}


def test_turns_that_do_not_fit_are_left_out():
    assert list(sigmas(MEMS, 10.0)) == ["parked"]
    assert list(sigmas(MEMS, 32.0)) == ["parked", "reversing carousel"]
    assert "six positions" not in sigmas(MEMS, 100.0)


@pytest.mark.nightly(fast=("45.0",))
@pytest.mark.parametrize("duration_s", [45.0, 123.4, 300.0])
def test_study_with_motion_of_option_has_its_bound(duration_s):
    choice = sinsjax.plan_turns(**FOG, **WITH_SCALE, latitude_deg=45.0, duration_s=duration_s)
    drawn = (*FOG, *WITH_SCALE)
    laws = {key: {"normal": [0.0, (FOG | WITH_SCALE)[key]]} for key in drawn if "rw" not in key}
    noise = {key: FOG[key] for key in FOG if "rw" in key}
    for option in choice.options:
        study = sinsjax.study_from_dict(
            {
                "study": {"duration_s": duration_s, "rate_hz": 20.0, "record_interval_s": 0.1},
                "earth": {"latitude_deg": 45.0},
                "motion": {"yaw_center_deg": 0.0} | option.motion,
                "sensors": noise,
                "drawn": laws,
            }
        )
        found = sinsjax.information_bound(study)["bound_u_arcmin"].to_pylist()
        assert found == pytest.approx([option.sigma_arcmin], rel=1e-3), option.name


def test_drifts_raise_every_option():
    without = sigmas(FOG, 300.0)
    drifting = sigmas(FOG, 300.0, gyro_instability_deg_per_h=0.1, gyro_instability_time_s=50.0)
    assert all(drifting[name] > without[name] for name in without)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gyro_bias_deg_per_h": -1.0}, r"^gyro_bias_deg_per_h: -1.0 is not 0 or more"),
        ({"accel_vrw_ug_per_sqrt_hz": 0.0}, r"^accel_vrw_ug_per_sqrt_hz: 0.0 is not positive"),
        ({"duration_s": float("nan")}, r"^duration_s: nan is not positive"),
        ({"latitude_deg": 90.0}, r"^latitude_deg: 90.0 is not between -90 and 90"),
    ],
)
def test_meaningless_numbers_are_refused(changes, message):
    given = {"latitude_deg": 45.0, "duration_s": 60.0} | MEMS | changes
    with pytest.raises(InputError, match=message):
        sinsjax.plan_turns(**given)
