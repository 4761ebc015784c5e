"""A results directory: read, damaged, interrupted, on a full disk, continued and extended.

Real processes and real signals are in `test_kills`.
"""

import os
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from matplotlib.figure import Figure
from support.stored_results import store_results
from support.studies import small_study
from support.sweep_directories import (
    CHUNK_RUNS,
    CHUNKS,
    TaskRecorder,
    assert_complete,
    make_study,
    modification_times,
    read_files_and_times,
    read_parts,
    rewrite_manifest,
    sweep_study,
)
from support.synthetic_tables import synthetic_summary

import sinsjax
from sinsjax import columns, plots
from sinsjax.errors import InputError
from sinsjax.execution import directory as places
from sinsjax.execution import store, tasks
from sinsjax.execution.prepare import prepare_job
from sinsjax.platform import files, runtime
from sinsjax.study.load import study_to_toml

pytestmark = pytest.mark.optimised(False)

STUDY, RUNS = sweep_study(), CHUNKS * CHUNK_RUNS


def sweep(directory, study=STUDY, **options):
    """Run a study into a directory; return the names of the computed chunks."""
    recorder = TaskRecorder()
    options = {"chunk_runs": CHUNK_RUNS} | options
    sinsjax.run_into(study, directory, executor=recorder.executor, **options)
    return recorder.done


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    directory = tmp_path_factory.mktemp("whole") / "out"
    assert len(sweep(directory)) == CHUNKS
    return directory


@pytest.fixture
def out(uninterrupted, tmp_path):
    """A copy of the results of an uninterrupted run."""
    return Path(shutil.copytree(uninterrupted, tmp_path / "out"))


def chunk_name(number):
    return f"part-{number // 6:04d}-{number % 6:06d}"


def test_results_of_a_directory_are_those_in_memory(uninterrupted):
    """In order, although two environments are two programs, whose runs alternate."""
    results, stored = sinsjax.run(STUDY), sinsjax.Results.read(uninterrupted)
    assert stored.study == STUDY and stored.wall_s > 0 and "1,536 runs, " in repr(stored)
    assert stored.summary.cast(results.summary.schema).equals(results.summary)
    assert stored.curves.cast(results.curves.schema).equals(results.curves)
    assert stored.summary["run_id"].to_pylist() == list(range(RUNS))
    assert stored.curves["time_s"].to_pylist() == [1.0, 2.0] * RUNS
    for found in (results, stored):
        assert found.rows(["status", "run_id", "status"]).column_names == ["status", "run_id"]
        assert found.read_curves([3, 5])["run_id"].to_pylist() == [3, 3, 5, 5]


def test_columns_and_runs_are_selected(uninterrupted):
    table = sinsjax.read_summary(uninterrupted, ["status", "run_id"], run_ids=[2, 0, RUNS])
    assert table.column_names == ["status", "run_id"] and table["run_id"].to_pylist() == [0, 2]
    # What a part says of itself does not hold for all rows.
    assert table.schema.metadata == {b"sinsjax.schema": columns.SCHEMA_VERSION.encode()}
    assert sinsjax.read_curves(uninterrupted, []).num_rows == 0
    with pytest.raises(InputError, match="summary: column nees_up is missing"):
        sinsjax.read_summary(uninterrupted, ["nees", "nees_up"])


def test_unfinished_results_have_the_draws_that_every_variant_has(tmp_path):
    rows = synthetic_summary(STUDY).slice(0, 65)  # two draws of 32 variants, and a run
    curves = pa.table({"run_id": range(65), "time_s": np.zeros(65)})
    out = store_results(tmp_path / "out", STUDY, rows, curves, state="interrupted")
    found = sinsjax.Results.read(out)
    assert found.unfinished and (found.runs, found.draws) == (64, 2)
    assert found.read_curves(range(65)).num_rows == 64
    assert found.warnings[0].startswith("unfinished: 65 of 1,536 runs are done")
    assert sinsjax.read_summary(out).num_rows == 65


def flip_bit(path, bit=12_345):
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


DAMAGES = {
    "gone": (Path.unlink, r"(is|are) missing.*`--resume`"),
    "a bit in a page": (flip_bit, "has changed since"),
    "another chunk's": (
        lambda path: shutil.copy(path.with_stem(chunk_name(9)), path),
        "or under another name",
    ),
    "another study's": (
        lambda path: path.write_bytes(
            places.to_sealed_parquet(pq.read_table(path), {"sinsjax.study": "0123456789abcdef"})
        ),
        "of another study's results",
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_part_is_refused_and_recomputed(uninterrupted, out, name):
    before, (damage, line) = modification_times(out), DAMAGES[name]
    damage(out / "summary" / f"{chunk_name(2)}.parquet")
    damage(out / "curves" / f"{chunk_name(7)}.parquet")
    for read in (sinsjax.read_summary, sinsjax.read_curves, sinsjax.Results.read):
        with pytest.raises(InputError, match=line):
            read(out)
    assert sweep(out, resume=True) == [chunk_name(2), chunk_name(7)]
    assert_complete(out, uninterrupted)
    changed = {name for name, at in modification_times(out).items() if before[name] != at}
    assert {Path(name).stem for name in changed} == {chunk_name(2), chunk_name(7)}


def by_link(path):
    path.rename(path.with_name(f"{path.name}.moved"))
    path.symlink_to(path.with_name(f"{path.name}.moved"))


def by_pipe(path):
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def by_other_text(path):
    path.write_text(path.read_text().replace('"chunk_runs": 128', '"chunk_runs": 64'))


REPLACED = [("manifest.json", by_other_text), ("manifest.json", by_pipe), (".lock", by_pipe)]
REPLACED += [("study.toml", by_link), ("summary", by_link)]


@pytest.mark.parametrize(("name", "replace"), REPLACED)
def test_links_and_pipes_in_results_are_refused_unchanged(out, name, replace):
    replace(out / name)
    before = read_files_and_times(out)
    for attempt in (
        lambda: sinsjax.run_into(STUDY, out, resume=True),
        lambda: sinsjax.run_into(STUDY, out, overwrite=True),
        lambda: sinsjax.Results.read(out),
    ):
        with pytest.raises(InputError, match=rf"{name}: (is a link or a pipe|has changed since)"):
            attempt()
    assert read_files_and_times(out) == before


def test_edited_study_of_results_is_named(out):
    study = STUDY.replace({"sensors.gyro_bias_deg_per_h": 0.5})
    (out / "study.toml").write_text(study_to_toml(study))
    with pytest.raises(InputError, match=r"study\.toml: .* \[sensors\] gyro_bias_deg_per_h: 0\.1 "):
        sinsjax.Results.read(out)
    sinsjax.run_into(STUDY, out, resume=True)
    assert sinsjax.Results.read(out).study == STUDY


SEALED = {
    "parquet": places.to_sealed_parquet(pa.table({"run_id": [1, 2]}), {"sinsjax.study": "0123"}),
    "json": places.to_sealed_json({"state": "complete", "warnings": [f'{places.SEAL_KEY}": "1']}),
}


@pytest.mark.parametrize("kind", SEALED)
def test_any_flipped_bit_is_noticed(kind):
    content = SEALED[kind]
    assert places.is_intact(content)
    for place in range(len(content)):
        flipped = bytearray(content)
        flipped[place] ^= 1 << place % 8
        assert not places.is_intact(bytes(flipped)) and not places.is_intact(content[:place])


def test_resume_keeps_chunk_size_and_curves_of_directory(uninterrupted, out):
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
    [
        ("summary/part-of-my-thesis.parquet", {}),
        ("study.toml", {"resume": True}),
        ("figures/mine.png", {"overwrite": True}),
    ],
)
def test_foreign_files_are_refused_and_left_unchanged(tmp_path, name, options):
    mine = tmp_path / name
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("mine")
    before = read_files_and_times(tmp_path)
    line = f"contains {name.partition('/')[0]}, which is not a result .give another"
    with pytest.raises(InputError, match=line):
        sweep(tmp_path, **options)
    assert read_files_and_times(tmp_path) == before


def test_results_written_before_lock_are_not_lost(out, uninterrupted, tmp_path):
    """Two starts at a time on a new directory, of which one had ended when the other took hold."""
    other = sweep_study(study={"seed": 2})
    for study, chunk_runs, resume, line in (
        (STUDY, None, True, "another process has just written there"),
        (other, CHUNK_RUNS, True, "contains results of another study"),
        (other, CHUNK_RUNS, False, "already contains results"),
    ):
        options = {"directory": tmp_path / "new", "chunk_runs": chunk_runs, "resume": resume}
        late = prepare_job(study, **options)._replace(directory=out)
        session = runtime.describe_environment()
        with pytest.raises(InputError, match=line), store.locked_store(late, session):
            pass
    assert read_parts(out) == read_parts(uninterrupted)


def test_overwrite_and_resume_keep_user_files_and_remove_stale_ones(uninterrupted, out):
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
    assert sinsjax.read_summary(out).num_rows == CHUNKS * CHUNK_RUNS
    assert sweep(out, resume=True) == []
    assert not any((out / name).exists() for name in stale) and drawn.exists()
    (out / "reruns/3/curve.png").write_bytes(b"old")
    few = sweep_study(study={"seed": 2, "curves": False, "draws": 24})
    assert len(sweep(out, few, overwrite=True)) == CHUNKS // 2
    assert not [*out.glob("curves/*.parquet")] and not (out / "reruns/3/curve.png").exists()
    assert len(sweep(out, overwrite=True)) == CHUNKS and not drawn.exists()
    assert all((out / name).read_bytes() == b"mine" for name in mine)
    assert {n: b for n, b in read_parts(out).items() if n not in mine} == read_parts(uninterrupted)


@pytest.mark.nightly(fast=("2",))
@pytest.mark.parametrize("failing", [2, 7, 22])
def test_failed_write_raises_input_error_and_keeps_finished_parts(
    uninterrupted, tmp_path, monkeypatch, failing
):
    """The n-th file that is to be synced finds the disk full; the first two are no parts."""
    out, sync, synced = tmp_path / "out", files.os.fsync, []

    def full(handle):
        synced.append(handle)
        if len(synced) == 2 * failing + 1:  # every file, and the directory of its name
            raise OSError(28, "No space left on device")
        sync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", full)
        with pytest.raises(InputError, match="cannot be written: No space left on device"):
            sweep(out)
    there, times = read_parts(out), modification_times(out)
    assert there.items() <= read_parts(uninterrupted).items()
    assert not list(out.rglob("*.tmp"))
    kept = {k: t for k, t in times.items() if k.replace("curves", "summary") in there}
    sweep(out, resume=True)
    assert kept.items() <= modification_times(out).items()
    assert_complete(out, uninterrupted)


def test_resume_of_another_study_version_or_instruction_set_is_refused(out, monkeypatch):
    before, here = read_files_and_times(out), runtime.relevant_versions()
    for study, line in (
        (sweep_study(study={"draws": 47}), r"study: \[study\] draws: 48 there, 47 here$"),
        (sweep_study(filter={"p0_level_deg": 14.0}), r"p0_level_deg: 15.0 there, 14.0 here"),
    ):
        with pytest.raises(InputError, match=line):
            sweep(out, study, resume=True)
    # Workers are asked, not the process that hands their rows on.
    theirs = tasks.local_executor()._replace(facts={"instructions": "VAX"})
    with pytest.raises(InputError, match="instruction set .*, but here is VAX .*xla_cpu_max_isa"):
        sinsjax.run_into(STUDY, out, resume=True, executor=theirs)
    monkeypatch.setattr(runtime, "relevant_versions", lambda: here | {"scipy": "0.0"})
    with pytest.raises(InputError, match=r"with scipy .*, but here is 0\.0"):
        sweep(out, resume=True)
    assert read_files_and_times(out) == before


def study_with_draws(draws, **tables):
    tables = {"axes": {"p0_yaw_deg": [10.0, 40.0, 60.0]}} | tables
    return small_study(study={"duration_s": 2.0, "window_s": [0, 2], "draws": draws}, **tables)


RULE = {"statistic": "success_rate", "half_width": 0.9}
MANY = {"method": ["compass", "kalman5"], "q_accel_ug": [1.0 * i for i in range(1, 40)]}
EXTENDED = {
    "drawn": lambda more: make_study("drawn", 140 if more else 100),
    "duplicates": lambda more: study_with_draws(300 if more else 20, axes=MANY),
    "stopped": lambda more: study_with_draws(140 if more else 80, stop_when=RULE),
}
"""Sobol points, a list and a grid that are cycled; equal variants; a stop at 64 draws."""


@pytest.mark.nightly
@pytest.mark.parametrize("kind", EXTENDED)
def test_extension_equals_all_draws_at_once(tmp_path, kind):
    out, few, many = tmp_path / "out", EXTENDED[kind](False), EXTENDED[kind](True)
    sinsjax.run_into(few, out)
    before = modification_times(out)
    extended = sinsjax.run_into(many, out, resume=True)
    assert before and before.items() <= modification_times(out).items()
    assert extended.manifest.extended_at == (few.n_draws,)
    whole = sinsjax.run(many).summary
    assert extended.summary.equals(whole.cast(extended.summary.schema))
