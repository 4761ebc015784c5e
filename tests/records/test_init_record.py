"""`sinsjax init record --from LOG`: names tell, or the user is asked; nothing is guessed.

Most logs are of one body at rest: heading 35, pitch 1 and roll -2 deg at 48 deg of latitude.
"""

import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.record_files import from_body_axes
from support.refusals import assert_named, refusal_line
from support.studies import STILL, small_study
from support.turning_logs import turned_record

import sinsjax as package
from sinsjax.errors import InputError
from sinsjax.study.from_record import make_study_text

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]

RATE = 25.0
DEG = np.pi / 180
G = 9.80665
TIME = np.arange(1, 751) / RATE
XYZ = tuple("xyz")
GYROS, ACCELS = (tuple(f"{sensor}_{a}" for a in XYZ) for sensor in ("gyro", "accel"))
NAMES = ("time_s", *GYROS, *ACCELS)
UNITS = (NAMES[0], *(f"{n} [rad/s]" for n in GYROS), *(f"{n} [m/s^2]" for n in ACCELS))
TRUTH = (35.0, 1.0, -2.0)
Samples = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def body() -> Samples:
    """Rates (rad/s) and specific forces (m/s^2) of 30 s, right-front-up, good gyros."""
    study = small_study(
        study={"duration_s": 30.0, "rate_hz": RATE, "window_s": [15, 30]},
        earth={"earth": "wgs84", "latitude_deg": 48.0},
        motion=STILL | {"yaw_center_deg": -35.0, "pitch_center_deg": 1.0, "roll_center_deg": -2.0},
        sensors={
            "gyro_bias_deg_per_h": 0.01,
            "gyro_noise_deg_per_h": 0.05,
            "accel_bias_ug": 20.0,
            "accel_noise_ug": 20.0,
        },
    )
    record = package.simulated_record(study)
    return record.dtheta * RATE, record.dv * RATE


def mems(body: Samples) -> np.ndarray:
    """Rates of the same body by gyros that cannot find north, rad/s."""
    noise = np.random.default_rng(3).normal(size=body[0].shape)
    return body[0] + np.array([500.0, -800.0, 700.0]) * DEG / 3600 + 0.02 * DEG * noise


def in_axes(body: Samples, axes: str) -> Samples:
    return from_body_axes(body[0], axes), from_body_axes(body[1], axes)


def write(path: Path, columns: Sequence[np.ndarray], names: Sequence[str] = NAMES) -> Path:
    table = np.column_stack(columns)
    rows = [",".join("" if np.isnan(x) else f"{x:.15g}" for x in row) for row in table.tolist()]
    path.write_text("\n".join([*([",".join(names)] if names else ()), *rows]) + "\n")
    return path


def read_study(path: Path, **answers: Any) -> tuple[dict[str, Any], dict[str, str], list[str]]:
    """Return the study of a log, its open questions with their evidence, and its doubts."""
    given = {place.replace("__", "."): value for place, value in answers.items()}
    text = make_study_text(path, Path("its.toml"), given)
    found = re.findall(r"^# (DOUBT|QUESTION): (.*(?:\n#   .*)*)\n(\w*)", text, re.MULTILINE)
    said = [(kind, " ".join(words.replace("\n#  ", "").split()), key) for kind, words, key in found]
    questions = {key: words for kind, words, key in said if kind == "QUESTION"}
    return tomllib.loads(text), questions, [words for kind, words, _ in said if kind == "DOUBT"]


def align(path: Path, **answers: Any) -> dict[str, Any]:
    """Return the row of the study that is written for a log, with answers to its questions."""
    given = {"earth.latitude_deg": 48.0}
    given |= {place.replace("__", "."): value for place, value in answers.items()}
    config = path.with_suffix(".toml")
    config.write_text(make_study_text(path, config, given))
    (row,) = package.align(path, config, curves=False).summary.to_pylist()
    return row


def assert_truth(row: dict[str, Any]) -> None:
    assert (row["heading_deg"] - TRUTH[0] + 180) % 360 - 180 == pytest.approx(0, abs=1.5)
    assert (row["pitch_deg"], row["roll_deg"]) == pytest.approx(TRUTH[1:], abs=0.01)


# --- names that tell

CLEAN = {
    "VectorNav": ("frd", "Time [s]", 1, "AngularRate_@ [rad/s]", 1, "Accel_@ [m/s^2]", 1),
    "mg": ("flu", "t[ms]", 1e3, "gyro_@[deg/s]", DEG, "acc_@[mg]", 1e-3 * G),
    "EuRoC": ("flu", "timestamp [ns]", 1e9, "w_RS_S_@ [rad s^-1]", 1, "a_RS_S_@ [m s^-2]", 1),
    "m/sec2": ("flu", "Time", 1, "Gyro@[deg/s]", DEG, "Acc@[m/sec2]", 1),
    "MicroStrain": ("frd", "GPS TOW", 1, "@ Gyro [x8005]", 1, "@ Accel [x8004]", G),
    "ROS": ("flu", "header.stamp", 1e9, "angular_velocity.@", 1, "linear_acceleration.@", 1),
    "PX4": ("frd", "timestamp", 1e6, "gyro_rad[@]", 1, "accelerometer_m_s2[@]", 1),
    "deg/h and ug": ("flu", "t", 1, "w@ [deg/h]", DEG / 3600, "f@ [ug]", 1e-6 * G),
    "increments": ("flu", "time_s", 1, "dtheta_@ [deg]", DEG * RATE, "dv_@ [m/s]", RATE),
    "arcsec": ("flu", "time_s", 1, "DeltaAngle@ (arcsec)", DEG / 3600 * RATE, "DV@ (m/s)", RATE),
    "mixed": ("flu", "time_s", 1, "gyro_@ (rad/s)", 1, "dv_@ (m/s)", RATE),
    "units behind": ("flu", "time_ms", 1e3, "g@_dps", DEG, "a@_mps2", 1),
    "words of units": ("frd", "tow", 1e3, "gyro_@_rad_s", 1, "accel_@_m_s2", 1),
    "axes before": ("flu", "t", 1, "@_gyro_rad/s", 1, "@ Acc (m/s2)", 1),
}
"""Axes, and the name and unit of time, gyros and accelerometers."""


@pytest.mark.parametrize("name", CLEAN)
def test_logs_whose_names_tell_are_silent_and_read_in_body_axes(name, body, tmp_path):
    axes, time, to_time, gyro, rad_per_s, accel, m_per_s2 = CLEAN[name]
    rates, forces = in_axes(body, axes)
    letters = {"PX4": "012", "axes before": "123"}.get(name, "xyz")
    names = [pattern.replace("@", axis) for pattern in (gyro, accel) for axis in letters]
    attitude = np.tile([1.0, -2.0, -35.0], (len(TIME), 1))
    columns = [TIME * to_time, rates / rad_per_s, forces / m_per_s2, attitude]
    path = write(tmp_path / "log.csv", columns, [time, *names, "pitch", "roll", "yaw"])
    study, questions, doubts = read_study(path)
    assert ([*questions], doubts) == (["latitude_deg"], [])
    assert study["alignment"] == {"method": "inertial"}
    assert re.search(r"the gyros give 4[78]\.\d", questions["latitude_deg"])
    answered, *said = read_study(path, earth__latitude_deg=48.0)
    assert said == [{}, []]
    record = package.load_increments(package.study_from_dict(answered), path).record
    np.testing.assert_allclose(record.dtheta * RATE, body[0], rtol=1e-9)
    np.testing.assert_allclose(record.dv * RATE, body[1], rtol=1e-9)


def test_stated_unit_holds_and_gyros_without_north_level(body, sinsjax, tmp_path):
    """A suspicion never leads to another unit: 0.31 deg/s of bias is that, and not 19 deg/h."""
    names = [NAMES[0], *(f"{n} (rad/s)" for n in NAMES[1:4]), *(f"{n} (m/s2)" for n in NAMES[4:])]
    path = write(tmp_path / "log.csv", [TIME, mems(body), body[1]], [f"rfu_{n}" for n in names])
    study, questions, (doubt,) = read_study(path)
    assert [*questions] == ["latitude_deg"] and "hides Earth rate" in doubt
    assert "gyros give" not in questions["latitude_deg"]
    assert study["record"]["gyro_unit"] == "rad_per_s"
    assert study["alignment"] == {"method": "level"}
    row = align(path)
    sigma_deg = row["sigma_e_arcmin"] / 60
    assert row["sigma_e_arcmin"] == pytest.approx(17.2, abs=0.2)  # of 5,000 ug
    assert (row["pitch_deg"], row["roll_deg"]) == pytest.approx(TRUTH[1:], abs=sigma_deg)
    assert row["heading_deg"] is None and row["sigma_u_arcmin"] is None


# --- questions

ROS = tuple(f"{name}.{a}" for name in ("angular_velocity", "linear_acceleration") for a in XYZ)
DELTAS = tuple(f"delta_angle_{a}" for a in XYZ)
FREE = tuple("abcdef")


@pytest.mark.parametrize(
    ("names", "factors", "asked"),
    [
        (GYROS + ACCELS, (1, 1), {"gyro_unit": '"rad_per_s": mean rate 15'}),
        (DELTAS + ACCELS, (1 / RATE, 1), {"gyro_unit": '"arcsec": mean rate'}),
        (ROS, (1 / DEG, 1 / G), {"gyro_unit": "ROS writes m/s^2, but force in g"}),
        (GYROS + ACCELS, (131e3 / DEG, 16384 / G), {"accel_unit": "if these are counts, one is"}),
        (FREE, (1, 1), {"gyro_columns": "b 4.0", "accel_columns": "f 9.8", "gyro_unit": "open"}),
        ((), (1, 1), {"gyro_columns": "column_1 15.02", "accel_columns": "column_7 9.8"}),
        (UNITS[1:4] + tuple(f"accel_ned_{a}" for a in XYZ), (1, 1), {"accel_columns": "ned"}),
        (UNITS[1:] + ("gyro2_x", "gyro2_y", "gyro2_z"), (1, 1), {"gyro_columns": "gyro2_x"}),
        (tuple(f"frd_{n}" for n in UNITS[1:]), (1, 1), {"axes_order": "'frd'"}),
        (UNITS[1:4] + ("accel_x", "accel_neg_y", "accel_z"), (1, 1), {"accel_columns": "neg_y"}),
    ],
)  # fmt: skip
def test_what_names_do_not_tell_is_a_question(names, factors, asked, body, tmp_path):
    gyro, accel = (v * factor for v, factor in zip(body, factors, strict=True))
    columns = [TIME, gyro, accel, *([gyro] if len(names) > 6 else [])]
    path = write(tmp_path / "log.csv", columns, ("time_s", *names) if names else ())
    study, questions, _ = read_study(path, earth__latitude_deg=48.0)
    for key, evidence in asked.items():
        assert study["record"][key] == "?" and evidence in questions[key]
    assert {*questions} - {"gyro_unit", "accel_unit", "axes_order", "rate_hz"} <= {*asked}


def test_answered_log_gives_attitude(body, tmp_path):
    """A log of counts whose columns have no sensors' names."""
    columns = [TIME, body[0] * 131e3 / DEG, body[1] * 16384 / G]
    path = write(tmp_path / "log.csv", columns, ("time_s", *FREE))
    units = {"gyro_unit": "deg_per_s", "accel_unit": "g", "axes_order": "rfu"}
    scales = {"gyro_scale": 1 / 131e3, "accel_scale": 1 / 16384}
    answers = units | scales | {"gyro_columns": [*"abc"], "accel_columns": [*"def"]}
    assert_truth(align(path, **{f"record__{key}": value for key, value in answers.items()}))


def test_open_question_is_refused_until_answered(body, sinsjax, tmp_path):
    write(tmp_path / "log.csv", [TIME, mems(body), body[1]])
    code, told, error = sinsjax("init", "record", "--from", "log.csv")
    assert (code, error) == (0, "") and "gyro_unit" in told
    for command in (("validate", "log.toml"), ("align", "log.csv", "log.toml", "-o", "out")):
        code, _, error = sinsjax(*command)
        assert code == 2 and error.count("\n") == 2
        places = ("error: log.toml: [record] gyro_unit", "record.gyro_unit=VALUE")
        assert_named(error.splitlines()[1], *places)
        assert "[earth] latitude_deg: an open question" in error.splitlines()[0]
    answers = ("--set", "record.gyro_unit=rad_per_s", "--set", "earth.latitude_deg=48")
    code, _, error = sinsjax("align", "log.csv", "log.toml", "-o", "out", *answers)
    assert code == 2 and "hides Earth rate" in error and "method = 'level'" in error
    answers += ("--set", "alignment.method=level")
    code, told, error = sinsjax("align", "log.csv", "log.toml", "-o", "out", *answers)
    assert code == 0 and "hides Earth rate" in error and "Warning" not in told
    assert error.startswith("Warning: log.csv: 0 to ") and error.count("\n") == 1


def test_doubts_are_counted_in_their_file(body, sinsjax, tmp_path):
    write(tmp_path / "log.csv", [np.delete(v, 500, axis=0) for v in (TIME, *body)])
    printed = sinsjax("init", "record", "--from", "log.csv")[1]
    assert "log.toml has 1 line with # DOUBT to check." in printed


@pytest.mark.parametrize(
    ("column", "labels"),
    [("a", ("UncalAccel", "UncalGyro")), ("type", ("IMU", "GPS")), ("sensor_id", ("7.5", "1.5"))],
)
def test_rows_of_sensors_in_turn_are_refused_with_the_way_on(column, labels, tmp_path):
    rows = [f"{labels[k % 2]},{k},1,2,3,4,5,6" for k in range(100)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join([",".join([column, *NAMES]), *rows]))
    line = refusal_line(make_study_text, path, Path("x.toml"))
    assert_named(line, str(path), ", ".join(labels), "nearest stamp")


def test_increments_tell_their_unit_once_the_rate_is_known(body, tmp_path):
    names = [f"{n}_{a}" for n in ("dtheta", "dv") for a in XYZ]
    path = write(tmp_path / "log.csv", [v / RATE for v in in_axes(body, "flu")], names)
    study, questions, (doubt,) = read_study(path)
    assert {"rate_hz", "gyro_unit", "accel_unit"} <= {*questions} and "length is unknown" in doubt
    assert study["study"]["rate_hz"] == "?" and "Earth" not in questions["gyro_unit"]
    study, questions, doubts = read_study(path, study__rate_hz=RATE)
    assert [*questions] == ["latitude_deg", "gyro_unit"] and not doubts
    assert re.search(r'"rad": mean rate 15\S* deg/h, 1 times', questions["gyro_unit"])
    assert_truth(align(path, study__rate_hz=RATE, record__gyro_unit="rad"))


@pytest.mark.parametrize(
    ("time", "gyro", "accel", "told"),
    [
        (1.0, 0.0, 1.0, "has Earth rate been removed"),
        (1.0, 1.0, 0.0, "no axis is near the vertical"),
        (np.nan, 1.0, 1.0, "no column has times"),
        (0.0, 1.0, 1.0, "time repeats"),
        (1e-320, 1.0, 1.0, "time repeats"),
        (1e6, 1.0, 1.0, "named as s, but its steps"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_log_that_tells_nothing_is_a_question_or_a_line(time, gyro, accel, told, body, tmp_path):
    rates, forces = np.array(in_axes(body, "flu")) * [[[gyro]], [[accel]]]
    path = write(tmp_path / "log.csv", [TIME * time, rates, forces], UNITS)
    try:
        text = " ".join(make_study_text(path, Path("x.toml")).replace("\n#  ", "").split())
    except InputError as error:
        text = str(error)
    assert told in text and "gyros give" not in text


# --- the rest of the study


def test_longest_part_without_a_gap_is_aligned(body, tmp_path):
    table = np.column_stack([TIME, *in_axes(body, "flu")])
    table[400, 2] = np.nan
    path = write(tmp_path / "log.csv", [np.delete(table, [*range(100, 150)], axis=0)], UNITS)
    study, _, (gap, filled) = read_study(path, record__max_gap_s=0.08)
    assert study["record"]["start_s"] == [6.0] and "a gap at 25 Hz" in gap and "missing" in filled
    assert read_study(path)[0]["record"]["start_s"] == [17.0]


def test_largest_bias_of_a_turned_base_is_asked(tmp_path):
    """Nine static positions about the vertical: their means lack Earth rate, which turns show."""
    turns = tuple(30.0 * k for k in range(1, 9)), (40.0,) * 8, 10.0
    some = turned_record(turns, gyro_bias_deg_per_h=1200)
    time_s = np.arange(1, len(some.gyro) + 1) / some.rate_hz
    columns, names = [time_s, some.gyro, some.accel], [f"rfu_{name}" for name in UNITS]
    study, questions, (doubt,) = read_study(write(tmp_path / "log.csv", columns, names))
    assert study["alignment"]["method"] == "gravity_fit" and "turns by 3" in doubt
    assert {*questions} == {"latitude_deg", "fit_gyro_bias_deg_per_h"}
