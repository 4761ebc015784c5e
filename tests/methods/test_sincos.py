"""The filter in sine and cosine of the azimuth: its model, a naive one, and what it is good for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.in_engine import (
    DEG_PER_H,
    PAPER1,
    UG,
    filter_params,
    measured,
    navigation,
    place,
    runner,
    site,
)
from oracles.naive import DEG, PAPER, WGS84, Filter, exp, of_quaternion, skew
from oracles.naive_filters import SINCOS, about_up, closed_loop, upright
from support.studies import small_study

from sinsjax import run as run_study
from sinsjax.maths.algebra import entries_as_numbers, triangle_index
from sinsjax.methods.base import Options
from sinsjax.methods.registry import METHODS
from sinsjax.methods.sincos import method as sincos
from sinsjax.units import ARCMIN

pytestmark = pytest.mark.optimised(False)

RATE, SAMPLES, LATITUDE = 100, 1500, 32 * DEG
P0 = np.array([0.1, 0.1, 15 * DEG, 15 * DEG, 0.5**0.5, 0.5**0.5]) ** 2
Q = (np.array([500 * UG] * 2 + [0.1 * DEG_PER_H] * 4) / RATE) ** 2
R = 1e-3**2  # strong enough for a heading to be found within seconds
PHI0, V0 = np.array([10.0, -15.0, 120.0]) * DEG, np.array([0.3, -0.2])


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


def dense(triangle):
    """Covariances (samples, 6, 6)."""
    index = triangle_index(6)
    order = np.array([[index[i, j] for j in range(6)] for i in range(6)])
    return np.moveaxis(np.array(triangle)[order], -1, 0)


SCHEDULES = {
    "feedback every sample": {},
    "resets": {"every": 100, "resets": (333, 700)},
    "partial feedback, heading reset": {"every": 10, "gain": 0.3, "resets": (250,), "kind": "yaw"},
    "P times 10": {"every": 50, "resets": (500,), "kind": "scale"},
    "resets restart feedback": {"every": 100, "resets": (333, 700), "restarts": True},
    "resets wait for feedback": {"every": 60, "resets": (301, 720), "at_feedback": True},
}


@pytest.mark.representative("feedback every sample")
@pytest.mark.parametrize("schedule", SCHEDULES)
def test_closed_loop_matches_naive_filter(schedule):
    filt = Filter(P0, Q, R, **SCHEDULES[schedule])
    start = exp(-PHI0) @ PAPER1.matrix(0.0)
    about = {"latitude": LATITUDE, "c": start, "v": V0, "filt": filt}
    naive = closed_loop(SINCOS, measured(PAPER, LATITUDE, SAMPLES), 1 / RATE, PAPER, **about)
    nav = navigation(start, V0, LATITUDE)
    state, attitude, covariance = runner("kalman_sincos")(
        filter_params(filt), site(PAPER, LATITUDE), nav, measured(PAPER, LATITUDE, SAMPLES)
    )
    close = {"rtol": 0, "atol": 1e-9}
    np.testing.assert_allclose(of_quaternion(np.stack(state.nav.q, axis=1)), naive.c, **close)
    v = np.stack([state.nav.ve, state.nav.vn], axis=1)
    np.testing.assert_allclose(v, naive.v[:, :2], **close)
    np.testing.assert_allclose(np.stack(state.belief.x, axis=1), naive.x, **close)
    np.testing.assert_allclose(dense(state.belief.p), naive.p, rtol=1e-8, atol=1e-12)
    c = of_quaternion(np.stack(attitude, axis=1))
    np.testing.assert_allclose(c, naive.corrected, rtol=0, atol=1e-8)
    assert_first_order(naive, np.array(covariance))


def assert_first_order(naive, covariance):
    """The covariance of the attitude is P taken through the attitude's own derivative."""
    for k in (680, SAMPLES - 1):
        assert covariance[-1, k] < 0.1  # the heading is known
        x, c = naive.x[k], naive.c[k]
        slope = np.zeros((3, 6))
        for j in range(2, 6):
            step = np.zeros(6)
            step[j] = 1e-6
            there, back = (SINCOS.corrected(x + d, c) for d in (step, -step))
            turn = there @ back.T
            slope[:, j] = [turn[2, 1], turn[0, 2], turn[1, 0]]
        p = slope / 2e-6 @ naive.p[k] @ slope.T / 2e-6
        upper = p[np.triu_indices(3)]
        # What is left of the tilt turns its slope; feedback leaves little.
        np.testing.assert_allclose(covariance[:, k], upper, rtol=0.02, atol=0.02 * upper.max())


def test_initial_attitude_is_kept_with_uniform_sigma_and_finite_slope():
    """With its sigma and slope: there a root or an arc tangent would have none."""
    method, filt = METHODS["kalman_sincos"](Options(1 / RATE)), filter_params(Filter(P0, Q, R))

    def corrected(nav):
        return method.attitude(method.init(filt, nav)), method.covariance(method.init(filt, nav))

    nav = navigation(exp(-PHI0), V0, LATITUDE)
    (q, covariance), tangent = jax.jvp(corrected, (nav,), (jax.tree.map(jnp.ones_like, nav),))
    np.testing.assert_allclose(q, nav.q, rtol=0, atol=1e-16)
    assert np.sqrt(covariance.uu) == pytest.approx(180 * DEG / 3**0.5, rel=1e-12)
    np.testing.assert_array_equal(tangent[1].uu, 0.0)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tangent))


def test_reset_keeps_sine_and_cosine_states():
    filt = filter_params(Filter(P0, Q, R, every=100, resets=(800,)))
    nav = navigation(exp(-PHI0) @ PAPER1.matrix(0.0), V0, LATITUDE)
    state, attitude, _ = runner("kalman_sincos")(
        filt, site(PAPER, LATITUDE), nav, measured(PAPER, LATITUDE, SAMPLES)
    )
    x = np.array(state.belief.x)
    np.testing.assert_array_equal(x[:4, 799], 0.0)
    assert abs(x[4, 799]) > 0.1
    assert np.abs(x[4:, 799] - x[4:, 798]).max() < 1e-2
    np.testing.assert_array_equal(dense(state.belief.p)[799], np.diag(filt.p0))


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


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_covariance_does_not_depend_on_attitude_or_velocity():
    """Whatever the attitude and velocity, to the bit."""
    filt, here = filter_params(Filter(P0, Q, R, every=100)), site(PAPER, LATITUDE)
    run = runner("kalman_sincos")
    one = run(
        filt,
        here,
        navigation(PAPER1.matrix(0.0), [0.0, 0.0], LATITUDE),
        measured(PAPER, LATITUDE, SAMPLES),
    )[0]
    other = run(
        filt, here, navigation(exp(-PHI0), V0, LATITUDE), measured(PAPER, LATITUDE, SAMPLES)
    )[0]
    np.testing.assert_array_equal(one.belief.p, other.belief.p)
