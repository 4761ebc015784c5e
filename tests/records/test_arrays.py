"""Records from arrays of any library, and their impossible samples."""

from datetime import UTC, datetime
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from support.refusals import assert_named, assert_refusal, refusal_line

from sinsjax import record_from_arrays
from sinsjax.execution.prepare import prepare_job
from sinsjax.study.load import study_from_dict

RATE, T = 100.0, 3000
TIME = np.arange(1, T + 1) / RATE
RNG = np.random.default_rng(0)
GYRO = RNG.normal(scale=1e-5, size=(T, 3)) + [0, 5e-5, 5e-5]  # rad/s, right-front-up
ACCEL = RNG.normal(scale=1e-3, size=(T, 3)) + [0, 0, 9.8]  # m/s^2
STAMPS = 1_714_564_800_000_000_000 + 10_000_000 * np.arange(1, T + 1)  # ns
REFERENCE = {"time_s": [0, 10], "pitch_deg": [1, 1], "roll_deg": [2, 2], "heading_deg": [30, 30]}


@pytest.mark.parametrize(
    ("units", "rad_per_s", "m_per_s2"),
    [
        (("deg_per_s", "g"), np.pi / 180, 9.80665),
        (("deg_per_h", "mg"), np.pi / 180 / 3600, 9.80665e-3),
        (("arcsec", "m_per_s"), np.pi / 180 / 3600 * RATE, RATE),
    ],
)
def test_units_and_axes_of_arrays_are_converted(units, rad_per_s, m_per_s2):
    """Of a box with x front, y right, z down; and of one with x front, y left, z up."""
    front, right, up = 1.0, 2.0, 3.0
    for axes, sensed in (("frd", [front, right, -up]), ("flu", [front, -right, up])):
        vectors = (np.tile(np.array(sensed) / factor, (T, 1)) for factor in (rad_per_s, m_per_s2))
        given = {"axes": axes, "gyro_unit": units[0], "accel_unit": units[1]}
        record = record_from_arrays(TIME, *vectors, **given).record
        np.testing.assert_allclose(record.dtheta[0] * RATE, [right, front, up])
        np.testing.assert_allclose(record.dv[0] * RATE, [right, front, up])


def test_stamps_of_every_library_give_rate_and_start():
    pandas = pytest.importorskip("pandas")
    stamps = [
        STAMPS,
        pa.array(STAMPS, pa.timestamp("ns", "Europe/Paris")),
        [datetime.fromtimestamp(stamp * 1e-9, UTC) for stamp in STAMPS.tolist()],
        pandas.to_datetime(pandas.Series(STAMPS)).dt.tz_localize("UTC"),
    ]
    for time in stamps:
        record = record_from_arrays(time, GYRO, ACCEL, time_unit="ns").record
        assert (record.rate_hz, record.t0_s) == pytest.approx((RATE, 1714564800.0))


@pytest.mark.parametrize("library", ["pyarrow", "pandas", "polars"])
def test_tables_of_every_library_give_same_record(library):
    module = pytest.importorskip(library)
    make = getattr(module, "table", None) or module.DataFrame
    stored = record_from_arrays(TIME + 5, GYRO, ACCEL, reference=make(REFERENCE))
    assert stored.reference.time_s.tolist() == [-5.0, 5.0]  # from the record's start
    assert stored.reference.attitude_deg[0].tolist() == [1.0, 2.0, -30.0]
    if library != "pyarrow":
        columns = dict(zip(["gx", "gy", "gz"], GYRO.T, strict=True))
        found = record_from_arrays(TIME, module.DataFrame(columns), ACCEL)
        assert (found.record.dtheta == stored.record.dtheta).all()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"gyro": GYRO[:, :2]}, "gyro: (T, 3) 3000"),
        ({"time": TIME[:-2]}, "time 2998 3000"),
        ({"time": ["x", *TIME[1:]]}, "row 0: column 'time': 'x'"),
        ({"time": None}, "rate_hz: required"),
        ({"rate_hz": 50.0}, "column 'time' 100 rate_hz 50"),
        ({"reference": {"time_s": [0, 1]}}, "reference: yaw_deg heading_deg 'time_s'"),
    ],
)
def test_invalid_array_input_raises_one_line_error(change, told):
    given = {"time": TIME, "gyro": GYRO, "accel": ACCEL} | change
    assert_refusal(refusal_line(record_from_arrays, **given), f"arrays: {told}")


# Samples that are impossible at rest


def texts(gyro: Any = GYRO, accel: Any = ACCEL) -> list[str]:
    record = record_from_arrays(None, gyro, accel, rate_hz=RATE).record
    return [anomaly.text for anomaly in record.anomalies]


def test_samples_beyond_sensor_range_are_named_and_refused():
    gyro, accel = GYRO.copy(), ACCEL.copy()
    gyro[7, 2], accel[500:510, 0] = 50.0, -9999 * 9.80665
    (text,) = texts(gyro=gyro)
    assert_named(text, "rows 7 to 7: column 'gyro[:, 2]'", "50", "2865")
    assert not texts(accel=ACCEL * 100)  # the unit is wrong, which the mean reveals
    tables = {
        "study": {"duration_s": 10.0, "window_s": [0, 10]},
        "earth": {"earth": "wgs84", "latitude_deg": 45.0},
        "record": {"format": "arrays"},
        "coarse": {"coarse_duration_s": 10.0},
        "alignment": {"method": "inertial"},
    }
    study, stored = study_from_dict(tables), record_from_arrays(TIME, GYRO, accel)
    line = refusal_line(prepare_job, study, record=stored)
    place = "arrays: rows 500 to 509: column 'accel[:, 0]'"
    assert_named(line, place, "-98056.7", "-9999 g", "20 g")
    trusting = study.replace({"record.trust": True})
    assert "rows 500 to 509" in prepare_job(trusting, record=stored).warnings[0]
    later = study.replace({"record.start_s": [8.0]})  # they are not read
    assert not prepare_job(later, record=stored).warnings


@pytest.mark.parametrize(("count", "told"), [(100, ["rows 1000 to 1099"]), (99, [])])
def test_dead_and_stuck_channels_are_reported(count, told):
    gyro, accel = GYRO.copy(), ACCEL.copy()
    for values in (gyro, accel):
        values[1000 : 1000 + count] = values[1000]
    assert [text.partition(":")[0] for text in texts(gyro, accel)] == told
    assert not texts(gyro)  # one sensor of few counts may repeat itself
    gyro[:, 0] = 0.1
    assert_named(texts(gyro)[0], "constant in every row", "column 'gyro[:, 0]'")
