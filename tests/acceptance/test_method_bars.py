"""Settling time and accuracy of the methods: at [P1]'s conditions, and against the bound."""

import tomllib
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from oracles.naive import DEG
from scipy import stats
from support.studies import STILL, small_study

import sinsjax

pytestmark = [pytest.mark.nightly, pytest.mark.optimised(False)]

CONFIG = Path(__file__).parents[2] / "configs" / "paper1_conditions.toml"
PAPER = tomllib.loads(CONFIG.read_text(encoding="utf-8"))


def cases(methods):
    """Return [[cases]] of methods and initial misalignments, Euler angles, deg."""
    return [
        {"case": f"{method} {e} {n} {u}", "method": method}
        | {"phi_e0_deg": e, "phi_n0_deg": n, "phi_u0_deg": u}
        for method, (e, n, u) in methods
    ]


STARTS = [(0, 0, 30), (5, 5, 30), (20, 20, 120), (10, 10, 80), (0, 0, 170)]
DRAWS, END_S = 256, 300
BARS = {"kalman_sincos": 130.0, "optimisation": 120.0}
"""The median of the time to 10 arcmin at most, s: from every start."""
FROM_SMALL = {"ekf_azimuth": 215.0, "invariant": 215.0}
"""Likewise, from small misalignments."""
CASES = [*product(BARS, STARTS), *product(FROM_SMALL, [(5, 5, 30)])]


def heading_bound_arcmin(t):
    """Return the 1 sigma bound of phi_u after t (s): white noise of [P1], 100 Hz."""
    north = 15.041067 * DEG / 3600 * np.cos(32 * DEG)
    return 2 * 500e-6 * np.sqrt(3 / (100 * t)) / (north * t) / DEG * 60


def test_heading_settles_in_time_and_near_information_bound():
    data = PAPER | {"cases": cases(CASES)}
    data["study"] = PAPER["study"] | {
        **{"duration_s": float(END_S), "draws": DRAWS, "curves": True, "record_interval_s": 5.0},
        **{"window_s": [200, END_S], "steady_after_s": 200.0},
    }
    chosen = ("method", "specific_force")
    data["alignment"] = {k: v for k, v in PAPER["alignment"].items() if k not in chosen}
    found = sinsjax.run(sinsjax.study_from_dict(data))
    shape = DRAWS, len(CASES)
    phi = found.curves["phi_u_arcmin"].to_numpy().reshape(*shape, -1)
    phi = phi - found.summary["floor_arcmin"].to_numpy().reshape(*shape, 1)
    phi = (phi + 10800) % 21600 - 10800
    settled = found.summary["settle_10_s"].fill_null(np.inf).to_numpy().reshape(shape)
    # The better end of the median's interval, by order statistics.
    median = np.sort(settled, axis=0)[int(stats.binom.ppf(0.025, DRAWS, 0.5))]
    assert (median <= [(BARS | FROM_SMALL)[method] for method, _ in CASES]).all()
    phi = phi[:, [method in BARS for method, _ in CASES]]
    for within in np.sum(np.abs(phi[..., -1]) < 6, axis=0):
        assert stats.binomtest(int(within), DRAWS).proportion_ci().high >= 0.95
    for t in (60, END_S):
        spread, bound = np.std(phi[..., t // 5 - 1], axis=0, ddof=1), heading_bound_arcmin(t)
        quantiles = stats.chi2.ppf([[0.975], [0.025]], DRAWS - 1)
        low, high = spread * np.sqrt((DRAWS - 1) / quantiles)
        assert (low <= 1.15 * bound).all() and (high >= 0.85 * bound).all()


DEFAULT_S = {(5, 5, 30): 110.0, (20, 20, 120): 480.0, (0, 0, 170): 394.0, (5, 5, 150): 376.0}
"""Mean settling time of `kalman5` of 64 draws to 10' about the bias floor, s."""


def test_kalman5_with_its_defaults_settles_without_resets():
    draws = 16
    settings = {"duration_s": 900.0, "rate_hz": 100.0, "judged_from": "floor", "draws": draws}
    tables = {name: PAPER[name] for name in ("earth", "motion", "sensors")}
    tables |= {"study": settings, "alignment": {"misalignment": "euler"}}
    data = tables | {"cases": cases([*product(["kalman5"], DEFAULT_S)])}
    summary = sinsjax.run(sinsjax.study_from_dict(data)).summary
    times = summary["settle_10_s"].fill_null(np.inf).to_numpy().reshape(draws, -1)
    error = times.std(axis=0, ddof=1) / draws**0.5
    assert (np.abs(times.mean(axis=0) - [*DEFAULT_S.values()]) < 4 * error + 5).all()


BASES = {
    "still": STILL,
    "sway": {"lever_arm_m": [2.0, 2.0, 2.0]},
    "third order": STILL | {"surge_m_per_s": 0.1},
    "gauss-markov": STILL | {"surge_m_per_s": 0.1, "surge_model": "gauss_markov"},
}


@pytest.mark.parametrize("base", BASES)
def test_heading_sigma_is_within_1_5_times_information_bound(base):
    methods, draws = ["kalman_surge", "optimisation_position"], 128
    study = small_study(
        study={"duration_s": 300.0, "rate_hz": 25.0, "draws": draws, "window_s": [200, 300]},
        motion=BASES[base],
        sensors={"gyro_bias_deg_per_h": 0.0, "accel_bias_ug": 0.0},
        filter={"q_reading": "per_sample", "r_reading": "psd"},
        axes={"method": methods},
    )
    phi = sinsjax.run(study).summary["phi_u_arcmin"].to_numpy().reshape(draws, -1)
    low, high = np.sqrt(draws / stats.chi2.ppf([[0.975], [0.025]], draws) * np.mean(phi**2, 0))
    bound = sinsjax.information_bound(study)["bound_u_arcmin"].to_numpy()
    assert (low <= 1.5 * bound).all() and (high >= bound).all()
