"""Result tables: their columns, the conditions for nulls, and reading them from a directory."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.chunks import chunk
from support.stored_results import store_results, write_manifest, write_part
from support.studies import BASE, STILL, small_study, with_paper_values
from support.sweep_directories import read_files_and_times
from support.synthetic_tables import synthetic_summary

from sinsjax import columns
from sinsjax.arena.simulated_record import simulated_record
from sinsjax.errors import InputError
from sinsjax.execution import run, tables
from sinsjax.execution.directory import read_manifest
from sinsjax.execution.results import read_curves, read_summary
from sinsjax.execution.tasks import Job
from sinsjax.study import sampling
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study
from sinsjax.types import Vec3
from sinsjax.units import ARCMIN, DEG

CONTRACT = """
run_id draw_id variant_id method reset_count reset_cycle_s reset_times_s start_s
phi_e0_deg phi_n0_deg phi_u0_deg phi_e_arcmin phi_n_arcmin phi_u_arcmin pitch_deg roll_deg yaw_deg
sigma_e_arcmin sigma_n_arcmin sigma_u_arcmin phi_u_mean_arcmin phi_u_std_arcmin phi_e_mean_arcmin
phi_e_std_arcmin phi_n_mean_arcmin phi_n_std_arcmin pitch_mean_deg pitch_std_deg roll_mean_deg
roll_std_deg yaw_mean_deg yaw_std_deg floor_arcmin settle_60_s settle_10_s settle_3_s nees nis_u
status settle_60_truth_s settle_10_truth_s settle_3_truth_s has_floor ok_floor ok_truth
""".split()


FROM_FLOOR = {"judged_from": "floor", "dwell_s": 0.0}
"""A study that judges from the bias floor."""


def summary_of(study: Study, *given: Any, has_truth: bool = True, **named: Any) -> pa.Table:
    """Return the summary of a chunk of results, see `support.chunks.chunk`."""
    rows = given[0] if named == {} and len(given) == 1 else chunk(*given, **named)
    builder = tables.TableBuilder(study, has_truth=has_truth)
    return builder.summary_table(rows, np.arange(study.n_variants))


def test_summary_has_contract_columns_and_axis_columns() -> None:
    study = small_study(
        axes={"q_reading": ["psd", "per_step"], "p0_yaw_deg": [40.0, 80.0], "reset_count": [0, 2]},
        resets={"reset_cycle_s": 2.0},
    )
    table = summary_of(study, [0.0] * 8, [[0.0] * 3] * 8)
    assert len(set(table.column_names)) == table.num_columns
    assert {*CONTRACT, "q_reading", "p0_yaw_deg"} <= set(table.column_names)
    assert table["q_reading"].to_pylist() == ["psd"] * 4 + ["per_step"] * 4
    assert table["reset_count"].to_pylist() == [0, 2] * 4
    assert table["reset_times_s"].to_pylist() == [[], [2.0, 4.0]] * 4
    assert table.schema.field("phi_u_arcmin").metadata[b"unit"] == b"arcmin"
    swept = small_study(axes={"gyro_bias_deg_per_h": [0.1, [0.1, 0.0, 0.0]]})
    table = summary_of(swept, [0.0] * 2, [[0.0] * 3] * 2)
    assert table["gyro_bias_deg_per_h"].to_pylist() == [[0.1], [0.1, 0.0, 0.0]]
    bands = small_study(study={"settle_bands_arcmin": [30.0]})  # and that of the status
    assert {"settle_30_s", "settle_10_s"} <= set(summary_of(bands, [0.0], [[0.0] * 2]).column_names)


def test_key_columns_carry_unit_and_meaning() -> None:
    drawn = {"gyro_bias_deg_per_h": "deg/h", "gyro_misalignment_arcsec": "arcsec"}
    swept = {"accel_vrw_ug_per_sqrt_hz": [1.0, 2.0], "gravity_m_per_s2": [9.8, 9.81]}
    laws = {key: {"normal": [0, 1]} for key in drawn}
    tables_ = BASE | {"sensors": {}, "earth": {"latitude_deg": 32.0}, "drawn": laws, "axes": swept}
    study = study_from_dict(with_paper_values(tables_))
    schema = columns.arrow_schema(tables.TableBuilder(study).summary_columns)
    units = drawn | {"accel_vrw_ug_per_sqrt_hz": "ug/sqrt(Hz)", "gravity_m_per_s2": "m/s^2"}
    for key, unit in units.items():
        how = "drawn" if key in drawn else "swept"
        assert schema.field(key).metadata[b"unit"].decode() == unit
        assert schema.field(key).metadata[b"meaning"].decode().startswith(f"{how} by the study: ")


def test_summary_gives_settling_times_and_status_per_run() -> None:
    study = small_study(
        study=FROM_FLOOR, motion=STILL, axes={"phi_u0_deg": [float(i) for i in range(4)]}
    )
    # Bands 60, 10, 3 arcmin; the run ends at 6 s.
    outside = [[0.0, 1.0, 6.0], [2.0, 6.0, 6.0], [6.0, 6.0, 6.0], [6.0, 6.0, 6.0]]
    table = summary_of(study, [-21.0, -5.0, 700.0, np.nan], outside)
    assert table["settle_60_s"].to_pylist() == [0.0, 2.0, None, None]
    assert table["settle_10_s"].to_pylist() == [1.0, None, None, None]
    assert table["status"].to_pylist() == ["ok", "not_settled", "diverged", "not_settled"]
    assert table["phi_u_arcmin"].null_count == 1
    assert table["phi_n_arcmin"].to_pylist() == pytest.approx([2.0] * 4)
    assert table["yaw_deg"].to_pylist() == pytest.approx([1 / DEG] * 4)
    broken = summary_of(study, [0.0], [[6.0, 6.0, 6.0]], yaw=np.nan)
    assert broken["status"].to_pylist() == ["nonfinite"]


def test_window_statistics_of_attitude_are_in_degrees() -> None:
    """Those of the heading error are in arcmin, with other numbers for each axis and angle."""
    rows = chunk([0.0], [[0.0] * 3])
    mean, std = (
        tuple(np.array([of * (i + 1) * unit]) for i, unit in enumerate([ARCMIN] * 3 + [DEG] * 3))
        for of in (1.0, 0.1)
    )
    rows = rows._replace(outcome=rows.outcome._replace(mean=mean, std=std))
    table = summary_of(small_study(), rows)
    names = ("phi_e{}_arcmin", "phi_n{}_arcmin", "phi_u{}_arcmin")
    names += ("pitch{}_deg", "roll{}_deg", "yaw{}_deg")
    for suffix, of in (("_mean", 1.0), ("_std", 0.1)):
        found = [table[name.format(suffix)][0].as_py() for name in names]
        assert found == pytest.approx([of * (i + 1) for i in range(6)])


def test_settling_time_is_reported_in_update_time_and_data_time() -> None:
    """The data that was there: what had been recorded by then, and no more than the record."""
    axes = {"passes": [1, 3], "phi_u0_deg": [0.0, 1.0]}
    study = small_study(study=FROM_FLOOR, motion=STILL, passes={"stored_s": 2.0}, axes=axes)
    # The first two runs end after 2 s, the others after 6 s.
    outside = [[0.0, 1.0, 2.0], [2.0, 2.0, 2.0], [1.0, 2.0, 5.0], [3.0, 4.0, 6.0]]
    table = summary_of(study, [-21.0] * 4, outside)
    for band, settled, data in (
        (60, [0.0, None, 1.0, 3.0], [0.0, None, 1.0, 2.0]),
        (10, [1.0, None, 2.0, 4.0], [1.0, None, 2.0, 2.0]),
        (3, [None, None, 5.0, None], [None, None, 2.0, None]),
    ):
        assert table[f"settle_{band}_s"].to_pylist() == settled
        assert table[f"settle_{band}_data_s"].to_pylist() == data
    assert table["status"].to_pylist() == ["ok", "not_settled", "ok", "ok"]
    study = small_study(passes={"stored_s": 2.0})
    table = summary_of(study, [0.0], [[0.0] * 3], has_truth=False)
    assert table["settle_10_data_s"].null_count == 1
    left = {name for name in CONTRACT if table[name].null_count == 0}
    assert {"pitch_deg", "yaw_mean_deg", "yaw_std_deg", "sigma_u_arcmin"} <= left
    needing = ("phi_u_arcmin", "phi_u_mean_arcmin", "settle_10_s", "floor_arcmin", "nees", "status")
    assert not left & set(needing)


def test_values_of_method_without_covariance_are_null() -> None:
    """The engine gives nan for what follows from a covariance."""
    none = np.full(8, np.nan)
    rows = chunk([0.0] * 8, [[0.0] * 3] * 8)
    last = rows.outcome.last._replace(sigma=Vec3(none, none, none))
    unknown = {"last": last, "nees": none, "nis_u": none, "above_share": (none,) * 3}
    study = small_study(
        alignment={"method": "compass"},
        compass={"level_sigma_per_s": 0.5, "level_time_s": 2.0},
        axes={"phi_u0_deg": [float(i) for i in range(8)]},
    )
    table = summary_of(study, rows._replace(outcome=rows.outcome._replace(**unknown)))
    for name in ("sigma_u_arcmin", "nees", "nis_u", "p_above_error_share", "reset_cycle_s"):
        assert table[name].null_count == table.num_rows == 8
    assert table["phi_u_arcmin"].null_count == table["status"].null_count == 0


def test_drawn_keys_become_summary_columns() -> None:
    """A number, or one for each axis of a vector key, of the draw that a run belongs to."""
    drawn = {
        "yaw_period_s": {"values": [9.0, 10.0]},
        "gyro_scale_ppm": {"values": [[1.0, 2.0, 3.0], 4.0]},
        "phi_u0_deg": {"uniform": [-5, 5]},
    }
    none = {"motion": {"yaw_period_s": None}, "alignment": {"phi_u0_deg": None}}
    study = small_study(drawn=drawn, axes={"p0_yaw_deg": [40.0, 80.0]}, **none)
    rows = chunk([0.0] * 4, [[0.0] * 3] * 4)
    table = summary_of(
        study, rows._replace(draw=np.array([1, 1, 2, 2]), variant=np.array([0, 1, 0, 1]))
    )
    assert table["run_id"].to_pylist() == [2, 3, 4, 5]
    assert table["yaw_period_s"].to_pylist() == [10.0, 10.0, 9.0, 9.0]
    assert table["gyro_scale_ppm"].to_pylist() == [[4.0] * 3] * 2 + [[1.0, 2.0, 3.0]] * 2
    phi = sampling.drawn_values(study, 3)["phi_u0_deg"]
    assert table["phi_u0_deg"].to_pylist() == [phi[1], phi[1], phi[2], phi[2]]


def test_single_precision_is_refused_without_deleting_results(tmp_path: Path) -> None:
    study = small_study()
    store_results(tmp_path / "out", study, synthetic_summary(study))
    before = read_files_and_times(tmp_path / "out")
    with jax.enable_x64(False):
        for call in (
            lambda: run.run_into(study, tmp_path / "out", overwrite=True),
            lambda: run.run(study),
            lambda: simulated_record(study),
        ):
            with pytest.raises(InputError, match="double precision"):
                call()
    assert read_files_and_times(tmp_path / "out") == before


# --- reading ------------------------------------------------------------------------------------


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    """Return a directory with two parts of two runs, the later ones first."""
    study = small_study()
    for part, runs in enumerate(([2, 3], [0, 1])):
        rows = {"run_id": runs, "status": ["ok", None], "nees": [float(runs[0]), None]}
        curves = {"run_id": [*runs, *runs], "time_s": [2.0, 2.0, 1.0, 1.0]}
        for dataset, values in (("summary", rows), ("curves", curves)):
            path = tmp_path / dataset / f"part-0000-00000{part}.parquet"
            table = pa.table(values).replace_schema_metadata({"part": str(part)})
            write_part(path, table, Job(study).identity)
    write_manifest(tmp_path, study)
    return tmp_path


def test_rows_are_sorted_and_columns_and_runs_selected(stored: Path) -> None:
    assert read_summary(stored)["run_id"].to_pylist() == [0, 1, 2, 3]
    curves = read_curves(stored)
    assert curves["run_id"].to_pylist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert curves["time_s"].to_pylist() == [1.0, 2.0] * 4
    assert read_curves(stored, [1, 2])["run_id"].to_pylist() == [1, 1, 2, 2]
    assert read_curves(stored, []).num_rows == 0
    # What a part says of itself does not hold for all rows.
    schema = {b"sinsjax.schema": columns.SCHEMA_VERSION.encode()}
    assert read_summary(stored).schema.metadata == schema
    table = read_summary(stored, ["nees", "run_id"], run_ids=[2, 0, 9])
    assert table.to_pylist() == [{"nees": 0.0, "run_id": 0}, {"nees": 2.0, "run_id": 2}]
    assert read_summary(stored, ["status", "nees"]).column_names == ["status", "nees"]
    with pytest.raises(InputError, match="summary: column nees_u is missing"):
        read_summary(stored, ["nees", "nees_u"])


def test_directory_without_results_is_refused_in_one_line(tmp_path: Path) -> None:
    for read in (read_summary, read_manifest):
        with pytest.raises(InputError, match="out: contains no results"):
            read(tmp_path / "out")
    assert read_curves(tmp_path / "out", [1]).num_rows == 0
    (tmp_path / "manifest.json").write_bytes(b"null")
    with pytest.raises(InputError, match="manifest.json: has changed since"):
        read_manifest(tmp_path)


def test_part_that_no_manifest_counts_is_read_and_verified(stored: Path) -> None:
    """A sweep writes its manifest less often than its parts."""
    write_manifest(stored, small_study(), runs_done=0)
    assert read_summary(stored).num_rows == 4 and read_curves(stored).num_rows == 8
    (stored / "manifest.json").unlink()
    assert read_summary(stored).num_rows == 4
    path = stored / "summary" / "part-0000-000001.parquet"
    pq.write_table(pq.read_table(path), path)
    with pytest.raises(InputError, match=r"part-0000-000001\.parquet: has changed since"):
        read_summary(stored)
    assert read_summary(stored, verify=False)["run_id"].to_pylist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda path: path.rename(path.with_name("part-0000-000007.parquet")), "another name"),
        (lambda path: path.replace(path.parents[1] / "curves" / path.name), "another name"),
        (
            lambda path: write_part(path, pa.table({"run_id": [1]}), "0123456789abcdef"),
            "of another study's results",
        ),
    ],
)
def test_intact_part_of_another_place_is_refused(
    stored: Path, change: Callable[[Path], object], words: str
) -> None:
    (stored / "manifest.json").unlink() if "name" in words else None
    change(stored / "summary" / "part-0000-000001.parquet")
    with pytest.raises(InputError, match=words):
        read_summary(stored), read_curves(stored)


def test_missing_parts_are_noticed(stored: Path) -> None:
    write_manifest(stored, small_study(), curves=True)
    (path,) = stored.glob("curves/*1.parquet")
    path.unlink()
    with pytest.raises(InputError, match=rf"curves/{path.name}: is missing \(`--resume`"):
        read_curves(stored)
    assert read_summary(stored).num_rows == 4
    (stored / "summary" / path.name).unlink()
    with pytest.raises(InputError, match=r"summary: parts are missing: 2 of 4 runs .*`--resume`"):
        read_summary(stored)
    assert read_summary(stored, verify=False).num_rows == 2
