"""Doubts about a record are reported before its alignment, or the record is refused."""

import numpy as np
import pytest
from support.stored_results import report_text
from support.studies import STILL, recorded_study, small_study

import sinsjax
from sinsjax.errors import InputError, StudyWarning
from sinsjax.execution.prepare import iter_warnings_of_bands_below_noise, prepare_job
from sinsjax.records import Reference
from sinsjax.records.checks import StationaryValues, check_stationary
from sinsjax.records.reference import StoredRecord
from sinsjax.units import DEG, DEG_PER_H, micro_g

pytestmark = pytest.mark.optimised(False)

EARTH_RATE = 15.041067 * DEG_PER_H
UP = np.array([0, 0, EARTH_RATE * np.sin(32 * DEG)]) / 100
"""Vertical Earth rate of a sample at 32 N, rad."""


def simulate(motion):
    """A record of 200 s at 32 N with 0.1 deg/h and 500 ug."""
    study = small_study(study={"duration_s": 200.0, "window_s": [0, 200]}, motion=motion)
    return sinsjax.simulated_record(study)


@pytest.fixture(scope="module")
def still():
    return simulate(STILL)


@pytest.fixture(scope="module")
def swinging():
    return simulate({})


def found(record, *, gyro=10.0, latitude=32.0):
    expected = StationaryValues(EARTH_RATE, latitude * DEG, 9.8, gyro, 5000 * micro_g())
    return check_stationary(record, (0, 20_000), expected)


def test_plausible_record_has_no_findings(still, swinging):
    for record in (still, swinging, simulate(dict.fromkeys(STILL, 20.0))):
        assert not found(record) and not found(record, gyro=1.0)


def test_wrong_accelerometer_unit_is_refused_and_named(swinging):
    for factor, named in (
        (1 / 9.80665, "accelerometers' unit"),
        (9.80665, "9.81 times gravity"),
        (-1.0, "points down"),
    ):
        (first, *_) = found(swinging._replace(dv=swinging.dv * factor))
        assert first.is_certain and named in first.text
    turned = [v[:, [1, 0, 2]] * [1, 1, -1] for v in (swinging.dtheta, swinging.dv)]
    (first, *_) = found(swinging._replace(dtheta=turned[0], dv=turned[1]))
    assert first.is_certain and "'yx-z' for front-right-down" in first.text


@pytest.mark.parametrize(
    ("factor", "added", "options", "named", "hides_north"),
    [
        (1 / DEG, 0, {}, "57.6 times Earth rate", True),
        (1, -UP, {"gyro": 3.0}, "a gyro bias of 7.86 deg/h", False),
        (1, -2 * UP, {}, "vertical part has the wrong sign", True),
        # It would be Earth rate in other units, but not along the vertical.
        (1, [700 * DEG_PER_H / 100, 0, 0], {}, "hides Earth rate", True),
        (1, 0, {"latitude": 14.0}, "not 14:", False),
        (1, np.array([0, 4, 4]) * DEG_PER_H / 100, {"gyro": 1.0}, "a gyro bias of 5.7", False),
        # The latitude of so biased gyros is too uncertain to be named.
        (1, np.array([0, 4, 4]) * DEG_PER_H / 100, {"gyro": 1.0}, "times Earth rate: are", False),
    ],
)
def test_doubtful_gyros_are_named_with_the_likely_cause(
    still, factor, added, options, named, hides_north
):
    """Whether the unit or the gyros are wrong, level angles are right."""
    (one,) = found(still._replace(dtheta=still.dtheta * factor + added), **options)
    assert named in one.text and (one.is_certain, one.hides_north) == (False, hides_north)


LONG = {
    "study": {"duration_s": 30.0, "record_interval_s": 5.0, "window_s": [0, 30]},
    "coarse": {"coarse_duration_s": 60.0},
}


def test_hard_findings_are_refused_unless_record_is_trusted(swinging, tmp_path):
    stored = StoredRecord(swinging._replace(dv=-swinging.dv, source="drive.imu"), None)
    line = r"^drive.imu: 0 to 90 s: the specific force points down.*trust = true"
    with pytest.raises(InputError, match=line):
        sinsjax.run_into(recorded_study(**LONG), tmp_path / "out", stored)
    assert not (tmp_path / "out").exists()
    trusting = recorded_study(**LONG, record={"trust": True})
    assert "points down" in prepare_job(trusting, record=stored).warnings[0]


def test_doubts_are_listed_in_manifest_and_report(still, tmp_path):
    record = still._replace(dv=still.dv * 0.99, source="drive.imu", remarks=("3 missing",))
    with pytest.warns(StudyWarning):
        results = sinsjax.run_into(recorded_study(**LONG), tmp_path, StoredRecord(record, None))
    filled, light = results.manifest.warnings
    assert filled.startswith("drive.imu: 3 missing")
    assert light.startswith("drive.imu: 0 to 90 s: the mean specific force is 9.7")
    told = " ".join(report_text(tmp_path).split())
    assert f"Warning {filled}" in told and f"Warning {light}" in told


def test_data_after_to_s_are_not_used(swinging):
    stored = StoredRecord(swinging, None)
    study = recorded_study(**LONG, record={"from_s": 100.0, "to_s": 190.0})
    assert not prepare_job(study, record=stored).warnings
    with pytest.raises(InputError, match=r"needs data up to 191 s, but \[record\] to_s is 190"):
        prepare_job(study, {"record.from_s": 101.0}, stored)


def test_fractional_rate_and_late_clock_use_record_times(still):
    """Times are those of the record: 200 samples a record are 1.001 s."""
    rate = 199.8
    record = still._replace(rate_hz=rate, t0_s=1763000000.25)
    study = recorded_study(
        study={"duration_s": 5.0, "record_interval_s": 1.0, "window_s": [0, 5]},
        record={"start_s": [0.0, 2.0], "trust": True},
        coarse={"coarse_duration_s": 10.0},
        alignment={"feedback_interval_s": 0.1},
    )
    with pytest.warns(StudyWarning):
        made = sinsjax.run(study, StoredRecord(record, None), curves=True)
    times = made.curves["time_s"].to_pylist()[:4]
    np.testing.assert_allclose(times, 200 / rate * np.arange(1, 5), rtol=1e-9)
    starts = made.summary["start_s"].to_pylist()
    np.testing.assert_allclose(starts, [0, 400 / rate], rtol=1e-9)
    late = Reference(1000 + np.arange(21.0), np.zeros((21, 3)), "r.csv")
    with pytest.raises(InputError, match=r"covers 1763001000.25 to 1763001020.25 s, .* clocks dif"):
        sinsjax.run(study, StoredRecord(record, late))


TACTICAL = {
    "study": {"duration_s": 600.0, "window_s": [400, 600], "settle_bands_arcmin": [60, 10]},
    "sensors": {"gyro_noise_deg_per_h": None, "gyro_arw_deg_per_sqrt_h": 0.02},
}


@pytest.mark.parametrize(
    ("changes", "band"),
    [
        ({}, "10'"),
        ({"axes.gyro_arw_deg_per_sqrt_h": [0.02, 0.1]}, "10'"),
        ({"axes.gyro_arw_deg_per_sqrt_h": [0.02, 0.001]}, None),  # one of the variants reaches it
        ({"drawn.gyro_arw_deg_per_sqrt_h.uniform": [0.02, 0.1]}, None),
        ({"filter.p0_yaw_deg": 0.1}, None),  # the start knows the heading
    ],
)
def test_band_below_the_noise_of_the_sensors_is_warned_of(changes, band):
    lines = list(iter_warnings_of_bands_below_noise(small_study(**TACTICAL).replace(changes)))
    assert len(lines) == (band is not None)
    for line in lines:
        assert line.startswith(f"{band} cannot be reached reliably") and "in 600 s (29'," in line
