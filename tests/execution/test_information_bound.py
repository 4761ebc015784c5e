"""The information bound of a study, per variant, and the studies for which it is refused."""

import numpy as np
import pytest
from support.studies import small_study

from sinsjax.covariance import information as bounds
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
        closed = bounds.record_bound(
            np.array([20.0, 60.0]),
            gyro_noise=0.1 * DEG_PER_H,
            accel_noise=500 * micro_g(),
            rate_hz=study.rate_hz,
            gravity=place.gravity,
            rate_n=place.rate_n,
        )
        np.testing.assert_allclose(own, closed / ARCMIN, rtol=0.03)


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
    ],
)
def test_information_bound_refuses_zero_noise_passes_and_drawn_latitude(changes, message):
    with pytest.raises(InputError, match=message):
        information_bound(make_study(**changes))
