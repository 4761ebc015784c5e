"""Settling time and accuracy of the methods at [P1]'s conditions, and the information bound."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from oracles.naive import DEG
from scipy import stats

import sinsjax

pytestmark = [pytest.mark.nightly, pytest.mark.optimised(False)]

CONFIG = Path(__file__).parents[2] / "configs" / "paper1_conditions.toml"
STARTS = [(0, 0, 30), (5, 5, 30), (20, 20, 120), (10, 10, 80), (0, 0, 170)]
"""Initial misalignments, Euler angles, deg."""
SMALL = (5, 5, 30)
DRAWS, END_S = 256, 300
BARS = {"kalman_sincos": 130.0, "optimisation": 120.0}
"""The median of the time to 10 arcmin at most, s: from every start."""
FROM_SMALL = {"ekf_azimuth": 215.0, "invariant": 215.0}
"""Likewise, from `SMALL`."""
Case = tuple[str, tuple[int, int, int]]
CASES: list[Case] = [
    *((method, start) for method in BARS for start in STARTS),
    *((method, SMALL) for method in FROM_SMALL),
]


def heading_bound(t: float) -> float:
    """Return the 1 sigma bound of phi_u after t (s), rad: white noise of [P1], 100 Hz."""
    north = 15.041067 * DEG / 3600 * np.cos(32 * DEG)
    return 2 * 500e-6 * np.sqrt(3 / (100 * t)) / (north * t)


def better_median(times: np.ndarray) -> float:
    """The better end of the median's interval, by order statistics."""
    return float(np.sort(times)[int(stats.binom.ppf(0.025, DRAWS, 0.5))])


@pytest.fixture(scope="module")
def results() -> tuple[dict[Case, np.ndarray], dict[Case, np.ndarray]]:
    """Errors from the floor (draws, records), arcmin, and times to 10' (draws,), s, by case."""
    data = tomllib.loads(CONFIG.read_text(encoding="utf-8"))
    data["study"] |= {
        **{"duration_s": float(END_S), "draws": DRAWS, "curves": True, "record_interval_s": 5.0},
        **{"window_s": [200, END_S], "steady_after_s": 200.0},
    }
    del data["alignment"]["method"], data["alignment"]["specific_force"]
    data["cases"] = [
        {
            "case": f"{method} {e} {n} {u}",
            **{"method": method, "phi_e0_deg": e, "phi_n0_deg": n, "phi_u0_deg": u},
        }
        for method, (e, n, u) in CASES
    ]
    results = sinsjax.run(sinsjax.study_from_dict(data))
    summary, curves = results.summary, results.curves
    shape = DRAWS, len(CASES)
    limit = summary["floor_arcmin"].to_numpy().reshape(*shape, 1)
    phi = curves["phi_u_arcmin"].to_numpy().reshape(*shape, -1) - limit
    phi = (phi + 10800) % 21600 - 10800
    settled = summary["settle_10_s"].to_numpy(zero_copy_only=False).reshape(shape)
    settled = np.where(np.isnan(settled), np.inf, settled)
    return (
        {case: phi[:, i] for i, case in enumerate(CASES)},
        {case: settled[:, i] for i, case in enumerate(CASES)},
    )


@pytest.mark.parametrize("start", range(len(STARTS)), ids=str)
@pytest.mark.parametrize("method", BARS)
def test_heading_settles_from_every_start_near_information_bound(results, method, start):
    errors, settled = (of[method, STARTS[start]] for of in results)
    assert better_median(settled) <= BARS[method]
    within = int(np.sum(np.abs(errors[:, -1]) < 6))
    assert stats.binomtest(within, DRAWS).proportion_ci().high >= 0.95
    for t in (60, END_S):
        spread = np.std(errors[:, t // 5 - 1], ddof=1)
        interval = spread * np.sqrt((DRAWS - 1) / stats.chi2.ppf([0.975, 0.025], DRAWS - 1))
        bound = heading_bound(t) / DEG * 60
        assert interval[0] <= 1.15 * bound
        assert interval[1] >= 0.85 * bound


@pytest.mark.parametrize("method", FROM_SMALL)
def test_nonlinear_filter_settles_in_time_from_small_misalignment(results, method):
    assert better_median(results[1][method, SMALL]) <= FROM_SMALL[method]
