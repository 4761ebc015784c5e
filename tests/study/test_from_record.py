"""`sinsjax init record --from`: logs of several conventions become studies that run."""

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.commands import Command
from support.refusals import assert_named
from support.studies import small_study

import sinsjax as package
from sinsjax.errors import InputError
from sinsjax.records.layout import NAMED_AXES, Record, from_body_axes
from sinsjax.records.psins import write_psins
from sinsjax.study.from_record import make_study_text

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]

RATE = 100.0
DEG = np.pi / 180
G = 9.80665
NAMES = ("t", "gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")


@pytest.fixture(scope="module")
def rates() -> tuple[np.ndarray, np.ndarray]:
    """Rates (rad/s) and specific forces (m/s^2), right-front-up, of 100 s on a base that sways."""
    study = small_study(
        study={"duration_s": 100.0, "window_s": [50, 100]},
        earth={"latitude_deg": 45.0},
        motion={"pitch_amplitude_deg": 0.3, "roll_amplitude_deg": 0.2, "yaw_amplitude_deg": 0.2},
        sensors={"gyro_bias_deg_per_h": 0.01, "accel_bias_ug": 50.0},
    )
    record = package.simulated_record(study)
    return record.dtheta * RATE, record.dv * RATE


def columns(
    rates: tuple[np.ndarray, np.ndarray], axes: str, gyro: float, accel: float, step: float
) -> np.ndarray:
    """(T, 7) time, gyros, accelerometers in some axes and units; a sample's step in its unit."""
    order = NAMED_AXES.get(axes, axes)
    own = [from_body_axes(rates[0], order) / gyro, from_body_axes(rates[1], order) / accel]
    return np.column_stack([step * np.arange(1, len(own[0]) + 1), *own])


def write(
    path: Path,
    table: np.ndarray,
    names: tuple[str, ...] = NAMES,
    *,
    mark: str = ",",
    before: str = "",
    time: str = "%.12g",
) -> Path:
    formats = [time, *["%.12g"] * (table.shape[1] - 1)]
    np.savetxt(path, table, formats, mark, header=before + mark.join(names), comments="")
    return path


def load_with_doubts(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Return the study of a file, and its doubts."""
    text = make_study_text(path, Path("its.toml"))
    doubts = re.findall(r"^# DOUBT: (.*(?:\n#   .*)*)", text, re.MULTILINE)
    return tomllib.loads(text), [" ".join(doubt.replace("\n#  ", "").split()) for doubt in doubts]


def align_written_study(sinsjax: Command, path: Path, *more: str) -> dict[str, Any]:
    """The row of the study that is written for a file: it validates and runs with more options."""
    code, told, error = sinsjax("init", "record", "--from", path.name, "-o", "its.toml")
    assert (code, error) == (0, ""), error
    code, told, error = sinsjax("validate", "its.toml", *more)
    assert (code, error) == (0, ""), error
    code, told, error = sinsjax("align", path.name, "its.toml", "-o", "out", *more)
    assert code == 0 and "error" not in error, error  # what is doubtful is told there
    (row,) = package.read_summary("out").to_pylist()
    return row


LOGS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "FRD in rad/s, semicolons, comments": (
        lambda path, rates: write(
            path,
            columns(rates, "frd", 1.0, 1.0, 0.01),
            mark=";",
            before="# logger 3\n# axes: front-right-down\n",
        ),
        {"axes_order": "frd", "gyro_unit": "rad_per_s", "time_unit": "s"},
    ),
    "increments in arcsec and ug s, ns": (
        lambda path, rates: write(
            path,
            columns(rates, "rfu", DEG / 3600 * RATE, G * 1e-6 * RATE, 1e7),
            ("TimeStamp", "DeltaAngleX", "DeltaAngleY", "DeltaAngleZ", "DVX", "DVY", "DVZ"),
            time="%d",
        ),
        {"axes_order": "flu", "gyro_unit": "arcsec", "accel_unit": "ug_s", "time_unit": "ns"},
    ),
    "no time": (
        lambda path, rates: write(
            path,
            columns(rates, "rfu", 1.0, 1.0, 1.0),
            ("sample", "wx", "wy", "wz", "fx", "fy", "fz"),
            time="%d",
        ),
        {"gyro_unit": "rad_per_s", "accel_unit": "m_per_s2"},
    ),
    "x up": (
        lambda path, rates: write(path, columns(rates, "z-yx", 1, 1, 0.01)),
        {"axes_order": "yzx"},
    ),
}


@pytest.mark.nightly(fast=("FRD in rad/s, semicolons, comments",))
@pytest.mark.parametrize("name", LOGS)
def test_log_becomes_study_that_runs(name, rates, sinsjax, tmp_path):
    make, expected = LOGS[name]
    path = make(tmp_path / "log.csv", rates)
    study, doubts = load_with_doubts(path)
    found = {key: study["record"].get(key) for key in expected}
    assert found == expected
    untimed = name == "no time"
    assert study["study"].get("rate_hz") == ("?" if untimed else RATE)
    assert study["earth"]["latitude_deg"] == pytest.approx(45.0, abs=0.3)
    assert not doubts or untimed or name == "x up"
    assert study["alignment"] == {"method": "inertial"} and "filter" not in study
    row = align_written_study(sinsjax, path, *(["--set", "study.rate_hz=100"] if untimed else []))
    assert abs(row["roll_deg"]) < 1 and abs(row["pitch_deg"]) < 1
    # Of a box whose front is not told the yaw is off by right angles, as the doubt says.
    off = (row["yaw_deg"] - 10 + 45) % 90 - 45
    assert abs(off) < 1.5
    if study["record"]["axes_order"] == "frd":
        assert abs(row["yaw_deg"] - 10) < 1.5


@pytest.mark.nightly
def test_short_gaps_are_interpolated_and_long_gap_moves_start(rates, sinsjax, tmp_path):
    table = columns(rates, "rfu", 1.0, 1.0, 0.01)
    table[3000, 2] = np.nan
    gone = [*range(500, 503), *range(2000, 2100)]
    path = write(tmp_path / "log.csv", np.delete(table, gone, axis=0))
    study, doubts = load_with_doubts(path)
    assert study["record"]["max_gap_s"] == 0.04
    assert study["record"]["start_s"] == [21.0]
    assert any("from 20.0 to 21.01 s" in doubt for doubt in doubts)
    assert abs((align_written_study(sinsjax, path)["yaw_deg"] - 10 + 45) % 90 - 45) < 4


def test_parquet_log_with_dates_becomes_study_that_runs(rates, sinsjax, tmp_path):
    table = columns(rates, "frd", DEG, G, 10_000_000)
    dates = np.datetime64("2024-05-01", "ns") + table[:, 0].astype("timedelta64[ns]")
    names = ("stamp", *(f"imu_frd_{name}" for name in NAMES[1:]))
    path = tmp_path / "log.parquet"
    pq.write_table(pa.table(dict(zip(names, [dates, *table[:, 1:].T], strict=True))), path)
    study, _ = load_with_doubts(path)
    assert study["record"]["time_unit"] == "iso" and study["record"]["axes_order"] == "frd"
    assert abs(align_written_study(sinsjax, path)["yaw_deg"] - 10) < 1.5


def test_study_ends_a_second_before_log(rates, tmp_path):
    """The reference of a log may end slightly before it."""
    path = write(tmp_path / "log.csv", columns(rates, "rfu", 1.0, 1.0, 0.01))
    study, _ = load_with_doubts(path)
    assert study["study"]["duration_s"] + study["coarse"]["coarse_duration_s"] == 99.0


def test_psins_log_becomes_study_that_runs(rates, sinsjax, tmp_path):
    record = Record(rates[0] / RATE, rates[1] / RATE, RATE)
    record = record._replace(latitude_deg=45.0, height_m=10.0, gravity_m_per_s2=9.8)
    path = tmp_path / "log.imu"
    write_psins(record, path, gyro_scale_arcsec=1e-4, accel_scale_ug_s=1e-2)
    study, _ = load_with_doubts(path)
    assert study["record"] == {"format": "psins", "axes_order": "xyz", "start_s": [0.0]}
    assert study["earth"] == {"earth": "wgs84"}
    assert abs(align_written_study(sinsjax, path)["yaw_deg"] - 10) < 1.5


@pytest.mark.nightly
def test_log_with_odd_rate_is_read(rates, sinsjax, tmp_path):
    table = columns(rates, "rfu", 1.0, 1.0, 1 / 102.4)
    table[:, 1:] *= [*[1.024] * 3, 1, 1, 1]
    path = write(tmp_path / "log.csv", table)
    study, _ = load_with_doubts(path)
    assert study["study"]["rate_hz"] == 102.4
    assert study["study"]["record_interval_s"] == 102 / 102.4
    align_written_study(sinsjax, path)


AMBIGUOUS: dict[str, tuple[Callable[..., Any], str]] = {
    "stated unit": (
        lambda t: (t, tuple(f"{n} [deg/s]" if "gyro" in n else n for n in NAMES)),
        "1 times Earth rate in rad/s",
    ),
    "stated g": (lambda t: (t, tuple(f"{n}_g" if "acc" in n else n for n in NAMES)), "9.8 times"),
    "stated ms": (lambda t: (t, ("time_ms", *NAMES[1:])), "1e+05"),
    "increments": (lambda t: (t * [1, 1, 1, 1, 1e3, 1e3, 1e3], NAMES), "increments"),
    "down": (lambda t: (t * [1, 1, 1, 1, -1, -1, -1], NAMES), "southern hemisphere"),
    "two gyros": (
        lambda t: (np.hstack([t, t[:, 1:4]]), (*NAMES, *(f"raw_{n}" for n in NAMES[1:4]))),
        "raw_gyro_x, raw_gyro_y, raw_gyro_z",
    ),
}


@pytest.mark.parametrize("name", AMBIGUOUS)
def test_ambiguous_log_is_marked_with_doubt(name, rates, tmp_path):
    make, named = AMBIGUOUS[name]
    path = write(tmp_path / "log.csv", *make(columns(rates, "rfu", 1.0, 1.0, 0.01)))
    assert named in " ".join(load_with_doubts(path)[1])


def test_missing_sample_marks_give_one_doubt_with_remedy(rates, tmp_path):
    table = columns(rates, "rfu", 1.0, 1.0, 0.01)
    table[2000:9000:500, 4:] = -9999.0
    _, doubts = load_with_doubts(write(tmp_path / "log.csv", table))
    (line,) = [doubt for doubt in doubts if "refused" in doubt]
    assert_named(line, "row 2002: column 'accel_x'", "-9999", "-1020 g", "41")


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda t: (t, ("t", "gyro_x\u202e", *NAMES[2:])), r"column 'gyro_x\u202e'"),
        (lambda t: (t, (*NAMES[:6], "accel_z\x7f")), r"column 'accel_z\x7f'"),
        (lambda t: (t[:500], NAMES), "5 s "),
        (lambda t: (t[:, :5], NAMES[:5]), "row 1: 5 columns"),
    ],
    ids=["turned letters", "deleted letter", "short", "few columns"],
)
def test_unusable_log_is_refused_in_one_line(make, named, rates, sinsjax, tmp_path):
    write(tmp_path / "log.csv", *make(columns(rates, "rfu", 1.0, 1.0, 0.01)))
    code, told, error = sinsjax("init", "record", "--from", "log.csv")
    assert (code, told, error.count("\n")) == (2, "", 1)
    assert error.startswith("error: log.csv: ") and named in error
    assert not Path("log.toml").exists()


def test_backward_time_stamps_are_refused_with_row(rates, sinsjax, tmp_path):
    table = columns(rates, "rfu", 1.0, 1.0, 0.01)
    write(tmp_path / "log.csv", table[::-1], ("Tstamp", *NAMES[1:]))
    code, told, error = sinsjax("init", "record", "--from", "log.csv")
    assert (code, told, error.count("\n")) == (2, "", 1)
    assert "column 'Tstamp': row 3: " in error and "from 100.0 to 99.99 s" in error
    # A column that no name calls a time may decrease, and one that can be read comes first.
    load_with_doubts(write(tmp_path / "log.csv", table[::-1], ("other", *NAMES[1:])))
    both = np.column_stack([table[::-1, 0], table])
    study, _ = load_with_doubts(write(tmp_path / "log.csv", both, ("date", *NAMES)))
    assert study["record"]["time_column"] == "t"


def test_study_without_known_rate_is_refused(rates, sinsjax, tmp_path):
    table = columns(rates, "rfu", 1.0, 1.0, 1e4)
    table[:, 0] = (1.763e15 + table[:, 0]).astype(np.float32)
    path = write(tmp_path / "log.csv", table, ("Tstamp[us]", *NAMES[1:]))
    study, doubts = load_with_doubts(path)
    assert study["study"]["rate_hz"] == "?" and not doubts
    assert sinsjax("init", "record", "--from", "log.csv")[0] == 0
    for command in (("validate", "log.toml"), ("align", "log.csv", "log.toml", "-o", "out")):
        code, _, error = sinsjax(*command)
        assert code == 2
        assert_named(error.strip(), "error: log.toml: [study] rate_hz", "column 'Tstamp[us]'")


def test_warning_is_printed_once_on_standard_error(rates, sinsjax, tmp_path):
    light = columns(rates, "rfu", 1.0, 1.0, 0.01) * [1, 1, 1, 1, 0.99, 0.99, 0.99]
    write(tmp_path / "log.csv", light)
    assert sinsjax("init", "record", "--from", "log.csv")[0] == 0
    code, told, error = sinsjax("align", "log.csv", "log.toml", "-o", "out")
    assert code == 0 and "Warning" not in told
    assert error.startswith("Warning: log.csv: 0 to 99 s: ")
    assert error.count("\n") == error.count("Warning") == 1


def test_first_row_may_have_empty_cells_but_no_text(rates, tmp_path):
    path = write(tmp_path / "log.csv", columns(rates, "rfu", 1.0, 1.0, 0.01))
    header, first, *rest = path.read_text().splitlines()
    cells = first.split(",")
    path.write_text("\n".join([header, ",".join([cells[0], "", "", "", *cells[4:]]), *rest]))
    assert load_with_doubts(path)[0]["record"]["gyro_unit"] == "rad_per_s"
    for row, cell in (("-,x,x,x,y,y,y", "'x'"), ('0,"0,1","0,1","0,1","1,2",3,4', "'0,1'")):
        path.write_text("\n".join([header, row, first, *rest]))
        with pytest.raises(InputError) as caught:
            make_study_text(path, Path("x.toml"))
        assert_named(str(caught.value), f"{path}: row 2: column 'gyro_x'", cell)
