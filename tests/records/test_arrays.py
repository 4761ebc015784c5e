"""Records from arrays of any library, and their impossible samples."""

from datetime import UTC, datetime
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from support.refusals import assert_named, assert_refusal

import sinsjax
from sinsjax.errors import InputError
from sinsjax.execution.prepare import prepare_job
from sinsjax.records.reference import Reference
from sinsjax.study.load import study_from_dict

RATE, T = 100.0, 3000
TIME = np.arange(1, T + 1) / RATE
RNG = np.random.default_rng(0)
GYRO = RNG.normal(scale=1e-5, size=(T, 3)) + [0, 5e-5, 5e-5]  # rad/s, right-front-up
ACCEL = RNG.normal(scale=1e-3, size=(T, 3)) + [0, 0, 9.8]  # m/s^2
STAMPS = 1_714_564_800_000_000_000 + 10_000_000 * np.arange(1, T + 1)  # ns
REFERENCE = {
    "time_s": [0.0, 10.0],
    "pitch_deg": [1.0, 1.0],
    "roll_deg": [2.0, 2.0],
    "heading_deg": [30.0, 30.0],
}


def make_record(time: Any = TIME, gyro: Any = GYRO, accel: Any = ACCEL, **more: Any) -> Any:
    return sinsjax.record_from_arrays(time, gyro, accel, **more)


def refusal_line(call: Any, *given: Any, **more: Any) -> str:
    with pytest.raises(InputError) as caught:
        call(*given, **more)
    line = str(caught.value)
    assert line.isprintable()
    return line


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
        record = make_record(
            TIME, *vectors, axes=axes, gyro_unit=units[0], accel_unit=units[1]
        ).record
        np.testing.assert_allclose(record.dtheta[0] * RATE, [right, front, up])
        np.testing.assert_allclose(record.dv[0] * RATE, [right, front, up])


def test_stamps_of_every_library_give_rate_and_start():
    pandas = pytest.importorskip("pandas")
    stamps = [
        STAMPS,
        STAMPS.astype("datetime64[ns]"),
        pa.array(STAMPS, pa.timestamp("ns", "Europe/Paris")),
        [datetime.fromtimestamp(stamp * 1e-9, UTC) for stamp in STAMPS.tolist()],
        pandas.to_datetime(pandas.Series(STAMPS)).dt.tz_localize("UTC"),
    ]
    for time in stamps:
        record = make_record(time, time_unit="ns").record
        assert record.rate_hz == pytest.approx(RATE)
        assert record.t0_s == pytest.approx(1714564800.0)


def test_missing_values_are_missing_samples():
    gyro = GYRO.copy()
    gyro[10] = np.nan
    for some in (gyro, np.ma.masked_invalid(gyro), gyro.astype(object)):
        (flaw,) = make_record(gyro=some).record.flaws
        assert_refusal(flaw.text, "arrays: row 10: column 'gyro[:, 0]': empty 0.02")
    record = make_record(gyro=gyro, max_gap_s=0.02).record
    assert record.filled == 1 and np.isfinite(record.dtheta).all()


@pytest.mark.parametrize("library", ["pyarrow", "pandas", "polars"])
def test_tables_of_every_library_give_same_record(library):
    module = pytest.importorskip(library)
    make = getattr(module, "table", None) or module.DataFrame
    stored = make_record(reference=make(REFERENCE))
    assert stored.reference.attitude_deg[0].tolist() == [1.0, 2.0, -30.0]
    if library != "pyarrow":
        columns = dict(zip(["gx", "gy", "gz"], GYRO.T, strict=True))
        found = make_record(gyro=module.DataFrame(columns))
        assert (found.record.dtheta == stored.record.dtheta).all()


def test_reference_times_become_relative_to_record_start():
    own = Reference(np.array([100.0, 110.0]), np.zeros((2, 3)), None)
    assert make_record(TIME + 100, reference=own).reference.time_s.tolist() == [0.0, 10.0]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"gyro": GYRO[:, :2]}, "gyro: (T, 3) 3000"),
        ({"time": TIME[:-2]}, "time 2998 3000"),
        ({"gyro": np.array([[1, 2, 3], [1, "x", 3]], object)}, "gyro: 'x'"),
        ({"time": ["x", *TIME[1:]]}, "row 0: column 'time': 'x'"),
        ({"time": None}, "rate_hz: required"),
        ({"gyro": GYRO * 1e37}, "row 0: column 'gyro[:, 0]': range"),
        ({"time": TIME[::-1]}, "column 'time': row 1: backward 30.0 29.99"),
        ({"rate_hz": 50.0}, "column 'time' 100 rate_hz 50"),
        ({"axes": "yxz"}, "axes_order: 'yxz' left-handed"),
        ({"reference": {}}, "reference: rows 0"),
        ({"reference": {"time_s": [0, 1]}}, "reference: yaw_deg heading_deg 'time_s'"),
    ],
)
def test_invalid_array_input_raises_one_line_error(change, told):
    assert_refusal(refusal_line(make_record, **change), f"arrays: {told}")


# Samples that are impossible at rest


def change_rows(values: np.ndarray, rows: Any, axis: Any, to: Any) -> np.ndarray:
    values = values.copy()
    values[rows, axis] = to
    return values


def texts(gyro: Any = GYRO, accel: Any = ACCEL, **more: Any) -> list[str]:
    record = make_record(None, gyro, accel, rate_hz=RATE, **more).record
    return [anomaly.text for anomaly in record.anomalies]


def study(**record: Any) -> Any:
    return study_from_dict(
        {
            "study": {"duration_s": 10.0, "window_s": [0, 10]},
            "earth": {"earth": "wgs84", "latitude_deg": 45.0},
            "record": {"format": "arrays", **record},
            "coarse": {"coarse_duration_s": 10.0},
            "alignment": {"method": "inertial"},
        }
    )


def test_samples_beyond_sensor_range_are_named_and_refused():
    accel = change_rows(ACCEL, slice(500, 510), 0, -9999 * 9.80665)
    stored = make_record(accel=accel)
    line = refusal_line(prepare_job, study(), record=stored)
    place = "arrays: rows 500 to 509: column 'accel[:, 0]'"
    assert_named(line, place, "-98056.7", "-9999 g", "20 g")
    assert "rows 500 to 509" in prepare_job(study(trust=True), record=stored).warnings[0]
    assert not prepare_job(study(start_s=[8.0]), record=stored).warnings  # they are not read
    (text,) = texts(gyro=change_rows(GYRO, 7, 2, 50.0))
    assert_named(text, "rows 7 to 7: column 'gyro[:, 2]'", "50", "2865")
    assert not texts(accel=ACCEL * 100)  # the unit is wrong, which the mean reveals


def test_dead_and_stuck_channels_are_reported():
    gyro, accel = (change_rows(v, slice(1000, 1100), slice(3), v[1000]) for v in (GYRO, ACCEL))
    (stuck,) = texts(gyro, accel)
    assert stuck.startswith("rows 1000 to 1099: ")
    short = (change_rows(v, slice(1000, 1099), slice(3), v[1000]) for v in (GYRO, ACCEL))
    assert not texts(*short)
    assert not texts(gyro)  # one sensor of few counts may repeat itself
    assert len(texts(np.zeros((T, 3)), np.zeros((T, 3)) + 9.8)) == 1
    job = prepare_job(study(), record=make_record(TIME, gyro, accel))
    assert job.warnings[0].startswith("arrays: rows 1000 to 1099: ")
    dead = make_record(gyro=change_rows(GYRO, slice(None), 0, 0.1))
    warnings = prepare_job(study(trust=True), record=dead).warnings
    assert "column 'gyro[:, 0]'" in warnings[0] and "hides Earth rate" in warnings[1]


def test_gyros_that_hide_north_are_refused_unless_trusted_or_not_needed():
    """In deg/s these would nearly be Earth rate."""
    biased = make_record(gyro=GYRO + np.radians(np.array([500, -800, 700]) / 3600))
    line = refusal_line(prepare_job, study(), record=biased)
    assert_named(line, "arrays: 0 to 20 s", "hides Earth rate", "method = 'level'", "trust = true")
    level = study().replace({"alignment.method": "level"})
    for some in (level, study(trust=True)):
        assert "hides Earth rate" in prepare_job(some, record=biased).warnings[-1]


def test_file_keys_are_refused_for_arrays():
    assert_refusal(refusal_line(study, gyro_unit="rad"), "study: [record] gyro_unit: 'arrays'")
