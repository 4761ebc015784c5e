"""Out-of-range samples and stuck channels are reported with their rows."""

from typing import Any

import numpy as np
import pytest
from support.refusals import assert_named

import sinsjax
from sinsjax.errors import InputError
from sinsjax.execution.prepare import prepare_job
from sinsjax.records import Record, RecordLayout, read_csv, read_psins, write_csv, write_psins
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict

RATE, T = 100.0, 3000
RNG = np.random.default_rng(0)
GYRO = RNG.normal(scale=1e-5, size=(T, 3)) + [0, 5e-5, 5e-5]  # rad/s, right-front-up
ACCEL = RNG.normal(scale=1e-3, size=(T, 3)) + [0, 0, 9.8]  # m/s^2
NAMES = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
LAYOUT = RecordLayout(
    "csv",
    gyro_columns=NAMES[:3],
    accel_columns=NAMES[3:],
    gyro_unit="rad_per_s",
    accel_unit="g",
    rate_hz=RATE,
)


def make_record(gyro: Any = GYRO, accel: Any = ACCEL, **more: Any) -> StoredRecord:
    return sinsjax.record_from_arrays(None, gyro, accel, rate_hz=RATE, **more)


def texts(gyro: Any = GYRO, accel: Any = ACCEL, **more: Any) -> list[str]:
    return [odd.text for odd in make_record(gyro, accel, **more).record.anomalies]


def change_rows(values: np.ndarray, rows: Any, axis: Any, to: Any) -> np.ndarray:
    values = values.copy()
    values[rows, axis] = to
    return values


def study(**record: Any) -> Any:
    return study_from_dict(
        {
            "study": {"duration_s": 10.0, "window_s": [0, 10]},
            "earth": {"earth": "wgs84", "latitude_deg": 45.0},
            "record": {"format": "arrays", **record},
            "coarse": {"coarse_method": "analytic", "coarse_duration_s": 10.0},
            "alignment": {"method": "inertial"},
        }
    )


def test_samples_beyond_sensor_range_are_named_and_refused():
    accel = change_rows(ACCEL, slice(500, 510), 0, -9999 * 9.80665)
    accel[700, 1] = 250.0
    stored = make_record(accel=accel)
    with pytest.raises(InputError) as caught:
        prepare_job(study(), record=stored)
    place = "arrays: rows 500 to 509: column 'accel[:, 0]'"
    assert_named(str(caught.value), place, "-98056.7", "-9999 g", "20 g", "1")
    assert "rows 500 to 509" in prepare_job(study(trust=True), record=stored).warnings[0]
    assert not prepare_job(study(start_s=[8.0]), record=stored).warnings  # they are not read
    (text,) = texts(gyro=change_rows(GYRO, 7, 2, 50.0))
    assert_named(text, "row 7: column 'gyro[:, 2]'", "50", "2865")


def test_wrong_unit_is_not_reported_as_outlier():
    assert not texts(accel=ACCEL * 100) and not texts(gyro=GYRO * 206265 * 60)


def test_dead_and_stuck_channels_are_reported():
    (dead,) = texts(gyro=change_rows(GYRO, slice(None), 0, 0.0))
    assert "column 'gyro[:, 0]' is 0 " in dead
    gyro, accel = (change_rows(v, slice(1000, 1100), slice(3), v[1000]) for v in (GYRO, ACCEL))
    (stuck,) = texts(gyro, accel)
    assert stuck.startswith("rows 1000 to 1099: ")
    short = (change_rows(v, slice(1000, 1099), slice(3), v[1000]) for v in (GYRO, ACCEL))
    assert not texts(*short)
    assert not texts(gyro)  # one sensor of few counts may repeat itself
    assert len(texts(np.zeros((T, 3)), np.zeros((T, 3)) + 9.8)) == 1
    (warning,) = prepare_job(study(), record=make_record(gyro, accel)).warnings
    assert warning.startswith("arrays: rows 1000 to 1099: ")


def test_dead_gyro_that_hides_north_is_named_and_leaves_level():
    job = prepare_job(study(), record=make_record(change_rows(GYRO, slice(None), 0, 0.1)))
    dead, hidden = job.warnings
    assert "column 'gyro[:, 0]' is 0.1 " in dead and "hides Earth rate" in hidden
    assert job.study.methods == ("level",)


@pytest.mark.parametrize("trust", [False, True])
def test_stated_unit_holds_and_biased_gyros_leave_level(trust):
    """In deg/s these would nearly be Earth rate; trusted, they gave a roll of -7.8 deg for -2.3."""
    biased = GYRO + np.radians(np.array([500, -800, 700]) / 3600)
    job = prepare_job(study(trust=trust), record=make_record(biased))
    assert job.study.methods == ("level",)
    assert "hides Earth rate" in job.warnings[-1]


@pytest.mark.parametrize("unit", ["rad_per_s", "deg_per_h"])
def test_subtracted_mean_of_whole_log_is_reported(unit):
    """A sway that the log cuts short: over the part that is aligned the mean is not zero."""
    sway = 2e-4 * np.cos(np.arange(T)[:, None] / T * [3.0, 4.0, 5.0])
    sensed = GYRO + sway
    factor = 1.0 if unit == "rad_per_s" else 3600 * 180 / np.pi
    removed = np.round((sensed - sensed.mean(axis=0)) * factor, 9)
    removed[5, 1] = np.nan
    asks = "mean of each gyro over the whole log"
    stored = make_record(removed, gyro_unit=unit, max_gap_s=0.1)
    job = prepare_job(study(), record=stored)
    assert job.study.methods == ("level",) and asks in job.warnings[-1]
    for gyro in (sensed * factor, removed + [0, 0, 1e-5 * factor]):
        assert not texts(gyro, gyro_unit=unit, max_gap_s=0.1)


def test_reported_row_numbers_match_file_rows(tmp_path):
    accel = change_rows(ACCEL, 20, 2, 1e4)
    record = Record(GYRO / RATE, accel / RATE, RATE, latitude_deg=45.0, gravity_m_per_s2=9.8)
    write_csv(record, tmp_path / "a.csv", LAYOUT)
    (odd,) = read_csv(tmp_path / "a.csv", LAYOUT).anomalies
    assert (odd.begin, odd.end, odd.is_certain) == (20, 21, True)
    assert_named(odd.text, "row 22: column 'accel_z'", "1019.72", "1020 g")
    write_psins(record, tmp_path / "a.imu", gyro_scale_arcsec=1e-4, accel_scale_ug_s=1e-2)
    (odd,) = read_psins(tmp_path / "a.imu").anomalies
    rows = (tmp_path / "a.imu").read_text().splitlines()
    number = int(odd.text.split()[1].rstrip(":"))
    assert int(rows[number - 1].split()[5]) == max(int(row.split()[5]) for row in rows[-T:])
