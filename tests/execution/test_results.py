"""Results in memory and from a directory: rows, curves, and what contradicts the manifest."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.stored_results import store_results, write_manifest, write_part
from support.studies import small_study
from support.synthetic_tables import synthetic_summary

import sinsjax
from sinsjax import columns
from sinsjax.errors import InputError
from sinsjax.execution.directory import read_manifest
from sinsjax.execution.results import Results, read_curves, read_summary
from sinsjax.execution.tasks import Job

pytestmark = pytest.mark.optimised(False)

AXES = {"phi_u0_deg": [5.0, 10.0], "p0_yaw_deg": [20.0, 40.0, 80.0]}


@pytest.fixture(scope="module")
def results() -> Results:
    return sinsjax.run(small_study(study={"curves": True}, axes=AXES))


def test_results_of_a_directory_are_read_from_it(tmp_path: Path, results: Results) -> None:
    stored = sinsjax.run_into(results.study, tmp_path / "out")
    assert stored.summary.equals(results.summary.cast(stored.summary.schema))
    assert stored.curves.equals(results.curves.cast(stored.curves.schema))
    assert str(tmp_path)[:20] in repr(stored) and "18 runs, " in repr(stored)
    again = Results.read(tmp_path / "out")
    assert again.summary.equals(stored.summary) and again.study == results.study
    assert again.wall_s > 0 and stored.wall_s > 0
    for found in (results, again):
        assert found.rows(["status", "run_id", "status"]).column_names == ["status", "run_id"]
        assert set(found.read_curves([3, 5])["run_id"].to_pylist()) == {3, 5}


def test_unfinished_results_have_the_draws_that_every_variant_has(tmp_path: Path) -> None:
    study = small_study(study={"draws": 3}, axes=AXES)
    rows = synthetic_summary(study).slice(0, 13)  # two draws of six variants, and a run
    curves = pa.table({"run_id": range(13), "time_s": np.zeros(13)})
    out = store_results(tmp_path / "out", study, rows, curves, state="interrupted")
    found = Results.read(out)
    assert found.unfinished and (found.runs, found.draws) == (12, 2)
    assert found.read_curves(range(13)).num_rows == 12
    assert found.warnings[0].startswith("unfinished: 13 of 18 runs are done")
    assert read_summary(out).num_rows == 13


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
    with pytest.raises(InputError, match="summary: column nees_u is missing"):
        read_summary(stored, ["nees", "nees_u"])


def test_directory_without_results_is_refused_in_one_line(tmp_path: Path) -> None:
    for read in (read_summary, read_curves, read_manifest, Results.read):
        with pytest.raises(InputError, match="out: contains no results"):
            read(tmp_path / "out")


def test_part_that_no_manifest_counts_is_read_and_verified(stored: Path) -> None:
    """A sweep writes its manifest less often than its parts."""
    write_manifest(stored, small_study(), runs_done=0)
    assert read_summary(stored).num_rows == 4 and read_curves(stored).num_rows == 8
    path = stored / "summary" / "part-0000-000001.parquet"
    pq.write_table(pq.read_table(path), path)
    with pytest.raises(InputError, match=r"part-0000-000001\.parquet: has changed since"):
        read_summary(stored)


PLACES: dict[str, Callable[[Path], object]] = {
    "number": lambda path: path.rename(path.with_name("part-0000-000007.parquet")),
    "dataset": lambda path: shutil.copy(path, path.parents[1] / "curves"),
    "study": lambda path: write_part(path, pa.table({"run_id": [1]}), "0123456789abcdef"),
}


@pytest.mark.parametrize("place", PLACES)
def test_intact_part_of_another_place_is_refused(stored: Path, place: str) -> None:
    PLACES[place](stored / "summary" / "part-0000-000001.parquet")
    with pytest.raises(InputError, match="of another study's results, or under another name"):
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
