"""Draws with companions: the same runs, and estimates that few of them give."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from rich.console import Console
from support.kept import assert_complete, manifest, times
from support.stored import told
from support.studies import STILL, refusal, small_study

from sinsjax.execution import forecast, rerun
from sinsjax.execution import run as study_run
from sinsjax.execution.estimates import read_estimates
from sinsjax.execution.layouts import controlled
from sinsjax.execution.tables import read_summary
from sinsjax.study.load import Study

pytestmark = [pytest.mark.slow, pytest.mark.optimised(False)]

DRAWS, MANY = 48, 512
SETTINGS: dict[str, Any] = {
    **{"duration_s": 40.0, "record_interval_s": 4.0, "window_s": [20, 40]},
    **{"report_times_s": [20.0], "settle_bands_arcmin": [20.0, 10.0]},
    **{"estimate": "controlled", "draws": DRAWS},
}


def study_of(**changes: Any) -> Study:
    """40 s at rest from errors of a degree or two, with a reset and without."""
    tables: dict[str, Any] = {
        "motion": STILL,
        "alignment": {"feedback_interval_s": 1.0, "phi_e0_deg": 0.5, "phi_n0_deg": 0.5},
        "axes": {"phi_u0_deg": [0.0, 1.0], "reset_times_s": [[], [10.0]]},
    }
    settings = SETTINGS | changes.pop("study", {})
    return small_study(**(tables | changes), study=settings)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("controlled") / "out"
    study_run.run_into(study_of(), directory)
    return directory


@pytest.fixture(scope="module")
def many() -> pa.Table:
    """Plain draws of the same study, ten times as many."""
    return study_run.run(study_of(study={"estimate": "draws", "draws": MANY})).summary


def test_controlled_runs_equal_plain_draws(stored: Path, many: pa.Table) -> None:
    few = read_summary(stored)
    own = [name for name in few.column_names if not name.startswith("companion_")]
    assert own == many.column_names
    first = many.slice(0, few.num_rows)
    assert few.select(own).cast(first.schema).equals(first)
    told_ = manifest(stored)
    assert told_["runs"] == told_["runs_done"] == 4 * DRAWS


def test_companion_errors_correlate_with_runs(stored: Path) -> None:
    """The heading error at 20 s and at the end, each beside its run's."""
    few = read_summary(stored)
    for at in ("_at_20", ""):
        run, beside = (
            few[f"{whose}phi_u{at}_arcmin"].to_numpy().reshape(DRAWS, 4)
            for whose in ("", "companion_")
        )
        for variant in range(4):
            assert np.corrcoef(run[:, variant], beside[:, variant])[0, 1] > 0.98


def test_controlled_estimates_of_few_draws_match_many_draws(stored: Path, many: pa.Table) -> None:
    """Every controlled estimate within four standard errors of ten times as many draws."""
    study, made = study_of(), read_estimates(stored)
    floor = many["floor_arcmin"].to_numpy().reshape(MANY, 4)
    for one in controlled(study):
        names = [column.name for column in one.columns]
        found = {name: made[name].to_numpy(zero_copy_only=False) for name in names}
        value, low, high = (found[name] for name in names[3:6])
        if one.kind == "settle":
            whole = np.nan_to_num(many[one.column].to_numpy(zero_copy_only=False), nan=40.0)
            values = whole.reshape(MANY, 4)
        else:
            phi = many[f"phi_u{one.at}_arcmin"].to_numpy().reshape(MANY, 4)
            error = phi if one.truth else phi - floor
            values = error**2 if one.kind == "rms" else np.abs(error) <= one.band_arcmin
        mean, of_many = values.mean(0), values.std(0) / MANY**0.5
        if one.kind == "rms":
            mean, of_many = np.sqrt(mean), of_many / (2 * np.sqrt(mean))
        allowed = 4 * np.hypot((high - low) / 3.92, of_many) + 1e-9
        assert (np.abs(value - mean) < allowed).all(), (names[3], value, mean)
        assert ((low <= value) & (value <= high)).all()
    factors = made["saved_error_rms"].to_numpy()
    assert (factors > 10).all()


def test_plain_estimates_match_draw_averages(stored: Path) -> None:
    rows, made = read_summary(stored), read_estimates(stored)
    assert made["draws"].to_pylist() == [DRAWS] * 4
    seconds = rows["settle_10_truth_s"].fill_null(40.0).to_numpy().reshape(DRAWS, 4)
    np.testing.assert_allclose(made["plain_settle_10_truth_mean_s"], seconds.mean(0))
    within = np.abs(rows["phi_u_arcmin"].to_numpy().reshape(DRAWS, 4)) <= 20
    np.testing.assert_allclose(made["plain_within_20_truth_share"], within.mean(0))
    for column in ("controlled_settle_10_truth_mean_low_s", "saved_within_20_truth"):
        assert made.schema.field(column).metadata[b"meaning"]


def test_resume_rebuilds_only_missing_files(stored: Path, tmp_path: Path) -> None:
    shutil.copytree(stored, tmp_path, dirs_exist_ok=True)
    assert_complete(tmp_path, stored)
    before = times(tmp_path)
    estimates = next(name for name in before if name.startswith("estimates"))
    summary = next(name for name in before if name.startswith("summary"))
    said: list[study_run.RunProgress] = []
    for lost in (estimates, summary):
        (tmp_path / lost).unlink()
        (tmp_path / "manifest.json").unlink(missing_ok=True)
        study_run.run_into(study_of(), tmp_path, resume=True, tell=said.append)
        assert_complete(tmp_path, stored)
        kept = set(before) - {estimates, summary}
        assert {name: times(tmp_path)[name] for name in kept} == {n: before[n] for n in kept}
    runs = 4 * DRAWS
    assert said[:3] == [
        study_run.RunProgress(runs, runs, 0, runs),
        *(study_run.RunProgress(done, 4, 0, 0, "estimates") for done in (0, 4)),
    ]


def test_rerun_repeats_run_with_companion(stored: Path, tmp_path: Path) -> None:
    assert rerun.rerun_into(stored, 5, Console(quiet=True), out=tmp_path / "again")


def test_controlled_study_stops_with_fewer_runs(tmp_path: Path) -> None:
    """At a half width that 64 draws reach with companions, and not alone."""
    axes = {"reset_times_s": [[10.0]], "phi_u0_deg": [28.0, 29.0, 30.0, 31.0]}
    until = {"statistic": "settle_20_s_mean", "half_width": 0.8}
    changes: dict[str, Any] = {"axes": axes, "stop_when": until}
    made = study_run.run(study_of(**changes, study={"draws": 256})).summary
    alone = {"estimate": "draws", "draws": 256}
    plain = study_run.run(study_of(**changes, study=alone)).summary
    assert made.num_rows < plain.num_rows


def test_report_shows_controlled_and_plain_estimates(stored: Path) -> None:
    said = told(stored)
    table = said.partition("with companions")[2]
    assert "times as many draws saved" in table and "draws alone" in table


def test_invalid_controlled_settings_are_refused() -> None:
    few = {"estimate_samples": 512}
    assert refusal(study=SETTINGS | few, motion=STILL) == (
        "[study] estimate_samples: must be at least 4096 with estimate = 'controlled', got 512"
    )
    told_ = refusal(study=SETTINGS, motion=STILL, alignment={"method": "inertial"}, axes={})
    assert "knows no linear part of inertial (use estimate = 'draws')" in told_


def test_forecast_counts_companions() -> None:
    alone = forecast.of(study_of(study={"estimate": "draws"}))
    assert forecast.of(study_of()).run_s > 1.3 * alone.run_s
