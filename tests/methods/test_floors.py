"""What constant biases leave of an alignment: closed forms against averages, and against runs."""

from typing import Any

import jax
import numpy as np
import pytest
from oracles.in_engine import ARCMIN
from oracles.naive import DEG
from scipy.spatial.transform import Rotation
from support.studies import STILL, small_study, with_paper_values

from sinsjax import run
from sinsjax.execution.success import has_floor
from sinsjax.methods.floors import mean_attitude
from sinsjax.strapdown.base_motion import Motion, Sway
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study

DEG_PER_H = DEG / 3600


def motion(*angles: tuple[float, float, float, float]) -> Motion:
    """Center, amplitude (deg), period (s) and phase (deg) of pitch, roll and yaw."""
    units = np.array([DEG, DEG, 1.0, DEG])
    return Motion(*(Sway(*np.asarray(angle) * units) for angle in angles))


MOTIONS = {
    "large": motion((10, 60, 6.1, 0), (-20, 100, 7.3, 40), (130, 180, 9.7, 70)),
    "in step": motion((10, 60, 8, 0), (-20, 80, 8, 40), (130, 120, 8, 70)),
    "pitch with yaw": motion((0, 60, 8, 30), (5, 80, 7.1, 40), (30, 120, 8, 70)),
    "roll with yaw": motion((0, 60, 7.1, 30), (5, 80, 8, 40), (30, 120, 8, 70)),
    "pitch with roll": motion((0, 60, 8, 30), (5, 80, 8, 40), (30, 120, 7.1, 0)),
}


@pytest.mark.nightly(fast=("large",))
@pytest.mark.parametrize("name", MOTIONS)
def test_mean_attitude_matches_average_over_many_periods(name: str) -> None:
    one = MOTIONS[name]
    t = np.linspace(0, 71_000, 300_007, endpoint=False)
    pitch, roll, yaw = (
        s.center + s.amplitude * np.sin(2 * np.pi * t / s.period + s.phase) for s in one.angles
    )
    turned = Rotation.from_euler("ZXY", np.column_stack([yaw, pitch, roll])).as_matrix()
    weights = np.hanning(len(t))  # over no whole number of all periods
    want = np.tensordot(weights, turned, 1) / weights.sum()
    np.testing.assert_allclose(mean_attitude(one), want, rtol=0, atol=1e-6)
    np.testing.assert_allclose(jax.jit(mean_attitude)(one), mean_attitude(one), rtol=0, atol=1e-14)


def ends(study: Study) -> list[tuple[np.ndarray, float, str]]:
    """Last phi (3,) and floor of each variant, rad (NaN for none), and its status."""
    rows = run(study, curves=False).summary.to_pylist()
    assert [row["variant_id"] for row in rows] == [*range(study.n_variants)]
    keys = [f"{key}_arcmin" for key in ("phi_e", "phi_n", "phi_u", "floor")]
    found = np.array([[row[key] for key in keys] for row in rows], float) * ARCMIN
    return [(one[:3], one[3], row["status"]) for one, row in zip(found, rows, strict=True)]


def test_bias_floor_matches_paper_value() -> None:
    """[P1] section 2.4.1 prints -27.0248'; small angles, both terms and 15.041 deg/h -25.877'."""
    study = small_study(study={"draws": 1}, motion={"yaw_center_deg": 0.0} | STILL)
    ((_, found, _),) = ends(study)
    omega_n = 15.041067 * np.cos(32 * DEG)
    want = -np.arctan2(0.1, omega_n + 0.1) + 500e-6 * np.tan(32 * DEG)
    assert found == pytest.approx(want, abs=0.01 * ARCMIN)
    assert found / ARCMIN == pytest.approx(-25.8769, abs=0.25)


RATE = 15.041067  # deg/h, of [earth]'s default
BIASES = [(e, n, 0.0) for e, n in ((5, 0), (0, 5), (5, 5), (20, 0), (0, 20), (20, 20))]
SETTLING = {"r_velocity_m_per_s": 1e-3, "q_reading": "psd", "q_accel_ug": 5.0}
"""A filter that trusts what it measures: its level does not lag behind a north bias."""
QUICK = SETTLING | {"q_gyro_deg_per_h": 5.0}
SLOW_SWAY = {"yaw_amplitude_deg": 90.0, "yaw_period_s": 1800.0}
SWAY = {"yaw_amplitude_deg": 90.0, "yaw_period_s": 100.0}
LOOP_TIME = {"duration_s": 2400.0, "rate_hz": 20.0}
LOOPS = {"level_sigma_per_s": 0.04, "azimuth_sigma_per_s": 0.04, "level_time_s": 300.0}


def study_of(method: str, **changes: Any) -> Study:
    """Runs of 20 minutes without noise, from 10 deg of heading; headed north, body is n."""
    data: dict[str, Any] = {
        "study": {"duration_s": 1200.0, "rate_hz": 5.0, "draws": 1, "window_s": [1100.0, 1200.0]},
        "earth": {"latitude_deg": 60.0},
        "motion": {"yaw_center_deg": 0.0},
        "sensors": {},
        "alignment": {"method": method, "phi_u0_deg": 10.0},
    }
    for name, change in changes.items():
        data[name] = data.get(name, {}) | change
    if "latitude_deg" in data.get("drawn", {}):
        del data["earth"]["latitude_deg"]
    return study_from_dict(with_paper_values(data))


def closed_form(eps: Any, latitude: float) -> float:
    """phi_U, rad, of gyro biases in deg/h."""
    north = RATE * np.cos(latitude * DEG) + eps[1]
    return float(-np.arctan2(eps[0], north))


def holds(found: float, want: float) -> bool:
    """To 2 % and 5 arcmin."""
    return abs(found - want) <= 0.02 * abs(want) + 5 * ARCMIN


@pytest.mark.nightly
@pytest.mark.optimised(False)
@pytest.mark.parametrize("method", ["kalman5", "kalman10", "compass"])
def test_run_with_level_gyro_bias_ends_at_bias_floor(method: str) -> None:
    """Level, too.

    But for compass loops with 20 deg/h of both at 60 deg: what is felt there is 4.5 times omega_N,
    and so is the gain of the azimuth loop, whose margin is 1 + 4 xi^2, 4.6 here: it still rings.
    """
    changes: dict[str, Any] = {"filter": QUICK}
    if method == "compass":
        changes = {"study": LOOP_TIME, "compass": LOOPS | {"azimuth_damping": 0.95}}
    biases = BIASES[:-1] if method == "compass" else BIASES
    axes = {"latitude_deg": (0.0, 60.0), "gyro_bias_deg_per_h": biases}
    study = study_of(method, axes=axes, **changes)
    given = study.values("gyro_bias_deg_per_h"), study.values("latitude_deg"), ends(study)
    for eps, latitude, (phi, floor, status) in zip(*given, strict=True):
        want = closed_form(eps, latitude)
        assert holds(phi[2], want), (eps, latitude, phi[2] / DEG, want / DEG)
        assert floor == pytest.approx(want, abs=1e-9)
        assert max(abs(phi[:2])) < 6 * ARCMIN
        assert (status == "no_north") == (np.hypot(*eps[:2]) > RATE * np.cos(latitude * DEG))


@pytest.mark.nightly
def test_compass_loops_lag_under_up_gyro_bias() -> None:
    """By 2 eps_U/sigma of the sigma in force at the end, as told; less where more is felt."""
    study = study_of(
        "compass",
        study={"duration_s": 3000.0, "rate_hz": 20.0},
        compass=LOOPS | {"sigma_times_s": [1500.0]},
        axes={
            "gyro_bias_deg_per_h": [(0.0, 0.0, 5.0), (0.0, 0.0, 20.0), (-5.0, -2.0, -20.0)],
            "sigma_factors": [[1.0, 1.0], [1.0, 0.25]],
        },
    )
    given = study.values("gyro_bias_deg_per_h"), study.values("sigma_factors"), ends(study)
    for eps, factors, (phi, floor, _) in zip(*given, strict=True):
        lag = 2 * eps[2] * DEG_PER_H / (0.04 * factors[-1])
        north = RATE * np.cos(60 * DEG)
        felt = north / np.hypot(eps[0], north + eps[1])
        want = closed_form(eps, 60.0) - np.arcsin(lag * felt)
        assert floor == pytest.approx(want, rel=0.01)
        assert abs(phi[2] - want) < 0.02 * abs(lag)
        assert phi[2] == pytest.approx(floor, abs=0.1 * ARCMIN)


@pytest.mark.nightly
def test_compass_lag_changes_sign_with_pass_direction() -> None:
    study = study_of(
        "compass",
        study={"duration_s": 3000.0, "rate_hz": 20.0},
        compass=LOOPS,
        passes={"stored_s": 1000.0, "turn": "reflect"},
        axes={"gyro_bias_deg_per_h": [(0.0, 0.0, 20.0), (5.0, 0.0, 20.0)], "passes": [2, 3]},
    )
    found = ends(study)
    lag = 2 * 20.0 * DEG_PER_H / 0.04
    for i, sign in ((0, 1), (1, -1)):
        assert found[i][0][2] == pytest.approx(sign * lag, rel=0.02)
    for phi, floor, _ in found:
        assert phi[2] == pytest.approx(floor, abs=0.5 * ARCMIN)


def runs_with_floor(study: Study, last_reset_s: float = 0.0) -> list[bool]:
    """Of the first draw's runs."""
    ids = np.arange(study.n_variants)
    return has_floor(study, 0 * ids, ids, np.full(ids.shape, last_reset_s)).tolist()


def test_bias_floor_needs_ten_sway_periods_since_last_reset() -> None:
    biased = {"gyro_bias_deg_per_h": [0.0, 1.0, 0.0]}
    for bias in (biased, {"accel_bias_ug": 10.0}):
        study = study_of("kalman5", motion=SWAY, sensors=bias)
        assert runs_with_floor(study, 200.0) == [True]
        assert runs_with_floor(study, 200.1) == [False]
    assert runs_with_floor(study_of("kalman5", motion=SLOW_SWAY)) == [True]  # nothing to turn
    still = study_of("kalman5", motion=SLOW_SWAY | {"yaw_amplitude_deg": 0.0}, sensors=biased)
    assert runs_with_floor(still, 1200.0) == [True]
    passes = {"stored_s": 600.0, "passes": 2}
    again = study_of("kalman5", motion=SWAY, sensors=biased, passes=passes)
    assert runs_with_floor(again) == [False]  # a record has but six periods


def test_kalman10_has_bias_floor_only_on_still_base() -> None:
    biased = {"gyro_bias_deg_per_h": 0.1}
    assert runs_with_floor(study_of("kalman10", sensors=biased)) == [True]
    swung = {"yaw_amplitude_deg": 180.0, "yaw_period_s": 20.0}
    for sensors in (biased, {}):
        assert runs_with_floor(study_of("kalman10", motion=swung, sensors=sensors)) == [False]
    wide = study_of("kalman10", filter={"p0_gyro_bias_deg_per_h": 5.0}, sensors=biased)
    assert runs_with_floor(wide) == [False]
    reset = study_of("kalman10", resets={"reset_gyro_bias_deg_per_h": 5.0}, sensors=biased)
    assert runs_with_floor(reset) == [False]
