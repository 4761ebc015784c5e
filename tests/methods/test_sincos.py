"""Filters in sine and cosine of the azimuth: their models, and what they are good for.

`test_naive_filters.py` compares them with naive ones in closed loop.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.in_engine import place
from oracles.naive import DEG, PAPER, WGS84, exp, skew
from oracles.naive_filters import about_up, upright
from scipy.linalg import expm
from support.studies import small_study

from sinsjax import run as run_study
from sinsjax.engine.build import Scenario
from sinsjax.maths.algebra import entries_as_numbers
from sinsjax.methods import sincos as sincos
from sinsjax.methods.sincos import SurgeParams
from sinsjax.strapdown import processes
from sinsjax.units import ARCMIN

pytestmark = pytest.mark.optimised(False)

LATITUDE, SURGE_S = 32 * DEG, 2.0


def rates_at_rest(a, tilt, v, planet, latitude):
    """V' and (t_E', t_N') of a navigator off by a and the tilt, on a base at rest."""
    true = exp([0.3, -0.4, 2.2])
    w_ie, _ = planet.rates(latitude, (0.0, 0.0))
    f_b, w_b = true.T @ [0.0, 0.0, planet.g(latitude)], true.T @ w_ie
    off = upright(tilt).T @ about_up(-a)  # C_n^{n'}, as C_{n'}^n = Rz(a) e
    c = off @ true
    w_ie, w_en = planet.rates(latitude, v)
    acceleration = c @ f_b - np.cross(2 * w_ie + w_en, [*v, 0.0])
    c_dot = c @ skew(w_b) - skew(w_ie + w_en) @ c
    # u = C_n^{n'} z = C_b^{n'} C_n^b z; C_n^b z changes by the base's turn alone.
    up_b = true.T @ [0.0, 0.0, 1.0]
    true_dot = true @ skew(w_b) - skew(planet.rates(latitude, (0.0, 0.0))[0]) @ true
    u_dot = c_dot @ up_b + c @ (true_dot.T @ [0.0, 0.0, 1.0])
    return np.array([*acceleration[:2], u_dot[1], -u_dot[0]])


@pytest.mark.parametrize("planet", [WGS84, PAPER])
@given(st.floats(-np.pi, np.pi), st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_sincos_transition_matches_navigator_at_any_azimuth(planet, a, seed):
    """Exactly in the azimuth; to first order in velocity and tilt, by central differences."""
    model = np.zeros((6, 6))
    for entry, value in entries_as_numbers(sincos.transition(place(planet, LATITUDE), 1.0)).items():
        model[entry] = value
    x = np.random.default_rng(seed).normal(size=4) * np.array([1e-3, 1e-3, 1e-5, 1e-5])
    here = rates_at_rest(a, x[2:], x[:2], planet, LATITUDE)
    there = rates_at_rest(a, -x[2:], -x[:2], planet, LATITUDE)
    heading = model[:4, 4:] @ [np.sin(a), 1 - np.cos(a)]
    np.testing.assert_allclose((here + there)[2:] / 2, heading[2:], rtol=0, atol=1e-12)
    np.testing.assert_allclose((here - there) / 2, model[:4, :4] @ x, rtol=2e-3, atol=3e-9)
    np.testing.assert_array_equal(model[4:], 0.0)


def matched(**changes):
    """A study whose filter believes the sensors' own noise."""
    sections = {
        "study": {"duration_s": 120.0, "draws": 32, "window_s": [60, 120], "curves": True},
        "sensors": {"gyro_bias_deg_per_h": 0.0, "accel_bias_ug": 0.0, "gyro_noise_deg_per_h": 0.1},
        "alignment": {"method": "kalman_sincos"},
        "filter": {"q_reading": "per_sample", "r_velocity_m_per_s": 1e-3},
    }
    for name, change in changes.items():
        sections[name] = sections.get(name, {}) | change
    return small_study(**sections)


def heading_errors(results):
    """(draws, variants, records) rad."""
    table = results.curves
    draws = results.summary["draw_id"].to_numpy().max() + 1
    variants = results.summary["variant_id"].to_numpy().max() + 1
    return table["phi_u_arcmin"].to_numpy().reshape(draws, variants, -1) * ARCMIN


@pytest.mark.nightly
def test_converged_heading_does_not_depend_on_initial_heading():
    """From 30 s on, on the same noise."""
    study = matched(
        study={"draws": 4, "duration_s": 60.0, "window_s": [30, 60]},
        alignment={"phi_e0_deg": 0.0, "phi_n0_deg": 0.0, "phi_u0_deg": 0.0},
        axes={"phi_u0_deg": [0.0, 30.0, -90.0, 170.0, 180.0]},
    )
    phi = heading_errors(run_study(study))
    from_none = phi[:, :1, 30:]
    off = (phi[:, :, 30:] - from_none + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(off).max() < 0.01 * ARCMIN


@pytest.mark.nightly
def test_north_drift_estimate_and_sigma_are_consistent():
    """Its sigmas cover its errors at the end, and the north drift comes out."""
    bias = 0.5
    study = matched(
        sensors={"gyro_bias_deg_per_h": [0.0, bias, 0.0]},
        motion={"yaw_center_deg": 0.0, "yaw_amplitude_deg": 0.0},
        study={"draws": 128, "duration_s": 300.0, "rate_hz": 25.0, "window_s": [200, 300]},
    )
    results = run_study(study)
    drift, sigma = (
        results.summary[f"gyro_north_drift{part}_deg_per_h"].to_numpy() for part in ("", "_sigma")
    )
    # The bias sways with pitch and roll, whose mean cosines are 0.9995 and 0.9991.
    assert np.sqrt(np.mean(((drift - bias) / sigma) ** 2)) == pytest.approx(1, abs=0.25)
    assert np.mean(drift) == pytest.approx(bias, abs=4 * sigma[0] / len(drift) ** 0.5 + 0.01)


# With states of a surge


def test_surge_model_autocovariance_matches_bounded_velocity():
    """Whose acceleration is bounded far above what the filter samples: its autocovariance."""
    a = np.zeros((10, 10))
    for entry, value in entries_as_numbers(
        sincos.surge_transition(place(WGS84, LATITUDE), SurgeParams(1 / SURGE_S), 1.0)
    ).items():
        a[entry] = value
    dt, rms = 0.05, 0.3
    whole = processes.bounded_velocity_process(np.full(3, rms), SURGE_S, 1e3, 1e-3)
    stationary = whole.begin @ whole.begin.T
    axis = np.ix_([sincos.PLACE_E, sincos.SURGE_E], [sincos.PLACE_E, sincos.SURGE_E])
    own = np.diag([(rms * SURGE_S) ** 2, rms**2])
    for later in range(0, 100, 10):
        expected = (
            rms**2
            * whole.output
            @ (
                np.linalg.matrix_power(whole.transition, round(later * dt / 1e-3))
                @ stationary
                @ whole.output
            )
        )
        found = (expm(a[axis] * later * dt) @ own)[1, 1]
        assert found == pytest.approx(expected, abs=2e-3 * rms**2)
    np.testing.assert_array_equal(a[:6, 6:], 0.0)
    np.testing.assert_array_equal(a[6:, :6], 0.0)


def test_surge_keys_of_study_set_filter_parameters():
    study = small_study(
        alignment={"method": "kalman_surge"},
        filter={"q_reading": "per_sample"},
        surge={"r_surge_m_per_s": 0.3, "r_surge_time_s": 4.0},
    )
    params = Scenario(study).part(0).group.variants.method
    p0, q = np.array(params.p0)[:, 0], np.array(params.q)[:, 0]
    np.testing.assert_allclose(p0[6:], [1.44, 1.44, 0.09, 0.09], rtol=1e-12)
    np.testing.assert_allclose(q[6:], [0, 0, 4.5e-4, 4.5e-4], rtol=1e-12)
    np.testing.assert_array_equal(params.reset_to, params.p0)
    assert params.extra.rate == 0.25
