"""The spread of the heading that the fit of velocities finds, against its draws."""

import numpy as np
import pytest
from scipy import stats
from support.studies import small_study

from sinsjax.execution import run as study_run

pytestmark = [pytest.mark.nightly, pytest.mark.optimised(False)]

DRAWS, ENDS, BAR = 256, ("_at_60", "_at_120", ""), (0.90, 1.10)
SETTINGS = {"duration_s": 200.0, "window_s": [100, 200], "report_times_s": [60.0, 120.0]}
STARTS = {"phi_e0_deg": [0.0, 20.0], "phi_n0_deg": [0.0, 20.0]}


def test_optimisation_sigma_matches_draws() -> None:
    """On a swaying base with biases: the intervals of the ratios, corrected for all, meet the bar.

    No start enters, so that draws give the same numbers from each.
    """
    tables = {
        "alignment": {"method": "optimisation"} | dict.fromkeys([*STARTS, "phi_u0_deg"]),
        "axes": {"start": STARTS | {"phi_u0_deg": [0.0, 120.0]}},
    }
    few = {"estimate": "covariance", "draws": None, "estimate_samples": 16}
    made = study_run.estimate(small_study(study=SETTINGS | few, **tables))
    drawn = study_run.run(small_study(study=SETTINGS | {"draws": DRAWS}, **tables)).summary
    tail = 0.025 / (2 * len(ENDS))
    low, high = np.sqrt((DRAWS - 1) / stats.chi2.ppf([1 - tail, tail], DRAWS - 1))
    for axis in "eu":
        for end in ENDS if axis == "u" else ("",):
            phi = drawn[f"phi_{axis}{end}_arcmin"].to_numpy().reshape(DRAWS, -1)
            sigma = made[f"true_sigma_{axis}{end}_arcmin"].to_numpy()
            ratio = phi.std(axis=0, ddof=1) / sigma
            assert (ratio * low < BAR[1]).all() and (ratio * high > BAR[0]).all(), (axis, end)
            mean = made[f"phi_{axis}{end}_arcmin"].to_numpy()
            assert (np.abs(phi.mean(0) - mean) < 4 * sigma / DRAWS**0.5).all(), (axis, end)
    assert max(made[f"nonlinearity{end}"].to_numpy().max() for end in ENDS) < 0.2
    assert not any(made["filled_by_draws"].to_pylist())
