"""Logs as people write them, with their dirt: each becomes a study, or a line that says why not.

All are of one body at rest: heading 35, pitch 1 and roll -2 deg at 48 deg of latitude.
"""

import bz2
import gzip
import io
import lzma
import re
import tomllib
import zipfile
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from support.refusals import assert_named
from support.studies import STILL, small_study

import sinsjax as package
from sinsjax.errors import InputError
from sinsjax.records.evidence import _settled_by_physics as settled_by_physics
from sinsjax.records.layout import NAMED_AXES, from_body_axes
from sinsjax.study.from_record import make_study_text

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]

RATE = 25.0
DEG = np.pi / 180
G = 9.80665
TIME = np.arange(1, 751) / RATE
XYZ = tuple("xyz")
NAMES = ("time_s", *(f"gyro_{a}" for a in XYZ), *(f"accel_{a}" for a in XYZ))
UNITS = (NAMES[0], *(f"{n} [rad/s]" for n in NAMES[1:4]), *(f"{n} [m/s^2]" for n in NAMES[4:]))
TRUTH = (35.0, 1.0, -2.0)


@pytest.fixture(scope="module")
def body() -> tuple[np.ndarray, np.ndarray]:
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


def mems(body: tuple[np.ndarray, np.ndarray], bias_deg_per_s: float) -> np.ndarray:
    """Rates of the same body by gyros that cannot find north, rad/s."""
    rng = np.random.default_rng(3)
    bias = bias_deg_per_s * DEG * np.array([0.78, -0.52, 0.35])
    return body[0] + bias + 0.02 * DEG * rng.normal(size=body[0].shape)


def in_axes(body: tuple[np.ndarray, np.ndarray], axes: str) -> tuple[np.ndarray, np.ndarray]:
    order = NAMED_AXES[axes]
    return from_body_axes(body[0], order), from_body_axes(body[1], order)


def write(
    path: Path,
    columns: Sequence[np.ndarray],
    names: Sequence[str] = NAMES,
    *,
    mark: str = ",",
    before: str = "",
) -> Path:
    table = np.column_stack(columns)
    lines = [mark.join(f"{value:.15g}" for value in row) for row in table.tolist()]
    header = [mark.join(names)] if names else []
    path.write_text(before + "\n".join([*header, *lines]) + "\n")
    return path


def read_study(path: Path, **answers: Any) -> tuple[dict[str, Any], dict[str, str], list[str]]:
    """Return the study of a log, its open questions with their evidence, and its doubts."""
    given = {place.replace("__", "."): value for place, value in answers.items()}
    text = make_study_text(path, Path("its.toml"), given)
    found = re.findall(r"^# (DOUBT|QUESTION): (.*(?:\n#   .*)*)\n(\w*)", text, re.MULTILINE)
    said = [(kind, " ".join(words.replace("\n#  ", "").split()), key) for kind, words, key in found]
    questions = {key: words for kind, words, key in said if kind == "QUESTION"}
    return tomllib.loads(text), questions, [words for kind, words, _ in said if kind == "DOUBT"]


def align(path: Path, tmp_path: Path, **overrides: Any) -> dict[str, Any]:
    """Return the row of the study that is written for a log."""
    config = tmp_path / "its.toml"
    config.write_text(make_study_text(path, config))
    changes = {place.replace("__", "."): value for place, value in overrides.items()}
    (row,) = package.align(path, config, overrides=changes, curves=False).summary.to_pylist()
    return row


def assert_truth(row: dict[str, Any], *, heading_deg: float = 1.5, level_deg: float = 0.01) -> None:
    assert (row["heading_deg"] - TRUTH[0] + 180) % 360 - 180 == pytest.approx(0, abs=heading_deg)
    assert (row["pitch_deg"], row["roll_deg"]) == pytest.approx(TRUTH[1:], abs=level_deg)


def assert_body(study: dict[str, Any], path: Path, body: tuple[np.ndarray, np.ndarray]) -> None:
    """Check that a study reads the body's own rates and specific forces from a log."""
    record = package.load_increments(package.study_from_dict(study), path).record
    np.testing.assert_allclose(record.dtheta * RATE, body[0], rtol=1e-9)
    np.testing.assert_allclose(record.dv * RATE, body[1], rtol=1e-9)


# --- clean logs

MILLI = 1e-3
CLEAN = {
    "VectorNav": ("frd", "Time [s]", 1, "AngularRate_@ [rad/s]", 1, "Accel_@ [m/s^2]", 1),
    "ArduPilot": ("frd", "TimeUS", 1e6, "Gyr@", 1, "Acc@", 1),
    "Bosch": ("flu", "t[ms]", 1e3, "gyro_@[mdeg/s]", MILLI * DEG, "acc_@[mg]", MILLI * G),
    "EuRoC": ("flu", "timestamp [ns]", 1e9, "w_RS_S_@ [rad s^-1]", 1, "a_RS_S_@ [m s^-2]", 1),
    "m/sec2": ("flu", "Time", 1, "Gyro@[deg/s]", DEG, "Acc@[m/sec2]", 1),
    "MicroStrain": ("frd", "GPS TOW", 1, "@ Gyro [x8005]", 1, "@ Accel [x8004]", G),
    "Xsens": ("flu", "SampleTimeFine", 1e4, "Gyr_@", 1, "Acc_@", 1),
    "ROS": ("flu", "header.stamp", 1e9, "angular_velocity.@", 1, "linear_acceleration.@", 1),
    "deg/h and ug": ("flu", "t", 1e3, "w@ [deg/h]", DEG / 3600, "f@ [ug]", 1e-6 * G),
    "increments": ("flu", "time_s", 1, "dtheta_@ [deg]", DEG * RATE, "dv_@ [m/s]", RATE),
    "rates beside increments": ("flu", "time_s", 1, "gyro_@", 1, "dv_@", RATE),
    "no units": ("flu", "time", 1e6, "g@", 1, "a@", 1),
}
"""Axes, and the name and unit of time, gyros and accelerometers."""


def clean_logs(body: tuple[np.ndarray, np.ndarray], folder: Path) -> dict[str, Path]:
    """Write logs in the usual names and units, of which none needs a question."""
    logs: dict[str, tuple[list[np.ndarray], Sequence[str]]] = {}
    for name, (axes, time, to_time, gyro, rad_per_s, accel, m_per_s2) in CLEAN.items():
        g, a = in_axes(body, axes)
        names = [pattern.replace("@", axis) for pattern in (gyro, accel) for axis in "xyz"]
        logs[name] = [TIME * to_time, g / rad_per_s, a / m_per_s2], [time, *names]
    (gyro, accel), (frd, _), (flu, flu_accel) = body, in_axes(body, "frd"), in_axes(body, "flu")
    turns = [f"{turn}Rate (deg/s)" for turn in ("Roll", "Pitch", "Yaw")]
    ways = [f"acc_{way}" for way in ("right", "front", "up")]
    logs["roll rate"] = [TIME, gyro[:, [1, 0, 2]] / DEG, accel], ["time", *turns, *ways]
    frd_names = [f"gyro_{way}" for way in ("front", "right", "down")]
    logs["two orders"] = [TIME, frd, accel], ["time", *frd_names, *ways]
    logs["1 Hz"] = [np.arange(30) + 1.0, flu[::25], flu_accel[::25]], NAMES
    paths = {name: write(folder / f"{k}.csv", *log) for k, (name, log) in enumerate(logs.items())}
    plain = [TIME, flu, flu_accel]
    paths["commented"] = write(folder / "commented.csv", plain, (f"%{NAMES[0]}", *NAMES[1:]))
    paths["blanks"] = write(folder / "blanks.txt", plain, mark="   ")
    paths["slashes"] = write(folder / "tabs.txt", plain, mark="\t", before="// sensor: 3, ENU\n")
    paths["preamble"] = write(folder / "preamble.csv", plain, before="INFO\nMark=comma\n\nDATA\n")
    paths["units below"] = write(folder / "units.csv", [TIME, flu / DEG, flu_accel / G])
    first, *rows = paths["units below"].read_text().splitlines()
    paths["units below"].write_text("\n".join([first, "s,deg/s,deg/s,deg/s,g,g,g", *rows, ""]))
    return paths


FEW = ("VectorNav", "Bosch", "MicroStrain", "ROS", "increments", "roll rate", "two orders")


def test_clean_logs_are_read_in_body_axes_without_question_or_doubt(body, tmp_path):
    logs = clean_logs(body, tmp_path)
    for name in (*FEW, "preamble", "units below"):
        study, *said = read_study(logs[name])
        assert said == [{}, []], name
        assert_body(study, logs[name], body)


@pytest.mark.nightly
def test_clean_logs_give_attitude_without_question_or_doubt(body, tmp_path):
    logs = clean_logs(body, tmp_path)
    assert len(logs) == 20
    said = {name: read_study(path)[1:] for name, path in logs.items()}
    assert said == dict.fromkeys(logs, ({}, []))
    rows = {name: align(path, tmp_path) for name, path in logs.items()}
    for name, row in rows.items():
        assert_truth(row, heading_deg=3.0 if name == "1 Hz" else 1.5)


# --- units


@pytest.mark.nightly(fast=("1.0-1.0", "9.80665-0.017453292519943295"))
@pytest.mark.parametrize("unit", [1.0, DEG])
@pytest.mark.parametrize("accel_unit", [1.0, G])
def test_unit_of_mems_gyros_without_name_is_a_question(unit, accel_unit, body, tmp_path):
    for bias_deg_per_s in 0.31 * np.geomspace(0.1, 10, 6):
        gyro = mems(body, bias_deg_per_s)
        path = write(tmp_path / "log.csv", [TIME, gyro / unit, body[1] / accel_unit])
        study, questions, doubts = read_study(path)
        assert study["record"]["gyro_unit"] == "?"
        assert [*questions] == ["gyro_unit"]
        for name in ("rad_per_s", "deg_per_s", "deg_per_h"):
            assert re.search(rf'"{name}": mean rate \S+ deg/h', questions["gyro_unit"])
        assert study["earth"]["latitude_deg"] == 45.0 and len(doubts) == 1


def test_quiet_gyros_settle_their_unit_by_earth_rate_within_a_per_cent():
    """A mean rate that only comes near it in some unit settles nothing."""
    gyro, dv = np.ones((600, 3)), np.tile([0.0, 0.0, G / RATE], (600, 1))

    def unit(of_earth: float) -> str:
        ratio = {"rad_per_s": 206265 * of_earth, "deg_per_s": 3600 * of_earth}
        return settled_by_physics(
            gyro, dv, ratio | {"deg_per_h": of_earth}, "rad_per_s", has_dead=False, rate_hz=RATE
        )[0]

    assert unit(0.995) == unit(1.005) == "deg_per_h"
    assert {unit(of_earth) for of_earth in (0.7, 0.97, 1.03, 1.3)} == {""}


def test_open_question_is_refused_with_its_evidence_until_answered(body, sinsjax, tmp_path):
    write(tmp_path / "log.csv", [TIME, mems(body, 0.31), body[1]])
    code, told, error = sinsjax("init", "record", "--from", "log.csv")
    assert (code, error) == (0, "") and "gyro_unit" in told
    for command in (("validate", "log.toml"), ("align", "log.csv", "log.toml", "-o", "out")):
        code, _, error = sinsjax(*command)
        assert code == 2 and error.count("\n") == 1
        place = "error: log.toml: [record] gyro_unit"
        assert_named(error.strip(), place, "accelerometers", "record.gyro_unit=VALUE")
    answer = ("--set", "record.gyro_unit=rad_per_s")
    code, told, error = sinsjax("align", "log.csv", "log.toml", "-o", "out", *answer)
    assert code == 0 and "hides Earth rate" in error
    assert sinsjax("init", "record", "--from", "log.csv", "-o", "two.toml", *answer)[0] == 0
    study = tomllib.loads(Path("two.toml").read_text())
    assert study["record"]["gyro_unit"] == "rad_per_s"
    assert study["alignment"] == {"method": "level"}


def test_sways_settle_unit_of_gyros_that_cannot_find_north(tmp_path):
    study = small_study(
        study={"duration_s": 40.0, "rate_hz": RATE, "window_s": [15, 30]},
        motion={"pitch_amplitude_deg": 2.0, "roll_amplitude_deg": 2.0},
        sensors={"gyro_bias_deg_per_h": 2000.0},
    )
    record = package.simulated_record(study)
    for factor, unit in ((1.0, "rad_per_s"), (DEG, "deg_per_s")):
        gyro, time = record.dtheta * RATE / factor, np.arange(1, 1001) / RATE
        path = write(tmp_path / "log.csv", [time, gyro, record.dv * RATE])
        assert read_study(path)[0]["record"]["gyro_unit"] == unit


def test_counts_are_questions_about_their_scale(body, tmp_path):
    counts = [np.round(body[0] / DEG * 131 * 1e3), np.round(body[1] / G * 16384)]
    path = write(tmp_path / "log.csv", [TIME, *counts])
    study, questions, _ = read_study(path)
    assert [*questions] == ["gyro_scale", "accel_scale"]
    assert study["record"]["gyro_scale"] == study["record"]["accel_scale"] == "?"
    assert "As rates, 6.1" in questions["accel_scale"] and "131" in questions["gyro_scale"]
    row = align(
        path,
        tmp_path,
        record__gyro_scale=1 / 131e3,
        record__accel_scale=1 / 16384,
        record__gyro_unit="deg_per_s",
        record__axes_order="rfu",
        earth__latitude_deg=48.0,
    )
    assert_truth(row, level_deg=0.05)


NOVATEL = "%RAWIMUSXA,2000,{t:.3f};00,26,2000,{t:.9f},00801503,{az},{ay},{ax},{gz},{gy},{gx}*0f\n"


def test_novatel_counts_are_read_in_axes_of_their_names(body, tmp_path):
    """Accelerometers first, in the order z, -y, x."""
    gyro, accel = np.round(body[0] / RATE / 1e-10), np.round(body[1] / RATE / 2e-8)
    fields = [
        NOVATEL.format(
            t=3e5 + t, az=f"{a[2]:.0f}", ay=f"{-a[1]:.0f}", ax=f"{a[0]:.0f}",
            gz=f"{g[2]:.0f}", gy=f"{-g[1]:.0f}", gx=f"{g[0]:.0f}",
        )
        for t, g, a in zip(TIME, gyro, accel, strict=True)
    ]  # fmt: skip
    path = tmp_path / "raw.txt"
    path.write_text("".join(fields))
    _, questions, _ = read_study(path)
    assert [*questions] == ["gyro_scale", "accel_scale"]
    count = re.search(r"As increments, (\S+) m/s per sample a count", questions["accel_scale"])
    assert count and float(count[1]) == pytest.approx(2e-8, rel=1e-3)
    scales = {"record__gyro_scale": 1e-10, "record__accel_scale": 2e-8}
    row = align(path, tmp_path, **scales, record__axes_order="rfu", earth__latitude_deg=48.0)
    assert_truth(row)


def test_wrong_scale_of_good_gyros_is_doubted_unless_their_bias_is_given(body, tmp_path):
    gyro, accel = in_axes(body, "flu")
    for factor, bias in ((0.5, "7.5"), (1.4, "6.0")):
        path = write(tmp_path / "log.csv", [TIME, factor * gyro, accel], UNITS)
        latitude, scale = read_study(path)[2]
        assert f"{factor} times Earth rate" in scale and f"bias of {bias}" in scale
        study, _, doubts = read_study(path, record__gyro_bias_deg_per_h=8.0)
        assert study["record"]["gyro_bias_deg_per_h"] == 8.0 and doubts == [latitude]


# --- columns and axes


def test_accelerometers_with_gravity_are_chosen_among_several(body, tmp_path):
    gyro, accel = in_axes(body, "flu")
    names = [
        f"{sensor}_{axis}" for sensor in ("Accelerometer", "Gyroscope", "Total") for axis in XYZ
    ]
    names = ["seconds_elapsed", *(n.replace("Total", "TotalAcceleration") for n in names)]
    path = write(tmp_path / "log.csv", [TIME, accel - accel.mean(axis=0), gyro, accel], names)
    study, *said = read_study(path)
    assert said == [{}, []]
    assert_body(study, path, body)
    path = write(tmp_path / "log.csv", [TIME, gyro, accel - accel.mean(axis=0)])
    study, questions, _ = read_study(path)
    assert study["record"]["accel_columns"] == "?"
    assert "gravity" in questions["accel_columns"]


@pytest.mark.parametrize(
    ("names", "named"),
    [
        (tuple("abcdefg"), "a 15.02"),
        (("t", "roll_rate", "pitch_rate", "spare", *NAMES[4:]), "yaw"),
        (("t", "gyro_F", "gyro_R", "spare", *NAMES[4:]), "up or down"),
        ((), "column_1 15.02"),
    ],
)
def test_unknown_columns_are_a_question_and_can_be_named(names, named, body, tmp_path):
    path = write(tmp_path / "log.csv", [TIME, *in_axes(body, "flu")], names)
    study, questions, _ = read_study(path)
    assert study["record"]["gyro_columns"] == study["record"]["gyro_unit"] == "?"
    assert named in questions["gyro_columns"]
    used = list(names) or [f"column_{k}" for k in range(1, 8)]
    answers = {"record__gyro_columns": used[1:4], "record__accel_columns": used[4:]}
    study, questions, _ = read_study(path, **answers)
    assert not questions and study["record"]["gyro_unit"] == "rad_per_s"
    assert study["record"]["gyro_columns"] == used[1:4]


def test_file_without_names_takes_those_of_the_study(body, tmp_path):
    before = "a,b\n3,4,5,6,7,8,9\n"
    path = write(tmp_path / "log.csv", [TIME, *in_axes(body, "flu")], (), before=before)
    shape = {"record__columns": list(NAMES), "record__skip_rows": 2}
    study, questions, doubts = read_study(path, **shape)
    assert (questions, doubts) == ({}, [])
    assert (study["record"]["columns"], study["record"]["skip_rows"]) == ([*NAMES], 2)
    config = tmp_path / "its.toml"
    answers = {place.replace("__", "."): value for place, value in shape.items()}
    config.write_text(make_study_text(path, config, answers))
    (row,) = package.align(path, config).summary.to_pylist()
    assert_truth(row)


def test_names_that_contradict_gravity_are_a_question(body, tmp_path):
    names = ("t", *(f"frd_{n}" for n in NAMES[1:]))
    study, questions, doubts = read_study(write(tmp_path / "log.csv", [TIME, *body], names))
    assert study["record"]["axes_order"] == "?" and not doubts
    assert "'frd'" in questions["axes_order"] and "+1.00 g" in questions["axes_order"]


def test_mounting_gives_attitude_of_the_vehicle(body, sinsjax, tmp_path):
    """A box that is turned by yaw 90 deg in the vehicle: its front points left."""
    turned = [v @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) for v in body]
    path = write(tmp_path / "log.csv", [TIME, *turned], [f"rfu_{n}" for n in NAMES])
    row = align(path, tmp_path, record__mounting_deg=(0.0, 0.0, 90.0))
    assert_truth(row)
    set_mounting = ("--set", "record.mounting_deg=[0, 0, 90]")
    code, told, _ = sinsjax("align", "log.csv", "its.toml", "-o", "out", *set_mounting)
    assert code == 0 and re.search(r"heading 3[456]\.\d+ deg of the vehicle, ", told)
    code, told, _ = sinsjax("align", "log.csv", "its.toml", "-o", "box")
    assert code == 0 and re.search(r"heading 30[456]\.\d+ deg of \+y, ", told)


# --- clocks


def test_clocks_of_all_kinds_give_the_rate(body, tmp_path):
    seconds = np.floor(TIME) + 1.6e9
    nanoseconds = np.round((TIME - np.floor(TIME)) * 1e9)
    bursts = 1.6e9 + np.ceil(TIME / 0.2) * 0.2 + np.arange(len(TIME)) % 5 * 1e-4
    stamps: dict[str, tuple[list[np.ndarray], list[str]]] = {
        "joined": ([seconds, nanoseconds], ["stamp.secs", "stamp.nsecs"]),
        "joined, of another name": ([seconds, nanoseconds / 1e3], ["tv_sec", "tv_usec"]),
        "best of two": ([bursts * 1e9, (1.6e9 + TIME) * 1e9], ["time", "header.stamp"]),
    }
    for name, (columns, names) in stamps.items():
        path = write(tmp_path / "log.csv", [*columns, *in_axes(body, "flu")], [*names, *NAMES[1:]])
        study, questions, doubts = read_study(path)
        assert (study["study"]["rate_hz"], questions, doubts) == (RATE, {}, []), name
        assert study["record"].get("time_fraction_column") == (
            names[1] if "joined" in name else None
        )
        assert_body(study, path, body)
    assert study["record"]["time_column"] == "header.stamp"


def test_times_of_day_may_pass_midnight(body, tmp_path):
    clock = np.datetime64("2020-01-01T23:59:50", "ms") + (TIME * 1e3).astype("timedelta64[ms]")
    path = write(tmp_path / "log.csv", [TIME, *in_axes(body, "flu")], ("UTC time", *NAMES[1:]))
    header, *rows = path.read_text().splitlines()
    rows = [f"{str(t)[11:]},{row.partition(',')[2]}" for t, row in zip(clock, rows, strict=True)]
    path.write_text("\n".join([header, *rows, ""]))
    study, questions, doubts = read_study(path)
    assert (study["record"]["time_unit"], questions, doubts) == ("iso", {}, [])
    assert_truth(align(path, tmp_path))


@pytest.mark.parametrize("form", ["%d.%m.%Y %H:%M:%S,%f", "%m/%d/%Y %H:%M:%S.%f"])
def test_day_first_dates_are_read_and_other_ones_named(form, body, tmp_path):
    path = write(
        tmp_path / "log.csv", [TIME, *in_axes(body, "flu")], ("Zeit", *NAMES[1:]), mark=";"
    )
    header, *rows = path.read_text().splitlines()
    start = datetime(2026, 3, 11, 9, 35, 12)
    stamps = [f"{start + timedelta(seconds=time_s):{form}}" for time_s in TIME]
    rows = [f"{t};{row.partition(';')[2]}" for t, row in zip(stamps, rows, strict=True)]
    path.write_text("\n".join([header, *(row.replace(".", ",") for row in rows), ""]))
    if "," in form:
        path.write_text("\n".join([header, *rows, ""]))
        study, questions, doubts = read_study(path)
        assert (study["record"]["time_unit"], questions, doubts) == ("iso", {}, [])
        record = package.load_increments(make_study(path, tmp_path), path).record
        assert record.t0_s == pytest.approx(start.replace(tzinfo=UTC).timestamp(), abs=1e-6)
    else:
        question = read_study(path)[1]["rate_hz"]
        assert_named(question, "row 2: column 'Zeit'", "'03/11/2026 09:35:12.040000'")


@pytest.mark.parametrize("kind", ["bursts", "every second stamp late"])
def test_stamps_that_cannot_be_read_give_mean_rate_with_doubt(kind, body, tmp_path):
    late = 0.64 / RATE * (np.arange(len(TIME)) % 2)
    if kind == "bursts":
        late = np.ceil(TIME / 0.2) * 0.2 + np.arange(len(TIME)) % 5 * 1e-4 - TIME
    path = write(tmp_path / "log.csv", [1.6e9 + TIME + late, *in_axes(body, "flu")])
    study, questions, (doubt,) = read_study(path)
    assert study["study"]["rate_hz"] == RATE and not questions
    assert "uneven" in doubt and "time_column" not in study["record"]
    assert_body(study, path, body)


@pytest.mark.nightly(fast=("repeated1",))
@pytest.mark.parametrize("repeated", [[300], list(range(10, 700, 20))])
def test_repeated_rows_are_left_out_and_counted(repeated, body, tmp_path):
    table = np.column_stack([TIME, *in_axes(body, "flu")])
    path = write(tmp_path / "log.csv", [np.insert(table, repeated, table[repeated], axis=0)])
    study, questions, (doubt,) = read_study(path)
    assert study["study"]["rate_hz"] == RATE and not questions
    assert f"row {repeated[0] + 3} " in doubt and ("35 rows" in doubt) == (len(repeated) == 35)
    assert_body(study, path, body)


# --- containers and damage


def pack(path: Path, kind: str) -> Path:
    data, packed = path.read_bytes(), path.with_name(f"log.{kind}")
    if kind == "zip":
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            archive.writestr("folder/log.csv", data)
        packed.write_bytes(buffer.getvalue())
    else:
        compress = {"gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress}
        encode = {"utf16": lambda b: b.decode().encode("utf-16")} | compress
        packed.write_bytes(encode[kind](data))
    return packed


@pytest.mark.parametrize("kind", ["gz", "bz2", "xz", "zip", "utf16"])
def test_packed_and_utf16_logs_are_read(kind, body, tmp_path):
    path = pack(write(tmp_path / "log.csv", [TIME, *in_axes(body, "flu")]), kind)
    study, *said = read_study(path)
    assert said == [{}, []]
    assert_body(study, path, body)


def test_cp1252_logs_are_read_like_utf8(body, tmp_path):
    gyro, accel = in_axes(body, "flu")
    names = ["t", *(f"Gyro {a} [°/h]" for a in XYZ), *(f"Acc {a} [m/s²]" for a in XYZ)]
    path = write(tmp_path / "log.csv", [TIME, gyro / DEG * 3600, accel], names)
    utf8 = read_study(path)
    path.write_bytes(path.read_text("utf-8").encode("cp1252"))
    assert read_study(path) == utf8 and utf8[1:] == ({}, [])
    assert utf8[0]["record"]["gyro_unit"] == "deg_per_h"
    assert len(package.load_increments(make_study(path, tmp_path), path).record.dv) == len(TIME)


def refusal(path: Path) -> str:
    """Return the line that a log is refused with, without its path, which begins it."""
    with pytest.raises(InputError) as caught:
        make_study_text(path, Path("x.toml"))
    line = str(caught.value)
    assert line.startswith(f"{path}: ") and "\n" not in line
    return line.removeprefix(f"{path}: ")


def test_other_formats_are_named(tmp_path):
    for content, named in (
        (b"MATLAB 5.0 MAT-file, Platform", "MATLAB"),
        (b"\x93NUMPY\x01\x00", "NumPy"),
        (b"#ROSBAG V2.0\n", "ROS bag"),
        (b"PK\x03\x04", "archive"),
        (gzip.compress(b"t,gx,gy\n" * 999)[:40], "archive"),
    ):
        (tmp_path / "log.bin").write_bytes(content)
        assert named in refusal(tmp_path / "log.bin")


def test_archive_of_several_files_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "log.zip", "w") as archive:
        archive.writestr("a.csv", "1")
        archive.writestr("b.csv", "2")
    assert "2 files" in refusal(tmp_path / "log.zip")


def test_digits_of_other_scripts_are_no_numbers(body, tmp_path):
    path = write(tmp_path / "log.csv", [TIME, *in_axes(body, "flu")])
    lines = path.read_text().splitlines()
    lines[400] = lines[400][:-1] + "\uff15"
    path.write_text("\n".join([*lines, ""]))
    assert_named(refusal(path), "row 401: column 'accel_z'", "number")


@pytest.mark.parametrize("cut", [8, 12, 60])
def test_row_that_is_cut_off_is_left_out(cut, body, tmp_path):
    path = write(tmp_path / "log.csv", [TIME, *(np.round(v, 9) for v in in_axes(body, "flu"))])
    path.write_bytes(path.read_bytes()[:-cut])
    _, questions, doubts = read_study(path)
    assert not questions and len(doubts) == 1 and "row 751" in doubts[0]
    record = package.load_increments(make_study(path, tmp_path), path).record
    assert len(record.dv) == len(TIME) - 1


def make_study(path: Path, tmp_path: Path) -> Path:
    config = tmp_path / "its.toml"
    config.write_text(make_study_text(path, config))
    return config


def test_decimal_commas_and_delimiters_at_line_ends_are_read(body, tmp_path):
    path = write(tmp_path / "log.csv", [TIME, *in_axes(body, "flu")], mark=";")
    header, *rows = path.read_text().splitlines()
    for text in (
        "\n".join([header, *(row.replace(".", ",") for row in rows), ""]),
        "\r\n".join([header, *(f"{row};" for row in rows), ""]),
        "\n".join([f"{header};", *(f"{row.replace('.', ',')};" for row in rows), ""]),
    ):
        path.write_text(text, newline="")
        study, *said = read_study(path)
        assert said == [{}, []]
        assert_body(study, path, body)


TURN_BY_90 = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def two_sensors(
    body: tuple[np.ndarray, np.ndarray], block: int, turn: np.ndarray = TURN_BY_90
) -> tuple[list[np.ndarray], np.ndarray]:
    """Return columns at twice the rate with blocks of rows of one sensor and of another."""
    is_second = np.arange(2 * len(TIME)) // block % 2 == 1
    both = [np.repeat(v, 2, axis=0) for v in in_axes(body, "flu")]
    time = np.arange(1, 2 * len(TIME) + 1) / (2 * RATE)
    return [time, *(np.where(is_second[:, None], v @ turn, v) for v in both)], is_second


@pytest.mark.nightly(fast=("unit-texts0-1", "node-texts1-10"))
@pytest.mark.parametrize("block", [1, 10])
@pytest.mark.parametrize(("name", "texts"), [("unit", ("left", "right")), ("node", ("7", "9"))])
def test_rows_of_two_sensors_by_any_label_are_refused(name, texts, block, body, tmp_path):
    columns, is_second = two_sensors(body, block)
    path = write(tmp_path / "log.csv", columns, UNITS)
    header, *rows = path.read_text().splitlines()
    rows = [f"{texts[k]},{row}" for k, row in zip(is_second.astype(int), rows, strict=True)]
    path.write_text("\n".join([f"{name},{header}", *rows, ""]))
    named = f"column '{name}' is {', '.join(texts)}, "
    assert named in refusal(path)
    pq.write_table(pa.csv.read_csv(path), tmp_path / "log.parquet")
    assert named in refusal(tmp_path / "log.parquet")
    if block == 1:
        assert "2 sensors" in refusal(write(tmp_path / "log.csv", columns, UNITS))


def test_labels_without_another_mean_stay_silent(body, tmp_path):
    columns, is_second = two_sensors(body, 1, np.eye(3))
    rng = np.random.default_rng(1)
    labels = {
        "node": is_second * 1.0,
        "fix": rng.integers(0, 4, len(is_second)) * 1.0,
        "moving": (columns[1][:, 0] > columns[1][:, 0].mean() - 1.0) * 1.0,
        "seq": np.arange(len(is_second)) % 8.0,
        "temperature": 20 + 0.1 * np.floor(columns[0] / 9),
    }
    names = [UNITS[0], *labels, *UNITS[1:]]
    path = write(tmp_path / "log.csv", [columns[0], *labels.values(), *columns[1:]], names)
    assert read_study(path)[1:] == ({}, [])
    study = small_study(study={"duration_s": 60.0, "rate_hz": RATE, "window_s": [15, 30]})
    record = package.simulated_record(study)  # which sways
    time = np.arange(1, len(record.dv) + 1) / RATE
    side = (record.dv[:, 0] > np.median(record.dv[:, 0])) * 1.0
    columns = [time, side, record.dtheta * RATE, record.dv * RATE]
    path = write(tmp_path / "log.csv", columns, (UNITS[0], "side", *UNITS[1:]))
    assert not read_study(path)[1]


@pytest.mark.nightly(fast=("n",))
@pytest.mark.parametrize("frame", ["n", "world"])
def test_accelerations_in_a_navigation_frame_are_passed_over(frame, body, tmp_path):
    gyro, accel = in_axes(body, "flu")
    level = np.array([0.0, 0.0, 9.81]) + 1e-3 * np.random.default_rng(2).normal(size=accel.shape)
    of_body = [f"accel_{'b_' if frame == 'n' else ''}{a}" for a in XYZ]
    names = [*UNITS[:4], *(f"accel_{frame}_{a}" for a in XYZ), *of_body]
    path = write(tmp_path / "log.csv", [TIME, gyro, level, accel], names)
    study, *said = read_study(path)
    assert said == [{}, []]
    assert_body(study, path, body)
    path = write(tmp_path / "log.csv", [TIME, gyro, level], names[:7])
    _, questions, _ = read_study(path)
    assert f"({frame})" in questions["accel_columns"]


def test_front_of_roll_rates_is_a_question_that_names_and_sways_settle(body, tmp_path):
    names = ["time", "roll_rate", "pitch_rate", "yaw_rate", "ax", "ay", "az"]
    path = write(tmp_path / "log.csv", [TIME, body[0][:, [1, 0, 2]], body[1]], names)
    _, questions, _ = read_study(path)
    assert [*questions] == ["axes_order"]
    with pytest.raises(InputError, match="'rfu'.* 'pitch_rate', 'roll_rate', 'yaw_rate'"):
        align(path, tmp_path, record__axes_order="rfu")
    study, questions, _ = read_study(path, record__axes_order="rfu")
    assert not questions and study["record"]["gyro_columns"][0] == "pitch_rate"
    pqr = write(tmp_path / "pqr.csv", [TIME, *in_axes(body, "flu")], ["time", *"pqr", *names[4:]])
    assert read_study(pqr)[1:] == ({}, [])  # p is about x by definition
    swaying = small_study(study={"duration_s": 40.0, "rate_hz": RATE, "window_s": [15, 30]})
    record = package.simulated_record(swaying)
    time = np.arange(1, len(record.dv) + 1) / RATE
    columns = [time, record.dtheta[:, [1, 0, 2]] * RATE, record.dv * RATE]
    study, questions, _ = read_study(write(tmp_path / "log.csv", columns, names))
    assert not questions and study["record"]["gyro_columns"][0] == "pitch_rate"
    assert study["record"]["axes_order"] == "xyz"


@pytest.mark.nightly(fast=("0.97-1.0",))
@pytest.mark.parametrize("accel_unit", [1.0, G])
@pytest.mark.parametrize("ratio", [0.97, 1.0])
def test_mems_bias_that_looks_like_earth_rate_is_a_question(ratio, accel_unit, body, tmp_path):
    gyro, accel = in_axes(body, "flu")
    rng = np.random.default_rng(4)
    earth_rate = 15.041 / 3600  # deg/s, of gyros in rad/s
    bias = ratio * earth_rate * np.array([0.5, -0.4, 0.768])
    noisy = gyro - gyro.mean(axis=0) + bias + 0.02 * DEG * rng.normal(size=gyro.shape)
    path = write(tmp_path / "log.csv", [TIME, noisy, accel / accel_unit])
    study, questions, _ = read_study(path)
    assert [*questions] == ["gyro_unit"] and study["earth"]["latitude_deg"] == 45.0
    path = write(tmp_path / "log.csv", [TIME, gyro / DEG, accel / accel_unit])
    study, questions, _ = read_study(path)  # gyros with so little noise have no such bias
    assert not questions and study["record"]["gyro_unit"] == "deg_per_s"


def test_gyros_that_turn_opposite_to_the_vertical_are_a_question(tmp_path):
    study = small_study(study={"duration_s": 40.0, "rate_hz": RATE, "window_s": [15, 30]})
    record = package.simulated_record(study)
    time = np.arange(1, len(record.dv) + 1) / RATE
    path = write(tmp_path / "log.csv", [time, -record.dtheta * RATE, record.dv * RATE])
    study, questions, _ = read_study(path)
    assert [*questions] == ["gyro_scale"]
    assert study["record"]["gyro_unit"] == "rad_per_s"


# --- gyros that cannot find north


@pytest.mark.nightly(fast=("False",))
@pytest.mark.parametrize("trust", [False, True])
def test_hidden_north_leaves_level_with_honest_sigma(trust, body, sinsjax, tmp_path):
    names = [f"rfu_{NAMES[0]}", *(f"rfu_{n} (rad/s)" for n in NAMES[1:4]), *NAMES[4:]]
    write(tmp_path / "log.csv", [TIME, mems(body, 0.31), body[1]], names)
    assert sinsjax("init", "record", "--from", "log.csv")[0] == 0
    study = tomllib.loads(Path("log.toml").read_text())
    assert study["alignment"] == {"method": "level"}
    changes = [
        *("--set", "alignment.method=kalman5", "--set", f"record.trust={str(trust).lower()}"),
        *("--set", "filter.q_reading=psd", "--set", "filter.q_gyro_arw_deg_per_sqrt_h=0.3"),
        *("--set", "filter.q_accel_ug_per_sqrt_hz=100"),
    ]
    code, told, error = sinsjax("align", "log.csv", "log.toml", "-o", "out", *changes)
    assert code == 0 and error.count("Warning") == 1 and "level, not kalman5" in error
    assert "heading" not in told.lower().split("none")[0]
    (row,) = package.read_summary("out").to_pylist()
    assert row["heading_deg"] is None and row["sigma_u_arcmin"] is None
    assert row["sigma_e_arcmin"] == pytest.approx(17.2, abs=0.2)  # of 5,000 ug
    sigma_deg = row["sigma_e_arcmin"] / 60
    assert (row["pitch_deg"], row["roll_deg"]) == pytest.approx(TRUTH[1:], abs=sigma_deg)
