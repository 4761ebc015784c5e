"""A run repeated alone has the same bits as in its sweep."""

import shutil

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console
from support.record_files import write_psins
from support.stored_results import write_part
from support.studies import add_true_reference, recorded_study, small_study
from support.sweep_directories import STUDIES, make_study

import sinsjax as package
from sinsjax.errors import InputError
from sinsjax.execution.run import repeat_run, rerun_stored_run
from sinsjax.execution.tables import replace_column
from sinsjax.execution.tasks import Job
from sinsjax.records import PSINS_LAYOUT, read_psins_counts
from sinsjax.records.reference import StoredRecord

pytestmark = [pytest.mark.usefixtures("drawn_on_request"), pytest.mark.optimised(False)]

SHORT = {"duration_s": 2.0, "window_s": [0, 2], "curves": True}


@pytest.mark.nightly
@pytest.mark.parametrize("name", STUDIES)
def test_rerun_matches_run_of_whole_study(name):
    study = make_study(name)
    whole, runs = package.run(study), study.n_variants * study.n_draws
    for run_id in (0, 65, runs // 2 + 1, runs - 1):
        again = repeat_run(study, run_id)
        row, curve = again["summary"], again["curves"]
        assert row.num_rows == 1
        for table, one in ((whole.summary, row), (whole.curves, curve)):
            assert one.equals(table.filter(pa.compute.equal(table["run_id"], run_id))), run_id
        last = curve.slice(curve.num_rows - 1)
        for name in ("phi_u_arcmin", "sigma_n_arcmin", "yaw_deg"):
            assert last[name].to_pylist() == row[name].to_pylist()


@pytest.mark.nightly
def test_rerun_and_resume_of_recorded_runs_need_the_same_record(tmp_path):
    stored = add_true_reference(package.simulated_record(small_study()))
    path, other, out = tmp_path / "swing.imu", tmp_path / "other.imu", tmp_path / "out"
    write_psins(stored.record, path)
    write_psins(stored.record._replace(dv=stored.record.dv * 1.01), other)
    axes = {"phi_u0_deg": [0.0, 3.0], "reset_times_s": [[], [1.0]]}
    study = recorded_study(study=SHORT, record={"start_s": [0.0, 0.5]}, axes=axes)
    package.run_into(study, out, StoredRecord(read_psins_counts(path, PSINS_LAYOUT), None))
    with pytest.raises(InputError, match="contains results of another record or reference"):
        package.run_into(study, out, stored, resume=True)
    with pytest.raises(InputError, match=r"needs a record \(give it with --record\)"):
        repeat(out, 3)
    with pytest.raises(InputError, match="the results are of another record or reference"):
        repeat(out, 3, files=(other, None))
    assert repeat(out, 3, files=(path, None))


STUDY = small_study(study=SHORT | {"draws": 4}, axes={"p0_yaw_deg": [1.0 + i for i in range(64)]})
"""A draw fills a tile, so that one program runs all draws, or one again."""


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return package.run_into(STUDY, tmp_path_factory.mktemp("reruns") / "out").directory


def repeat(directory, run_id, **options):
    return rerun_stored_run(directory, run_id, Console(quiet=True), **options)


def test_rerun_command_exits_1_when_the_row_differs(sinsjax, out, tmp_path):
    stored = package.read_summary(out, run_ids=[0])
    code, said, _ = sinsjax("rerun", out, "--run-id", 0, "-o", tmp_path / "one")
    assert code == 0 and f"phi_u_arcmin  {stored['phi_u_arcmin'][0].as_py()}\n" in said
    assert pq.read_table(tmp_path / "one" / "summary.parquet").to_pylist() == stored.to_pylist()
    curve = pq.read_table(tmp_path / "one" / "curve.parquet")
    assert curve["time_s"].to_pylist() == [1.0, 2.0] and not any(curve["run_id"].to_pylist())
    with pytest.raises(InputError, match="has no run 256"):
        repeat(out, 256)
    with pytest.raises(InputError, match=r"has no \[record\] section"):
        repeat(out, 0, files=(tmp_path / "swing.imu", None))
    changed = shutil.copytree(out, tmp_path / "changed")
    part = min(changed.glob("summary/*.parquet"))
    table = pq.read_table(part)
    yaw = pa.compute.add(table["yaw_deg"], 1e-13).combine_chunks()
    write_part(part, replace_column(table, "yaw_deg", yaw), Job(STUDY).input_hash)
    code, said, _ = sinsjax("rerun", changed, "--run-id", 0, "-o", tmp_path / "two")
    assert code == 1 and "identical" not in said
    assert f"1 of {table.num_columns} columns differ from the stored row: yaw_deg" in said
