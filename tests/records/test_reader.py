"""Logs of any shape are opened, or refused in one line; their clocks are found or asked for."""

import gzip
import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.refusals import assert_refusal

from sinsjax.errors import InputError
from sinsjax.records import RecordLayout, read_record
from sinsjax.records.psins import is_psins
from sinsjax.records.reader import open_log
from sinsjax.records.stamps import Clock, propose_clock
from sinsjax.study.changes import parse_changes

NAMES = "time_s,gx,gy,gz,ax,ay,az"
ROWS = [f"{k / 100:g},{k},0.5,-3e-5,0,0,9.8" for k in range(1, 201)]
COLUMNS = NAMES.split(",")
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


@pytest.mark.parametrize(
    "content",
    [
        PLAIN.encode(),
        gzip.compress(PLAIN.encode()),
        PLAIN.encode("utf-16"),
        PLAIN.encode("utf-8-sig").replace(b"\n", b"\r\n"),
        PLAIN.replace(",", ";").replace(".", ",").encode(),
        PLAIN.replace(",", "   ").encode(),
        text("%" + NAMES.replace(",", " ")).encode(),
        text("File info", "rate,100", "", NAMES).encode(),
        text(NAMES, "[s],[rad/s],[rad/s],[rad/s],[m/s2],[m/s2],[m/s2]").encode(),
        text(NAMES, rows=[f"{row}," for row in ROWS]).encode(),
        text("// made by hand", NAMES, "#", *ROWS[:9], "# 2,a,comment", rows=ROWS[9:]).encode(),
    ],
    ids=[
        *(
            "plain",
            "gzip",
            "UTF-16",
            "BOM and CRLF",
            "decimal commas",
            "blanks",
            "names in comment",
        ),
        *("preamble", "unit row", "delimiter at line ends", "comments"),
    ],
)
def test_text_of_every_shape_gives_same_numbers(tmp_path, content):
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    table = open_log(path)
    assert table.names[:7] == COLUMNS and {*COLUMNS} <= table.numbers
    assert bool(table.units) == (b"[rad/s]" in content)
    columns = table.read(COLUMNS)
    expected = [[float(cell) for cell in row.split(",")] for row in ROWS]
    np.testing.assert_array_equal(np.column_stack(columns), expected)
    assert len(read_record(path, LAYOUT).dv) == 200


def test_parquet_is_known_by_its_content(tmp_path):
    table = pa.table({name: np.arange(5.0) for name in COLUMNS} | {"text": list("aabab")})
    pq.write_table(table, tmp_path / "log.dat")
    opened = open_log(tmp_path / "log.dat")
    assert (opened.format, opened.names) == ("parquet", [*COLUMNS, "text"])
    assert "text" not in opened.numbers and opened.head["gx"][1] == "1.0"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "empty"),
        (b"\n\n", "blank"),
        (b"%RAWIMUSXA,2000,300000.08\n" * 9, "comments"),
        (PLAIN.replace("gx", "g\N{DEGREE SIGN}").encode("cp1252"), "UTF-8 iconv"),
        (b"PK\x03\x04\x14\0\0\0", "UTF-8 unpack"),
        (b"MATLAB 5.0 MAT-file\0\1", "UTF-8 MATLAB"),
        (gzip.compress(PLAIN.encode())[:300], "archive"),
        (",".join(map(str, range(20_000))).encode(), "20,000 columns"),
        (text(NAMES, rows=["nan,nan,nan,nan,nan,nan,nan"] * 50).encode(), "no row number six"),
        (text(NAMES, rows=[f"{k / 100},1,2,3,4,5," for k in range(9)]).encode(), "no row number"),
        (b"IMU,1,2,3,4,5,6,7\nGPS,1,2,3\n" * 50, "row 2: 4 8 row 1 header [record] columns"),
        (text(NAMES, *ROWS[:9], "0.1,2,3").encode(), "row 11: 7 columns 3"),
        (PLAIN.replace("0.5", "x", 1).encode(), "row 2: column 'gy': 'x'"),
    ],
)
def test_unreadable_logs_are_refused_in_one_line(tmp_path, content, told):
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        table = open_log(path)
        read_record(path, LAYOUT if "gx" in table.names else unnamed(table.names))
    assert_refusal(str(caught.value), f"{path}: {told}")
    assert "\n" not in str(caught.value)


def unnamed(names: list[str]) -> RecordLayout:
    return LAYOUT._replace(
        time_column="", rate_hz=1.0, gyro_columns=tuple(names[1:4]), accel_columns=tuple(names[4:7])
    )


def test_pipe_is_refused_instead_of_waited_for(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    for call in (open_log, is_psins):
        with pytest.raises(InputError, match="a pipe"):
            call(path)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"gyro_columns": ("gx", "gyro_neg_y", "gz")}, "gyro_columns: minus 'gyro_neg_y'"),
        (
            {"gyro_columns": ("roll_rate", "pitch_rate", "yaw_rate")},
            "gyro_columns: 'pitch_rate', 'roll_rate', 'yaw_rate'",
        ),
    ],
)
def test_names_that_contradict_axes_or_signs_are_refused(tmp_path, change, told):
    with pytest.raises(InputError) as caught:
        read_record(tmp_path / "log.csv", LAYOUT._replace(**change))
    assert_refusal(str(caught.value), f"{tmp_path / 'log.csv'}: {told}")


def test_names_that_agree_with_axes_and_signs_are_accepted(tmp_path):
    names = ("roll_rate", "pitch_rate", "minus yaw")
    rows = text(NAMES.replace("gx,gy,gz", ",".join(names)))
    (tmp_path / "log.csv").write_text(rows)
    layout = LAYOUT._replace(gyro_columns=names, gyro_scale=(1.0, 1.0, -1.0), axes_order="frd")
    record = read_record(tmp_path / "log.csv", layout)
    np.testing.assert_allclose(record.dtheta[0] * 100, [0.5, 1, -3e-5])


@pytest.mark.parametrize("order", ["-y-xz", "y-xz", "zxy", "frd"])
def test_axes_order_needs_no_quotes_in_a_shell(order):
    assert parse_changes([f"record.axes_order={order}"]) == {"record.axes_order": order}


# Clocks


def clock(folder: Path, columns: dict[str, list[str]], units: str = "") -> Clock:
    """Return the proposed clock of a log with some columns of times."""
    rows = [",".join([*times, "1,2,3,4,5,6"]) for times in zip(*columns.values(), strict=True)]
    path = folder / "log.csv"
    head = [",".join([*columns, "a,b,c,d,e,f"])]
    path.write_text(text(*head, *([units + ",r,r,r,m,m,m"] if units else []), rows=rows))
    return propose_clock(str(path), open_log(path), {}, list("abcdef"))


TICKS = [k for k in range(1, 901) if not 300 <= k < 400]  # at 100 Hz, a second is missing


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
    assert found.rate_hz == pytest.approx(100) and not found.is_open
    assert (found.fields["time_column"], found.fields["time_fraction_column"]) == (*columns,)
    layout = RecordLayout("csv", gyro_columns=("a", "b", "c"), accel_columns=("d", "e", "f"))
    record = read_record(tmp_path / "log.csv", layout._replace(**found.fields))
    assert [flaw[:2] for flaw in record.flaws] == [(299, 399)]
    assert "row 301: a gap at 100 Hz" in record.flaws[0].text


@pytest.mark.parametrize(
    ("name", "unit", "step", "begin"),
    [
        ("tow", "ms", 10, 385_000_000),
        ("TimeUS", "us", 2500, 0),
        ("timestamp_ns", "ns", 10**7, 0),
        ("timestamp", "us", 80_000, 0),
        ("time_s", "s", 1, 0),
        ("seconds_elapsed", "s", 0.01, 0),
        ("time [ms]", "ms", 10, 5),
        ("UTC_time_milliseconds", "ms", 1, 0),
    ],
)
def test_unit_of_a_clock_is_that_of_its_name_or_steps(tmp_path, name, unit, step, begin):
    found = clock(tmp_path, {name: [f"{begin + k * step:.12g}" for k in range(1, 300)]})
    assert (found.fields["time_column"], found.fields["time_unit"]) == (name, unit)
    assert not found.is_open
    assert found.rate_hz * step == pytest.approx({"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit])


def test_unit_of_a_clock_is_that_of_the_row_of_units(tmp_path):
    found = clock(tmp_path, {"time": [str(k) for k in range(1, 300)]}, units="ms")
    assert (found.rate_hz, found.is_open) == (pytest.approx(1000), False)


@pytest.mark.parametrize(
    ("name", "stamps", "asked"),
    [
        ("time", [str(k) for k in range(1, 300)], ['"s": 1 Hz', '"ms": 1000 Hz']),
        ("time_s", [str(10 * k) for k in range(1, 300)], ["is named as s", '"ms": 100 Hz']),
        ("time_s", [f"{k // 20}" for k in range(300)], ["time repeats", "21.3571 Hz"]),
        ("time_s", [f"{k - k % 2 * 3}" for k in range(1, 300)], ["runs backward", "true rate"]),
        ("temperature", ["20"] * 299, ["no column has times"]),
    ],
)
def test_clock_that_is_not_certain_is_an_open_question(tmp_path, name, stamps, asked):
    found = clock(tmp_path, {name: stamps})
    (question,) = [note.question for note in found.notes.values() if note.question]
    for words in asked:
        assert words in question


def test_times_of_day_are_a_clock_beyond_midnight(tmp_path):
    times = [f"23:59:{58 + k // 100:02d}.{k % 100:02d}" for k in range(200)]
    times += [f"00:00:{k // 100:02d}.{k % 100:02d}" for k in range(200)]
    found = clock(tmp_path, {"when": times})
    assert (found.fields["time_unit"], found.rate_hz) == ("iso", pytest.approx(100))
