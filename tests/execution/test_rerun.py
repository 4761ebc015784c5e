"""A run repeated alone has the same bits as in its sweep."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console
from support.commands import command_line
from support.record_files import write_psins
from support.studies import add_true_reference, small_study, with_paper_values
from support.sweep_directories import STUDIES, make_study, read_files_and_times

from sinsjax.arena.simulated_record import simulated_record
from sinsjax.errors import InputError
from sinsjax.execution import rerun
from sinsjax.execution import run as study_run
from sinsjax.execution.results import read_part_metadata, read_summary
from sinsjax.execution.sealed import to_sealed_parquet
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
        again = rerun.repeat_run(study, run_id, stored)
        assert again.row.num_rows == 1
        for table, one in ((whole.summary, again.row), (whole.curves, again.curve)):
            if table.num_rows:
                assert one.equals(table.filter(pa.compute.equal(table["run_id"], run_id))), run_id
        last = again.curve.slice(again.curve.num_rows - 1)
        for name in ("phi_u_arcmin", "sigma_n_arcmin", "yaw_deg"):
            assert last[name].to_pylist() == again.row[name].to_pylist()


@pytest.mark.nightly
@pytest.mark.parametrize("name", STUDIES)
def test_rerun_matches_run_of_whole_study(name: str) -> None:
    study = make_study(name)
    runs = study.n_draws * study.n_variants
    chosen = [0, 65, runs // 2 + 1, runs - 1]
    assert {run % study.n_variants for run in chosen} != {0}
    assert_alone_as_among_others(study, runs=chosen)


@pytest.mark.nightly
def test_rerun_matches_with_resets_tied_to_feedback() -> None:
    """Of the schedule and of a trigger; the clock of some runs in a tile starts anew."""
    study = small_study(
        study=SHORT | {"draws": 20, "curves": True},
        alignment={"feedback_interval_s": 0.3},
        filter={"r_velocity_m_per_s": 1e-3},
        resets={
            "reset_trigger": "innovation",
            "trigger_window_s": 0.01,
            "trigger_threshold": 3e-4,
            "reset_times_s": [1.37],
        },
        axes={"reset_at_feedback": [False, True], "reset_restarts_feedback": [False, True]},
    )
    assert_alone_as_among_others(study, runs=[1, 2, 77])


@pytest.mark.nightly
@pytest.mark.optimised(True)
def test_rerun_matches_in_study_that_stopped_early() -> None:
    """After 64 draws of 6 variants, compiled as shipped."""
    study = small_study(
        study=SHORT | {"draws": 150},
        stop_when={"statistic": "success_rate", "half_width": 0.4},
        axes={"phi_u0_deg": [0.0, 1.0, 2.0], "reset_times_s": [[], [1.37]]},
    )
    assert_alone_as_among_others(study, runs=[5, 383])


# --- records ------------------------------------------------------------------------------------


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
def test_rerun_of_recorded_run_needs_same_record(tmp_path: Path, stored: StoredRecord) -> None:
    path, other, out = tmp_path / "swing.imu", tmp_path / "other.imu", tmp_path / "out"
    write_psins(stored.record, path)
    write_psins(stored.record._replace(dv=stored.record.dv * 1.01), other)
    study = recorded_study(earth={"latitude_deg": 32.0})
    study_run.run_into(study, out, StoredRecord(read_psins(path, PSINS_LAYOUT), None))
    with pytest.raises(InputError, match=r"needs a record \(give it with --record\)"):
        rerun_into(out, 3)
    with pytest.raises(InputError, match="the results are of another record or reference"):
        rerun_into(out, 3, files=(other, None))
    assert "The row is identical to the stored one" in rerun_into(out, 3, files=(path, None))


# --- directories --------------------------------------------------------------------------------

STUDY = small_study(
    study=SHORT | {"draws": 4, "curves": True}, axes={"p0_yaw_deg": [1.0 + i for i in range(64)]}
)
"""A draw fills a tile, so that one program runs all draws, or one again."""


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("reruns") / "out"
    study_run.run_into(STUDY, directory)
    return directory


def rerun_into(directory: Path, run_id: int, **options: Any) -> str:
    file = io.StringIO()
    rerun.rerun_stored_run(directory, run_id, Console(file=file, width=40), **options)
    return file.getvalue()


@pytest.mark.nightly
def test_rerun_from_directory_is_printed_and_stored(out: Path, tmp_path: Path) -> None:
    before = read_files_and_times(out)
    told = rerun_into(out, 77, out=tmp_path / "one")
    stored = read_summary(out, run_ids=[77])
    assert f"The row is identical to the stored one in all {stored.num_columns} columns." in told
    assert f"phi_u_arcmin  {stored['phi_u_arcmin'][0].as_py()}\n" in told
    assert pq.read_table(tmp_path / "one" / "summary.parquet").to_pylist() == stored.to_pylist()
    curve = pq.read_table(tmp_path / "one" / "curve.parquet")
    assert curve["time_s"].to_pylist() == [1.0, 2.0]
    assert set(curve["run_id"].to_pylist()) == {77}
    assert read_files_and_times(out) == before
    rerun_into(out, 78)
    there = {"summary.parquet", "curve.parquet", "curve.png"}
    study_run.run_into(STUDY, out, resume=True)
    assert {p.name for p in (out / "reruns" / "78").iterdir()} == there
    assert read_summary(out).num_rows == STUDY.n_draws * STUDY.n_variants


@contextmanager
def change_headings(out: Path, by: float) -> Iterator[int]:
    """Change the stored headings of the first rows; return the number of columns."""
    (part, *_) = sorted(out.glob("summary/*.parquet"))
    content = part.read_bytes()
    table, marks = pq.read_table(part), read_part_metadata(content)
    column = table.column_names.index("yaw_deg")
    yaw = pa.compute.add(table["yaw_deg"], by)
    changed = table.set_column(column, table.schema.field(column), yaw)
    part.write_bytes(to_sealed_parquet(changed, marks))
    try:
        yield table.num_columns
    finally:
        part.write_bytes(content)


def test_rerun_command_exits_1_when_the_row_differs(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sinsjax = command_line(monkeypatch, capsys)
    with change_headings(out, 1e-13) as columns:
        code, said, _ = sinsjax("rerun", out, "--run-id", 0, "-o", tmp_path / "one")
    assert code == 1 and "identical" not in said
    assert f"1 of {columns} columns differ from the stored row: yaw_deg " in said
    assert sinsjax("rerun", out, "--run-id", 0, "-o", tmp_path / "two")[0] == 0


def test_invalid_rerun_raises_one_line_error(
    out: Path, tmp_path: Path, stored: StoredRecord
) -> None:
    runs = STUDY.n_draws * STUDY.n_variants
    with pytest.raises(InputError, match=f"has no run {runs} .runs are numbered 0 to {runs - 1}"):
        rerun_into(out, runs)
    with pytest.raises(InputError, match="nothing"):
        rerun_into(tmp_path / "nothing", 0)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="file: cannot be written"):
        rerun_into(out, 0, out=tmp_path / "file")
    write_psins(stored.record, tmp_path / "swing.imu")
    with pytest.raises(InputError, match=r"has no \[record\] section"):
        rerun_into(out, 0, files=(tmp_path / "swing.imu", None))
