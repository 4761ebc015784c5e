"""A results directory after damage, interruption and changes, in this process.

What takes real processes and real signals is in `test_kills`.
"""

import json
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from matplotlib.figure import Figure
from support.studies import PAPER, small_study
from support.sweep_directories import (
    CHUNK_RUNS,
    CHUNKS,
    TaskRecorder,
    assert_complete,
    modification_times,
    read_files_and_times,
    read_manifest_entries,
    read_parts,
    rewrite_manifest,
    sweep_study,
)

from sinsjax import plots
from sinsjax.arena.simulated_record import simulated_record
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution import forecast, store
from sinsjax.execution import run as study_run
from sinsjax.execution.prepare import RunOptions, prepare_job
from sinsjax.execution.results import read_summary
from sinsjax.execution.sealed import to_sealed_parquet
from sinsjax.execution.tasks import Job, TaskRunner
from sinsjax.platform import files
from sinsjax.records import Reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

STUDY = sweep_study()


def sweep(directory: Path, study: Study = STUDY, **options: Any) -> list[str]:
    """Run a study into a directory; return the names of the computed chunks."""
    recorder = TaskRecorder()
    options = {"chunk_runs": CHUNK_RUNS} | options
    study_run.run_into(study, directory, executor=recorder.executor, **options)
    return recorder.done


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results of an uninterrupted run."""
    directory = tmp_path_factory.mktemp("whole") / "out"
    assert len(sweep(directory)) == CHUNKS
    return directory


@pytest.fixture
def out(uninterrupted: Path, tmp_path: Path) -> Path:
    """Return a copy of the results of an uninterrupted run."""
    return Path(shutil.copytree(uninterrupted, tmp_path / "out"))


def prepared(directory: Path, **options: Any) -> Job:
    return prepare_job(STUDY, options=RunOptions(directory, chunk_runs=CHUNK_RUNS, **options))


def chunk_name(number: int) -> str:
    return f"part-{number // 6:04d}-{number % 6:06d}"


# --- parts --------------------------------------------------------------------------------------


def test_part_metadata_identify_study_and_chunk_only(uninterrupted: Path) -> None:
    for name in read_parts(uninterrupted):
        about = pq.ParquetFile(uninterrupted / name)
        metadata = about.schema_arrow.metadata
        assert metadata.keys() == {b"sinsjax.schema", b"sinsjax.study", b"sinsjax.chunk"}
        assert metadata[b"sinsjax.study"].decode() == Job(STUDY).identity
        assert json.loads(metadata[b"sinsjax.chunk"]) == {
            "dataset": name.split("/")[0],
            "name": Path(name).stem,
            "part": int(name.split("-")[1]),
            "draws": [0, 48],
            "call": int(name.split("-")[2].removesuffix(".parquet")),
            "runs": CHUNK_RUNS,
            "rows": about.metadata.num_rows,
            "chunk_runs": CHUNK_RUNS,
        }


# --- what can befall a part ---------------------------------------------------------------------


def flip_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0x10
    path.write_bytes(content)


def rewrite(table: pa.Table, path: Path) -> None:
    """Write a part as the engine does."""
    path.write_bytes(to_sealed_parquet(table))


def swap_files(path: Path) -> None:
    path.write_bytes((path.parent / f"{chunk_name(9)}.parquet").read_bytes())


def replace_by_foreign_part(path: Path) -> None:
    table = pq.read_table(path)
    metadata = table.schema.metadata | {b"sinsjax.study": b"0123456789abcdef"}
    rewrite(table.replace_schema_metadata(metadata), path)


def drop_last_row(path: Path) -> None:
    table = pq.read_table(path)
    rewrite(table.slice(0, table.num_rows - 1), path)


DAMAGES: dict[str, Callable[[Path], None]] = {
    "gone": Path.unlink,
    "half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]) and None,
    "a bit in a page": flip_bit,
    "another chunk's": swap_files,
    "another study's": replace_by_foreign_part,
    "a row less": drop_last_row,
}


def edit_chunk_runs(path: Path) -> None:
    path.write_text(path.read_text().replace(f'"chunk_runs": {CHUNK_RUNS}', '"chunk_runs": 256'))


MANIFESTS: dict[str, Callable[[Path], Any]] = {
    "there": lambda directory: None,
    "deleted": lambda directory: (directory / "manifest.json").unlink(),
    "garbled": lambda directory: (directory / "manifest.json").write_text('{"schema": "1", "st'),
    "denying": lambda directory: rewrite_manifest(directory, runs_done=0),
    "another's": lambda directory: (directory / "manifest.json").write_text("[" * 20_000),
    "edited": lambda directory: edit_chunk_runs(directory / "manifest.json"),
}


@pytest.mark.nightly(
    fast=(
        *("gone-there", "gone-deleted", "a bit in a page-there", "another chunk's-there"),
        *("another study's-deleted", "a row less-deleted"),
    )
)
@pytest.mark.parametrize("told", ["there", "deleted"])
@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_part_is_detected_and_recomputed(
    uninterrupted: Path, out: Path, name: str, told: str
) -> None:
    before = modification_times(out)
    DAMAGES[name](out / "summary" / f"{chunk_name(2)}.parquet")
    DAMAGES[name](out / "curves" / f"{chunk_name(7)}.parquet")
    MANIFESTS[told](out)
    assert sweep(out, resume=True) == [chunk_name(2), chunk_name(7)]
    assert_complete(out, uninterrupted)
    kept = {key for key, time in modification_times(out).items() if before[key] == time}
    assert {
        key for key in before if chunk_name(2) in key or chunk_name(7) in key
    } == before.keys() - kept


@pytest.mark.parametrize("told", MANIFESTS)
def test_intact_parts_are_kept_for_any_manifest_state(
    uninterrupted: Path, out: Path, told: str
) -> None:
    before = modification_times(out)
    MANIFESTS[told](out)
    assert sweep(out, resume=True) == []
    assert modification_times(out) == before
    assert_complete(out, uninterrupted)


@pytest.mark.parametrize("name", ["chunk_runs", "all of it", "study.toml too"])
def test_chunk_size_is_recovered_from_parts_without_manifest(
    uninterrupted: Path, out: Path, name: str
) -> None:
    """The default would cut this study into other chunks, none of which is there."""
    (out / "manifest.json").unlink()
    (out / "summary" / f"{chunk_name(0)}.parquet").write_bytes(b"no part")
    if name == "study.toml too":
        (out / "study.toml").unlink()
    options = {"chunk_runs": {"chunk_runs": CHUNK_RUNS}.get(name)}
    assert sweep(out, resume=True, **options) == [chunk_name(0)]
    assert_complete(out, uninterrupted)


def test_resume_keeps_chunk_size_and_curves_of_directory(uninterrupted: Path, out: Path) -> None:
    shutil.rmtree(out / "curves")
    made = sweep(out, resume=True, chunk_runs=None, curves=False)
    assert len(made) == CHUNKS
    assert_complete(out, uninterrupted)
    assert sweep(out, resume=True, chunk_runs=CHUNK_RUNS) == []
    with pytest.raises(InputError) as told:
        sweep(out, resume=True, chunk_runs=1024)
    assert f"out: chunk_runs: 1024 requested, but its results were begun with {CHUNK_RUNS} " in str(
        told.value
    )
    assert_complete(out, uninterrupted)


# --- what is refused ----------------------------------------------------------------------------


def changed_study(**changes: Any) -> Study:
    """Return the study with changed keys; those set to None are omitted."""
    data = STUDY.model_dump(exclude_none=True)
    data["axes"] |= data.pop("zips")
    data = {name: dict(table) for name, table in data.items() if table}
    for name, change in changes.items():
        merged = data.get(name, {}) | change
        data[name] = {key: value for key, value in merged.items() if value is not None}
    return study_from_dict(data)


def test_resume_with_other_study_reports_differing_keys(out: Path) -> None:
    before = read_files_and_times(out)
    other = changed_study(study={"draws": 49, "name": "b"}, filter={"p0_level_deg": 14.0})
    line = (
        r"out: contains results of another study: \[filter\] p0_level_deg: 15.0 there, 14.0 here; "
    )
    with pytest.raises(InputError, match=rf"{line}\[study\] draws: 48 there, 49 here$"):
        sweep(out, other, resume=True)
    assert read_files_and_times(out) == before


def test_resume_allows_changed_name(uninterrupted: Path, out: Path) -> None:
    before = modification_times(out)
    assert sweep(out, changed_study(study={"name": "renamed"}), resume=True) == []
    assert modification_times(out) == before
    assert read_manifest_entries(out)["study"]["study"]["name"] == "renamed"
    assert 'name = "renamed"' in (out / "study.toml").read_text()
    assert_complete(out, uninterrupted)


def test_other_study_is_refused_from_its_parts(out: Path) -> None:
    """Only the parts identify their study."""
    (out / "manifest.json").write_bytes(b"\x00\xff")
    (out / "study.toml").write_text("[study")
    (out / "summary" / f"{chunk_name(0)}.parquet").write_bytes(b"no part")
    before = read_files_and_times(out)
    with pytest.raises(InputError, match="contains results of another study"):
        sweep(out, changed_study(study={"seed": 2}), resume=True)
    assert read_files_and_times(out) == before
    assert sweep(out, resume=True) == [chunk_name(0)]


def test_garbled_study_file_is_restored_on_resume(uninterrupted: Path, out: Path) -> None:
    (out / "study.toml").write_text("[study]\nduration_s = -1")
    assert sweep(out, resume=True) == []
    assert_complete(out, uninterrupted)
    assert (out / "study.toml").read_bytes() == (uninterrupted / "study.toml").read_bytes()


def test_results_of_another_schema_are_refused_by_their_version(out: Path) -> None:
    rewrite_manifest(out, schema="5", versions={"sinsjax": "3.0"})
    before = read_files_and_times(out)
    with pytest.raises(InputError, match=r"results of sinsjax 3\.0, .*schema 5.*--overwrite"):
        sweep(out, resume=True)
    assert read_files_and_times(out) == before
    assert len(sweep(out, overwrite=True)) == CHUNKS


@pytest.mark.parametrize(
    ("name", "options"),
    [("summary", {}), ("study.toml", {"resume": True}), ("manifest.json", {"overwrite": True})],
)
def test_foreign_files_are_refused_and_left_unchanged(
    tmp_path: Path, name: str, options: dict[str, bool]
) -> None:
    mine = tmp_path / name
    if "." not in name:
        mine.mkdir()
        mine = mine / "part-of-my-thesis.parquet"
    mine.write_text("mine")
    before = read_files_and_times(tmp_path)
    with pytest.raises(
        InputError, match=f"contains {name}, which is not a result .give another directory"
    ):
        sweep(tmp_path, **options)
    assert read_files_and_times(tmp_path) == before


# --- records ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded() -> tuple[Study, StoredRecord]:
    study = study_from_dict(
        {
            "study": {"duration_s": 2.0, "rate_hz": 100.0, "window_s": [0, 2]},
            "alignment": {"phi_u0_deg": 3.0},
            "record": {"format": "psins", "start_s": [0.0, 1.0]},
            "coarse": {"coarse_duration_s": 3.0},
            "filter": PAPER,
        }
    )
    time_s = np.arange(0, 6.01, 0.01)
    reference = Reference(time_s, np.zeros((len(time_s), 3)), "true.csv")
    return study, StoredRecord(simulated_record(small_study()), reference)


@pytest.mark.nightly
def test_another_record_or_reference_is_refused(
    recorded: tuple[Study, StoredRecord], tmp_path: Path
) -> None:
    study, stored = recorded
    out = tmp_path / "out"
    sweep(out, study, record=stored)
    before = read_files_and_times(out)
    record, reference = stored
    assert reference is not None
    late = record.dv.copy()
    late[-1, 2] += 1e-12
    for other in (
        StoredRecord(record._replace(dv=late), reference),
        StoredRecord(record, None),
        StoredRecord(record, reference._replace(attitude_deg=reference.attitude_deg + 1e-9)),
    ):
        with pytest.raises(InputError, match="contains results of another record or reference"):
            sweep(out, study, record=other, resume=True)
    assert read_files_and_times(out) == before
    assert sweep(out, study, record=stored, resume=True) == []
    moved = StoredRecord(record._replace(source="copy.imu"), reference._replace(source="copy.csv"))
    assert sweep(out, study, record=moved, resume=True) == []


# --- the writer ---------------------------------------------------------------------------------


def test_second_writer_of_directory_is_refused(out: Path) -> None:
    held = store.DirectoryStore(prepared(out, resume=True), {})
    before = read_files_and_times(out)
    for options in ({"resume": True}, {"overwrite": True}):
        with pytest.raises(InputError, match="out: another process is writing there"):
            sweep(out, **options)
    assert read_files_and_times(out) == before
    held.unlock()
    assert sweep(out, resume=True) == []


def test_results_written_before_lock_are_not_lost(
    out: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    """Two starts at a time on a new directory, of which one had ended when the other took hold."""
    for study, chunk_runs in ((STUDY, None), (sweep_study(study={"seed": 2}), CHUNK_RUNS)):
        options = RunOptions(tmp_path / "new", chunk_runs=chunk_runs, resume=True)
        late = prepare_job(study, options=options)._replace(directory=out)
        with pytest.raises(InputError, match="another process has just written there"):
            store.DirectoryStore(late, {})
    assert read_parts(out) == read_parts(uninterrupted)


def test_stale_temporary_files_are_removed_and_others_kept(uninterrupted: Path, out: Path) -> None:
    left = [
        ".manifest.json.77.tmp",
        ".study.toml.78.tmp",
        f"summary/.{chunk_name(1)}.parquet.79.tmp",
        f"curves/.{chunk_name(1)}.parquet.80.tmp",
        "figures/.misalignment.png.81.tmp",
    ]
    mine = [".notes.tmp", "notes.txt", "figures/mine.txt", ".manifest.json"]
    (out / "figures").mkdir()
    for name in left + mine:
        (out / name).write_bytes(b"PAR1")
    assert read_summary(out).num_rows == CHUNKS * CHUNK_RUNS
    assert sweep(out, resume=True) == []
    assert_complete_but(out, uninterrupted, mine)
    for name in left:
        (out / name).write_bytes(b"PAR1")
    assert len(sweep(out, overwrite=True)) == CHUNKS
    assert_complete_but(out, uninterrupted, mine)


def assert_complete_but(out: Path, uninterrupted: Path, mine: list[str]) -> None:
    assert {path.name for path in out.rglob(".*") if path.is_file()} == {
        ".lock",
        ".notes.tmp",
        ".manifest.json",
    }
    assert all((out / name).read_bytes() == b"PAR1" for name in mine)
    assert read_parts(out) == read_parts(uninterrupted)


def test_overwrite_keeps_user_files(uninterrupted: Path, out: Path) -> None:
    mine = [
        "summary/part-notes.txt",
        "summary/part-best.parquet",
        "summary/mine.parquet",
        "curves/part-0000-000000.csv",
        "figures/thesis.png",
        "figures/misalignment.png",
        "figures/.thesis.png.tmp",
        "reruns/mine/curve.png",
        "reruns/3/curve.txt",
        "notes/.part-1.77.tmp",
        "study.toml.old",
    ]
    for name in mine:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(b"mine")
    drawn = plots.render_png(Figure(figsize=(1, 1)))
    (out / "figures" / "distribution.png").write_bytes(drawn)
    (out / ".figures.json").write_text("{}")  # of version 1.0
    assert read_summary(out).num_rows == CHUNKS * CHUNK_RUNS
    assert sweep(out, resume=True) == []
    (out / "reruns/3/curve.png").write_bytes(b"old")
    few = sweep_study(study={"seed": 2, "curves": False, "draws": 24})
    assert len(sweep(out, few, overwrite=True)) == CHUNKS // 2
    assert not list(out.glob("curves/*.parquet")) and not (out / "reruns/3/curve.png").exists()
    assert len(sweep(out, overwrite=True)) == CHUNKS
    assert all((out / name).read_bytes() == b"mine" for name in mine)
    left = {path.relative_to(out).as_posix() for path in (out / "figures").iterdir()}
    assert left == {name for name in mine if name.startswith("figures/")}
    assert read_summary(out).num_rows == CHUNKS * CHUNK_RUNS
    assert {n: b for n, b in read_parts(out).items() if n not in mine} == read_parts(uninterrupted)


@pytest.mark.nightly(fast=("7",))
@pytest.mark.parametrize("removed", [1, 7, 23])
def test_killed_overwrite_leaves_resumable_results(
    uninterrupted: Path, out: Path, monkeypatch: pytest.MonkeyPatch, removed: int
) -> None:
    other = sweep_study(study={"seed": 2})
    with monkeypatch.context() as patch:
        left, unlink = [removed], Path.unlink

        def killed(self: Path, missing_ok: bool = False) -> None:
            if self.suffix == ".parquet":
                left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            unlink(self, missing_ok)

        patch.setattr(Path, "unlink", killed)
        with pytest.raises(KeyboardInterrupt):
            sweep(out, other, overwrite=True)
    there = read_parts(out)
    assert there.items() < read_parts(uninterrupted).items()
    with pytest.raises(InputError, match="contains results of another study"):
        sweep(out, other, resume=True)
    assert read_parts(out) == there
    sweep(out, resume=True)
    assert_complete(out, uninterrupted)


def test_resume_of_empty_directory_starts_sweep(tmp_path: Path) -> None:
    few = sweep_study(study={"draws": 8})  # a chunk of each environment
    assert len(sweep(tmp_path / "begun", few)) == 2
    (tmp_path / "empty").mkdir()
    (tmp_path / "locked").mkdir()
    (tmp_path / "locked" / ".lock").touch()
    for name in ("new/below", "empty", "locked"):
        assert len(sweep(tmp_path / name, few, resume=True)) == 2
        assert_complete(tmp_path / name, tmp_path / "begun")


# --- stopping -----------------------------------------------------------------------------------


@pytest.mark.nightly(fast=("5",))
@pytest.mark.parametrize("chunks", [0, 1, 5, CHUNKS - 4])
def test_stopped_sweep_keeps_finished_chunks_and_resumes(
    uninterrupted: Path, tmp_path: Path, chunks: int
) -> None:
    stop, seen = threading.Event(), []

    def on_progress(now: study_run.RunProgress) -> None:
        seen.append(now)
        if now.done >= chunks * CHUNK_RUNS:
            stop.set()

    out = tmp_path / "out"
    with pytest.raises(StudyInterrupted, match=f"of 1,536 runs are in {out}"):
        made = TaskRecorder()
        study_run.run_into(
            STUDY,
            out,
            chunk_runs=CHUNK_RUNS,
            on_progress=on_progress,
            stop=stop,
            executor=made.executor,
        )
    told = read_manifest_entries(out)
    assert told["state"] == "interrupted"
    assert told["runs_done"] == len(made.done) * CHUNK_RUNS == seen[-1].done
    # Those that were under way are finished, two devices have three.
    assert chunks <= len(made.done) <= chunks + 3
    assert {
        name: content
        for name, content in read_parts(uninterrupted).items()
        if name in read_parts(out)
    } == read_parts(out)
    before = modification_times(out)
    assert sorted([*made.done, *sweep(out, resume=True)]) == [chunk_name(i) for i in range(CHUNKS)]
    assert before.items() <= modification_times(out).items()
    assert_complete(out, uninterrupted)


def test_stop_after_last_chunk_is_ignored(uninterrupted: Path, tmp_path: Path) -> None:
    stop = threading.Event()

    def on_progress(now: study_run.RunProgress) -> None:
        if now.done == now.total:
            stop.set()

    sweep(tmp_path / "out", on_progress=on_progress, stop=stop)
    assert stop.is_set()
    assert_complete(tmp_path / "out", uninterrupted)


# --- failing writes -----------------------------------------------------------------------------


@pytest.mark.nightly(fast=("2",))
@pytest.mark.parametrize("failing", range(2, 27, 5))
def test_failed_write_raises_input_error_and_keeps_finished_parts(
    uninterrupted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int
) -> None:
    """The n-th file that is to be synced finds the disk full; the first two are no parts."""
    out, sync = tmp_path / "out", files.os.fsync
    synced: list[int] = []

    def full(handle: int) -> None:
        synced.append(handle)
        if len(synced) == 2 * failing + 1:  # every file, and the directory of its name
            raise OSError(28, "No space left on device")
        sync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", full)
        with pytest.raises(InputError, match="cannot be written: No space left on device"):
            sweep(out)
    there = read_parts(out)
    assert there == {
        name: content for name, content in read_parts(uninterrupted).items() if name in there
    }
    assert not list(out.rglob("*.tmp"))
    if any("summary" in name for name in there):
        assert read_summary(out).num_rows == CHUNK_RUNS * sum("summary" in name for name in there)
    before = {
        k: t for k, t in modification_times(out).items() if k.replace("curves", "summary") in there
    }
    sweep(out, resume=True)
    assert before.items() <= modification_times(out).items()
    assert_complete(out, uninterrupted)


def test_failed_chunk_releases_directory_for_resume(uninterrupted: Path, tmp_path: Path) -> None:
    def do(runner: TaskRunner, tasks: Any) -> Any:
        yield runner.compute(next(iter(tasks)))
        raise MemoryError

    with pytest.raises(MemoryError):
        study_run.run_into(
            STUDY, tmp_path / "out", chunk_runs=CHUNK_RUNS, executor=study_run.Executor(do, {})
        )
    assert len(sweep(tmp_path / "out", resume=True)) == CHUNKS - 1
    assert_complete(tmp_path / "out", uninterrupted)


# --- the manifest -------------------------------------------------------------------------------


def test_manifest_records_study_identity_and_timing(uninterrupted: Path, out: Path) -> None:
    told = read_manifest_entries(uninterrupted)
    assert told["fingerprint"] == store.fingerprint(STUDY)
    assert told["identity"] == Job(STUDY).identity
    assert (told["seed"], told["schema"], told["draws"]) == (1, "4", 48)
    assert (
        study_from_dict({k: v for k, v in told["study"].items() if v and k != "zips"}).axes
        == STUDY.axes
    )
    assert told["wall_s"] > 0 and told["versions"]["numpy"] == np.__version__
    sweep(out, resume=True)
    again = read_manifest_entries(out)
    assert again["started_unix_s"] == told["started_unix_s"] and again["wall_s"] > told["wall_s"]


def test_forecast_disk_space_is_near_actual_size(uninterrupted: Path) -> None:
    """At 128 runs a part, of which some 20 kB say how it is laid out, more is taken."""
    expected = forecast.forecast_sweep(STUDY)
    taken = (
        sum(len(content) for content in read_parts(uninterrupted).values()) - 2 * CHUNKS * 20_000
    )
    assert 0.5 < expected.runs * expected.run_bytes / taken < 2
