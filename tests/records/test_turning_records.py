"""Records of a base that turns are told by its gyros, and keep their method."""

from functools import cache

import numpy as np
import pytest
from support.turning_logs import DEG, DEG_PER_H, EARTH_RATE, TURNS, G, Turned, turned_record

from sinsjax.records.checks import StationaryValues, check_stationary
from sinsjax.records.layout import Finding, Record, RecordLayout

LAYOUT = RecordLayout("csv", gyro_unit="rad_per_s", accel_unit="m_per_s2")
TURNED_DEG = {"one turn by 180": 180, "one turn by 90": 90, "four positions": 270}

simulated = cache(turned_record)


def found(some: Turned) -> list[Finding]:
    record = Record(some.gyro / some.rate_hz, some.accel / some.rate_hz, some.rate_hz)
    expected = StationaryValues(EARTH_RATE, 48 * DEG, G, gyro_bias_deg_per_h=10.0)
    return check_stationary(record, (0, len(record.dv)), LAYOUT, expected)


@pytest.mark.parametrize("bias_deg_per_h", [1.0, 1000.0])
@pytest.mark.parametrize("motion", TURNS)
def test_turned_base_is_reported_with_its_angle_and_may_find_north(motion, bias_deg_per_h):
    """The mean rate of two positions lacks Earth rate: they must not be levelled."""
    (one,) = found(simulated(motion, gyro_bias_deg_per_h=bias_deg_per_h))
    assert not one.is_certain and not one.hides_north
    turned_deg = float(one.text.split("turns by ")[1].split()[0])
    if motion in TURNED_DEG and bias_deg_per_h == 1.0:
        assert turned_deg == pytest.approx(TURNED_DEG[motion], abs=5)


def test_biases_of_parked_gyros_are_not_taken_for_turns():
    """A bias about the vertical looks like a turntable to the gyros alone."""
    parked = turned_record("parked", gyro_bias_deg_per_h=0.0, rate_hz=10.0)
    rng = np.random.default_rng(5)
    for _ in range(3):
        bias = 10 ** rng.uniform(2, 3.5) * np.array([0.1, 0.1, 1]) * rng.normal(size=3) * DEG_PER_H
        noise = 0.05 * DEG * rng.normal(size=parked.gyro.shape)
        (one,) = found(parked._replace(gyro=parked.gyro + bias + noise))
        assert one.hides_north and not one.is_certain
