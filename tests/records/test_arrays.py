"""Records from arrays: units, axes, dates, gaps, references, and one line per error."""

import contextlib
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from support.refusals import assert_refusal
from support.studies import STILL, small_study, small_tables

import sinsjax
from sinsjax.engine.scenario import start_samples
from sinsjax.errors import InputError
from sinsjax.execution.prepare import prepare_job
from sinsjax.records.layout import from_body_axes
from sinsjax.records.reference import Reference, StoredRecord
from sinsjax.study.load import study_from_dict

RATE, T = 100.0, 50
TIME = np.arange(1, T + 1) / RATE
RNG = np.random.default_rng(0)
GYRO = RNG.normal(scale=1e-3, size=(T, 3))  # rad/s, right-front-up
ACCEL = RNG.normal(scale=0.1, size=(T, 3)) + [0, 0, 9.8]  # m/s^2
G = 9.80665
GYROS = {
    "rad_per_s": 1.0,
    "deg_per_s": 180 / np.pi,
    "deg_per_h": 3600 * 180 / np.pi,
    "rad": 1 / RATE,
    "deg": 180 / np.pi / RATE,
    "arcsec": 3600 * 180 / np.pi / RATE,
}
ACCELS = {
    "m_per_s2": 1.0,
    "g": 1 / G,
    "mg": 1e3 / G,
    "ug": 1e6 / G,
    "m_per_s": 1 / RATE,
    "g_s": 1 / G / RATE,
    "ug_s": 1e6 / G / RATE,
}
PAIRS = [("deg_per_s", "g"), ("deg_per_h", "mg"), ("rad_per_s", "ug"), ("rad", "m_per_s")]
PAIRS += [("deg", "g_s"), ("arcsec", "ug_s")]
REFERENCE = {
    "time_s": [0.0, 10.0],
    "pitch_deg": [1.0, 1.0],
    "roll_deg": [2.0, 2.0],
    "heading_deg": [30.0, 30.0],
}


def make_record(time: Any = TIME, gyro: Any = GYRO, accel: Any = ACCEL, **more: Any) -> Any:
    return sinsjax.record_from_arrays(time, gyro, accel, **more)


def refusal_line(*given: Any, **more: Any) -> str:
    with pytest.raises(InputError) as caught:
        make_record(*given, **more)
    line = str(caught.value)
    assert line.isprintable()
    return line


@pytest.mark.parametrize(("gyro_unit", "accel_unit"), PAIRS)
@pytest.mark.parametrize(("axes", "order"), [("rfu", "xyz"), ("frd", "yx-z"), ("flu", "-yxz")])
def test_array_units_and_axes_are_converted(gyro_unit, accel_unit, axes, order):
    gyro, accel = (from_body_axes(values, order) for values in (GYRO, ACCEL))
    factors = GYROS[gyro_unit], ACCELS[accel_unit]
    units = {"gyro_unit": gyro_unit, "accel_unit": accel_unit, "axes": axes}
    before = gyro.copy()
    record = make_record(TIME, gyro * factors[0], accel * factors[1], **units).record
    assert record.rate_hz == RATE and record.t0_s == 0.0
    np.testing.assert_allclose(record.dtheta, GYRO / RATE, rtol=1e-12)
    np.testing.assert_allclose(record.dv, ACCEL / RATE, rtol=1e-12)
    assert (gyro == before).all()


def test_frd_and_flu_axes_map_to_right_front_up():
    """Of a box with x front, y right, z down; and of one with x front, y left, z up."""
    front, right, up = 1.0, 2.0, 3.0
    for axes, sensed in (("frd", [front, right, -up]), ("flu", [front, -right, up])):
        record = make_record(accel=np.tile(sensed, (T, 1)), axes=axes).record
        np.testing.assert_allclose(record.dv[0] * RATE, [right, front, up])


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_time_units_are_converted_to_seconds(unit):
    factor = {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    record = make_record((TIME + 5) * factor, time_unit=unit).record
    assert record.rate_hz == RATE and record.t0_s == pytest.approx(5.0)


def zoned_dates() -> dict[str, Any]:
    """The same dates with a zone in libraries that are there, and as plain objects."""
    stamps = 1_714_564_800_000_000_000 + 10_000_000 * np.arange(1, T + 1)
    found: dict[str, Any] = {
        "NumPy": stamps.astype("datetime64[ns]"),
        "Arrow": pa.array(stamps, pa.timestamp("ns", "Europe/Paris")),
        "datetime": [datetime.fromtimestamp(stamp * 1e-9, UTC) for stamp in stamps.tolist()],
    }
    with contextlib.suppress(ImportError):
        pandas = __import__("pandas")
        dates = pandas.to_datetime(pandas.Series(stamps)).dt.tz_localize("UTC")
        found["pandas"] = dates.dt.tz_convert("Asia/Kathmandu")
        found["pandas, objects"] = found["pandas"].astype(object)
    return found


@pytest.mark.parametrize("library", zoned_dates())
def test_dates_of_every_library_give_rate_and_start(library):
    record = make_record(zoned_dates()[library]).record
    assert record.rate_hz == pytest.approx(RATE) and record.t0_s == pytest.approx(1714564800.0)


def test_missing_date_is_missing_sample():
    dates: list[Any] = zoned_dates()["datetime"]
    dates[20] = None
    assert [flaw[:2] for flaw in make_record(dates).record.flaws] == [(20, 21)]
    dates[21] = "noon"
    assert refusal_line(dates).startswith("arrays: time: ")


def test_pandas_na_is_missing_sample():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(GYRO).astype(object)
    frame.iloc[10, 1] = pandas.NA
    for gyro in (frame, frame.to_numpy(), frame.astype("Float64")):
        (flaw,) = make_record(gyro=gyro).record.flaws
        assert flaw[:2] == (10, 11) and "row 10: column 'gyro[:, 1]'" in flaw.text
    times = pandas.Series(TIME).astype(object)
    times[10] = pandas.NA
    assert [flaw[:2] for flaw in make_record(times).record.flaws] == [(10, 11)]


def test_gaps_are_interpolated_or_reported_as_flaws():
    gyro = GYRO.copy()
    gyro[10] = np.nan
    record = make_record(gyro=gyro, max_gap_s=0.02).record
    assert record.filled == 1 and np.isfinite(record.dtheta).all()
    (flaw,) = make_record(gyro=gyro).record.flaws
    assert_refusal(flaw.text, "arrays: row 10: column 'gyro[:, 0]': empty 0.02")
    masked = np.ma.masked_invalid(gyro)
    assert make_record(gyro=masked).record.flaws[0].begin == 10
    late = np.delete(TIME, slice(20, 23))
    rest = (np.delete(values, slice(20, 23), axis=0) for values in (GYRO, ACCEL))
    assert make_record(late, *rest, max_gap_s=0.05).record.filled == 3


@pytest.mark.parametrize("library", ["pyarrow", "pandas", "polars"])
def test_tables_of_every_library_give_same_record(library):
    plain = make_record(reference=REFERENCE)
    module = pytest.importorskip(library)
    make = getattr(module, "table", None) or module.DataFrame
    reference = make(REFERENCE)
    assert make_record(reference=reference).reference.attitude_deg[0].tolist() == [1.0, 2.0, -30.0]
    if library != "pyarrow":
        columns = {f"{name}{k}": v for name, own in (("g", GYRO), ("a", ACCEL)) for k, v in
                   enumerate(own.T)}  # fmt: skip
        frame = module.DataFrame(columns | {"t": TIME})
        found = make_record(frame["t"], frame[["g0", "g1", "g2"]], frame[["a0", "a1", "a2"]])
        assert (found.record.dtheta == plain.record.dtheta).all()
        assert (found.record.dv == plain.record.dv).all()


def test_reference_times_become_relative_to_record_start():
    own = Reference(np.array([100.0, 110.0]), np.zeros((2, 3)), None)
    assert make_record(TIME + 100, reference=own).reference.time_s.tolist() == [0.0, 10.0]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"gyro": GYRO[:, :2]}, "gyro: (T, 3) 50"),
        ({"time": TIME[:-2]}, "time: 48 50"),
        ({"gyro": [[1, 2, 3], [1, "x", 3]]}, "row 1: column 'gyro[:, 1]': 'x'"),
        ({"time": ["x", *TIME[1:]]}, "row 0: column 'time': 'x'"),
        ({"time": None}, "rate_hz: required time"),
        ({"gyro": GYRO * 1e35}, "row 0: column 'gyro[:, 0]': range"),
        ({"time": TIME[::-1]}, "column 'time': row 1: backward 0.5 0.49"),
        ({"rate_hz": 50.0}, "column 'time' 100 rate_hz 50"),
        ({"axes": "yxz"}, "axes: 'yxz' left-handed"),
        ({"time_unit": "iso"}, "time_unit: 'iso'"),
        ({"reference": {"time_s": [0, 1]}}, "reference: column 'pitch_deg'"),
    ],
)
def test_invalid_array_input_raises_one_line_error(change, told):
    assert_refusal(refusal_line(**change), f"arrays: {told}")


@pytest.fixture(scope="module")
def drive_data() -> tuple[Any, Any]:
    """Return the sensor output of a base at rest for a minute, and its truth."""
    study = small_study(
        study={"duration_s": 60.0, "window_s": [30, 60]},
        motion=STILL,
        sensors={"gyro_bias_deg_per_h": 0.01, "accel_bias_ug": 50.0},
    )
    return study, sinsjax.simulated_record(study)


RECORDED = {
    "study": {"duration_s": 20.0, "window_s": [10, 20], "draws": None, "rate_hz": None},
    "motion": None,
    "sensors": None,
    "alignment": {"phi_e0_deg": 0.5, "phi_n0_deg": 0.5, "phi_u0_deg": 5.0},
    "coarse": {"coarse_method": "analytic", "coarse_duration_s": 20.0},
    "record": {"format": "arrays", "start_s": [0.0, 10.0]},
}


def recorded(**changes: Any) -> Any:
    tables = small_tables(**RECORDED)
    tables["study"] = {k: v for k, v in tables["study"].items() if v is not None}
    tables = {name: table for name, table in tables.items() if table is not None}
    for name, change in changes.items():
        tables[name] = tables[name] | change
    return study_from_dict(tables)


@pytest.mark.nightly
@pytest.mark.optimised(False)
def test_study_runs_on_arrays(drive_data):
    record = drive_data[1]
    time = 100 + np.arange(1, len(record.dv) + 1) / record.rate_hz
    gyro, accel = (from_body_axes(v * record.rate_hz, "yx-z") for v in (record.dtheta, record.dv))
    gyro = np.degrees(gyro)
    level = np.zeros(61)
    reference = {
        "time_s": np.arange(100.0, 161.0),
        "pitch_deg": level,
        "roll_deg": level,
        "yaw_deg": level + 10.0,
    }
    stored = sinsjax.record_from_arrays(
        time, gyro, accel, gyro_unit="deg_per_s", axes="frd", reference=reference
    )
    rows = sinsjax.run(recorded(), stored).summary.to_pylist()
    assert [row["start_s"] for row in rows] == [0.0, 10.0]
    plain = sinsjax.run(recorded(), StoredRecord(record, None)).summary.to_pylist()
    for row, other in zip(rows, plain, strict=True):
        assert row["yaw_deg"] == pytest.approx(other["yaw_deg"], abs=1e-6)
        assert row["phi_u_arcmin"] == pytest.approx(60 * (10 - row["yaw_deg"]), rel=0.01)
        assert abs(row["pitch_deg"]) < 0.1


@pytest.mark.parametrize(
    ("accel", "units", "named"),
    [
        (-1.0, {}, "axes"),
        (1.0, {"time_unit": "ns"}, "time_unit"),
    ],
    ids=["gravity down", "fast time"],
)
def test_wrong_sign_or_unit_is_refused(accel, units, named, drive_data):
    record = drive_data[1]
    times = np.arange(1, len(record.dv) + 1) / record.rate_hz
    rates = record.dtheta * record.rate_hz, accel * record.dv * record.rate_hz
    with pytest.raises(InputError, match=named):
        sinsjax.run(recorded(), sinsjax.record_from_arrays(times, *rates, **units))


def test_rounded_timestamps_keep_start_times(drive_data):
    record = drive_data[1]
    time = np.round(1e-9 + np.arange(1, len(record.dv) + 1) / record.rate_hz * (1 + 1e-9), 9)
    stored = sinsjax.record_from_arrays(
        time, record.dtheta * record.rate_hz, record.dv * record.rate_hz
    )
    assert stored.record.rate_hz != 100.0
    study = prepare_job(recorded(), record=stored).study
    assert start_samples(study, study.rate_hz).tolist() == [0, 1000]


def test_file_keys_are_refused_for_arrays():
    for key, value in (("gyro_unit", "rad"), ("axes_order", "frd"), ("time_column", "t")):
        with pytest.raises(InputError) as caught:
            recorded(record={key: value})
        assert_refusal(str(caught.value), f"study: [record] {key}: 'arrays'")
