"""Resuming results: what is refused, and the extension by more draws."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from support.stored_results import store_results
from support.studies import PAPER, small_study
from support.sweep_directories import (
    make_study,
    modification_times,
    read_files_and_times,
    rewrite_manifest,
)
from support.synthetic_tables import synthetic_summary

from sinsjax.arena.simulated_record import simulated_record
from sinsjax.errors import InputError
from sinsjax.execution import rerun, run, tasks
from sinsjax.execution.directory import read_manifest
from sinsjax.execution.results import read_summary
from sinsjax.methods import registry as methods
from sinsjax.platform import runtime, xla
from sinsjax.records import Reference
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import study_from_dict, study_to_toml
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

SHORT = {"duration_s": 2.0, "window_s": [0, 2]}
AXES = {"p0_yaw_deg": [10.0, 40.0, 60.0]}
ZIP = {"reset_count": [0, 1, 2], "reset_cycle_s": [1.0, 1.0, 2.0]}
LIST = {"alignment": {"phi_u0_deg": None}, "drawn": {"phi_u0_deg": {"values": [1, 2, 3]}}}


def study_with_draws(draws: int, **tables: Any) -> Study:
    tables = {"axes": AXES} | tables
    return small_study(**{**tables, "study": SHORT | tables.get("study", {}) | {"draws": draws}})


# --- what is refused ----------------------------------------------------------------------------


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
            study_with_draws(3, **LIST),
            study_with_draws(4, **LIST),
            "[drawn] phi_u0_deg.values: ends with the 3 existing draws",
        ),
        (
            small_study(axes={"sched": ZIP}),
            small_study(axes={"sched": ZIP | {"reset_cycle_s": [1.0, 1.0, 2.5]}}),
            "[axes.sched] reset_cycle_s: [1.0, 1.0, 2.0] there, [1.0, 1.0, 2.5] here",
        ),
        (
            small_study(cases=[{"p0_yaw_deg": 40.0}, {"p0_yaw_deg": 50.0}]),
            small_study(cases=[{"p0_yaw_deg": 40.0}, {"p0_yaw_deg": 60.0}]),
            "[cases 1] p0_yaw_deg: 50.0 there, 60.0 here",
        ),
        (
            small_study(axes={"p0_yaw_deg": [10.0], "phi_u0_deg": [2.0]}),
            small_study(axes={"phi_u0_deg": [2.0], "p0_yaw_deg": [10.0]}),
            "the order of its keys",
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


def test_resume_with_other_package_version_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A package with methods counts only where the study has one of them."""
    study, here, out = small_study(), runtime.relevant_versions(), tmp_path / "out"
    monkeypatch.setattr(runtime, "relevant_versions", lambda: here | {"bringing": "1.0"})
    run.run_into(study, out)
    before = read_files_and_times(out)
    monkeypatch.setattr(runtime, "relevant_versions", lambda: here | {"scipy": "0.0"})
    with pytest.raises(InputError, match="out: was computed with scipy .*, but here is 0.0"):
        run.run_into(study, out, resume=True)
    monkeypatch.setattr(runtime, "relevant_versions", lambda: here | {"bringing": "1.1"})
    with monkeypatch.context() as patch:
        patch.setitem(methods.PACKAGES, "kalman5", ("bringing", "1.1"))
        with pytest.raises(InputError, match=r"computed with bringing 1\.0, but here is 1\.1 \("):
            run.run_into(study, out, resume=True)
    assert read_files_and_times(out) == before
    rewrite_manifest(out, instructions=None)  # as of an older version
    run.run_into(study, out, resume=True)
    assert read_manifest(out)["instructions"] == xla.instruction_set()


@pytest.mark.nightly
def test_resume_with_other_instruction_set_is_refused(tmp_path: Path) -> None:
    """Made by another process, which XLA holds to a smaller set than this one has."""
    reachable = {"settle_bands_arcmin": [1200.0], "success_band_arcmin": 1200.0}
    study, out = small_study(study=reachable), tmp_path / "out"
    (tmp_path / "study.toml").write_text(study_to_toml(study))
    command = [sys.executable, "-m", "sinsjax", "sweep", tmp_path / "study.toml", "-o", out]
    smaller = os.environ | {"XLA_FLAGS": "--xla_cpu_max_isa=SSE4_2"}
    subprocess.run(command, env=smaller, capture_output=True, check=True)
    before, here = read_files_and_times(out), xla.instruction_set()
    told = f"out: was computed with instruction set SSE4_2, but here is {here} .use.*max_isa=SSE4_2"
    with pytest.raises(InputError, match=told):
        run.run_into(study, out, resume=True)
    assert read_files_and_times(out) == before
    # Workers are asked, not the process that hands their rows on.
    theirs = tasks.local_executor()._replace(facts={"workers": 1, "instructions": "SSE4_2"})
    run.run_into(study, out, resume=True, executor=theirs)
    assert read_manifest(out)["instructions"] == "SSE4_2"


@pytest.mark.nightly
def test_another_record_or_reference_is_refused(tmp_path: Path) -> None:
    study = study_from_dict(
        {
            "study": SHORT | {"rate_hz": 100.0},
            "alignment": {"phi_u0_deg": 3.0},
            "record": {"format": "psins", "start_s": [0.0, 1.0]},
            "coarse": {"coarse_duration_s": 3.0},
            "filter": PAPER,
        }
    )
    time_s, out = np.arange(0, 6.01, 0.01), tmp_path / "out"
    record = simulated_record(small_study())
    reference = Reference(time_s, np.zeros((len(time_s), 3)), "true.csv")
    run.run_into(study, out, StoredRecord(record, reference))
    before = read_files_and_times(out)
    late = record.dv.copy()
    late[-1, 2] += 1e-12
    for other in (
        StoredRecord(record._replace(dv=late), reference),
        StoredRecord(record, None),
        StoredRecord(record, reference._replace(attitude_deg=reference.attitude_deg + 1e-9)),
    ):
        with pytest.raises(InputError, match="contains results of another record or reference"):
            run.run_into(study, out, other, resume=True)
    assert read_files_and_times(out) == before
    moved = StoredRecord(record._replace(source="copy.imu"), reference._replace(source="copy.csv"))
    run.run_into(study, out, moved, resume=True)
    assert read_manifest(out)["state"] == "complete"


# --- more draws ---------------------------------------------------------------------------------


def assert_extended(first: Study, second: Study, out: Path, chunk_runs: int | None = None) -> None:
    """Extend results of the first study to the second without recomputing any part."""
    run.run_into(first, out, chunk_runs=chunk_runs)
    before = modification_times(out)
    run.run_into(second, out, resume=True)
    assert before and before.items() <= modification_times(out).items()
    at_once = run.run(second, chunk_runs=chunk_runs)
    assert read_summary(out).equals(at_once.summary.cast(read_summary(out).schema))


@pytest.mark.nightly
def test_extended_rows_equal_sweep_with_all_draws_and_can_be_repeated(tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert_extended(study_with_draws(150), study_with_draws(170), out, 128)
    told = read_manifest(out)
    assert (told["state"], told["draws"], told["extended_at"]) == ("complete", 170, [150])
    before = modification_times(out)
    run.run_into(study_with_draws(170), out, resume=True)  # and gone on with as any other
    assert modification_times(out) == before
    run.run_into(study_with_draws(200), out, resume=True)
    assert read_manifest(out)["extended_at"] == [150, 170]
    whole = run.run(study_with_draws(200)).summary
    assert read_summary(out).equals(whole.cast(read_summary(out).schema))
    for run_id in (0, 599):
        assert rerun.rerun_stored_run(out, run_id, Console(quiet=True))


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["drawn", "duplicates"])
def test_extension_continues_drawn_designs_and_keeps_duplicates(tmp_path: Path, kind: str) -> None:
    """Sobol points, a list and a grid that have been cycled; variants that are computed once."""
    axes = {"method": ["compass", "kalman5"], "q_accel_ug": [1.0 * i for i in range(1, 40)]}
    studies = [
        make_study("drawn", draws) if kind == "drawn" else study_with_draws(draws, axes=axes)
        for draws in ((100, 140) if kind == "drawn" else (20, 300))
    ]
    assert_extended(*studies, tmp_path / "out", chunk_runs=None if kind == "drawn" else 128)


@pytest.mark.nightly
@pytest.mark.parametrize("half_width", [0.001, 0.9])
def test_extended_study_stops_at_same_draw_as_full_study(tmp_path: Path, half_width: float) -> None:
    """No interim analysis takes place where the first study ended."""
    rule = {"stop_when": {"statistic": "success_rate", "half_width": half_width}}
    out = tmp_path / "out"
    run.run_into(study_with_draws(80, **rule), out)
    run.run_into(study_with_draws(140, **rule), out, resume=True)
    at_once = run.run(study_with_draws(140, **rule)).summary
    assert at_once.num_rows == 3 * (140 if half_width < 0.5 else 64)
    assert read_summary(out).equals(at_once.cast(read_summary(out).schema))
