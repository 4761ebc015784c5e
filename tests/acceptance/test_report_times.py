"""Report times: heading error, its sigma and NEES of every run, without its curve."""

import tomllib
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pytest
from rich.console import Console
from support.alone import run_alone
from support.batches import batch_of, run_chunks
from support.studies import add_true_reference, refusal_line, small_study, with_paper_values

from sinsjax.arena.simulated_record import simulated_record
from sinsjax.errors import InputError
from sinsjax.execution import forecast, rerun, run
from sinsjax.records.reference import StoredRecord
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import study_from_dict, study_to_toml
from sinsjax.units import ARCMIN

pytestmark = pytest.mark.optimised(False)

FILTERS = {"axes": {"method": ["kalman5", "kalman_sincos"]}}
LOOPS = {
    "alignment": {"method": "compass"},
    "compass": {"level_sigma_per_s": 0.5, "level_time_s": 2.0, "azimuth_sigma_per_s": 0.05},
}
COARSE: dict[str, Any] = {
    "coarse": {"coarse_duration_s": 3.0},
    "passes": {"stored_s": 4.0, "direction": "rewind"},
    "axes": {
        "arm": {
            "coarse_method": ["none", "inertial", "inertial"],
            "coarse_then": ["hand_over", "hand_over", "replay"],
        }
    },
}
STUDIES: dict[str, dict[str, Any]] = {
    "filters": FILTERS,
    "loops": LOOPS,
    "turns": {"passes": {"stored_s": 2.0}, "axes": {"turn_covariance": ["carried", "reset"]}},
    "coarse": COARSE,
}


@cache
def results(name: str, *times: float) -> run.Results:
    reported = {"report_times_s": list(times)} if times else {}
    return run.run(small_study(**STUDIES[name] | {"study": {"curves": True} | reported}))


def at_record(curves: pa.Table, name: str, record: int) -> np.ndarray:
    """Return a column of the curves at a record, from 1, (runs,); NaN for null."""
    return curves[name].to_numpy().reshape(-1, 6)[:, record - 1]


@pytest.mark.nightly
@pytest.mark.parametrize("name", STUDIES)
def test_report_time_columns_match_curves(name: str) -> None:
    """Times count over all passes, from the first sample of coarse alignment."""
    summary, curves = results(name, 1.0, 2.0, 5.0)
    for time in (1, 2, 5):
        for column in ("phi_u", "sigma_u"):
            told = summary[f"{column}_at_{time}_arcmin"].to_numpy()
            np.testing.assert_array_equal(told, at_record(curves, f"{column}_arcmin", time))
        unknown = np.isnan(at_record(curves, "sigma_u_arcmin", time))
        np.testing.assert_array_equal(np.isnan(summary[f"nees_at_{time}"].to_numpy()), unknown)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["loops", "turns", "coarse"])
def test_report_times_leave_other_results_bit_identical(name: str) -> None:
    """Filters of one pass follow below, in optimised programs."""
    plain, reported = results(name), results(name, 1.0, 2.0, 5.0)
    names = plain.summary.column_names
    assert reported.summary.select(names).equals(plain.summary)
    assert reported.curves.equals(plain.curves)
    of_times = [n for n in reported.summary.column_names if n not in names]
    assert of_times == [
        *("phi_u_at_1_arcmin", "sigma_u_at_1_arcmin", "nees_at_1"),
        *("phi_u_at_2_arcmin", "sigma_u_at_2_arcmin", "nees_at_2"),
        *("phi_u_at_5_arcmin", "sigma_u_at_5_arcmin", "nees_at_5"),
    ]


@pytest.mark.nightly
@pytest.mark.optimised(True)
@pytest.mark.parametrize("method", ["kalman5", "kalman_sincos"])
def test_report_times_leave_optimised_filter_results_bit_identical(method: str) -> None:
    plain, reported = (
        run.run(small_study(alignment={"method": method}, study={"curves": True} | times))
        for times in ({}, {"report_times_s": [2.0, 5.0]})
    )
    assert reported.summary.select(plain.summary.column_names).equals(plain.summary)
    assert reported.curves.equals(plain.curves)


@pytest.mark.nightly
def test_single_run_matches_batch_at_report_times() -> None:
    group = batch_of(small_study(study={"report_times_s": [2.0, 6.0], "draws": 1}))
    draw = jax.tree.map(lambda a: a[0] if np.ndim(a) else a, group.draws)
    params = jax.tree.map(lambda a: a[0], group.params)
    one, _ = jax.jit(run_alone, static_argnums=0)(group.spec, group.environment, draw, params)
    (chunk,) = run_chunks(group)
    np.testing.assert_allclose(one.at_times, chunk.outcome.at_times[0], rtol=1e-9)
    assert abs(one.at_times[1, 0] - one.last.phi.z) == 0


def test_report_times_enter_study_toml_and_fingerprint_only_if_given() -> None:
    plain, reported = small_study(), small_study(study={"report_times_s": [2.0]})
    assert "report_times_s" not in study_to_toml(plain)
    assert len({fingerprint(plain), fingerprint(reported)}) == 2
    assert study_from_dict(tomllib.loads(study_to_toml(reported))) == reported
    assert forecast.forecast_sweep(reported).run_bytes > forecast.forecast_sweep(plain).run_bytes
    part = batch_of(plain)
    assert part.environment.criteria.report_samples is None


@pytest.mark.nightly
@pytest.mark.optimised(True)
def test_rerun_with_report_times_is_identical(tmp_path: Path) -> None:
    """Bit-equal: without optimisation the program with curves rounds differently."""
    replay = COARSE | {"axes": {"coarse_then": ["replay"]}}
    study = small_study(**replay, study={"report_times_s": [1.0, 5.0]})
    run.run_into(study, tmp_path / "out", curves=False)
    told = StringIO()
    rerun.rerun_stored_run(tmp_path / "out", 1, Console(file=told, width=200))
    assert "identical" in told.getvalue()


def record() -> StoredRecord:
    """Return six seconds of the swaying vehicle, with its true attitude."""
    simulated = small_study(sensors={"gyro_noise_deg_per_h": 0.0})
    return add_true_reference(simulated_record(simulated))


def recorded(times: list[float], coarse: dict[str, Any], **tables: Any) -> dict[str, Any]:
    settings = {"duration_s": 4.0, "rate_hz": 100.0, "window_s": [2, 4], "curves": True}
    data = {
        "study": settings | {"report_times_s": times},
        "record": {"format": "psins"},
        "coarse": {"coarse_duration_s": 2.0} | coarse,
    }
    return with_paper_values(data | tables)


@pytest.mark.nightly
def test_report_times_count_same_data_for_hand_over_and_replay() -> None:
    """The one has heard 2 s before t = 0; alone, its times are those of its records."""
    stored = record()
    both = recorded([3.0, 4.0], {}, axes={"coarse_then": ["hand_over", "replay"]})
    summary, curves = run.run(study_from_dict(both), stored)
    phi = curves["phi_u_arcmin"].to_numpy().reshape(2, 4)
    for time in (3, 4):
        told = summary[f"phi_u_at_{time}_arcmin"].to_numpy()
        np.testing.assert_array_equal(told, [phi[0, time - 3], phi[1, time - 1]])
    alone = run.run(study_from_dict(recorded([1.0, 4.0], {})), stored)
    own = alone.curves["phi_u_arcmin"].to_numpy()
    assert alone.summary["phi_u_at_1_arcmin"].to_pylist() == [own[0]]
    assert alone.summary["phi_u_at_4_arcmin"].to_pylist() == [own[3]]


@pytest.mark.nightly
def test_report_times_without_reference_give_only_sigma() -> None:
    summary = run.run(
        study_from_dict(recorded([1.0], {})), record()._replace(reference=None)
    ).summary
    assert summary["phi_u_at_1_arcmin"].null_count == summary["nees_at_1"].null_count == 1
    assert summary["sigma_u_at_1_arcmin"].to_pylist()[0] > 1 * ARCMIN


HERE = "[study] report_times_s: "


@pytest.mark.parametrize(
    ("tables", "line"),
    [
        (
            {"study": {"report_times_s": [2.0, 2.5]}},
            "2.5 s is not a whole number of record intervals of 1 s (nearest: 2 or 3)",
        ),
        (
            {"study": {"report_times_s": [2.0, 7.0]}},
            "7 s is not within the run (duration_s = 6)",
        ),
        (
            {"study": {"report_times_s": [5.0]}, "passes": {"stored_s": 2.0, "passes": 2}},
            "5 s is not within the run (duration_s = 6; the shortest run ends at 4 s)",
        ),
    ],
)
def test_report_times_between_records_or_after_run_are_refused(
    tables: dict[str, Any], line: str
) -> None:
    assert refusal_line(**tables) == HERE + line


@pytest.mark.parametrize(
    ("times", "coarse_s", "line"),
    [
        ([2.0], 2.0, "2 s is before the first record time of runs after coarse alignment of 2 s"),
        ([4.0], 2.5, "4 s is between two record times of runs after coarse alignment of 2.5 s"),
    ],
)
def test_report_times_outside_hand_over_records_are_refused(
    times: list[float], coarse_s: float, line: str
) -> None:
    arms = {"arm": {"coarse_then": ["hand_over", "replay"], "coarse_duration_s": [coarse_s, 2.0]}}
    tables = recorded(times, {}, axes=arms)
    del tables["coarse"]["coarse_duration_s"]
    with pytest.raises(InputError) as caught:
        study_from_dict(tables)
    assert str(caught.value) == f"study: {HERE}{line}"
