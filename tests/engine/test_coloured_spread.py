"""The spread of runs with surge, drifting biases and random walks, against their draws."""

from typing import Any

import numpy as np
import pytest
from support.studies import STILL, small_study

from sinsjax.execution import run as study_run

pytestmark = [pytest.mark.slow, pytest.mark.optimised(False)]

DRAWS, RESAMPLES = 1024, 4000
BAR = (0.90, 1.10)
INPUTS: dict[str, dict[str, Any]] = {
    "surge": {"motion": {"surge_m_per_s": 0.01, "surge_time_s": 3.0}},
    "instability": {
        "sensors": {
            **{"gyro_instability_deg_per_h": 0.5, "gyro_instability_time_s": 20.0},
            **{"accel_instability_ug": 200.0, "accel_instability_time_s": 10.0},
        }
    },
}


@pytest.mark.parametrize("name", INPUTS)
def test_sigma_is_that_of_draws(name: str) -> None:
    """Of the heading: the bootstrap interval of each ratio, corrected for four, meets the bar."""
    changes = {key: dict(table) for key, table in INPUTS[name].items()}
    changes["motion"] = STILL | changes.get("motion", {})
    tables: dict[str, Any] = {
        "alignment": {"feedback_interval_s": 1.0, "phi_e0_deg": 0.1, "phi_n0_deg": 0.1},
        "axes": {"method": ["kalman5", "kalman_sincos"], "reset_times_s": [[], [10.0]]},
        **changes,
    }
    common = {"duration_s": 40.0, "window_s": [20, 40]}
    few = {"estimate": "covariance", "estimate_samples": 16, "check_linearity": False}
    made = study_run.estimate(small_study(study=common | few, **tables))
    drawn = study_run.run(small_study(study=common | {"draws": DRAWS}, **tables)).summary
    sigma, random = made["true_sigma_u_arcmin"].to_numpy(), np.random.default_rng(1)
    errors = drawn["phi_u_arcmin"].to_numpy().reshape(DRAWS, -1)
    picks = random.integers(0, DRAWS, (RESAMPLES, DRAWS))
    every = np.stack([one[picks].std(axis=1, ddof=1) for one in errors.T], axis=1) / sigma
    tail = 0.025 / every.shape[1]
    low, high = np.quantile(every, [tail, 1 - tail], axis=0)
    assert (low < BAR[1]).all() and (high > BAR[0]).all()
    # The inputs matter: without them the spread is another.
    quiet = tables | {key: (STILL if key == "motion" else {}) for key in changes}
    without = study_run.estimate(small_study(study=common | few, **quiet))
    assert (sigma > 1.1 * without["true_sigma_u_arcmin"].to_numpy()).any()


def test_companions_and_their_expectation_know_of_surge() -> None:
    """A controlled mean of few draws is that of many."""
    settings = {"duration_s": 40.0, "window_s": [20, 40], "settle_bands_arcmin": [60.0]}
    tables: dict[str, Any] = {
        "motion": STILL | INPUTS["surge"]["motion"],
        "alignment": {"feedback_interval_s": 1.0, "phi_e0_deg": 0.1, "phi_n0_deg": 0.1},
        "axes": {"phi_u0_deg": [0.0, 1.0]},
    }
    given = settings | {"estimate": "controlled", "draws": 48}
    made = study_run.estimate(small_study(study=given, **tables))
    many = study_run.run(small_study(study=settings | {"draws": 1024}, **tables)).summary
    rms = np.sqrt(np.mean(many["phi_u_arcmin"].to_numpy().reshape(1024, 2) ** 2, axis=0))
    low, high, found = (
        made[f"controlled_error_rms_truth{end}_arcmin"].to_numpy() for end in ("_low", "_high", "")
    )
    allowed = 4 * np.hypot((high - low) / 3.92, rms / np.sqrt(2 * 1024))
    assert (np.abs(found - rms) < allowed).all()
    assert (made["saved_error_rms_truth"].to_numpy() > 1.5).all()
