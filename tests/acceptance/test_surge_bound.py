"""Accuracy of the methods relative to the information bound, with sway, surge, or neither."""

from itertools import product

import numpy as np
import pytest
from scipy import stats
from support.studies import STILL, small_study

import sinsjax

pytestmark = [pytest.mark.nightly, pytest.mark.optimised(False)]

RATE_HZ, DRAWS, END_S = 25.0, 128, 300.0
AIM = 1.5
"""Ratio to the bound at the end, for every motion."""
BASES = {
    "still": STILL,
    "sway": {"lever_arm_m": [2.0, 2.0, 2.0]},
    "third order": STILL | {"surge_m_per_s": 0.1},
    "gauss-markov": STILL | {"surge_m_per_s": 0.1, "surge_model": "gauss_markov"},
}
METHODS = ("kalman_surge", "optimisation_position")


@pytest.fixture(scope="module")
def ratios():
    """Standard deviation of phi_u (95 % interval) by method and motion, in units of the bound."""
    found = {}
    for base, motion in BASES.items():
        study = small_study(
            study={
                **{"duration_s": END_S, "rate_hz": RATE_HZ, "draws": DRAWS},
                "window_s": [200, END_S],
            },
            motion=motion,
            sensors={"gyro_bias_deg_per_h": 0.0, "accel_bias_ug": 0.0},
            filter={"q_reading": "per_sample", "r_reading": "psd"},
            axes={"method": list(METHODS)},
        )
        bound = sinsjax.information_bound(study)["bound_u_arcmin"].to_numpy()
        summary = sinsjax.run(study).summary
        phi = summary["phi_u_arcmin"].to_numpy().reshape(DRAWS, len(METHODS))
        spread = np.sqrt(DRAWS / stats.chi2.ppf([[0.975], [0.025]], DRAWS) * np.mean(phi**2, 0))
        found |= zip(product(METHODS, [base]), (spread / bound).T, strict=True)
    return found


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("method", METHODS)
def test_heading_sigma_is_within_1_5_times_information_bound(ratios, method, base):
    low, high = ratios[method, base]
    assert low <= AIM
    assert high >= 1
