"""The limit of a filter without bias states, against its closed form."""

import math

import pytest
from support.studies import small_study

from docs.studies.loops.runs import limits_of


def test_bias_floor_matches_closed_form():
    study = small_study(motion={"yaw_center_deg": 0.0})
    found = limits_of(study)
    arcmin = math.pi / 180 / 60
    nabla, eps = 500e-6, math.radians(0.1) / 3600
    omega_n = math.radians(15.041067) / 3600 * math.cos(math.radians(32))
    assert found.e == pytest.approx(-nabla / arcmin) == pytest.approx(-1.71887, abs=1e-5)
    assert found.n == pytest.approx(nabla / arcmin)
    expected = (-eps / omega_n + nabla * math.tan(math.radians(32))) / arcmin
    assert found.u == pytest.approx(expected) == pytest.approx(-25.8769, abs=1e-4)
    assert limits_of(study, 15.0).gyro == pytest.approx(-27.02478, abs=1e-5)


def test_bias_floor_rotates_body_biases_to_navigation_frame():
    study = small_study(
        motion={"yaw_center_deg": 90.0},
        sensors={"gyro_bias_deg_per_h": [0.0, 0.1, 0.0], "accel_bias_ug": [300.0, 0.0, 0.0]},
    )
    found = limits_of(study)
    assert found.e == pytest.approx(-300e-6 / (math.pi / 10800))  # the right axis looks north
    assert found.n == pytest.approx(0.0, abs=1e-9)
    assert found.gyro > 0
