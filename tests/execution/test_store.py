"""A results directory after damage, interruption and failing writes, in this process.

Real processes and real signals are in `test_kills`.
"""

import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from matplotlib.figure import Figure
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
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution import run as study_run
from sinsjax.execution import store
from sinsjax.execution.directory import to_sealed_parquet
from sinsjax.execution.prepare import prepare_job
from sinsjax.execution.results import read_summary
from sinsjax.platform import files, runtime
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


def chunk_name(number: int) -> str:
    return f"part-{number // 6:04d}-{number % 6:06d}"


def flip_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0x10
    path.write_bytes(content)


def swap_files(path: Path) -> None:
    path.write_bytes((path.parent / f"{chunk_name(9)}.parquet").read_bytes())


def replace_by_foreign_part(path: Path) -> None:
    table = pq.read_table(path)
    metadata = table.schema.metadata | {b"sinsjax.study": b"0123456789abcdef"}
    path.write_bytes(to_sealed_parquet(table.replace_schema_metadata(metadata)))


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "gone": Path.unlink,
    "a bit in a page": flip_bit,
    "another chunk's": swap_files,
    "another study's": replace_by_foreign_part,
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_part_is_detected_and_recomputed(uninterrupted: Path, out: Path, name: str) -> None:
    before = modification_times(out)
    DAMAGES[name](out / "summary" / f"{chunk_name(2)}.parquet")
    DAMAGES[name](out / "curves" / f"{chunk_name(7)}.parquet")
    assert sweep(out, resume=True) == [chunk_name(2), chunk_name(7)]
    assert_complete(out, uninterrupted)
    after = modification_times(out)
    assert {Path(key).stem for key in before if before[key] != after[key]} == {
        chunk_name(i) for i in (2, 7)
    }


def test_damaged_manifest_is_refused_and_parts_are_kept(out: Path) -> None:
    manifest = out / "manifest.json"
    edited = manifest.read_bytes().replace(b'"chunk_runs": 128', b'"chunk_runs": 256')
    manifest.write_bytes(edited)
    before = read_files_and_times(out)
    for options in ({}, {"resume": True}, {"overwrite": True}):
        with pytest.raises(InputError, match=r"manifest\.json: has changed since"):
            sweep(out, **options)
    assert read_files_and_times(out) == before


def test_resume_keeps_chunk_size_and_curves_of_directory(uninterrupted: Path, out: Path) -> None:
    """Whatever the manifest counts and study.toml contains."""
    shutil.rmtree(out / "curves")
    rewrite_manifest(out, runs_done=0)
    (out / "study.toml").write_text("[study]\nduration_s = -1")
    assert len(sweep(out, resume=True, chunk_runs=1024, curves=False)) == CHUNKS
    assert_complete(out, uninterrupted)
    assert (out / "study.toml").read_bytes() == (uninterrupted / "study.toml").read_bytes()
    before = modification_times(out)
    assert sweep(out, sweep_study(study={"name": "renamed"}), resume=True) == []
    assert modification_times(out) == before
    assert 'name = "renamed"' in (out / "study.toml").read_text()


@pytest.mark.parametrize(
    ("name", "options"),
    [("summary", {}), ("study.toml", {"resume": True}), ("figures", {"overwrite": True})],
)
def test_foreign_files_are_refused_and_left_unchanged(
    tmp_path: Path, name: str, options: dict[str, bool]
) -> None:
    mine = tmp_path / name if "." in name else tmp_path / name / "part-of-my-thesis.parquet"
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("mine")
    before = read_files_and_times(tmp_path)
    with pytest.raises(InputError, match=f"contains {name}, which is not a result .give another"):
        sweep(tmp_path, **options)
    assert read_files_and_times(tmp_path) == before


def test_results_written_before_lock_are_not_lost(
    out: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    """Two starts at a time on a new directory, of which one had ended when the other took hold."""
    other = sweep_study(study={"seed": 2})
    for study, chunk_runs, resume, line in (
        (STUDY, None, True, "another process has just written there"),
        (other, CHUNK_RUNS, True, "contains results of another study"),
        (other, CHUNK_RUNS, False, "already contains results"),
    ):
        options = {"directory": tmp_path / "new", "chunk_runs": chunk_runs, "resume": resume}
        late = prepare_job(study, **options)._replace(directory=out)
        with (
            pytest.raises(InputError, match=line),
            store.open_store(late, runtime.describe_environment()),
        ):
            pass
    assert read_parts(out) == read_parts(uninterrupted)


def test_overwrite_and_resume_keep_user_files_and_remove_stale_ones(
    uninterrupted: Path, out: Path
) -> None:
    mine = ["summary/part-notes.txt", "summary/part-best.parquet", "curves/part-0000-000000.csv"]
    mine += ["figures/thesis.png", "figures/misalignment.png", "figures/.thesis.png.tmp"]
    mine += ["reruns/mine/curve.png", "reruns/3/curve.txt", "notes/.part-1.77.tmp", ".notes.tmp"]
    stale = [".manifest.json.77.tmp", ".study.toml.78.tmp", "figures/.misalignment.png.81.tmp"]
    stale += [f"{name}/.{chunk_name(1)}.parquet.79.tmp" for name in ("summary", "curves")]
    for name in mine + stale:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(b"mine")
    drawn = out / "figures" / "distribution.png"
    drawn.write_bytes(plots.render_png(Figure(figsize=(1, 1))))
    assert read_summary(out).num_rows == CHUNKS * CHUNK_RUNS
    assert sweep(out, resume=True) == []
    assert not any((out / name).exists() for name in stale) and drawn.exists()
    (out / "reruns/3/curve.png").write_bytes(b"old")
    few = sweep_study(study={"seed": 2, "curves": False, "draws": 24})
    assert len(sweep(out, few, overwrite=True)) == CHUNKS // 2
    assert not [*out.glob("curves/*.parquet")] and not (out / "reruns/3/curve.png").exists()
    assert len(sweep(out, overwrite=True)) == CHUNKS and not drawn.exists()
    assert all((out / name).read_bytes() == b"mine" for name in mine)
    assert {n: b for n, b in read_parts(out).items() if n not in mine} == read_parts(uninterrupted)


@pytest.mark.nightly(fast=("5",))
@pytest.mark.parametrize("chunks", [0, 5, CHUNKS - 4])
def test_stopped_sweep_keeps_finished_chunks_and_resumes(
    uninterrupted: Path, tmp_path: Path, chunks: int
) -> None:
    stop, made, out = threading.Event(), TaskRecorder(), tmp_path / "out"

    def on_progress(now: study_run.RunProgress) -> None:
        if now.done >= chunks * CHUNK_RUNS:
            stop.set()

    options: dict[str, Any] = {"chunk_runs": CHUNK_RUNS, "on_progress": on_progress, "stop": stop}
    with pytest.raises(StudyInterrupted, match=f"of 1,536 runs are in {out}"):
        study_run.run_into(STUDY, out, executor=made.executor, **options)
    told = read_manifest_entries(out)
    assert (told["state"], told["runs_done"]) == ("interrupted", len(made.done) * CHUNK_RUNS)
    # Those that were under way are finished, two devices have three.
    assert chunks <= len(made.done) <= chunks + 3
    before = modification_times(out)
    assert sorted([*made.done, *sweep(out, resume=True)]) == [chunk_name(i) for i in range(CHUNKS)]
    assert before.items() <= modification_times(out).items()
    assert_complete(out, uninterrupted)


@pytest.mark.nightly(fast=("2",))
@pytest.mark.parametrize("failing", [2, 7, 22])
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
    assert there.items() <= read_parts(uninterrupted).items()
    assert not list(out.rglob("*.tmp"))
    before = {
        k: t for k, t in modification_times(out).items() if k.replace("curves", "summary") in there
    }
    sweep(out, resume=True)
    assert before.items() <= modification_times(out).items()
    assert_complete(out, uninterrupted)
