"""Studies that begin with coarse alignment, and reports at times of a run: rows of their tables."""

from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from support.studies import add_true_reference, refusal_line, small_study, with_paper_values

from sinsjax.arena.export import simulated_record
from sinsjax.execution import run
from sinsjax.study.load import study_from_dict
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
    assert curves["time_s"].to_pylist()[:6] == [1, 2, 3, 4, 5, 6]


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
    assert np.all(sigma[6][:, 3:] < sigma[2][:, 3:])


def test_only_resets_after_coarse_alignment_are_accepted_unless_it_is_replayed() -> None:
    resets = {"reset_times_s": [2.0, 4.0]}
    line = "[resets] reset_times_s: the reset at 2 s is not after the end of coarse alignment,"
    line += " at 2 s (reset later)"
    assert refusal_line(coarse={"coarse_duration_s": 2.0}, resets=resets) == line
    small_study(coarse={"coarse_duration_s": 2.0, "coarse_then": "replay"}, resets=resets)


# Report times

REPORTED: dict[str, dict[str, Any]] = {
    "filters": {"axes": {"method": ["kalman5", "kalman_sincos"]}},
    "passes": {
        "passes": {"stored_s": 2.0},
        "axes": {"turn_covariance": ["carried", "reset"]},
    },
    "coarse": {
        "coarse": {"coarse_duration_s": 3.0},
        "passes": {"stored_s": 4.0},
        "axes": {
            "arm": {
                "coarse_method": ["none", "inertial", "inertial"],
                "coarse_then": ["hand_over", "hand_over", "replay"],
            }
        },
    },
}


@pytest.mark.nightly
@pytest.mark.optimised(True)
@pytest.mark.parametrize("name", REPORTED)
def test_report_times_repeat_the_curves_and_leave_other_results_bit_identical(name: str) -> None:
    """Times count over all passes, from the first sample of coarse alignment."""
    plain, reported = (
        run.run(small_study(**REPORTED[name] | {"study": {"curves": True} | times}))
        for times in ({}, {"report_times_s": [1.0, 2.0, 5.0]})
    )
    assert reported.summary.select(plain.summary.column_names).equals(plain.summary)
    assert reported.curves.equals(plain.curves)
    curves = {
        key: reported.curves[f"{key}_arcmin"].to_numpy().reshape(-1, 6)
        for key in ("phi_u", "sigma_u")
    }
    for time in (1, 2, 5):
        for key, values in curves.items():
            at_time = reported.summary[f"{key}_at_{time}_arcmin"].to_numpy()
            np.testing.assert_array_equal(at_time, values[:, time - 1])
        nees = reported.summary[f"nees_at_{time}"].to_numpy()
        np.testing.assert_array_equal(np.isnan(nees), np.isnan(curves["sigma_u"][:, time - 1]))


@pytest.mark.nightly
def test_report_times_count_same_data_for_hand_over_and_replay() -> None:
    """The one has heard 2 s of a record before t = 0; alone, its times are those of its records."""
    stored = add_true_reference(simulated_record(small_study()))

    def aligned(times: list[float], **axes: Any) -> run.Results:
        tables = {
            "study": {"duration_s": 4.0, "rate_hz": 100.0, "window_s": [2, 4], "curves": True},
            "record": {"format": "psins"},
            "coarse": {"coarse_duration_s": 2.0},
            "axes": axes,
        }
        tables["study"] |= {"report_times_s": times}
        return run.run(study_from_dict(with_paper_values(tables)), stored)

    both = aligned([3.0, 4.0], coarse_then=["hand_over", "replay"])
    phi = both.curves["phi_u_arcmin"].to_numpy().reshape(2, 4)
    for time in (3, 4):
        at_time = both.summary[f"phi_u_at_{time}_arcmin"].to_numpy()
        np.testing.assert_array_equal(at_time, [phi[0, time - 3], phi[1, time - 1]])
    alone = aligned([1.0, 4.0])
    own = alone.curves["phi_u_arcmin"].to_numpy()
    for time in (1, 4):
        assert alone.summary[f"phi_u_at_{time}_arcmin"].to_pylist() == [own[time - 1]]
