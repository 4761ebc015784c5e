"""Logs of any shape are opened, or refused in one line; their clocks are found or asked for."""

import gzip
import os
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.refusals import assert_refusal

from sinsjax.errors import InputError
from sinsjax.records import RecordLayout, read_record
from sinsjax.records.psins import is_psins
from sinsjax.records.reader import open_log
from sinsjax.study.changes import parse_changes
from sinsjax.study.from_record import make_study_text

NAMES = "time_s,gx,gy,gz,ax,ay,az"
ROWS = [f"{k / 100:g},{k},0.5,-3e-5,0,0,9.8" for k in range(1, 201)]
LAYOUT = RecordLayout(
    "csv",
    time_column="time_s",
    gyro_columns=("gx", "gy", "gz"),
    accel_columns=("ax", "ay", "az"),
    gyro_unit="rad_per_s",
    accel_unit="m_per_s2",
)


def text(*head: str, rows: list[str] = ROWS) -> str:
    return "\n".join([*head, *rows, ""])


PLAIN = text(NAMES)
SHAPES = {
    "gzip": gzip.compress(PLAIN.encode()),
    "UTF-16": PLAIN.encode("utf-16"),
    "BOM and CRLF": PLAIN.encode("utf-8-sig").replace(b"\n", b"\r\n"),
    "decimal commas": PLAIN.replace(",", ";").replace(".", ",").encode(),
    "blanks": PLAIN.replace(",", "   ").encode(),
    "quotes and signs": text(NAMES, rows=[f'"+{row.replace(",", ", ", 1)}' for row in ROWS])
    .replace(", ", '", +')
    .encode(),
    "names in comment": text("%" + NAMES.replace(",", " ")).encode(),
    "preamble": text("File info", "rate,100", "", NAMES).encode(),
    "unit row": text(NAMES, "[s],[rad/s],[rad/s],[rad/s],[m/s2],[m/s2],[m/s2]").encode(),
    "delimiter at line ends": text(NAMES, rows=[f"{row}," for row in ROWS]).encode(),
    "comments": text("// by hand", NAMES, "#", *ROWS[:9], "# 2,a,comment", rows=ROWS[9:]).encode(),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_text_of_every_shape_gives_same_numbers(tmp_path, shape):
    path = tmp_path / "log.csv"
    path.write_bytes(SHAPES[shape])
    assert bool(open_log(path).units) == (shape == "unit row")
    record = read_record(path, LAYOUT)
    expected = np.array([[float(cell) for cell in row.split(",")] for row in ROWS])
    np.testing.assert_allclose(record.dtheta * 100, expected[:, 1:4], rtol=1e-12)
    np.testing.assert_allclose(record.dv * 100, expected[:, 4:], rtol=1e-12)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "empty"),
        (b"\xff\xfe", "blank lines"),
        (b"\n\n", "blank"),
        (b"%RAWIMUSXA,2000,300000.08\n" * 9, "comments"),
        (PLAIN.replace("gx", "g\N{DEGREE SIGN}").encode("cp1252"), "UTF-8 iconv"),
        (b"PK\x03\x04\x14\0\0\0", "UTF-8 unpack"),
        (gzip.compress(PLAIN.encode())[:300], "cannot be read"),
        (",".join(map(str, range(20_000))).encode(), "20,000 columns"),
        (text(NAMES, rows=["nan,nan,nan,nan,nan,nan,nan"] * 50).encode(), "no row number six"),
        (text(NAMES, rows=[f"{k / 100},1,2,3,4,5," for k in range(9)]).encode(), "no row number"),
        (b"IMU,1,2,3,4,5,6,7\nGPS,1,2,3\n" * 50, "row 2: 4 8 row 1 header [record] columns"),
    ],
)
def test_unreadable_logs_are_refused_in_one_line(tmp_path, content, told):
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    layout = LAYOUT
    if content.startswith(b"IMU"):
        names = [f"column_{k}" for k in range(2, 8)]
        columns = {"gyro_columns": tuple(names[:3]), "accel_columns": tuple(names[3:])}
        layout = LAYOUT._replace(time_column="", rate_hz=1.0, **columns)
    with pytest.raises(InputError) as caught:
        read_record(path, layout)
    assert_refusal(str(caught.value), f"{path}: {told}")


def test_pipe_is_refused_instead_of_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for call in (open_log, is_psins):
        with pytest.raises(InputError, match="a pipe"):
            call(tmp_path / "pipe")
        with pytest.raises(InputError, match="cannot be read: No such"):
            call(tmp_path / "absent")


@pytest.mark.parametrize("order", ["-y-xz", "y-xz", "zxy", "frd"])
def test_axes_order_needs_no_quotes_in_a_shell(order):
    assert parse_changes([f"record.axes_order={order}"]) == {"record.axes_order": order}


# Clocks


def clock(folder: Path, columns: dict[str, list[str]], units: str = "") -> dict[str, Any]:
    """Return the [record] of a log with some columns of times, and the rate."""
    stamps = zip(*columns.values(), strict=True)
    rows = [",".join([*times, "1e-5,2e-5,5e-5,0,0,9.8"]) for times in stamps]
    head = ",".join([*columns, "wx,wy,wz,ax,ay,az"])
    (folder / "log.csv").write_text(text(head, *([f"{units},,,,,,"] if units else []), rows=rows))
    answers = {"record.gyro_unit": "rad_per_s", "earth.latitude_deg": 48.0}
    study = make_study_text(folder / "log.csv", Path("a.toml"), answers)
    return tomllib.loads(study)["record"] | tomllib.loads(study)["study"] | {"text": study}


TICKS = [k for k in range(1, 4001) if not 300 <= k < 400]  # at 100 Hz, a second is missing


@pytest.mark.parametrize(
    ("seconds", "fraction", "per_s"),
    [("sec", "nanosec", 10**9), ("stamp.secs", "stamp.nsecs", 10**9), ("t_s", "usec", 10**6)],
)
def test_seconds_and_their_fraction_are_joined(tmp_path, seconds, fraction, per_s):
    columns = {
        seconds: [str(1_600_000_000 + k // 100) for k in TICKS],
        fraction: [str(k % 100 * (per_s // 100)) for k in TICKS],
    }
    found = clock(tmp_path, columns)
    assert (found["time_column"], found["time_fraction_column"]) == (seconds, fraction)
    assert (found["rate_hz"], found["start_s"]) == (100.0, [4.0])
    assert "row 301: a gap at 100 Hz" in " ".join(found["text"].replace("\n#", "").split())


@pytest.mark.parametrize(
    ("name", "unit", "step", "begin"),
    [
        ("tow", "ms", 10, 385_000_000),
        ("TimeUS", "us", 2500, 0),
        ("timestamp_ns", "ns", 10**7, 0),
        ("time_s", "s", 1, 0),
        ("UTC_time_milliseconds", "ms", 1, 0),
    ],
)
def test_unit_of_a_clock_is_that_of_its_name_or_steps(tmp_path, name, unit, step, begin):
    rate_hz = {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit] / step
    count = round(20 * rate_hz)
    found = clock(tmp_path, {name: [f"{begin + k * step:.12g}" for k in range(1, count)]})
    assert (found["time_column"], found.get("time_unit", "s")) == (name, unit)
    assert found["rate_hz"] == pytest.approx(rate_hz)


def test_unit_of_a_clock_is_that_of_the_row_of_units(tmp_path):
    found = clock(tmp_path, {"time": [str(k) for k in range(1, 20_000)]}, units="ms")
    assert (found["rate_hz"], found["time_unit"]) == (1000.0, "ms")


@pytest.mark.parametrize(
    ("name", "stamps", "asked"),
    [
        ("time", [str(k) for k in range(1, 300)], ['"s": 1 Hz', '"ms": 1000 Hz']),
        ("time_s", [str(10 * k) for k in range(1, 300)], ["is named as s", '"ms": 100 Hz']),
        ("time_s", [f"{k // 20}" for k in range(300)], ["time repeats", "true rate"]),
        ("time_s", [f"{k - k % 2 * 3}" for k in range(1, 300)], ["runs backward", "true rate"]),
        ("temperature", ["20"] * 299, ["no column has times"]),
    ],
)
def test_clock_that_is_not_certain_is_an_open_question(tmp_path, name, stamps, asked):
    found = clock(tmp_path, {name: stamps})
    assert "?" in (found.get("rate_hz"), found.get("time_unit"))
    for words in asked:
        assert words in " ".join(found["text"].replace("\n#", "").split())
