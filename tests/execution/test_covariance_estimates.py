"""Covariance estimates, compared with draws of the same study, and as a dataset."""

import itertools
import random
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from rich.console import Console
from scipy import stats
from support.killed_commands import KilledCommand
from support.stored_results import report_text, store_results
from support.studies import STILL, small_study
from support.sweep_directories import (
    assert_complete,
    modification_times,
    read_manifest_entries,
    read_parts,
)
from support.synthetic_tables import synthetic_estimates

from sinsjax import columns
from sinsjax.errors import InputError
from sinsjax.execution import rerun
from sinsjax.execution import run as study_run
from sinsjax.execution.estimates import estimated_curves
from sinsjax.execution.prepare import RunOptions, prepare_job
from sinsjax.execution.results import read_estimates, read_summary
from sinsjax.execution.tasks import Executor, Job, TaskRunner
from sinsjax.study.load import study_to_toml
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

RUN_S, DRAWS = 60.0, 256
TIMES = ["", "_at_20", "_at_45"]


SHORT = {"duration_s": 2.0, "window_s": [0, 2], "report_times_s": [1.0]}


def make_study(**changes: Any) -> Study:
    """A minute at rest, four starts by two schedules, from errors of a few degrees.

    One program does all studies of 7 or 8 variants of them, with a reset or two schedules.
    """
    settings: dict[str, Any] = {
        **{"duration_s": RUN_S, "window_s": [30, RUN_S], "report_times_s": [20.0, 45.0]},
        **{"estimate": "covariance", "draws": None, "settle_bands_arcmin": [60.0, 20.0, 10.0]},
    }
    tables_: dict[str, Any] = {
        "motion": STILL,
        "alignment": {"feedback_interval_s": 1.0, "phi_e0_deg": 0.5, "phi_n0_deg": 0.5},
        "axes": {"phi_u0_deg": [0.0, 2.0, 3.5, 5.0], "reset_times_s": [[], [10.0]]},
    }
    changes = dict(changes)
    settings |= changes.pop("study", {})
    return small_study(**(tables_ | changes), study=settings)


def short_study(**changes: Any) -> Study:
    """Return a study of two parts of 130 variants, 2 s each: three tiles per part."""
    few = {"estimate_samples": 16, "check_linearity": False}
    settings = SHORT | few | changes.pop("study", {})
    axes = {"yaw_amplitude_deg": [2.8, 0.0], "p0_yaw_deg": [0.5 * i for i in range(1, 131)]}
    return make_study(study=settings, motion={}, axes=axes, **changes)


@pytest.fixture(scope="module")
def estimates_and_draws() -> tuple[pa.Table, pa.Table]:
    """Return estimates, and the summary of draws of the same study."""
    drawn = make_study(study={"estimate": "draws", "draws": DRAWS})
    return study_run.estimate(make_study()), study_run.run(drawn).summary


def by_variant(summary: pa.Table, column: str) -> np.ndarray:
    """(draws, variants)."""
    return summary[column].to_numpy().reshape(DRAWS, -1)


@pytest.mark.nightly
def test_mean_and_sigma_match_monte_carlo_draws(
    estimates_and_draws: tuple[pa.Table, pa.Table],
) -> None:
    """At each time: means within four standard errors, variances in their chi-square interval."""
    made, summary = estimates_and_draws
    assert made.num_rows == 8
    tail = 0.0005 / (len(TIMES) * made.num_rows)
    low, high = stats.chi2.ppf([tail, 1 - tail], DRAWS - 1) / (DRAWS - 1)
    for at in TIMES:
        phi = by_variant(summary, f"phi_u{at}_arcmin")
        mean, sigma = (made[f"{name}_u{at}_arcmin"].to_numpy() for name in ("phi", "true_sigma"))
        assert (np.abs(phi.mean(0) - mean) < 4 * sigma / DRAWS**0.5).all(), at
        ratio = phi.var(0, ddof=1) / sigma**2
        assert (ratio > low).all() and (ratio < high).all(), (at, ratio)
        own = by_variant(summary, f"sigma_u{at}_arcmin").mean(0)
        np.testing.assert_allclose(made[f"sigma_u{at}_arcmin"], own, rtol=0.02)
    for axis in "en":
        phi = by_variant(summary, f"phi_{axis}_arcmin")
        sigma = made[f"true_sigma_{axis}_arcmin"].to_numpy()
        ratio = phi.var(0, ddof=1) / sigma**2
        assert (ratio > 0.7).all() and (ratio < 1.4).all(), (axis, ratio)


@pytest.mark.nightly
def test_shares_and_settling_times_match_monte_carlo_draws(
    estimates_and_draws: tuple[pa.Table, pa.Table],
) -> None:
    """Within four standard errors, never counting as the end of the run."""
    made, summary = estimates_and_draws
    floor = by_variant(summary, "floor_arcmin")
    for band, (side, settled) in itertools.product(
        (60, 20, 10), (("", "settle_{}"), ("_truth", "settle_{}_truth"))
    ):
        name = settled.format(band)
        for at in TIMES:
            error = by_variant(summary, f"phi_u{at}_arcmin") - (0.0 if side else floor)
            share = made[f"within_{band}{side}{at}_share"].to_numpy()
            allowed = 4 * np.sqrt(share * (1 - share) / DRAWS) + 0.01
            assert (np.abs((np.abs(error) <= band).mean(0) - share) < allowed).all(), (name, at)
        seconds = np.nan_to_num(by_variant(summary, f"{name}_s"), nan=RUN_S)
        mean, error = (made[f"{name}_{what}_s"].to_numpy() for what in ("mean", "mean_error"))
        apart = 4 * np.sqrt(error**2 + seconds.var(0) / DRAWS) + 0.5
        assert (np.abs(seconds.mean(0) - mean) < apart).all(), (name, seconds.mean(0), mean)
        never = np.isnan(by_variant(summary, f"{name}_s")).mean(0)
        for q, share in (("q10", 0.1), ("median", 0.5), ("q90", 0.9)):
            missing = made[f"{name}_{q}_s"].is_null().to_numpy(zero_copy_only=False)
            assert (never[missing] > 1 - share - 0.12).all()
            assert (never[~missing] < 1 - share + 0.12).all()


@pytest.fixture(scope="module")
def made_of_short() -> pa.Table:
    return study_run.estimate(short_study(), chunk_runs=2)


@pytest.mark.nightly
def test_columns_have_unit_and_meaning_metadata(made_of_short: pa.Table) -> None:
    made = made_of_short
    for name in made.column_names:
        about = made.schema.field(name).metadata
        assert about[b"meaning"]
        for end, unit in (("_arcmin", b"arcmin"), ("_s", b"s"), ("_share", b"")):
            if name.endswith(end) and not name.endswith("_per_s"):
                assert about[b"unit"] == unit, name
    assert made["p0_yaw_deg"].to_pylist()[:3] == [0.5, 1.0, 1.5]
    assert {"method", "reset_times_s", "phi_u0_deg", "floor_arcmin"} < set(made.column_names)
    assert not {"run_id", "draw_id", "start_s"}.intersection(made.column_names)


@pytest.mark.nightly
def test_variant_without_bias_floor_has_truth_estimates_only(
    made_of_short: pa.Table,
) -> None:
    """A sway of 10 s has no bias floor in runs of two."""
    for row in made_of_short.to_pylist():
        assert not row["has_floor"] and row["floor_arcmin"] is None
        assert row["within_10_share"] is row["settle_10_mean_s"] is None
        assert row["within_10_truth_share"] is not None
        assert row["settle_10_truth_mean_s"] is not None


@pytest.mark.nightly
def test_noise_free_estimate_equals_single_run() -> None:
    quiet = {"gyro_noise_deg_per_h": 0.0, "accel_noise_ug": 0.0}
    made = study_run.estimate(make_study(sensors=quiet))
    drawn = study_run.run(
        make_study(sensors=quiet, study={"estimate": "draws", "draws": 1})
    ).summary
    for at in TIMES:
        assert set(made[f"true_sigma_u{at}_arcmin"].to_pylist()) == {0.0}
        expected = drawn[f"phi_u{at}_arcmin"].to_numpy()
        np.testing.assert_allclose(made[f"phi_u{at}_arcmin"], expected, rtol=1e-9)
        inside = np.abs(expected) <= 10
        np.testing.assert_array_equal(made[f"within_10_truth{at}_share"], inside.astype(float))
    seconds = drawn["settle_10_truth_s"]
    assert made["settle_10_truth_median_s"].equals(seconds)
    np.testing.assert_array_equal(made["settle_10_truth_mean_s"], seconds.fill_null(RUN_S))
    assert set(made["settle_10_truth_mean_error_s"].to_pylist()) == {0.0}


@pytest.mark.nightly
def test_estimated_curves_match_estimates_at_report_times(
    estimates_and_draws: tuple[pa.Table, pa.Table],
) -> None:
    """They match for a study with or without draws."""
    made = estimated_curves(make_study(study={"estimate": "draws", "draws": 2}))
    assert made["variant_id"].to_pylist() == np.repeat(range(8), int(RUN_S)).tolist()
    assert made["time_s"].to_pylist()[:3] == [1.0, 2.0, 3.0]
    for at, time_s in zip(TIMES, (RUN_S, 20.0, 45.0), strict=True):
        rows = made.filter(pc.equal(made["time_s"], time_s))
        for kind, axis in itertools.product(("phi", "true_sigma", "sigma"), "enu"):
            own = estimates_and_draws[0][f"{kind}_{axis}{at}_arcmin"]
            np.testing.assert_allclose(rows[f"{kind}_{axis}_arcmin"], own, rtol=1e-9, atol=1e-12)
    with pytest.raises(InputError, match="inertial"):
        estimated_curves(small_study(alignment={"method": "inertial"}))


# --- as a dataset -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results of an uninterrupted run, in parts of 128 variants and a remainder."""
    directory = tmp_path_factory.mktemp("whole") / "out"
    study_run.run_into(short_study(), directory, chunk_runs=128)
    assert sorted(read_parts(directory)) == [
        f"estimates/part-{part:04d}-{call:06d}.parquet" for part in (0, 1) for call in (0, 1)
    ]
    return directory


@pytest.mark.nightly
def test_estimates_are_equal_for_any_chunk_size_and_as_stored(
    uninterrupted: Path, made_of_short: pa.Table
) -> None:
    one, other = made_of_short, study_run.estimate(short_study(), chunk_runs=10**6)
    assert one.equals(other) and one.num_rows == 260
    stored = read_estimates(uninterrupted)
    assert stored["variant_id"].to_pylist() == list(range(260))
    assert stored.cast(one.schema).equals(one)
    few = read_estimates(uninterrupted, ["phi_u_arcmin", "method"])
    assert few.column_names == ["phi_u_arcmin", "method"] and few.num_rows == 260
    told_ = read_manifest_entries(uninterrupted)
    assert told_["runs"] == told_["runs_done"] == 260 and told_["state"] == "complete"


@pytest.mark.nightly
def test_stored_estimates_are_bytewise_equal_for_any_task_order(
    uninterrupted: Path, tmp_path: Path
) -> None:
    def elsewhere(_: TaskRunner, tasks: Any) -> Any:
        todo = list(tasks)
        random.Random(3).shuffle(todo)
        for task in todo:
            yield TaskRunner(Job(short_study(), None, None, 128)).compute_files(task)

    study_run.run_into(short_study(), tmp_path, chunk_runs=128, executor=Executor(elsewhere, {}))
    assert_complete(tmp_path, uninterrupted)


@pytest.mark.nightly
def test_resume_recomputes_only_missing_or_broken_parts(
    uninterrupted: Path, tmp_path: Path
) -> None:
    study_run.run_into(short_study(), tmp_path, chunk_runs=128)
    before = modification_times(tmp_path)
    first, second, *kept = sorted(before)
    (tmp_path / first).unlink()
    (tmp_path / second).write_bytes((tmp_path / second).read_bytes()[:-9])
    (tmp_path / "manifest.json").unlink()
    study_run.run_into(short_study(), tmp_path, resume=True)
    assert_complete(tmp_path, uninterrupted)
    assert {name: modification_times(tmp_path)[name] for name in kept} == {
        name: before[name] for name in kept
    }
    with pytest.raises(InputError, match=r"another study: \[study\] estimate_samples: 16 there"):
        study_run.run_into(short_study(study={"estimate_samples": 18}), tmp_path, resume=True)
    job = prepare_job(short_study(), options=RunOptions(tmp_path, resume=True))
    assert job.chunk_runs == 128


@pytest.mark.nightly
@pytest.mark.parametrize("moment", ["half", "before", "after"])
def test_sweep_resumes_after_kill(moment: str, uninterrupted: Path, tmp_path: Path) -> None:
    config, out = tmp_path / "study.toml", tmp_path / "out"
    config.write_text(study_to_toml(short_study()))
    words = ["sweep", str(config), "-o", str(out), "--resume", "--chunk-runs", "128"]
    killed = [(moment, "estimates/*", 2), ("never", "", 0)]
    for number, point in enumerate(killed):
        process = KilledCommand(words, {}, tmp_path / f"said{number}", point=point)
        process.proceed().process.join(120)
        code = process.process.exitcode
        assert code == (0 if number else -signal.SIGKILL), process.read_output()
        process.close()
    assert_complete(out, uninterrupted)


@pytest.mark.nightly
def test_draws_study_replaces_estimates_only_with_overwrite(
    uninterrupted: Path, tmp_path: Path
) -> None:
    study_run.run_into(short_study(), tmp_path, chunk_runs=128)
    drawn = make_study(study={"estimate": "draws", "draws": 2})
    with pytest.raises(InputError, match="contains results of another study"):
        study_run.run_into(drawn, tmp_path, resume=True)
    study_run.run_into(drawn, tmp_path, overwrite=True)
    assert not list(tmp_path.glob("estimates/*"))
    with pytest.raises(InputError) as caught:
        read_estimates(tmp_path)
    assert str(caught.value) == (
        f"{tmp_path}: contains runs, and no estimates of variants (`read_summary` reads them)"
    )


def test_operations_that_need_runs_are_refused_for_estimates(tmp_path: Path) -> None:
    out = store_results(tmp_path, short_study(), estimates=synthetic_estimates(short_study()))
    with pytest.raises(InputError) as caught:
        read_summary(out)
    assert str(caught.value) == (
        f"{out}: contains estimates of variants, and no runs (`read_estimates` reads them)"
    )
    with pytest.raises(InputError) as caught:
        rerun.rerun_stored_run(out, 0, Console())
    assert str(caught.value) == f"{out}: a covariance estimate has no run to repeat"
    with pytest.raises(InputError, match="curves: a covariance estimate has no runs"):
        study_run.run_into(short_study(), tmp_path / "curves", curves=True)
    assert not (tmp_path / "curves").exists()
    with pytest.raises(InputError, match="estimates: column settle_7_s is missing"):
        read_estimates(out, ["settle_7_s"])


# --- reported -----------------------------------------------------------------------------------


@pytest.mark.usefixtures("drawn_on_request")
def test_report_prints_least_share_over_starts_of_each_setting(tmp_path: Path) -> None:
    """Estimates are made up: shares of 30 and 90 % without a reset, 60 and 80 % with one."""
    study = make_study(axes={"phi_u0_deg": [0.0, 5.0], "reset_times_s": [[], [10.0]]})
    made = synthetic_estimates(
        study,
        within_10_truth_share=[0.3, 0.6, 0.9, 0.8],
        settle_10_truth_mean_s=[20.0, 30.0, 20.0, 30.0],
    )
    out = store_results(tmp_path, study, estimates=made)
    table = report_text(out).partition(
        "The soonest within 10' of true north, mean over phi_u0_deg"
    )[2]
    assert [line.split()[-2] for line in table.splitlines()[5:7]] == ["30", "60"]


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("axes", "checked"),
    [({"phi_u0_deg": [*range(8)]}, True), ({"method": ["kalman5"]}, False)],
)
def test_report_of_estimates_handles_any_axes(
    axes: dict[str, Any], checked: bool, tmp_path: Path
) -> None:
    resets, study = {"reset_times_s": [10.0]}, {"check_linearity": checked}
    study_run.run_into(make_study(axes=axes, resets=resets, study=study), tmp_path)
    said = report_text(tmp_path)
    assert "Every variant" in said and "by covariance analysis" in said
    assert columns.settle_estimate_columns(10.0)[0].name in read_estimates(tmp_path).column_names


def test_run_and_estimate_refuse_study_of_other_kind() -> None:
    with pytest.raises(InputError, match="have no runs \\(use sinsjax.estimate\\)"):
        study_run.run(short_study())
    with pytest.raises(InputError, match="is 'draws' \\(use sinsjax.run\\)"):
        study_run.estimate(make_study(study={"estimate": "draws", "draws": 1}))
