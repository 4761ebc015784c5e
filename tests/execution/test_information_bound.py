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
PLACE = earth.place(earth.wgs84(), 50 * DEG)


def tabulate(sensors=None, **changes):
    sensors = SENSORS | (sensors or {})
    study = small_study(study=STUDY, sensors=sensors, earth={"latitude_deg": 50.0}, **changes)
    return information_bound(study)


def bound_of(**changes):
    """The bounds of the study's variants at 20 s and 60 s, arcmin."""
    table = tabulate(**changes)
    variants = table.num_rows // 2
    assert table["variant_id"].to_pylist() == np.repeat(range(variants), 2).tolist()
    assert table["time_s"].to_pylist() == [20.0, 60.0] * variants
    return table["bound_u_arcmin"].to_numpy().reshape(variants, 2)


def test_variants_on_same_base_share_information_bound():
    found = bound_of(axes={"latitude_deg": [0.0, 50.0], "phi_u0_deg": [1.0, 30.0]})
    np.testing.assert_array_equal(found[::2], found[1::2])
    for latitude, own in zip((0.0, 50.0), found[::2], strict=True):
        place = earth.place(earth.wgs84(), latitude * DEG)
        closed = white_noise_bound(
            np.array([20.0, 60.0]),
            gyro_noise=0.1 * DEG_PER_H,
            accel_noise=500 * micro_g(),
            rate_hz=100.0,
            gravity=place.gravity,
            rate_n=place.rate_n,
        )
        np.testing.assert_allclose(own, closed / ARCMIN, rtol=0.03)


def test_information_bound_is_refused_where_it_is_unknown():
    key, drawn = "gyro_bias_deg_per_h", {"uniform": [-1.0, 1.0]}
    for changes, place in (
        ({"sensors": {"accel_noise_ug": 0.0}}, r"\[sensors\] accel_noise_ug"),
        ({"passes": {"stored_s": 20.0}}, r"\[passes\]"),
        ({"sensors": {key: None}, "drawn": {key: drawn}}, rf"\[drawn\] {key}"),
    ):
        with pytest.raises(InputError, match=f"^{place}: .* information"):
            tabulate(**changes)


def test_drawn_biases_of_parked_base_add_bias_floor_as_sigma():
    """Fixed ones do not matter, since the bound is measured from their bias floor."""
    known = bound_of()
    unbiased = {"gyro_bias_deg_per_h": 0.0, "accel_bias_ug": 0.0}
    np.testing.assert_array_equal(known, bound_of(sensors=unbiased))
    sigmas = {"gyro_bias_deg_per_h": 1.0, "accel_bias_ug": 5000.0}
    drawn = {key: {"normal": [0.1, sigma]} for key, sigma in sigmas.items()}
    gyro, accel = 1.0 * DEG_PER_H / PLACE.rate_n, 5000 * micro_g() / PLACE.gravity
    level = np.hypot(gyro, accel * PLACE.tan_latitude) / ARCMIN
    found = bound_of(sensors=dict.fromkeys(drawn), drawn=drawn)
    np.testing.assert_allclose(found, np.hypot(known, level), rtol=0.01)
