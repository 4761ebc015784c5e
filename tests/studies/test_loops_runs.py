import copy
import math

import numpy as np
import pytest
from support.studies import BASE, small_study

from docs.studies.loops.runs import bound_arcmin
from sinsjax.study.load import study_from_dict

COMPASS = {"alignment": {"method": "compass"}, "compass": {"level_time_s": 2.0}}


def compass_study(**changes):
    sections = COMPASS | {"passes": {"stored_s": 2.0}}
    for name, change in changes.items():
        sections[name] = sections.get(name, {}) | change
    return small_study(**sections)


def test_heading_bound_matches_closed_form():
    study = compass_study(
        earth={"gravity_m_per_s2": 9.8, "earth": "constants"},
        sensors={"gyro_noise_deg_per_h": 0.0, "accel_noise_ug": 500.0},
    )
    omega_n = math.radians(15.041067) / 3600 * math.cos(math.radians(32))
    sigma = math.sqrt(12 * (500e-6) ** 2 / 100 / np.array([80.0, 300.0])[0] ** 3) / omega_n
    found = bound_arcmin(study, [80.0, 300.0])
    assert found[0] == pytest.approx(math.degrees(sigma) * 60)
    assert found[0] / found[1] == pytest.approx((300 / 80) ** 1.5)


def test_heading_bound_agrees_for_density_and_per_sample_noise():
    per_sample = compass_study(sensors={"accel_noise_ug": 50.0})
    data = copy.deepcopy(BASE) | COMPASS | {"passes": {"stored_s": 2.0}}
    del data["sensors"]["accel_noise_ug"]
    data["sensors"]["accel_vrw_ug_per_sqrt_hz"] = 5.0  # at 100 Hz
    data["alignment"] = BASE["alignment"] | {"method": "compass"}
    density = study_from_dict(data)
    assert bound_arcmin(density, 80.0) == pytest.approx(bound_arcmin(per_sample, 80.0))


def test_heading_bound_uses_noise_of_axes_that_sense_heading():
    # Heading west: the right axis looks north, the front axis west.
    turned = {"yaw_center_deg": 90.0}
    quiet = {"gyro_noise_deg_per_h": [9.0, 0.0, 9.0], "accel_noise_ug": [1.0, 800.0, 800.0]}
    alike = {"gyro_noise_deg_per_h": 0.0, "accel_noise_ug": 1.0}
    found = bound_arcmin(compass_study(motion=turned, sensors=quiet), 80.0)
    assert found == pytest.approx(bound_arcmin(compass_study(sensors=alike), 80.0), rel=1e-6)
