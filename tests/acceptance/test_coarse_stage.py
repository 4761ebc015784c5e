"""Studies that begin with coarse alignment: from the study to the rows of its tables."""

import tomllib
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from rich.console import Console
from support.studies import add_true_reference, refusal_line, small_study, with_paper_values

from sinsjax.arena.simulated_record import simulated_record
from sinsjax.execution import rerun, run
from sinsjax.execution.tables import TableBuilder
from sinsjax.study.load import study_from_dict, study_to_toml
from sinsjax.study.study import Study

pytestmark = pytest.mark.optimised(False)

ARMS = {
    "coarse_method": ["none", "inertial", "optimisation", "inertial"],
    "coarse_then": ["hand_over", "hand_over", "hand_over", "replay"],
}


def study(**changes: Any) -> Study:
    tables: dict[str, Any] = {
        "study": {"draws": 3, "curves": True},
        "coarse": {"coarse_duration_s": 3.0},
        "axes": {"arm": ARMS, "phi_u0_deg": [0.0, 30.0]},
    }
    return small_study(**(tables | changes))


@cache
def results() -> run.Results:
    return run.run(study())


def values_of_variant(table: pa.Table, variant: int, name: str) -> np.ndarray:
    """Return the values of the runs of a variant, (draws, records or 1)."""
    runs = pc.equal(pc.bit_wise_and(table["run_id"], 7), variant)
    return table.filter(runs)[name].to_numpy().reshape(3, -1)


@pytest.mark.nightly
def test_attitude_before_hand_over_equals_coarse_method_alone() -> None:
    """Bit-equal to a run of this method alone, which continues after the coarse stage."""
    curves = results().curves
    for method, variants in {"inertial": (2, 3, 6, 7), "optimisation": (4, 5)}.items():
        changes = {"alignment": {"method": method}, "axes": {}, "coarse": {"coarse_method": "none"}}
        alone = run.run(study(**changes)).curves["phi_u_arcmin"].to_numpy().reshape(3, -1)
        for variant in variants:
            phi = values_of_variant(curves, variant, "phi_u_arcmin")
            np.testing.assert_array_equal(phi[:, :3], alone[:, :3])
            assert not np.any(phi[:, 3:] == alone[:, 3:])
    assert results().curves["time_s"].to_pylist()[:6] == [1, 2, 3, 4, 5, 6]
    meaning = curves.schema.field("time_s").metadata[b"meaning"]
    assert meaning == b"from the first sample of data"


@pytest.mark.nightly
def test_initial_heading_error_is_ignored_after_coarse_alignment() -> None:
    """Such variants are duplicates: computed once and shown once."""
    phi = results().summary["phi_u_arcmin"].to_numpy().reshape(3, 4, 2)
    same = phi[..., 0] == phi[..., 1]
    np.testing.assert_array_equal(same, [[False, True, True, True]] * 3)
    assert study().duplicate_of.tolist() == [0, 1, 2, 2, 4, 4, 6, 6]
    assert study().without_effect("phi_u0_deg").tolist() == [False] * 2 + [True] * 6


@pytest.mark.nightly
def test_sigma_is_nan_before_hand_over_and_smaller_after_replay() -> None:
    """There is no sigma before; a filter of all data since the start has a smaller one."""
    sigma = [values_of_variant(results().curves, v, "sigma_u_arcmin") for v in range(8)]
    assert not np.isnan(sigma[0]).any() and np.isnan(sigma[2][:, :3]).all()
    assert np.isnan(sigma[6][:, :3]).all() and not np.isnan(sigma[6][:, 3:]).any()
    replayed, handed_over = sigma[6][:, 3:], sigma[2][:, 3:]
    assert np.all(replayed < handed_over)


@pytest.mark.nightly
def test_coarse_summary_has_data_length_per_settling_time() -> None:
    summary = results().summary
    for band in (60, 10, 3):
        for kind in ("", "_truth"):
            data = summary[f"settle_{band}{kind}_data_s"]
            assert data.equals(summary[f"settle_{band}{kind}_s"])
    plain = TableBuilder(small_study()).summary_columns
    assert not any(column.name.endswith("data_s") for column in plain)


def test_resolved_toml_loads_as_equal_study() -> None:
    one = study()
    assert study_from_dict(tomllib.loads(study_to_toml(one))) == one
    assert small_study().coarse is None and study().coarse is not None


@pytest.mark.parametrize(
    ("tables", "line"),
    [
        (
            {"coarse": {"coarse_duration_s": 2.5}},
            "[coarse] coarse_duration_s: 2.5 s is not a whole number of record intervals of 1 s"
            " (nearest: 2 or 3)",
        ),
        (
            {"coarse": {"coarse_duration_s": 6.0}},
            "[coarse] coarse_duration_s: 6 s leaves no time for the method (at most 5)",
        ),
        (
            {"coarse": {"coarse_duration_s": 3.0}, "passes": {"stored_s": 2.0}},
            "[coarse] coarse_duration_s: 3 s leaves no time for the method (at most 2)",
        ),
        (
            {"coarse": {"coarse_method": "analytic", "coarse_duration_s": 2.0}},
            "[coarse] coarse_method: 'analytic' can only hand over a record (use 'inertial')",
        ),
        (
            {"coarse": {"coarse_duration_s": 2.0}, "alignment": {"method": "optimisation"}},
            "[coarse] coarse_method: method optimisation needs no coarse alignment (give 'none')",
        ),
        (
            {"coarse": {"coarse_duration_s": 2.0}, "resets": {"reset_times_s": [2.0, 4.0]}},
            (
                "[resets] reset_times_s: the reset at 2 s is not after the end of coarse alignment,"
                " at 2 s (reset later)"
            ),
        ),
    ],
)
def test_invalid_coarse_settings_are_refused(tables: dict[str, Any], line: str) -> None:
    assert refusal_line(**tables) == line


def test_replay_allows_resets_during_coarse_alignment() -> None:
    small_study(
        coarse={"coarse_duration_s": 2.0, "coarse_then": "replay"},
        resets={"reset_times_s": [1.0, 4.0]},
    )


@pytest.mark.nightly
def test_rerun_with_coarse_stage_is_identical(tmp_path: Path) -> None:
    """With passes that rewind, with a trigger, and after a replay."""
    one = study(
        axes={"coarse_then": ["hand_over", "replay"]},
        passes={"stored_s": 4.0, "direction": "rewind"},
        resets={"reset_trigger": "innovation", "trigger_threshold": 5.0, "trigger_window_s": 0.5},
    )
    run.run_into(one, tmp_path / "out", curves=False)
    for run_id in (2, 5):
        told = StringIO()
        rerun.rerun_stored_run(tmp_path / "out", run_id, Console(file=told, width=200))
        assert "identical" in told.getvalue()


@pytest.mark.nightly
def test_replayed_record_matches_its_simulation() -> None:
    """It begins at its start time with unknown attitude; t = 0 at its own hand-over."""
    silent = {"gyro_noise_deg_per_h": 0.0}
    stored = add_true_reference(simulated_record(study(sensors=silent)))
    settings: dict[str, Any] = {"duration_s": 4.0, "window_s": [2, 4], "curves": True}
    settings["settle_bands_arcmin"] = [9000]  # in a few seconds a run gets no nearer

    def recorded(**changes: Any) -> run.Results:
        tables: dict[str, Any] = {
            "study": settings | {"rate_hz": 100.0},
            "record": {"format": "psins"},
            "coarse": {"coarse_duration_s": 2.0},
        }
        return run.run(study_from_dict(with_paper_values(tables | changes)), stored)

    both = recorded(axes={"coarse_then": ["hand_over", "replay"]})
    phi = both.curves["phi_u_arcmin"].to_numpy().reshape(2, 4)[1]
    simulated = study(
        study=settings | {"draws": 1},
        coarse={"coarse_duration_s": 2.0, "coarse_then": "replay"},
        axes={},
        sensors=silent,
    )
    expected = run.run(simulated).curves["phi_u_arcmin"].to_numpy()
    np.testing.assert_allclose(phi, expected, rtol=1e-4, atol=0.01)
    names = ("settle_9000_truth_s", "settle_9000_truth_data_s")
    settled, data = (both.summary[name].to_pylist() for name in names)
    assert data == [settled[0] + 2.0, settled[1]]
    handed_over = recorded()
    assert len(handed_over.curves) == 4
    assert not any(name.endswith("data_s") for name in handed_over.summary.column_names)
