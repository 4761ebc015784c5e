"""Records of a base that turns are told by its gyros, and keep their method."""

from functools import cache

import numpy as np
import pytest
from support.turning_logs import DEG, DEG_PER_H, EARTH_RATE, TURNS, G, Turned, turned_record

from sinsjax.execution.prepare import prepare_job
from sinsjax.records.checks import StationaryValues, check_stationary
from sinsjax.records.layout import Finding, Record, RecordLayout
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict

LAYOUT = RecordLayout("csv", gyro_unit="rad_per_s", accel_unit="m_per_s2")
TURNED_DEG = {"one turn by 180": 180, "one turn by 90": 90, "four positions": 270}

simulated = cache(turned_record)


def as_record(some: Turned) -> Record:
    return Record(some.gyro / some.rate_hz, some.accel / some.rate_hz, some.rate_hz)


def found(some: Turned) -> list[Finding]:
    record = as_record(some)
    expected = StationaryValues(EARTH_RATE, 48 * DEG, G, gyro_bias_deg_per_h=10.0)
    return check_stationary(record, (0, len(record.dv)), LAYOUT, expected)


@pytest.mark.parametrize("bias_deg_per_h", [1.0, 1000.0])
@pytest.mark.parametrize("motion", TURNS)
def test_turned_base_is_reported_with_its_angle_and_may_find_north(motion, bias_deg_per_h):
    (one,) = found(simulated(motion, gyro_bias_deg_per_h=bias_deg_per_h))
    assert not one.is_certain and not one.hides_north
    turned_deg = float(one.text.split("turns by ")[1].split()[0])
    if motion in TURNED_DEG and bias_deg_per_h == 1.0:
        assert turned_deg == pytest.approx(TURNED_DEG[motion], abs=5)


@pytest.mark.parametrize("motion", ["one turn by 180", "one turn by 90"])
def test_two_position_record_keeps_its_method_and_is_not_levelled(motion):
    """The mean rate of two positions lacks Earth rate, which the turn between them shows."""
    tables = {
        "study": {"duration_s": 280.0, "record_interval_s": 2.0, "window_s": [0, 280]},
        "earth": {"earth": "wgs84", "latitude_deg": 48.0},
        "record": {"format": "arrays"},
        "coarse": {"coarse_duration_s": 20.0},
        "alignment": {"method": "gravity_fit"},
        "gravity_fit": {
            "fit_gyro_bias_deg_per_h": 10.0,
            "fit_gyro_arw_deg_per_sqrt_h": 0.02,
            "fit_accel_bias_ug": 500.0,
            "fit_accel_vrw_ug_per_sqrt_hz": 50.0,
        },
    }
    record = as_record(simulated(motion, gyro_bias_deg_per_h=8.0))
    job = prepare_job(study_from_dict(tables), record=StoredRecord(record, None))
    (line,) = job.warnings
    assert job.study.methods == ("gravity_fit",) and "the base turns by" in line


def test_biases_of_parked_gyros_are_not_taken_for_turns():
    """A bias about the vertical looks like a turntable to the gyros alone."""
    parked = turned_record("parked", gyro_bias_deg_per_h=0.0, rate_hz=10.0)
    rng = np.random.default_rng(5)
    for _ in range(3):
        bias = 10 ** rng.uniform(2, 3.5) * np.array([0.1, 0.1, 1]) * rng.normal(size=3) * DEG_PER_H
        noise = 0.05 * DEG * rng.normal(size=parked.gyro.shape)
        (one,) = found(parked._replace(gyro=parked.gyro + bias + noise))
        assert one.hides_north and not one.is_certain
