"""The spread of runs with surge, drifting biases and random walks, against their draws."""

from functools import cache
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


SETTINGS = {"duration_s": 40.0, "window_s": [20, 40]}
FEW = {"estimate": "covariance", "estimate_samples": 16, "check_linearity": False}
ALIGNMENT = {"feedback_interval_s": 1.0, "phi_e0_deg": 0.1, "phi_n0_deg": 0.1}
RESETS = {"reset_times_s": [[], [10.0]]}


@cache
def quiet_sigma() -> np.ndarray:
    """Of `kalman5` by its resets, without any of the inputs."""
    study = small_study(
        study=SETTINGS | FEW,
        motion=STILL,
        alignment=ALIGNMENT,
        axes={"method": ["kalman5"]} | RESETS,
    )
    return study_run.estimate(study)["true_sigma_u_arcmin"].to_numpy()


@pytest.mark.parametrize("name", INPUTS)
def test_sigma_is_that_of_draws(name: str) -> None:
    """Of the heading: the bootstrap interval of each ratio, corrected for four, meets the bar."""
    changes = {key: dict(table) for key, table in INPUTS[name].items()}
    changes["motion"] = STILL | changes.get("motion", {})
    tables: dict[str, Any] = {
        "alignment": ALIGNMENT,
        "axes": {"method": ["kalman5", "kalman_sincos"]} | RESETS,
        **changes,
    }
    made = study_run.estimate(small_study(study=SETTINGS | FEW, **tables))
    drawn = study_run.run(small_study(study=SETTINGS | {"draws": DRAWS}, **tables)).summary
    sigma, random = made["true_sigma_u_arcmin"].to_numpy(), np.random.default_rng(1)
    errors = drawn["phi_u_arcmin"].to_numpy().reshape(DRAWS, -1)
    picks = random.integers(0, DRAWS, (RESAMPLES, DRAWS))
    every = np.stack([one[picks].std(axis=1, ddof=1) for one in errors.T], axis=1) / sigma
    tail = 0.025 / every.shape[1]
    low, high = np.quantile(every, [tail, 1 - tail], axis=0)
    assert (low < BAR[1]).all() and (high > BAR[0]).all()
    # The inputs matter: without them the spread is another.
    assert (sigma[:2] > 1.1 * quiet_sigma()).any()


def test_companions_and_their_expectation_know_of_surge() -> None:
    """A controlled mean of few draws is that of many."""
    settings = SETTINGS | {"settle_bands_arcmin": [60.0]}
    tables: dict[str, Any] = {
        "motion": STILL | INPUTS["surge"]["motion"],
        "alignment": ALIGNMENT,
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
