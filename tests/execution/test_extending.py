"""Extending results by draws gives the rows of a sweep with all draws."""

from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from support.stored_results import store_results
from support.studies import small_study
from support.sweep_directories import make_study, modification_times, read_files_and_times
from support.synthetic_tables import synthetic_summary

from sinsjax.errors import InputError
from sinsjax.execution import rerun, run
from sinsjax.execution.directory import read_manifest
from sinsjax.execution.results import read_summary
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

SHORT = {"duration_s": 2.0, "window_s": [0, 2]}
AXES = {"p0_yaw_deg": [10.0, 40.0, 60.0]}


def study_with_draws(draws: int, **tables: Any) -> Study:
    tables = {"axes": AXES} | tables
    return small_study(**{**tables, "study": SHORT | tables.get("study", {}) | {"draws": draws}})


def assert_extended(
    first: Study, second: Study, folder: Path, chunk_runs: int | None = None
) -> Path:
    """Extend results of the first study to the second without recomputing any part."""
    out = folder / "out"
    run.run_into(first, out, chunk_runs=chunk_runs)
    before = modification_times(out)
    run.run_into(second, out, resume=True)
    after = modification_times(out)
    parts = {name for name in before if name.endswith(".parquet")}
    assert parts and {name: after[name] for name in parts} == {n: before[n] for n in parts}
    at_once = run.run(second, chunk_runs=chunk_runs)
    assert read_summary(out).equals(at_once.summary.cast(read_summary(out).schema))
    return out


@pytest.mark.nightly
@pytest.mark.parametrize("chunk_runs", [None, 128])
def test_extended_rows_equal_sweep_with_all_draws(tmp_path: Path, chunk_runs: int | None) -> None:
    out = assert_extended(study_with_draws(150), study_with_draws(170), tmp_path, chunk_runs)
    told = read_manifest(out)
    assert (told["state"], told["draws"], told["extended_at"]) == ("complete", 170, [150])
    before = modification_times(out)
    run.run_into(study_with_draws(170), out, resume=True)  # and gone on with as any other
    assert {n: t for n, t in modification_times(out).items() if "part" in n} == {
        n: t for n, t in before.items() if "part" in n
    }
    run.run_into(study_with_draws(200), out, resume=True)
    assert read_manifest(out)["extended_at"] == [150, 170]
    assert read_summary(out).equals(
        run.run(study_with_draws(200)).summary.cast(read_summary(out).schema)
    )


@pytest.mark.nightly
def test_rerun_works_on_extended_results(tmp_path: Path) -> None:
    """Runs from before and after the extension can be repeated."""
    out = assert_extended(study_with_draws(40), study_with_draws(50), tmp_path)
    for run_id in (0, 149):
        assert rerun.rerun_stored_run(out, run_id, Console(quiet=True))


@pytest.mark.nightly
def test_extension_continues_sobol_list_and_grid_draws(tmp_path: Path) -> None:
    """Sobol points continue, and so do a list and a grid that have been cycled."""
    assert_extended(make_study("drawn", 100), make_study("drawn", 140), tmp_path)


@pytest.mark.nightly
@pytest.mark.parametrize("half_width", [0.001, 0.9])
def test_extended_study_stops_at_same_draw_as_full_study(tmp_path: Path, half_width: float) -> None:
    """No interim analysis takes place where the first study ended."""
    rule = {"statistic": "success_rate", "half_width": half_width}
    tables_ = {"stop_when": rule}
    out = tmp_path / "out"
    run.run_into(study_with_draws(80, **tables_), out)
    run.run_into(study_with_draws(140, **tables_), out, resume=True)
    at_once = run.run(study_with_draws(140, **tables_)).summary
    assert at_once.num_rows == 3 * (140 if half_width < 0.5 else 64)
    assert read_summary(out).equals(at_once.cast(read_summary(out).schema))


@pytest.mark.nightly
def test_extension_keeps_duplicate_variants(tmp_path: Path) -> None:
    """The choice of computed variants is fixed when a directory is begun."""
    axes = {"method": ["compass", "kalman5"], "q_accel_ug": [1.0 * i for i in range(1, 40)]}
    assert_extended(
        study_with_draws(20, axes=axes), study_with_draws(300, axes=axes), tmp_path, chunk_runs=128
    )


@pytest.mark.nightly
def test_extended_results_are_recovered_without_manifest(tmp_path: Path) -> None:
    out = assert_extended(study_with_draws(80), study_with_draws(100), tmp_path)
    told = read_manifest(out)
    (out / "manifest.json").unlink()
    before = {n: t for n, t in modification_times(out).items() if "part" in n}
    run.run_into(study_with_draws(100), out, resume=True)
    again = read_manifest(out)
    assert (again["identity"], again["extended_at"]) == (told["identity"], [80])
    assert read_summary(out).num_rows == 300
    assert before.keys() == {n for n in modification_times(out) if "part" in n}


@pytest.mark.parametrize(
    ("there", "here", "told"),
    [
        (
            study_with_draws(80),
            study_with_draws(79),
            "[study] draws: 80 there, 79 here"
            " (draws can be added, not removed: continue with --draws 80)",
        ),
        (
            study_with_draws(80),
            study_with_draws(90, filter={"p0_level_deg": 14.0}),
            "[filter] p0_level_deg: 15.0 there, 14.0 here; [study] draws: 80 there, 90 here",
        ),
        (
            study_with_draws(
                3, alignment={"phi_u0_deg": None}, drawn={"phi_u0_deg": {"values": [1, 2, 3]}}
            ),
            study_with_draws(
                4, alignment={"phi_u0_deg": None}, drawn={"phi_u0_deg": {"values": [1, 2, 3]}}
            ),
            "[drawn] phi_u0_deg.values: ends with the 3 existing draws",
        ),
    ],
)
def test_invalid_extension_is_refused_without_changes(
    there: Study, here: Study, told: str, tmp_path: Path
) -> None:
    out = store_results(tmp_path / "out", there, synthetic_summary(there))
    before = read_files_and_times(out)
    with pytest.raises(InputError) as caught:
        run.run_into(here, out, resume=True)
    assert told in str(caught.value) and "\n" not in str(caught.value)
    assert read_files_and_times(out) == before
