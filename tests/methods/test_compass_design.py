import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sinsjax.methods import compass_design as loops
from sinsjax.methods.compass_design import PAPER_DAMPING, AzimuthGains, LevelGains

EARTH = {"gravity": 9.8, "radius": 6378165.0}
RATE_N = 7.292115e-5 * math.cos(math.radians(32.057313))
LEVEL = loops.level_gains(0.02, PAPER_DAMPING, **EARTH)
AZIMUTH = loops.azimuth_gains(0.01, PAPER_DAMPING, **EARTH)


sigmas = st.floats(1e-3, 1.0)
dampings = st.floats(0.1, 1.0)


def designed_roots(sigma, damping):
    wd = sigma * math.sqrt(1 / damping**2 - 1)
    return np.array([-sigma + 1j * wd, -sigma - 1j * wd])


@given(sigmas, dampings)
def test_level_gains_place_the_designed_roots(sigma, damping):
    gains = loops.level_gains(sigma, damping, **EARTH)
    expected = np.poly([-sigma, *designed_roots(sigma, damping)])
    np.testing.assert_allclose(loops.level_polynomial(gains, **EARTH), expected, rtol=1e-12)


@given(sigmas, dampings)
def test_azimuth_gains_place_the_designed_double_roots(sigma, damping):
    gains = loops.azimuth_gains(sigma, damping, **EARTH)
    expected = np.poly([*designed_roots(sigma, damping)] * 2)
    np.testing.assert_allclose(loops.azimuth_polynomial(gains, **EARTH), expected, rtol=1e-12)
    assert gains.k1 == gains.k4


@given(st.lists(st.floats(-2, 2), min_size=1, max_size=3), st.floats(0.1, 2), st.floats(0.1, 2))
def test_roots_are_sorted_and_rebuild_the_polynomial(real, imaginary, lead):
    polynomial = lead * np.poly([*real, -0.5 + 1j * imaginary, -0.5 - 1j * imaginary]).real
    found = loops.roots(polynomial)
    assert np.all(np.diff(found.real) <= 0)
    np.testing.assert_allclose(lead * np.poly(found), polynomial, atol=1e-10)


@given(sigmas, dampings, st.floats(0.1, 10))
def test_at_pace_scales_sigma(sigma, damping, pace):
    gains = loops.scale_azimuth_gains(loops.azimuth_gains(sigma, damping, **EARTH), pace)
    expected = loops.azimuth_gains(pace * sigma, damping, **EARTH)
    np.testing.assert_allclose(gains, expected, rtol=1e-11)


@given(st.floats(10, 1000), st.floats(0.05, 0.95))
def test_adjustment_time_is_one_damped_period(time, damping):
    sigma = loops.sigma_from_period(time, damping)
    wd = designed_roots(sigma, damping)[0].imag
    assert wd * time == pytest.approx(2 * math.pi)


gains3 = st.builds(LevelGains, st.floats(0, 1), st.floats(0, 1e4), st.floats(1e-8, 1e-2))
gains4 = st.builds(
    AzimuthGains,
    st.floats(0.01, 1),
    st.floats(0, 1e4),
    st.floats(1e-10, 1e-3),
    st.floats(0.01, 1),
)


@given(gains3, st.complex_numbers(min_magnitude=0.05, max_magnitude=2), st.integers(0, 99))
def test_levelling_response_matches_paper_closed_form(gains, s, seed):
    """[P2] eq. (1) against the resolvent of the state space."""
    g, r = EARTH.values()
    k1, k2, k3 = gains
    nabla, drift, dv0, phi0 = np.random.default_rng(seed).normal(size=4)
    matrix = loops.level_matrix(gains, **EARTH)
    delta = np.polyval(loops.level_polynomial(gains, **EARTH), s)
    size = np.polyval(loops.level_polynomial(gains, **EARTH), abs(s))
    dv, phi, _ = np.linalg.solve(s * np.eye(3) - matrix, [nabla + dv0, phi0 - drift, 0])
    stiffness = (1 + k2) / r * s + k3
    phi_form = -stiffness * (nabla + dv0) + (s**2 + k1 * s) * (phi0 - drift)
    dv_form = s**2 * (nabla + dv0) + g * s * (phi0 - drift)
    assert abs(phi * delta - phi_form) < 1e-9 * size * (1 + abs(phi))
    assert abs(dv * delta - dv_form) < 1e-9 * size * (1 + abs(dv))


@given(gains4, st.complex_numbers(min_magnitude=0.05, max_magnitude=2), st.integers(0, 99))
def test_azimuth_response_matches_paper_closed_form(gains, s, seed):
    """[P2] eq. (2) against the resolvent of the state space."""
    g, r = EARTH.values()
    k1, k2, k3, k4 = gains
    draw = np.random.default_rng(seed).normal(size=6)
    nabla, eps_e, eps_u, dv0, phi_e0, phi_u0 = draw * [1e-3, 1e-6, 1e-6, 0.1, 1e-3, 0.1]
    matrix = loops.azimuth_matrix(gains, **EARTH, rate_n=RATE_N)
    source = [nabla + dv0, phi_e0 - eps_e, phi_u0 - eps_u, 0]
    dv, phi_e, phi_u, _ = np.linalg.solve(s * np.eye(4) - matrix, source)
    q2 = s**2 + k1 * s + (1 + k2) * g / r
    delta = s * (s + k4) * q2 + g * k3
    size = np.polyval(loops.azimuth_polynomial(gains, **EARTH), abs(s))
    force = g * (phi_e0 - eps_e) + s * (nabla + dv0)
    phi_u_form = (s + k4) * q2 * (phi_u0 - eps_u) + k3 / RATE_N * force
    assert abs(phi_u * delta - phi_u_form) < 1e-9 * size * (1 + abs(phi_u))
    assert abs(q2 * dv - (force - g * RATE_N * phi_u)) < 1e-9 * (abs(force) + abs(q2 * dv) + 1)
    assert abs(g * phi_e - ((s + k1) * dv - nabla - dv0)) < 1e-9 * (abs(g * phi_e) + abs(dv) + 1)


def test_stability_check_is_batched_and_exact_for_short_samples():
    matrix = loops.azimuth_matrix(AZIMUTH, **EARTH, rate_n=RATE_N)
    got = loops.is_stable(matrix, np.array([1e-9, 0.005, 1.0, 1000.0]))
    assert got.tolist() == [True, True, True, False]
    level = loops.level_gains(np.array([0.02, 20.0, 2000.0]), PAPER_DAMPING, **EARTH)
    assert loops.is_stable(loops.level_matrix(level, **EARTH), 0.01).tolist() == [True, True, False]
    assert loops.is_stable(loops.level_matrix(LEVEL, **EARTH), 0.01).shape == ()
