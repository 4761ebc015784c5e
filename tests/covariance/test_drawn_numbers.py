"""The spread of runs whose starts and biases are drawn, against derivatives and against draws."""

import itertools
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from support.bootstrap import bootstrap_intervals
from support.studies import STILL, small_study

from sinsjax.execution import run as study_run

pytestmark = pytest.mark.optimised(False)

MEANS: dict[str, float] = {
    **{"phi_e0_deg": 0.05, "phi_n0_deg": 0.05, "phi_u0_deg": 0.2},
    **{"ve0_m_per_s": 0.0, "vn0_m_per_s": 0.0},
    **{"gyro_bias_deg_per_h": 0.1, "accel_bias_ug": 500.0},
}
SIGMAS = dict(zip(MEANS, (0.01, 0.02, 0.05, 0.001, 0.002, 0.02, 20.0), strict=True))
BIASES = ("gyro_bias_deg_per_h", "accel_bias_ug")
QUIET = {"gyro_noise_deg_per_h": 0.0, "accel_noise_ug": 0.0}
SETTINGS = {
    **{"duration_s": 40.0, "window_s": [20, 40], "report_times_s": [5.0, 20.0]},
    "settle_bands_arcmin": [60.0],
}
ESTIMATED = {"estimate": "covariance", "estimate_samples": 512, "check_linearity": False}
RESETS = {"reset_times_s": [[], [10.0]]}
"""Variants; with as many, and as many samples, everywhere the studies share what is compiled."""

STEP = 0.1
"""Of a difference, in sigmas."""

ENDS = ("_at_5", "_at_20", "")


def drawn_study(
    study: dict[str, Any], sensors: dict[str, float], laws: dict[str, Any], **tables: Any
) -> Any:
    """A base at rest whose draws have all of `MEANS` for themselves."""
    own = dict.fromkeys(key for key in MEANS if key.startswith("phi"))
    tables["alignment"] = own | tables["alignment"]
    sensors = sensors | dict.fromkeys(BIASES)
    return small_study(study=SETTINGS | study, motion=STILL, sensors=sensors, drawn=laws, **tables)


def normal(sigmas: dict[str, float]) -> dict[str, Any]:
    return {key: {"normal": [MEANS[key], sigma]} for key, sigma in sigmas.items()}


def differences(tables: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """(ends, numbers drawn, variants) of phi_u and of phi_u - floor by one sigma of each."""
    numbers = [(key, axis) for key in MEANS for axis in (range(3) if key in BIASES else (None,))]
    steps = [(*number, side) for number in numbers for side in (-STEP, STEP)]
    laws = {}
    for key, mean in MEANS.items():
        off = [(axis, side * SIGMAS[key] * (key == own)) for own, axis, side in steps]
        vectors = [[mean + d * (axis == i) for i in range(3)] for axis, d in off]
        laws[key] = {"values": vectors if key in BIASES else [mean + d for _, d in off]}
    study = drawn_study({"draws": len(steps)}, QUIET, laws, **tables)
    made = study_run.run(study).summary
    phi = np.stack([made[f"phi_u{end}_arcmin"].to_numpy() for end in ENDS])
    both = (phi, phi - made["floor_arcmin"].to_numpy())
    by_draw = (one.reshape(len(ENDS), len(steps), -1) for one in both)
    truth, limit = ((one[:, 1::2] - one[:, ::2]) / (2 * STEP) for one in by_draw)
    return truth, limit


def numbers(made: pa.Table, name: str) -> np.ndarray:
    """(ends, variants)."""
    return np.stack([made[f"{name}{end}_arcmin"].to_numpy() for end in ENDS])


def tables_of(method: str) -> dict[str, Any]:
    return {"alignment": {"feedback_interval_s": 1.0, "method": method}, "axes": RESETS}


@pytest.mark.nightly
@pytest.mark.parametrize("method", ["invariant", "compass"])
def test_noise_free_true_sigma_matches_finite_differences(method: str) -> None:
    """Of methods whose gains do not follow the error."""
    tables = tables_of(method) if method == "invariant" else {"alignment": {"method": method}}
    made = study_run.estimate(drawn_study(ESTIMATED, QUIET, normal(SIGMAS), **tables))
    truth, limit = differences(tables)
    for name, slopes in (("true_sigma_u", truth), ("true_sigma_u_from_floor", limit)):
        expected = np.sqrt(np.sum(slopes**2, axis=1))
        np.testing.assert_allclose(numbers(made, name), expected, rtol=0.02)


# --- against draws ------------------------------------------------------------------------------

WIDE = dict(zip(MEANS, (0.02, 0.03, 0.5, 0.005, 0.005, 0.05, 100.0), strict=True))
DRAWS, BAR = 1024, (0.90, 1.10)


def of_draws(method: str) -> pa.Table:
    study = drawn_study({"draws": DRAWS}, {}, normal(WIDE), **tables_of(method))
    return study_run.run(study).summary


def assert_sigma_and_settling_are_those_of(drawn: pa.Table, made: pa.Table) -> None:
    """The bootstrap interval of each ratio of sigma, corrected for all, meets the bar."""
    floor = drawn["floor_arcmin"].to_numpy().reshape(DRAWS, -1)
    tail = 0.05 / (2 * len(ENDS) * made.num_rows)
    for end, name in itertools.product(ENDS, ("true_sigma_u", "true_sigma_u_from_floor")):
        phi = drawn[f"phi_u{end}_arcmin"].to_numpy().reshape(DRAWS, -1)
        errors = phi - floor if "limit" in name else phi
        low, high = bootstrap_intervals(errors, tail) / made[f"{name}{end}_arcmin"].to_numpy()
        assert (low < BAR[1]).all() and (high > BAR[0]).all(), (end, name, low, high)
    for side in ("", "_truth"):
        mean, error = (
            made[f"settle_60{side}_{what}_s"].to_numpy() for what in ("mean", "mean_error")
        )
        seconds = drawn[f"settle_60{side}_s"].fill_null(SETTINGS["duration_s"]).to_numpy()
        seconds = seconds.reshape(DRAWS, -1)
        apart = 4 * np.sqrt(error**2 + seconds.var(0) / DRAWS) + 0.5
        assert (np.abs(seconds.mean(0) - mean) < apart).all(), (side, seconds.mean(0), mean)


@pytest.mark.nightly
@pytest.mark.parametrize("method", ["invariant", "kalman5"])
def test_estimated_sigma_and_settling_match_draws(method: str) -> None:
    made = study_run.estimate(drawn_study(ESTIMATED, {}, normal(WIDE), **tables_of(method)))
    assert_sigma_and_settling_are_those_of(of_draws(method), made)
