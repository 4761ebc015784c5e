"""A run repeated alone has the same bits as in its sweep."""

import shutil
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console
from support.commands import command_line
from support.record_files import write_psins
from support.stored_results import write_part
from support.studies import add_true_reference, small_study, with_paper_values
from support.sweep_directories import STUDIES, make_study

from sinsjax.arena.export import simulated_record
from sinsjax.errors import InputError
from sinsjax.execution import run as study_run
from sinsjax.execution.results import read_summary
from sinsjax.execution.run import repeat_run, rerun_stored_run
from sinsjax.execution.tables import replace_column
from sinsjax.execution.tasks import Job
from sinsjax.records import PSINS_LAYOUT, read_psins
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study

pytestmark = [pytest.mark.usefixtures("drawn_on_request"), pytest.mark.optimised(False)]

SHORT = {"duration_s": 2.0, "window_s": [0, 2]}


def assert_alone_as_among_others(
    study: Study, stored: StoredRecord | None = None, *, runs: list[int]
) -> None:
    whole = study_run.run(study, stored)
    for run_id in runs:
        again = repeat_run(study, run_id, stored)
        row, curve = again["summary"], again["curves"]
        assert row.num_rows == 1
        for table, one in ((whole.summary, row), (whole.curves, curve)):
            if table.num_rows:
                assert one.equals(table.filter(pa.compute.equal(table["run_id"], run_id))), run_id
        last = curve.slice(curve.num_rows - 1)
        for name in ("phi_u_arcmin", "sigma_n_arcmin", "yaw_deg"):
            assert last[name].to_pylist() == row[name].to_pylist()


@pytest.mark.nightly
@pytest.mark.parametrize("name", STUDIES)
def test_rerun_matches_run_of_whole_study(name: str) -> None:
    study = make_study(name)
    runs = study.n_variants * study.n_draws
    assert_alone_as_among_others(study, runs=[0, 65, runs // 2 + 1, runs - 1])


def recorded_study(**changes: Any) -> Study:
    sections = {
        "study": SHORT | {"rate_hz": 100.0, "curves": True},
        "alignment": {"phi_e0_deg": 1.0},
        "record": {"format": "psins", "start_s": [0.0, 0.5, 1.0]},
        "coarse": {"coarse_duration_s": 3.0},
        "axes": {"phi_u0_deg": [0.0, 3.0], "reset_times_s": [[], [1.0]]},
    }
    return study_from_dict(with_paper_values(sections | changes))


@pytest.fixture(scope="module")
def stored() -> StoredRecord:
    return add_true_reference(simulated_record(small_study()))


@pytest.mark.nightly
@pytest.mark.parametrize("judged", [True, False])
def test_rerun_matches_for_recorded_study(stored: StoredRecord, judged: bool) -> None:
    given = stored if judged else stored._replace(reference=None)
    assert_alone_as_among_others(recorded_study(), given, runs=[0, 6, 11])


@pytest.mark.nightly
def test_rerun_and_resume_of_recorded_runs_need_the_same_record(
    tmp_path: Path, stored: StoredRecord
) -> None:
    path, other, out = tmp_path / "swing.imu", tmp_path / "other.imu", tmp_path / "out"
    write_psins(stored.record, path)
    write_psins(stored.record._replace(dv=stored.record.dv * 1.01), other)
    study = recorded_study(earth={"latitude_deg": 32.0})
    study_run.run_into(study, out, StoredRecord(read_psins(path, PSINS_LAYOUT), None))
    with pytest.raises(InputError, match="contains results of another record or reference"):
        study_run.run_into(study, out, stored, resume=True)
    with pytest.raises(InputError, match=r"needs a record \(give it with --record\)"):
        repeat(out, 3)
    with pytest.raises(InputError, match="the results are of another record or reference"):
        repeat(out, 3, files=(other, None))
    assert repeat(out, 3, files=(path, None))


STUDY = small_study(
    study=SHORT | {"draws": 4, "curves": True}, axes={"p0_yaw_deg": [1.0 + i for i in range(64)]}
)
"""A draw fills a tile, so that one program runs all draws, or one again."""


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("reruns") / "out"
    study_run.run_into(STUDY, directory)
    return directory


def repeat(directory: Path, run_id: int, **options: Any) -> bool:
    return rerun_stored_run(directory, run_id, Console(quiet=True), **options)


def test_rerun_command_exits_1_when_the_row_differs(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sinsjax, stored = command_line(monkeypatch, capsys), read_summary(out, run_ids=[0])
    code, said, _ = sinsjax("rerun", out, "--run-id", 0, "-o", tmp_path / "one")
    assert code == 0 and f"phi_u_arcmin  {stored['phi_u_arcmin'][0].as_py()}\n" in said
    assert pq.read_table(tmp_path / "one" / "summary.parquet").to_pylist() == stored.to_pylist()
    curve = pq.read_table(tmp_path / "one" / "curve.parquet")
    assert curve["time_s"].to_pylist() == [1.0, 2.0] and not any(curve["run_id"].to_pylist())
    changed = Path(shutil.copytree(out, tmp_path / "changed"))
    (part, *_) = sorted(changed.glob("summary/*.parquet"))
    table = pq.read_table(part)
    yaw = pa.compute.add(table["yaw_deg"], 1e-13).combine_chunks()
    write_part(part, replace_column(table, "yaw_deg", yaw), Job(STUDY).identity)
    code, said, _ = sinsjax("rerun", changed, "--run-id", 0, "-o", tmp_path / "two")
    assert code == 1 and "identical" not in said
    assert f"1 of {table.num_columns} columns differ from the stored row: yaw_deg" in said


def test_invalid_rerun_raises_one_line_error(
    out: Path, tmp_path: Path, stored: StoredRecord
) -> None:
    with pytest.raises(InputError, match="has no run 256"):
        repeat(out, 256)
    with pytest.raises(InputError, match="nothing"):
        repeat(tmp_path / "nothing", 0)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="file: cannot be written"):
        repeat(out, 0, out=tmp_path / "file")
    write_psins(stored.record, tmp_path / "swing.imu")
    with pytest.raises(InputError, match=r"has no \[record\] section"):
        repeat(out, 0, files=(tmp_path / "swing.imu", None))
