"""A directory of results through everything that can befall it, in this process.

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
from support.kept import (
    CHUNK_RUNS,
    CHUNKS,
    Recorder,
    assert_complete,
    assert_intact,
    everything,
    manifest,
    parts,
    rewrite_manifest,
    sweep_study,
    times,
)
from support.studies import PAPER, small_study

from sinsjax.engine import build
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution import forecast, store, tables
from sinsjax.execution import run as study_run
from sinsjax.execution.directory import list_figures
from sinsjax.execution.prepare import Options, prepare
from sinsjax.execution.results import count_runs, read_curves, read_summary
from sinsjax.execution.sealed import sealed_parquet
from sinsjax.execution.tasks import Job, TaskRunner
from sinsjax.platform import files
from sinsjax.records import Reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

STUDY = sweep_study()


def sweep(directory: Path, study: Study = STUDY, **options: Any) -> list[str]:
    """Run a study into a directory; gives the names of the chunks that were made."""
    recorder = Recorder()
    options = {"chunk_runs": CHUNK_RUNS} | options
    study_run.run_into(study, directory, executor=recorder.executor, **options)
    return recorder.done


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What an uninterrupted run leaves."""
    directory = tmp_path_factory.mktemp("whole") / "out"
    assert len(sweep(directory)) == CHUNKS
    return directory


@pytest.fixture
def out(whole: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(whole, tmp_path / "out"))


def prepared(directory: Path, **options: Any) -> Job:
    return prepare(STUDY, options=Options(directory, chunk_runs=CHUNK_RUNS, **options))


def chunk(number: int) -> str:
    return f"part-{number // 6:04d}-{number % 6:06d}"


# --- parts --------------------------------------------------------------------------------------


def test_parts_are_bytewise_equal_in_repeated_sweeps(whole: Path, tmp_path: Path) -> None:
    other = tmp_path / "elsewhere" / "out"
    sweep(other)
    assert_complete(other, whole)


def test_part_metadata_identify_study_and_chunk_only(whole: Path) -> None:
    for name in parts(whole):
        about = pq.ParquetFile(whole / name)
        said = about.schema_arrow.metadata
        assert said.keys() == {b"sinsjax.schema", b"sinsjax.study", b"sinsjax.chunk"}
        assert said[b"sinsjax.study"].decode() == Job(STUDY).identity
        told = json.loads(said[b"sinsjax.chunk"])
        dataset, rows = name.split("/")[0], told.pop("rows")
        assert rows == about.metadata.num_rows == CHUNK_RUNS * (2 if dataset == "curves" else 1)
        assert told == {
            "dataset": dataset,
            "name": Path(name).stem,
            "part": int(name.split("-")[1]),
            "draws": [0, 48],
            "call": int(name.split("-")[2].removesuffix(".parquet")),
            "runs": CHUNK_RUNS,
            "chunk_runs": CHUNK_RUNS,
        }
        own = {b"ARROW:schema", b"sinsjax.sha256"}
        assert about.metadata.metadata.keys() == said.keys() | own
        assert about.metadata.created_by.startswith("parquet-cpp-arrow version ")
        for field in about.schema_arrow:
            assert field.metadata.keys() <= {b"unit", b"meaning"}


def test_every_run_is_stored_exactly_once(whole: Path) -> None:
    runs = STUDY.n_draws * STUDY.n_variants
    assert count_runs(whole) == runs == CHUNKS * CHUNK_RUNS
    assert read_summary(whole)["run_id"].to_pylist() == list(range(runs))
    curves = read_curves(whole)
    assert curves["run_id"].to_pylist() == [run for run in range(runs) for _ in range(2)]


# --- what can befall a part ---------------------------------------------------------------------


def flipped(place: Callable[[bytes], int]) -> Callable[[Path], None]:
    def flip(path: Path) -> None:
        content = bytearray(path.read_bytes())
        content[place(content)] ^= 0x10
        path.write_bytes(content)

    return flip


def rewrite(table: pa.Table, path: Path) -> None:
    """As the engine writes parts."""
    path.write_bytes(sealed_parquet(table))


def swapped(path: Path) -> None:
    path.write_bytes((path.parent / f"{chunk(9)}.parquet").read_bytes())


def of_another_study(path: Path) -> None:
    table = pq.read_table(path)
    metadata = table.schema.metadata | {b"sinsjax.study": b"0123456789abcdef"}
    rewrite(table.replace_schema_metadata(metadata), path)


def without_the_last_row(path: Path) -> None:
    table = pq.read_table(path)
    rewrite(table.slice(0, table.num_rows - 1), path)


def as_a_directory(path: Path) -> None:
    path.unlink()
    path.mkdir()


BEFALL: dict[str, Callable[[Path], None]] = {
    "gone": Path.unlink,
    "empty": lambda path: path.write_bytes(b"") and None,
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-100]) and None,
    "half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]) and None,
    "a bit in a page": flipped(lambda content: len(content) // 3),
    "a bit in the first page": flipped(lambda content: 60),
    "a bit in the footer": flipped(lambda content: len(content) - 200),
    "a bit in the magic": flipped(lambda content: len(content) - 1),
    "another chunk's": swapped,
    "another study's": of_another_study,
    "a row less": without_the_last_row,
}


def deny(directory: Path) -> None:
    """Have the manifest list nothing as done, intact otherwise."""
    chunks = manifest(directory)["chunks"]
    missing = [{"name": c["name"], "state": "missing", "runs": 1} for c in chunks]
    rewrite_manifest(directory, chunks=missing)


MANIFESTS: dict[str, Callable[[Path], Any]] = {
    "there": lambda directory: None,
    "deleted": lambda directory: (directory / "manifest.json").unlink(),
    "garbled": lambda directory: (directory / "manifest.json").write_text('{"schema": "1", "st'),
    "denying": deny,
}


@pytest.mark.parametrize("told", ["there", "deleted"])
@pytest.mark.parametrize("name", BEFALL)
def test_damaged_part_is_detected_and_recomputed(
    whole: Path, out: Path, name: str, told: str
) -> None:
    before = times(out)
    BEFALL[name](out / "summary" / f"{chunk(2)}.parquet")
    BEFALL[name](out / "curves" / f"{chunk(7)}.parquet")
    MANIFESTS[told](out)
    assert sweep(out, resume=True) == [chunk(2), chunk(7)]
    assert_complete(out, whole)
    kept = {key for key, time in times(out).items() if before[key] == time}
    assert {key for key in before if chunk(2) in key or chunk(7) in key} == before.keys() - kept


@pytest.mark.parametrize("told", MANIFESTS)
def test_intact_parts_are_kept_for_any_manifest_state(whole: Path, out: Path, told: str) -> None:
    before = times(out)
    MANIFESTS[told](out)
    assert sweep(out, resume=True) == []
    assert times(out) == before
    assert_complete(out, whole)


@pytest.mark.parametrize("name", ["chunk_runs", "all of it", "study.toml too"])
def test_chunk_size_is_recovered_from_parts_without_manifest(
    whole: Path, out: Path, name: str
) -> None:
    """The default would cut this study into other chunks, none of which is there."""
    (out / "manifest.json").unlink()
    (out / "summary" / f"{chunk(0)}.parquet").write_bytes(b"no part")
    if name == "study.toml too":
        (out / "study.toml").unlink()
    options = {"chunk_runs": {"chunk_runs": CHUNK_RUNS}.get(name)}
    assert sweep(out, resume=True, **options) == [chunk(0)]
    assert_complete(out, whole)


def test_resume_keeps_chunk_size_and_curves_of_directory(whole: Path, out: Path) -> None:
    shutil.rmtree(out / "curves")
    made = sweep(out, resume=True, chunk_runs=None, curves=False)
    assert len(made) == CHUNKS
    assert_complete(out, whole)
    assert sweep(out, resume=True, chunk_runs=CHUNK_RUNS) == []
    with pytest.raises(InputError) as told:
        sweep(out, resume=True, chunk_runs=1024)
    assert f"out: chunk_runs: 1024 requested, but its results were begun with {CHUNK_RUNS} " in str(
        told.value
    )
    assert_complete(out, whole)


@pytest.mark.parametrize("dataset", ["summary", "curves"])
def test_directory_in_place_of_part_raises_input_error(out: Path, dataset: str) -> None:
    as_a_directory(out / dataset / f"{chunk(3)}.parquet")
    with pytest.raises(InputError, match=f"{chunk(3)}.parquet: cannot be written: Is a directory"):
        sweep(out, resume=True)
    (out / dataset / f"{chunk(3)}.parquet").rmdir()
    assert sweep(out, resume=True) == [chunk(3)]


# --- what is refused ----------------------------------------------------------------------------

DIFFERING: dict[str, tuple[dict[str, Any], list[str]]] = {
    "a key": ({"study": {"seed": 2}}, ["[study] seed: 1 there, 2 here"]),
    "two keys": (
        {"study": {"draws": 49}, "filter": {"p0_level_deg": 14.0}},
        ["[study] draws: 48 there, 49 here", "[filter] p0_level_deg: 15.0 there, 14.0 here"],
    ),
    "a key that came": (
        {"resets": {"reset_count": 1, "reset_cycle_s": 1.0}},
        ["[resets] reset_count: 0 there, 1 here", "[resets] reset_cycle_s: none there, 1.0 here"],
    ),
    "an axis": (
        {"axes": {"p0_yaw_deg": [10.0]}},
        ["[axes] p0_yaw_deg: [10.0, 20.0, ", " there, [10.0] here"],
    ),
    "another axis": (
        {"axes": {"phi_u0_deg": [0.0]}},
        ["[axes] phi_u0_deg: none there, [0.0] here"],
    ),
    "curves": ({"study": {"curves": False}}, ["[study] curves: True there, False here"]),
    "a section": (
        {"drawn": {"phi_e0_deg": {"normal": [0, 1]}}, "alignment": {"phi_e0_deg": None}},
        ["[drawn] ", "[alignment] phi_e0_deg: 5.0 there, "],
    ),
}


def changed(**changes: Any) -> Study:
    """The study with keys changed; those set to None are left out."""
    data = STUDY.model_dump(exclude_none=True)
    data["axes"] |= data.pop("zips")
    data = {name: dict(table) for name, table in data.items() if table}
    for name, change in changes.items():
        merged = data.get(name, {}) | change
        data[name] = {key: value for key, value in merged.items() if value is not None}
    return study_from_dict(data)


@pytest.mark.parametrize("name", DIFFERING)
def test_resume_with_other_study_reports_differing_keys(out: Path, name: str) -> None:
    changes, named = DIFFERING[name]
    before = everything(out)
    with pytest.raises(InputError, match=r"out: holds results of another study: \[") as told:
        sweep(out, changed(**changes), resume=True)
    for text in named:
        assert text in str(told.value), (text, told.value)
    assert "name" not in str(told.value) and "\n" not in str(told.value)
    assert everything(out) == before


def test_resume_with_reordered_axes_is_refused(out: Path) -> None:
    before = everything(out)
    data = STUDY.model_dump(exclude_none=True)
    axes = dict(reversed(STUDY.axes.items()))
    study = study_from_dict({k: v for k, v in data.items() if v and k != "zips"} | {"axes": axes})
    with pytest.raises(InputError, match="another study: .*order"):
        sweep(out, study, resume=True)
    assert everything(out) == before


def test_resume_allows_changed_name(whole: Path, out: Path) -> None:
    before = times(out)
    assert sweep(out, changed(study={"name": "renamed"}), resume=True) == []
    assert times(out) == before
    assert manifest(out)["study"]["study"]["name"] == "renamed"
    assert 'name = "renamed"' in (out / "study.toml").read_text()
    assert_complete(out, whole)


def test_other_study_is_refused_from_parts_alone(out: Path) -> None:
    """Nothing but the parts is left to tell whose they are."""
    (out / "manifest.json").write_bytes(b"\x00\xff")
    (out / "study.toml").write_text("[study")
    (out / "summary" / f"{chunk(0)}.parquet").write_bytes(b"no part")
    before = everything(out)
    with pytest.raises(InputError, match="holds results of another study"):
        sweep(out, changed(study={"seed": 2}), resume=True)
    assert everything(out) == before
    assert sweep(out, resume=True) == [chunk(0)]


GARBLED = {
    "empty": b"",
    "no text": b"\x80\x81",
    "half": None,
    "null": b"null",
    "a list": b"[1, 2]",
    "a number": b"3",
    "nothing": b"{}",
    "another's": b'{"name": "a web page", "icons": []}',
    "deep": b"[" * 20_000,
    "deep sessions": b'{"fingerprint": "x", "sessions": [{"a": ' + b"[" * 900 + b"]" * 900 + b"}]}",
    "no chunks": b'{"fingerprint": "x", "chunks": 3, "sessions": {}}',
    "odd chunks": b'{"fingerprint": "x", "identity": "x", "chunks": [{"state": []}]}',
    "odd sessions": b'{"fingerprint": "x", "sessions": [{"wall_s": "long"}]}',
}


@pytest.mark.parametrize("name", GARBLED)
def test_garbled_manifest_requires_no_recomputation(whole: Path, out: Path, name: str) -> None:
    path = out / "manifest.json"
    path.write_bytes(GARBLED[name] or path.read_bytes()[: path.stat().st_size // 2])
    before = times(out)
    with pytest.raises(InputError, match="already holds results"):
        sweep(out)
    assert sweep(out, resume=True) == []
    assert times(out) == before
    assert_complete(out, whole)


@pytest.mark.parametrize("edited", ["0", "-128", "1.5", '"many"', "256", "null", "1"])
def test_edited_chunk_runs_in_manifest_are_recovered_from_parts(
    whole: Path, out: Path, edited: str
) -> None:
    text = (out / "manifest.json").read_text()
    text = text.replace(f'"chunk_runs": {CHUNK_RUNS}', f'"chunk_runs": {edited}')
    (out / "manifest.json").write_text(text)
    assert sweep(out, resume=True) == []
    assert_complete(out, whole)


@pytest.mark.parametrize("text", ["", "[study", "[study]\nduration_s = -1", "a = " + "[" * 20_000])
def test_garbled_study_file_is_restored_on_resume(whole: Path, out: Path, text: str) -> None:
    (out / "study.toml").write_text(text)
    assert sweep(out, resume=True) == []
    assert_complete(out, whole)
    assert (out / "study.toml").read_bytes() == (whole / "study.toml").read_bytes()


def test_results_of_older_version_are_refused_by_its_name(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "summary").mkdir(parents=True)
    pq.write_table(tables.pa.table({"run_id": [0]}), out / "summary" / "part-0000-000000.parquet")
    fingerprint = store.fingerprint(STUDY)
    told = {"schema": "1", "fingerprint": fingerprint, "versions": {"sinsjax": "0.5.0"}, "runs": 1}
    (out / "manifest.json").write_text(json.dumps(told))
    before = everything(out)
    with pytest.raises(InputError, match=r"results of sinsjax 0\.5\.0, .*schema 1.*--overwrite"):
        sweep(out, resume=True)
    assert everything(out) == before
    assert len(sweep(out, overwrite=True)) == CHUNKS


@pytest.mark.parametrize("name", ["summary", "curves", "figures", "study.toml", "manifest.json"])
@pytest.mark.parametrize("options", [{}, {"resume": True}, {"overwrite": True}])
def test_foreign_files_are_refused_and_left_unchanged(
    tmp_path: Path, name: str, options: dict[str, bool]
) -> None:
    mine = tmp_path / name
    if "." not in name:
        mine.mkdir()
        mine = mine / "part-of-my-thesis.parquet"
    mine.write_text("mine")
    before = everything(tmp_path)
    with pytest.raises(
        InputError, match=f"holds a {name} that is not a result .give another directory"
    ):
        sweep(tmp_path, **options)
    assert everything(tmp_path) == before


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
    return study, StoredRecord(build.simulated_record(small_study()), reference)


def test_another_record_or_reference_is_refused(
    recorded: tuple[Study, StoredRecord], tmp_path: Path
) -> None:
    study, stored = recorded
    out = tmp_path / "out"
    sweep(out, study, record=stored)
    before = everything(out)
    record, reference = stored
    assert reference is not None
    late = record.dv.copy()
    late[-1, 2] += 1e-12
    for other in (
        StoredRecord(record._replace(dv=late), reference),
        StoredRecord(record, None),
        StoredRecord(record, reference._replace(attitude_deg=reference.attitude_deg + 1e-9)),
    ):
        with pytest.raises(InputError, match="holds results of another record or reference"):
            sweep(out, study, record=other, resume=True)
    assert everything(out) == before
    assert sweep(out, study, record=stored, resume=True) == []
    moved = StoredRecord(record._replace(source="copy.imu"), reference._replace(source="copy.csv"))
    assert sweep(out, study, record=moved, resume=True) == []


# --- the writer ---------------------------------------------------------------------------------


def test_second_writer_of_directory_is_refused(out: Path) -> None:
    held = store.Store(TaskRunner(prepared(out, resume=True)))
    before = everything(out)
    for options in ({"resume": True}, {"overwrite": True}):
        with pytest.raises(InputError, match="out: another process is writing there"):
            sweep(out, **options)
    assert everything(out) == before
    held.release()
    assert sweep(out, resume=True) == []


def test_writer_releases_lock_after_failed_start(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as broken:
        broken.setattr(store, "_remove", lambda paths: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            sweep(out, resume=True)
    assert sweep(out, resume=True) == []


def test_directory_in_place_of_lock_raises_input_error(tmp_path: Path) -> None:
    (tmp_path / "out" / ".lock").mkdir(parents=True)
    with pytest.raises(InputError, match=r"out/\.lock: is no regular file"):
        sweep(tmp_path / "out")


def test_results_written_before_lock_are_not_lost(out: Path, whole: Path, tmp_path: Path) -> None:
    """Two starts at a time on a new directory, of which one had ended when the other took hold."""
    for study, chunk_runs in ((STUDY, None), (sweep_study(study={"seed": 2}), CHUNK_RUNS)):
        options = Options(tmp_path / "new", chunk_runs=chunk_runs, resume=True)
        late = TaskRunner(prepare(study, options=options)._replace(directory=out))
        with pytest.raises(InputError, match="another process has just written there"):
            store.Store(late)
    assert parts(out) == parts(whole)


def test_stale_temporary_files_are_removed_and_others_kept(whole: Path, out: Path) -> None:
    left = [
        ".manifest.json.77.tmp",
        ".study.toml.78.tmp",
        f"summary/.{chunk(1)}.parquet.79.tmp",
        f"curves/.{chunk(1)}.parquet.80.tmp",
        "figures/.misalignment.png.81.tmp",
        "..figures.json.82.tmp",
    ]
    mine = [".notes.tmp", "notes.txt", "figures/mine.txt", ".manifest.json"]
    (out / "figures").mkdir()
    for name in left + mine:
        (out / name).write_bytes(b"PAR1")
    assert count_runs(out) == CHUNKS * CHUNK_RUNS
    assert sweep(out, resume=True) == []
    assert_complete_but(out, whole, mine)
    for name in left:
        (out / name).write_bytes(b"PAR1")
    assert len(sweep(out, overwrite=True)) == CHUNKS
    assert_complete_but(out, whole, mine)


def assert_complete_but(out: Path, whole: Path, mine: list[str]) -> None:
    assert {path.name for path in out.rglob(".*") if path.is_file()} == {
        ".lock",
        ".writer",
        ".notes.tmp",
        ".manifest.json",
    }
    assert all((out / name).read_bytes() == b"PAR1" for name in mine)
    assert parts(out) == parts(whole)


def test_overwrite_keeps_user_files(whole: Path, out: Path) -> None:
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
    drawn = {"misalignment.png": b"drawn", "distribution.png": b"drawn"}
    (out / "figures" / "distribution.png").write_bytes(b"drawn")
    list_figures(drawn, out)  # one of which the person drew anew
    assert count_runs(out) == CHUNKS * CHUNK_RUNS
    assert sweep(out, resume=True) == []
    assert len(sweep(out, overwrite=True)) == CHUNKS
    assert all((out / name).read_bytes() == b"mine" for name in mine)
    left = {path.relative_to(out).as_posix() for path in (out / "figures").iterdir()}
    assert left == {name for name in mine if name.startswith("figures/")}
    assert read_summary(out).num_rows == CHUNKS * CHUNK_RUNS
    assert {n: b for n, b in parts(out).items() if n not in mine} == parts(whole)


def test_overwrite_removes_all_previous_results(out: Path) -> None:
    (out / "reruns" / "3").mkdir(parents=True)
    for name in ("summary.parquet", "curve.parquet", "curve.png"):
        (out / "reruns" / "3" / name).write_bytes(b"old")
    study = sweep_study(study={"seed": 2, "curves": False, "draws": 24})
    assert len(sweep(out, study, overwrite=True)) == CHUNKS // 2
    assert not list(out.glob("curves/*")) and not list(out.glob("reruns/3/*"))
    assert count_runs(out) == CHUNKS * CHUNK_RUNS // 2
    assert read_curves(out).num_rows == 0
    assert_intact(out)


@pytest.mark.parametrize("removed", [1, 7, 23])
def test_killed_overwrite_leaves_resumable_results(
    whole: Path, out: Path, monkeypatch: pytest.MonkeyPatch, removed: int
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
    there = parts(out)
    assert there.items() < parts(whole).items()
    with pytest.raises(InputError, match="holds results of another study"):
        sweep(out, other, resume=True)
    assert parts(out) == there
    sweep(out, resume=True)
    assert_complete(out, whole)


def test_resuming_a_complete_directory_does_nothing(whole: Path, out: Path) -> None:
    before = times(out)
    assert sweep(out, resume=True) == []
    assert times(out) == before
    assert len(manifest(out)["sessions"]) == 2
    assert_complete(out, whole)


def test_resume_of_empty_directory_starts_sweep(whole: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "locked").mkdir()
    (tmp_path / "locked" / ".lock").touch()
    for name in ("new/below", "empty", "locked"):
        assert len(sweep(tmp_path / name, resume=True)) == CHUNKS
        assert_complete(tmp_path / name, whole)


# --- stopping -----------------------------------------------------------------------------------


@pytest.mark.parametrize("chunks", [0, 1, 5, CHUNKS - 4])
def test_stopped_sweep_keeps_finished_chunks_and_resumes(
    whole: Path, tmp_path: Path, chunks: int
) -> None:
    stop, seen = threading.Event(), []

    def tell(now: study_run.RunProgress) -> None:
        seen.append(now)
        if now.done >= chunks * CHUNK_RUNS:
            stop.set()

    out = tmp_path / "out"
    with pytest.raises(StudyInterrupted, match=f"of 1,536 runs are in {out}"):
        made = Recorder()
        study_run.run_into(
            STUDY, out, chunk_runs=CHUNK_RUNS, tell=tell, stop=stop, executor=made.executor
        )
    told = manifest(out)
    assert told["state"] == "interrupted"
    assert len(told["chunks"]) == CHUNKS
    assert told["runs_done"] == len(made.done) * CHUNK_RUNS == seen[-1].done
    # Those that were under way are finished, two devices have three.
    assert chunks <= len(made.done) <= chunks + 3
    assert {name: content for name, content in parts(whole).items() if name in parts(out)} == parts(
        out
    )
    before = times(out)
    assert sorted([*made.done, *sweep(out, resume=True)]) == [chunk(i) for i in range(CHUNKS)]
    assert before.items() <= times(out).items()
    assert_complete(out, whole)


def test_stop_after_last_chunk_is_ignored(whole: Path, tmp_path: Path) -> None:
    stop = threading.Event()

    def tell(now: study_run.RunProgress) -> None:
        if now.done == now.total:
            stop.set()

    sweep(tmp_path / "out", tell=tell, stop=stop)
    assert stop.is_set()
    assert_complete(tmp_path / "out", whole)


def test_stop_during_resume_of_complete_results_is_ignored(out: Path) -> None:
    stop = threading.Event()
    stop.set()
    assert sweep(out, resume=True, stop=stop) == []
    assert manifest(out)["state"] == "complete"


# --- failing writes -----------------------------------------------------------------------------


@pytest.mark.parametrize("failing", range(2, 27, 5))
def test_failed_write_raises_input_error_and_keeps_finished_parts(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int
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
    there = parts(out)
    assert there == {name: content for name, content in parts(whole).items() if name in there}
    assert not list(out.rglob("*.tmp"))
    if any("summary" in name for name in there):
        assert count_runs(out) == CHUNK_RUNS * sum("summary" in name for name in there)
    before = {k: t for k, t in times(out).items() if k.replace("curves", "summary") in there}
    sweep(out, resume=True)
    assert before.items() <= times(out).items()
    assert_complete(out, whole)


def test_failed_chunk_releases_directory_for_resume(whole: Path, tmp_path: Path) -> None:
    def do(runner: TaskRunner, tasks: Any) -> Any:
        yield runner.pack(next(iter(tasks)))
        raise MemoryError

    with pytest.raises(MemoryError):
        study_run.run_into(
            STUDY, tmp_path / "out", chunk_runs=CHUNK_RUNS, executor=study_run.Executor(do, {})
        )
    assert len(sweep(tmp_path / "out", resume=True)) == CHUNKS - 1
    assert_complete(tmp_path / "out", whole)


# --- the manifest -------------------------------------------------------------------------------


def test_manifest_records_study_identity_and_timing(whole: Path, out: Path) -> None:
    told = manifest(whole)
    assert told["fingerprint"] == store.fingerprint(STUDY)
    assert told["identity"] == Job(STUDY).identity
    assert (told["seed"], told["schema"], told["draws"]) == (1, "4", 48)
    assert (
        study_from_dict({k: v for k, v in told["study"].items() if v and k != "zips"}).axes
        == STUDY.axes
    )
    assert all(chunk["seconds"] > 0 for chunk in told["chunks"])
    sweep(out, resume=True)
    again = manifest(out)
    assert [chunk["seconds"] for chunk in again["chunks"]] == [
        chunk["seconds"] for chunk in told["chunks"]
    ]
    assert again["started_unix_s"] == told["started_unix_s"]
    assert again["wall_s"] == pytest.approx(sum(s["wall_s"] for s in again["sessions"]), abs=0.01)


def test_manifest_writing_uses_small_share_of_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many chunks there are: here each takes no time, and a manifest a second."""
    clock, written = [0.0], []
    runner = TaskRunner(prepared(tmp_path / "out"))
    (tasks,) = runner.tasks()
    encoded = runner.pack(tasks[0])
    held = store.Store(runner)
    held.missing(tasks)

    def slow(path: Path, content: bytes) -> None:
        if path.name == "manifest.json":
            clock[0] += 1.0
            written.append(clock[0])
        else:
            clock[0] += 0.05

    monkeypatch.setattr(store, "_write", slow)
    monkeypatch.setattr(store.time, "monotonic", lambda: clock[0])
    held._next_manifest = 0.0
    for _ in range(1000):
        held.add(encoded)
    held.release()
    assert len(written) / clock[0] < 0.06
    assert len(written) >= 5


def test_forecast_disk_space_is_near_actual_size(whole: Path) -> None:
    """At 128 runs a part, of which some 20 kB say how it is laid out, more is taken."""
    expected = forecast.of(STUDY)
    taken = sum(len(content) for content in parts(whole).values()) - 2 * CHUNKS * 20_000
    assert 0.5 < expected.runs * expected.run_bytes / taken < 2
