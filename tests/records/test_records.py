"""Records: round trips of the three formats, stamps and gaps, and errors with file and row."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.record_files import write_record
from support.refusals import assert_refusal, refusal_line

from sinsjax import records
from sinsjax.records import Record, RecordLayout, reader

GYRO, ACCEL = ("gx", "gy", "gz"), ("ax", "ay", "az")
CSV = RecordLayout(
    "csv", time_column="time_s", gyro_columns=GYRO, accel_columns=ACCEL, rate_hz=100.0
)
ANY_RATE = CSV._replace(rate_hz=None)
NO_TIME = CSV._replace(time_column="")
ARCSEC = np.pi / 180 / 3600
HEADER = "% comment\n1 2 -90.6 0 0 0\n34.2 108.9 380 5 10 9.780327\n0.1 0.2 0.3 125 100 50\n"
SAMPLE = "-3 0 4 0 2 83\n"
HEAD = "time_s,gx,gy,gz,ax,ay,az\n"
ROWS = HEAD + "".join(f"{k / 100},1,2,3,4,5,6\n" for k in range(1, 5))


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape == b.shape and a.tobytes() == b.tobytes()


def read_whole(path: Path, layout: RecordLayout) -> Record:
    """Read a record and require its whole span, so missing samples are refused."""
    record = records.read_record(path, layout)
    records.require_samples(record, 0.0, len(record.dtheta) / record.rate_hz)
    return record


# --- there and back


@pytest.mark.parametrize("kind", ["csv", "parquet"])
@pytest.mark.parametrize(
    ("units", "exact"), [(("rad", "m_per_s"), True), (("deg_per_h", "mg"), False)]
)
@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("order", ["xyz", "y-xz", "-zy+x"])
def test_increments_survive_round_trip_bit_for_bit(tmp_path, kind, units, exact, timed, order):
    rng, rate_hz = np.random.default_rng(1), 1e3 / 7
    record = Record(*rng.normal(size=(2, 20, 3)) * 10 ** rng.uniform(-6, 6, (2, 20, 3)), rate_hz)
    layout = CSV._replace(
        format=kind, axes_order=order, rate_hz=rate_hz, gyro_scale=(1.0, -1.0, 0.25)
    )
    layout = layout._replace(gyro_unit=units[0], accel_unit=units[1])
    layout = layout if timed else layout._replace(time_column="")
    write_record(record, tmp_path / "record", layout)
    back = records.read_record(tmp_path / "record", layout)
    for read, written in ((back.dtheta, record.dtheta), (back.dv, record.dv)):
        np.testing.assert_allclose(read, written, rtol=1e-9)
        assert not exact or same_bits(read, written)
    assert back.rate_hz == record.rate_hz and back.t0_s == pytest.approx(0.0, abs=1e-12)


def test_psins_reader_applies_scale_header_and_axes_order(tmp_path):
    path = tmp_path / "a.imu"
    path.write_text(HEADER + "\n" + SAMPLE + "% late comment\r\n" + "+1 -1  1\t10 20 30 \n")
    record = records.read_psins_counts(path)
    scale = np.array([0.1, 0.2, 0.3]) * ARCSEC
    ug_s = np.array([125, 100, 50]) * 1e-6 * 9.780327
    np.testing.assert_allclose(record.dtheta, np.array([[-3, 0, 4], [1, -1, 1]]) * scale, 1e-14)
    np.testing.assert_allclose(record.dv, np.array([[0, 2, 83], [10, 20, 30]]) * ug_s, 1e-14)
    assert record[2:7] == (100.0, 5.0, 34.2, 380.0, 9.780327)
    moved = records.read_psins_counts(path, RecordLayout("psins", axes_order="y-xz", rate_hz=100.0))
    np.testing.assert_array_equal(moved.dv, record.dv[:, [1, 0, 2]] * [1, -1, 1])


# --- mistakes


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (HEADER + SAMPLE + "1 2 3\n" + SAMPLE, "row 6: 6 3"),
        (HEADER + "1 l 3 4 5 6\n", "row 5: column 'gyro y': 'l'"),
        (HEADER.replace(" 10 ", " 0 ") + SAMPLE, "row 3: interval 0 ms"),
        (ROWS + "0.05,1,2,3\n", "row 6: 7 4 last"),
        (ROWS + "\n0.05,1,2,x,4,5,6\n", "row 7: column 'gz': 'x'"),
        (ROWS + "0.05,1,2,1e300,4,5,6\n", "row 6: column 'gz': range"),
        (ROWS + ",1,2,3,4,5,6\n0.06,1,2,3,4,5,6\n", "column 'time_s': row 7: gap 100 0.04"),
        (ROWS + "0.07,1,2,3,4,5,6\n", "column 'time_s': row 6: gap 100 0.04 0.07"),
        (ROWS + "0.04,1,2,3,4,5,7\n", "column 'time_s': row 6: repeats 0.04"),
        (ROWS.replace("0.0", "0."), "column 'time_s' 10 rate_hz 100"),
    ],
)
def test_invalid_text_is_refused(tmp_path, text, told):
    path = tmp_path / "bad"
    path.write_text(text, newline="")
    layout = CSV if text.startswith(HEAD[:5]) else records.PSINS_LAYOUT
    assert_refusal(refusal_line(read_whole, path, layout), f"{path}: {told}")


def test_invalid_parquet_file_is_refused(tmp_path):
    path, layout = tmp_path / "bad.parquet", NO_TIME._replace(format="parquet")
    columns = {name: pa.array([1.0, 2.0, 3.0]) for name in GYRO + ACCEL}
    pq.write_table(pa.table(columns | {"ay": pa.array(["1", "b", "c"])}), path)
    told = f"{path}: row 2: column 'ay': 'b'"
    assert_refusal(refusal_line(read_whole, path, layout), told)
    path.write_bytes(path.read_bytes()[:-20])
    assert_refusal(refusal_line(records.read_record, path, layout), f"{path}: Parquet")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"gyro_unit": "dps"}, "gyro_unit: 'dps' rad deg arcsec rad_per_s"),
        ({"accel_columns": ("ax", "ay", "gx")}, "accel_columns: 'gx'"),
        ({"gyro_columns": ("gx", "gyro_neg_y", "gz")}, "gyro_columns: minus 'gyro_neg_y'"),
        ({"time_column": "", "rate_hz": None}, "rate_hz: required time_column"),
    ],
)
def test_invalid_layout_is_refused(change, told):
    line = refusal_line(records.check_layout, CSV._replace(**change), "study.toml")
    assert_refusal(line, f"study.toml: {told}")


# --- stamps and gaps


def timed_csv(folder: Path, time_s: np.ndarray) -> Path:
    path = folder / "timed.csv"
    rows = [f"{float(t)!r},{k},2,3,4,5,6" for k, t in enumerate(time_s)]
    path.write_text(HEAD + "\n".join(rows))
    return path


@pytest.mark.parametrize(
    ("late", "rows"),
    [([0.004], 0), ([0.007, 0.004], 1), ([0.012, 0.006], 2), ([0.0, 0.007] * 100, 100)],
)
def test_late_stamps_followed_by_timely_ones_are_no_gap(tmp_path, late, rows):
    time_s = np.arange(1, 401) / 100
    time_s[200 : 200 + len(late)] += late
    record = read_whole(timed_csv(tmp_path, time_s), CSV)
    assert len(record.dtheta) == 400 and not record.flaws and record.rate_hz == 100.0
    assert [remark.split()[0] for remark in record.remarks] == [str(rows)] * bool(rows)


def jittering_stamps() -> np.ndarray:
    """Stamps at 200 Hz that are up to 2 ms late."""
    return np.arange(1, 6001) / 200 + np.random.default_rng(7).uniform(0, 0.002, 6000)


def test_set_clock_is_refused(tmp_path):
    path = timed_csv(tmp_path, jittering_stamps() + np.where(np.arange(6000) < 3000, 0, 1e6))
    assert "row 3002: a gap at " in refusal_line(records.read_record, path, ANY_RATE)


@pytest.mark.parametrize("missing", [[], [300, 301, 5000], [2000, *range(4000, 4300)]])
def test_missing_samples_among_jittering_stamps_are_found(tmp_path, missing):
    path = timed_csv(tmp_path, np.delete(jittering_stamps(), missing))
    record = records.read_record(path, ANY_RATE)
    assert len(record.dtheta) == 6000 and record.rate_hz == pytest.approx(200, rel=1e-4)
    assert np.flatnonzero(np.isnan(record.dtheta[:, 0])).tolist() == missing
    if missing:
        assert f"row {missing[0] + 2}: a gap at 200" in record.flaws[0].text


@pytest.mark.parametrize("cell", [None, "", "-inf"])
def test_missing_samples_are_refused_or_interpolated_and_counted(tmp_path, cell):
    """A table whose values are times, without four samples: as gaps, or as other cells."""
    time_s, missing = np.arange(1, 401) / 100, [100, 200, 201, 202]
    cells = [[f"{t:.2f}"] * 7 for t in time_s]
    for k in missing:
        cells[k][3] = cell or ""
    path = tmp_path / "lacking.csv"
    kept = [row for k, row in enumerate(cells) if cell is not None or k not in missing]
    path.write_text(HEAD + "\n".join(map(",".join, kept)))
    record = records.read_record(path, CSV)
    whole = np.delete(np.arange(400), missing)
    np.testing.assert_allclose(record.dtheta[whole, 2], time_s[whole])
    assert np.isnan(record.dtheta[missing]).all()
    records.require_samples(record, 2.03, 1.97)
    for begin, needed in ((1.5, 0.51), (2.02, 1.0), (2.01, 0.01)):
        line = refusal_line(records.require_samples, record, begin, needed)
        row = 202 if cell is not None else 201
        assert f"row {row}: " in line and ("a gap" in line) == (cell is None)
    record = read_whole(path, CSV._replace(max_gap_s=0.04))
    assert "4 missing samples" in record.remarks[0]
    np.testing.assert_allclose(record.dtheta, time_s[:, None] * np.ones(3), rtol=1e-12)
    record = records.read_record(path, CSV._replace(max_gap_s=0.03))
    assert [flaw[:2] for flaw in record.flaws] == [(200, 203)]


def test_record_read_in_batches_is_bit_identical(tmp_path, monkeypatch):
    path, values = tmp_path / "long", np.random.default_rng(3).normal(size=(999, 6)).tolist()
    rows = [f"2024-05-01T00:00:{k / 100:06.3f},{row}" for k, row in enumerate(values)]
    rows = [row.replace("[", "").replace("]", "") for row in rows]
    del rows[500:503]
    rows[50:50], rows[300:300] = ["# a comment"], [""]
    path.write_text("\r\n".join([HEAD.strip(), *rows]))
    layout = CSV._replace(max_gap_s=0.1, axes_order="y-xz", time_unit="iso")
    whole = records.read_record(path, layout)
    monkeypatch.setattr(reader, "_BATCH_ROWS", 10)
    again = records.read_record(path, layout)
    assert same_bits(whole.dtheta, again.dtheta) and same_bits(whole.dv, again.dv)
    assert whole[2:] == again[2:] and whole.remarks[0].startswith("3 missing samples")


# --- reference

LEVEL = "time_s,pitch_deg,roll_deg"
SIGMAS = "sigma_e_deg,sigma_n_deg,sigma_u_deg"


def test_reference_accepts_headings_and_record_time_column(tmp_path):
    path, columns = tmp_path / "r.parquet", {"pitch_deg": [1.0] * 3, "roll_deg": [2.0] * 3}
    columns |= {"stamp": [0, 1000, 2000], "heading_deg": [350.0, 351.0, 352.0]}
    pq.write_table(pa.table(columns), path)
    layout = CSV._replace(time_column="stamp", time_unit="ms")
    reference = records.read_reference(path, layout)
    np.testing.assert_array_equal(reference.time_s, [0, 1, 2])
    np.testing.assert_array_equal(reference.attitude_deg[:, 2], [-350, -351, -352])
    assert_refusal(refusal_line(records.read_reference, path), f"{path}: column 'time_s'")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (f"{LEVEL}\n0,1,2\n", "yaw_deg heading_deg 'time_s"),
        (f"{LEVEL},yaw_deg\n0,1,2,3\n\n0,1,2,3\n", "row 4: time_s"),
        (f"{LEVEL},yaw_deg,sigma_e_deg\n0,1,2,3,4\n", "column 'sigma_n_deg'"),
        (f"{LEVEL},yaw_deg,{SIGMAS}\n0,1,2,3,1,-1,1\n", "row 2: sigma negative"),
    ],
)
def test_invalid_reference_is_refused(tmp_path, text, told):
    path = tmp_path / "r.csv"
    path.write_text(text)
    assert_refusal(refusal_line(records.read_reference, path), f"{path}: {told}")


# --- the real record


def test_real_psins_record_and_its_reference_are_read(data_dir):
    record = records.read_record(data_dir / "lasergyro_0_900.imu", records.PSINS_LAYOUT)
    assert (len(record.dtheta), record.rate_hz, record.latitude_deg) == (90_000, 100.0, 34.246048)
    assert np.linalg.norm(record.dv.mean(0)) * 100 == pytest.approx(9.79548, abs=2e-5)
    reference = records.read_reference(data_dir / "lasergyro_0_900_reference.csv")
    np.testing.assert_array_equal(reference.time_s, np.arange(901.0))
    np.testing.assert_array_equal(reference.attitude_deg[0], [0.897249, 0.166239, -90.588884])
    assert reference.sigma_deg is not None and reference.sigma_deg[0, 2] == 0.047809
