"""Studies that begin with coarse alignment, and reports at times of a run: rows of their tables."""

import numpy as np
import pytest
from support.refusals import refusal_line
from support.studies import add_true_reference, recorded_study, small_study

from sinsjax.arena.export import simulated_record
from sinsjax.execution import run

pytestmark = pytest.mark.optimised(False)

ARMS = {
    "coarse_method": ["none", "inertial", "optimisation", "inertial"],
    "coarse_then": ["hand_over", "hand_over", "hand_over", "replay"],
}


@pytest.mark.nightly
def test_coarse_method_gives_the_attitude_until_it_hands_over_or_is_replayed():
    axes, coarse = {"arm": ARMS, "phi_u0_deg": [0.0, 30.0]}, {"coarse_duration_s": 3.0}
    curves = run.run(small_study(study={"curves": True}, coarse=coarse, axes=axes)).curves
    assert curves["time_s"].to_pylist()[:6] == [1, 2, 3, 4, 5, 6]
    phi, sigma = (
        curves[name].to_numpy(zero_copy_only=False).reshape(3, 8, 6)
        for name in ("phi_u_arcmin", "sigma_u_arcmin")
    )
    for method, variants in {"inertial": (2, 3, 6, 7), "optimisation": (4, 5)}.items():
        alone = run.run(small_study(study={"curves": True}, alignment={"method": method})).curves
        alone = alone["phi_u_arcmin"].to_numpy().reshape(3, 6)
        for variant in variants:  # bit-equal to the method alone, which goes on
            np.testing.assert_array_equal(phi[:, variant, :3], alone[:, :3])
            assert not np.any(phi[:, variant, 3:] == alone[:, 3:])
    # The initial heading error counts without a coarse stage only.
    same = (phi[:, ::2] == phi[:, 1::2]).all(axis=(0, 2))
    assert same.tolist() == [False, True, True, True]
    # There is no sigma before; a filter of all data since the start has a smaller one.
    assert not np.isnan(sigma[:, 0]).any() and np.isnan(sigma[:, [2, 6], :3]).all()
    assert np.all(sigma[:, 6, 3:] < sigma[:, 2, 3:])


def test_only_resets_after_coarse_alignment_are_accepted_unless_it_is_replayed():
    resets = {"reset_times_s": [2.0, 4.0]}
    line = refusal_line(small_study, coarse={"coarse_duration_s": 2.0}, resets=resets)
    assert line.startswith("[resets] reset_times_s: the reset at 2 s is not after the end of")
    small_study(coarse={"coarse_duration_s": 2.0, "coarse_then": "replay"}, resets=resets)


REPORTED = {
    "filters": {"axes": {"method": ["kalman5", "kalman_sincos"]}},
    "passes": {"passes": {"stored_s": 2.0}, "axes": {"turn_covariance": ["carried", "reset"]}},
    "coarse": {
        "coarse": {"coarse_duration_s": 3.0},
        "passes": {"stored_s": 4.0},
        "axes": {"arm": {key: values[:2] + values[3:] for key, values in ARMS.items()}},
    },
}


@pytest.mark.nightly
@pytest.mark.optimised(True)
@pytest.mark.parametrize("name", REPORTED)
def test_report_times_repeat_the_curves_and_leave_other_results_bit_identical(name):
    """Times count over all passes, from the first sample of coarse alignment."""
    plain, reported = (
        run.run(small_study(**REPORTED[name] | {"study": {"curves": True} | times}))
        for times in ({}, {"report_times_s": [1.0, 2.0, 5.0]})
    )
    assert reported.summary.select(plain.summary.column_names).equals(plain.summary)
    assert reported.curves.equals(plain.curves)
    for key in ("phi_u", "sigma_u"):
        values = reported.curves[f"{key}_arcmin"].to_numpy(zero_copy_only=False).reshape(-1, 6)
        for time in (1, 2, 5):
            at_time = reported.summary[f"{key}_at_{time}_arcmin"].to_numpy(zero_copy_only=False)
            np.testing.assert_array_equal(at_time, values[:, time - 1])


@pytest.mark.nightly
def test_report_times_count_same_data_for_hand_over_and_replay():
    """The one has heard 2 s of a record before t = 0."""
    given = recorded_study(
        study={"duration_s": 4.0, "window_s": [2, 4], "curves": True, "report_times_s": [3.0, 4.0]},
        coarse={"coarse_duration_s": 2.0},
        axes={"coarse_then": ["hand_over", "replay"]},
    )
    both = run.run(given, add_true_reference(simulated_record(small_study())))
    phi = both.curves["phi_u_arcmin"].to_numpy().reshape(2, 4)
    for time in (3, 4):
        at_time = both.summary[f"phi_u_at_{time}_arcmin"].to_numpy()
        np.testing.assert_array_equal(at_time, [phi[0, time - 3], phi[1, time - 1]])
