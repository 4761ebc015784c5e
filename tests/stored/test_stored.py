"""Results that 1.0.0 stored are read, reported, continued and repeated by today's package.

They are never made again (the history of this folder says how they were). As soon as a new schema
makes them unreadable on purpose, one test shows the line that refuses them.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from golden.golden_studies import ENVIRONMENT, differences, numbers_of_tables, run_command
from reading import (
    DIRECTORIES,
    EXPECTED,
    HERE,
    RERUNS,
    TUNED,
    read_tables,
    summarised,
)
from support.sweep_directories import read_parts

import sinsjax

WITHIN = 1e-7
"""Of the largest number of a column, from the rows of 1.0.0 to those computed today."""


def expected() -> dict[str, Any]:
    return json.loads(EXPECTED.read_text("utf-8"))


def assert_same(old: dict[str, Any], new: dict[str, Any], tolerance: float) -> None:
    found = differences({"tables": old}, {"tables": new}, tolerance)
    if found:
        pytest.fail("\n".join([f"{len(found)} differences:", *found]), pytrace=False)


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of all stored results."""
    folder = tmp_path_factory.mktemp("stored")
    return Path(shutil.copytree(HERE, folder / "stored", ignore=shutil.ignore_patterns("*.py")))


@pytest.mark.parametrize("name", DIRECTORIES)
def test_stored_tables_have_their_columns_units_and_values(name: str) -> None:
    tables = {table: summarised(rows) for table, rows in read_tables(HERE / name).items()}
    assert_same(expected()["read"][name], tables, 0.0)


@pytest.mark.parametrize("name", DIRECTORIES)
def test_report_of_stored_results_has_their_numbers(name: str, copy: Path) -> None:
    page = copy / name / "page.html"
    run_command("report", copy / name, "--html", page)
    assert numbers_of_tables(page.read_text("utf-8")) == expected()["reported"][name]


def test_stored_tuning_gives_its_best_point_and_study() -> None:
    tuned, old = sinsjax.TuningResults(HERE / TUNED), expected()["tuned"]
    assert tuned.best == old["best"]
    assert [tuned.score.value, tuned.baseline.value] == pytest.approx(old["scores"], rel=1e-12)
    assert tuned.study.n_variants == 1


@pytest.fixture(scope="module")
def continued(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Another copy whose results were continued and repeated, and the tables that this gave."""
    folder = Path(shutil.copytree(HERE, tmp_path_factory.mktemp("continued") / "stored"))
    done = subprocess.run(
        [sys.executable, HERE / "reading.py", folder],
        env=os.environ | ENVIRONMENT | {"PYTHONPATH": os.pathsep.join(map(str, HERE.parents[:2]))},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folder, json.loads(done.stdout)


@pytest.mark.nightly
def test_continued_and_repeated_rows_are_those_of_the_version_that_stored_them(
    continued: tuple[Path, dict[str, Any]],
) -> None:
    assert_same(expected()["continued"], continued[1], WITHIN)


@pytest.mark.nightly
def test_continued_results_keep_their_stored_parts(
    continued: tuple[Path, dict[str, Any]],
) -> None:
    for name in ("killed", "extended", "tuned/sobol", "tuned/evaluation"):
        before, after = read_parts(HERE / name), read_parts(continued[0] / name)
        assert {part: after[part] for part in before} == before
        assert (len(after) > len(before)) == (name in ("killed", "extended"))
        assert sinsjax.read_manifest(continued[0] / name)["state"] == "complete"


@pytest.mark.nightly
@pytest.mark.parametrize("name", RERUNS)
def test_repeated_run_has_the_stored_row(name: str, continued: tuple[Path, dict[str, Any]]) -> None:
    run_id = RERUNS[name]
    row = pq.read_table(continued[0] / name / "reruns" / str(run_id) / "summary.parquet")
    stored = sinsjax.read_summary(HERE / name, run_ids=[run_id])
    assert_same({name: summarised(stored)}, {name: summarised(row)}, WITHIN)
