"""The spread of runs with surge, drifting biases and random walks, against their draws."""

from typing import Any

import pyarrow as pa
import pytest
from support.bootstrap import bootstrap_intervals
from support.studies import STILL, small_study

from sinsjax.execution import run as study_run

pytestmark = [pytest.mark.nightly, pytest.mark.optimised(False)]

DRAWS, BAR = 1024, (0.90, 1.10)
INPUTS: dict[str, dict[str, Any]] = {
    "surge": {"motion": {"surge_m_per_s": 0.01, "surge_time_s": 3.0}},
    "instability": {
        "sensors": {
            **{"gyro_instability_deg_per_h": 0.5, "gyro_instability_time_s": 20.0},
            **{"accel_instability_ug": 200.0, "accel_instability_time_s": 10.0},
        }
    },
}
SETTINGS = {"duration_s": 40.0, "window_s": [20, 40], "settle_bands_arcmin": [60.0]}
NEXT_TO_NOTHING = 1e-6
"""Of inputs; without any the program would be another."""


def tables(name: str, method: str, share: float = 1.0) -> dict[str, Any]:
    """A base at rest with a share of some inputs, and two schedules of resets."""
    scaled = {
        section: {key: share * x if "time" not in key else x for key, x in table.items()}
        for section, table in INPUTS[name].items()
    }
    start = {"phi_e0_deg": 0.1, "phi_n0_deg": 0.1}
    return scaled | {
        "motion": STILL | scaled.get("motion", {}),
        "alignment": {"method": method, "feedback_interval_s": 1.0} | start,
        "axes": {"reset_times_s": [[], [10.0]]},
    }


def assert_spread_is_that_of(drawn: pa.Table, made: pa.Table) -> None:
    """The bootstrap interval of each ratio of sigma, corrected for all, meets the bar."""
    sigma = made["true_sigma_u_arcmin"].to_numpy()
    errors = drawn["phi_u_arcmin"].to_numpy().reshape(DRAWS, -1)
    low, high = bootstrap_intervals(errors, 0.05 / len(sigma)) / sigma
    assert (low < BAR[1]).all() and (high > BAR[0]).all()


@pytest.mark.parametrize(
    ("name", "method"),
    [("surge", "kalman_sincos"), ("surge", "kalman5"), ("instability", "kalman_sincos")],
)
def test_covariance_sigma_matches_draws(name: str, method: str) -> None:
    few = SETTINGS | {"estimate": "covariance", "estimate_samples": 16, "check_linearity": False}
    made, quiet = (
        study_run.estimate(small_study(study=few, **tables(name, method, share)))
        for share in (1.0, NEXT_TO_NOTHING)
    )
    given = SETTINGS | {"draws": DRAWS}
    drawn = study_run.run(small_study(study=given, **tables(name, method))).summary
    assert_spread_is_that_of(drawn, made)
    # The inputs matter: without them the spread is another.
    sigma, without = (table["true_sigma_u_arcmin"].to_numpy() for table in (made, quiet))
    assert (sigma > 1.1 * without).any()
