"""The comparison of usual ways to turn sensors."""

import pytest

import sinsjax
from sinsjax.errors import InputError

KEYS = ("gyro_bias_deg_per_h", "gyro_arw_deg_per_sqrt_h", "accel_bias_ug")
KEYS += ("accel_vrw_ug_per_sqrt_hz",)
MEMS = dict(zip(KEYS, (1.0, 0.02, 500.0, 50.0), strict=True))
FOG = dict(zip(KEYS, (0.1, 0.005, 200.0, 30.0), strict=True))
LASER = dict(zip(KEYS, (0.003, 0.0005, 25.0, 5.0), strict=True))
WITH_SCALE = {"gyro_scale_ppm": 300.0, "gyro_misalignment_arcsec": 206.26}


def plan(sensors, duration_s, **changes):
    return sinsjax.plan_turns(
        **{"latitude_deg": 45.0, "duration_s": duration_s} | sensors | changes
    )


def sigmas(*given, **changes):
    return {option.name: option.sigma_arcmin for option in plan(*given, **changes).options}


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


def test_best_option_has_least_heading_error_and_laser_gyros_need_no_turn_within_a_minute():
    choice, stays = plan(MEMS, 300.0), plan(LASER, 60.0)
    assert choice.pays and not stays.pays and stays.best.motion == {}
    assert choice.best.sigma_arcmin == min(o.sigma_arcmin for o in choice.options)


def test_turns_that_do_not_fit_are_left_out():
    assert list(sigmas(MEMS, 10.0)) == ["parked"]
    assert list(sigmas(MEMS, 32.0)) == ["parked", "reversing carousel"]
    assert "six positions" not in sigmas(MEMS, 100.0)


@pytest.mark.nightly(fast=("45.0",))
@pytest.mark.parametrize("duration_s", [45.0, 123.4, 300.0])
def test_study_with_motion_of_option_has_its_bound(duration_s):
    sensors = FOG | WITH_SCALE
    laws = {key: {"normal": [0.0, sensors[key]]} for key in sensors if "rw" not in key}
    noise = {key: FOG[key] for key in FOG if "rw" in key}
    for option in plan(sensors, duration_s).options:
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
    with pytest.raises(InputError, match=message):
        plan(MEMS, **{"duration_s": 60.0} | changes)
