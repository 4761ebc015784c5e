"""The information bound of a study, per variant, and the studies for which it is refused."""

import numpy as np
import pytest
from oracles.white_noise_bound import white_noise_bound
from support.studies import small_study

from sinsjax.errors import InputError
from sinsjax.execution.information import information_bound
from sinsjax.strapdown import earth
from sinsjax.units import ARCMIN, DEG, DEG_PER_H, micro_g

STUDY = {"duration_s": 60.0, "report_times_s": [20.0], "window_s": [30, 60]}
SENSORS = {"gyro_noise_deg_per_h": 0.1, "accel_noise_ug": 500.0, "gyro_bias_deg_per_h": 1.0}


def make_study(**changes):
    given = {"study": STUDY, "sensors": SENSORS, "earth": {"latitude_deg": 50.0}}
    for name, change in changes.items():
        given[name] = given.get(name, {}) | change
    return small_study(**given)


def test_variants_on_same_base_share_information_bound():
    study = make_study(axes={"latitude_deg": [0.0, 50.0], "phi_u0_deg": [1.0, 30.0]})
    table = information_bound(study)
    assert table["variant_id"].to_pylist() == np.repeat(range(4), 2).tolist()
    assert table["time_s"].to_pylist() == [20.0, 60.0] * 4
    found = table["bound_u_arcmin"].to_numpy().reshape(2, 2, 2)
    np.testing.assert_array_equal(found[:, 0], found[:, 1])
    for latitude, own in zip((0.0, 50.0), found[:, 0], strict=True):
        place = earth.place(earth.wgs84(), latitude * DEG)
        closed = white_noise_bound(
            np.array([20.0, 60.0]),
            gyro_noise=0.1 * DEG_PER_H,
            accel_noise=500 * micro_g(),
            rate_hz=study.rate_hz,
            gravity=place.gravity,
            rate_n=place.rate_n,
        )
        np.testing.assert_allclose(own, closed / ARCMIN, rtol=0.03)


@pytest.mark.nightly
def test_surge_raises_information_bound_and_method_does_not_change_it():
    study = make_study(
        motion={"surge_time_s": 2.0},
        axes={"method": ["kalman5", "optimisation"], "surge_m_per_s": [0.0, 0.1]},
    )
    found = information_bound(study)["bound_u_arcmin"].to_numpy().reshape(2, 2, 2)
    np.testing.assert_array_equal(found[0], found[1])
    assert np.all(found[0, 1] > 2 * found[0, 0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensors": {"accel_noise_ug": 0.0}}, r"^\[sensors\] accel_noise_ug: the information"),
        ({"passes": {"stored_s": 20.0}}, r"^\[passes\]: repeated passes add no information"),
        (
            {"earth": {"latitude_deg": None}, "drawn": {"latitude_deg": {"uniform": [0.0, 60.0]}}},
            r"^\[earth\] latitude_deg: the information bound needs a fixed value",
        ),
        (
            {
                "sensors": {"gyro_bias_deg_per_h": None},
                "drawn": {"gyro_bias_deg_per_h": {"uniform": [-1.0, 1.0]}},
            },
            r"^\[drawn\] gyro_bias_deg_per_h: the information bound needs a fixed value or",
        ),
    ],
)
def test_information_bound_refuses_zero_noise_passes_and_drawn_latitude(changes, message):
    with pytest.raises(InputError, match=message):
        information_bound(make_study(**changes))


def drawn_study(**laws):
    """With drawn constant errors of the sensors."""
    drawn = {key: {"normal": [0.1, sigma]} for key, sigma in laws.items()}
    return make_study(sensors=dict.fromkeys(laws), drawn=drawn)


def test_fixed_biases_of_parked_base_do_not_change_bound():
    fixed = information_bound(make_study())["bound_u_arcmin"].to_pylist()
    unbiased = make_study(sensors={"gyro_bias_deg_per_h": 0.0, "accel_bias_ug": 0.0})
    assert fixed == information_bound(unbiased)["bound_u_arcmin"].to_pylist()


def test_drawn_biases_of_parked_base_add_bias_floor_as_sigma():
    place = earth.place(earth.wgs84(), 50 * DEG)
    found = information_bound(drawn_study(gyro_bias_deg_per_h=1.0, accel_bias_ug=5000.0))
    known = information_bound(make_study())["bound_u_arcmin"].to_numpy() * ARCMIN
    gyro, accel = 1.0 * DEG_PER_H / place.rate_n, 5000 * micro_g() / place.gravity
    level = np.sqrt(gyro**2 + (accel * place.tan_latitude) ** 2)
    expected = np.sqrt(known**2 + level**2) / ARCMIN
    np.testing.assert_allclose(found["bound_u_arcmin"].to_numpy(), expected, rtol=0.01)


def test_drawn_scale_and_cross_axis_errors_act_on_earth_rate_as_biases():
    place = earth.place(earth.wgs84(), 50 * DEG)
    level = {"gyro_noise_deg_per_h": 0.01, "accel_noise_ug": 10.0}
    drawn = {"gyro_misalignment_arcsec": {"normal": [0.0, 20000.0]}}
    study = make_study(
        motion={f"{angle}_amplitude_deg": 0.0 for angle in ("pitch", "roll", "yaw")}
        | {"yaw_center_deg": 0.0},
        sensors=level,
        drawn=drawn,
    )
    # The east gyro measures part of the north and of the up component of the Earth rate.
    sigma = 20000 * ARCMIN / 60 * np.hypot(1.0, place.rate_u / place.rate_n)
    found = information_bound(study)["bound_u_arcmin"].to_numpy()[-1]
    assert found == pytest.approx(sigma / ARCMIN, rel=0.02)


def test_surge_raises_bound_with_drawn_biases():
    drawn = {"gyro_bias_deg_per_h": {"normal": [0.0, 0.1]}}
    study = make_study(
        motion={"surge_time_s": 2.0},
        sensors={"gyro_bias_deg_per_h": None},
        drawn=drawn,
        axes={"surge_m_per_s": [0.0, 0.1]},
    )
    at_rest, surging = information_bound(study)["bound_u_arcmin"].to_numpy().reshape(2, 2)
    assert np.all(surging > 1.5 * at_rest)


def test_fixed_errors_of_turning_base_count_as_sigmas():
    turning = {"turn_times_s": [20.0]}
    fixed = make_study(motion=turning, sensors={"gyro_scale_ppm": -100.0, "accel_bias_ug": 0.0})
    drawn = make_study(
        motion=turning,
        sensors={"gyro_bias_deg_per_h": None, "accel_bias_ug": 0.0},
        drawn={
            "gyro_bias_deg_per_h": {"normal": [3.0, 1.0]},
            "gyro_scale_ppm": {"normal": [0.0, 100.0]},
        },
    )
    found, expected = (information_bound(s)["bound_u_arcmin"].to_pylist() for s in (fixed, drawn))
    assert found == expected


def test_turn_gets_under_bias_floor_and_swept_turns_have_their_own_bounds():
    study = make_study(
        motion={"turn_angles_deg": 180.0, "turn_rate_deg_per_s": 30.0},
        sensors={"gyro_noise_deg_per_h": 0.01, "accel_noise_ug": 50.0},
        axes={"turn_times_s": [[5.0], [27.0]]},
    )
    (_, early), (before, late) = information_bound(study)["bound_u_arcmin"].to_numpy().reshape(2, 2)
    floor = DEG_PER_H / earth.place(earth.wgs84(), 50 * DEG).rate_n / ARCMIN
    assert before > 0.95 * floor
    assert late < 0.3 * floor
    assert late < early
