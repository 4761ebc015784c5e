import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sinsjax.methods.compass import design as loops
from sinsjax.methods.compass.design import PAPER_DAMPING, AzimuthGains, LevelGains

EARTH = {"gravity": 9.8, "radius": 6378165.0}
RATE_N = 7.292115e-5 * math.cos(math.radians(32.057313))
LEVEL = loops.level_gains(0.02, PAPER_DAMPING, **EARTH)
AZIMUTH = loops.azimuth_gains(0.01, PAPER_DAMPING, **EARTH)
PRINTED_K3 = 8.1632653e-5


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


def test_paper_damping_reproduces_paper_gain_formulas():
    g, r = EARTH.values()
    np.testing.assert_allclose(LEVEL, (0.06, 4 * 0.02**2 * r / g - 1, 2 * 0.02**3 / g), rtol=1e-14)
    np.testing.assert_allclose(
        AZIMUTH, (0.02, 4 * 0.01**2 * r / g - 1, 4 * 0.01**4 / g, 0.02), rtol=1e-14
    )


def test_gains_match_printed_values_except_horizontal_k3():
    assert f"{LEVEL.k2:.8f}" == "1040.33306122"
    assert f"{AZIMUTH.k2:.7f}" == "259.3332653"
    assert f"{AZIMUTH.k3:.3e}" == "4.082e-09"
    assert PRINTED_K3 / LEVEL.k3 == pytest.approx(50, rel=1e-8)


def test_printed_horizontal_k3_is_unstable():
    polynomial = loops.level_polynomial(LEVEL._replace(k3=PRINTED_K3), **EARTH)
    _, a, b, c = polynomial
    assert a * b == pytest.approx(9.6e-5)
    assert a * b < c == pytest.approx(8e-4)  # Routh
    np.testing.assert_allclose(
        loops.roots(polynomial), [0.0254 + 0.0811j, 0.0254 - 0.0811j, -0.1108], atol=5e-5
    )
    unstable = loops.level_matrix(LEVEL._replace(k3=PRINTED_K3), **EARTH)
    assert not loops.is_stable(unstable, 1e-3)


@given(st.lists(st.floats(-2, 2), min_size=1, max_size=3), st.floats(0.1, 2), st.floats(0.1, 2))
def test_roots_are_sorted_and_rebuild_the_polynomial(real, imaginary, lead):
    polynomial = lead * np.poly([*real, -0.5 + 1j * imaginary, -0.5 - 1j * imaginary]).real
    found = loops.roots(polynomial)
    assert np.all(np.diff(found.real) <= 0)
    np.testing.assert_allclose(lead * np.poly(found), polynomial, atol=1e-10)


def test_roots_accept_batched_polynomials():
    sigma = np.array([[0.01, 0.02, 0.05], [0.1, 0.2, 0.3]])
    gains = loops.level_gains(sigma, 0.6, **EARTH)
    polynomials = loops.level_polynomial(gains, **EARTH)
    assert polynomials.shape == (2, 3, 4)
    found = loops.roots(polynomials)
    assert found.shape == (2, 3, 3)
    np.testing.assert_allclose(found[1, 2], loops.roots(polynomials[1, 2]), rtol=1e-12)


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


def test_paper_adjustment_times_give_expected_sigma():
    assert loops.sigma_from_period(150, PAPER_DAMPING) == pytest.approx(0.041888, abs=5e-7)
    assert loops.sigma_from_period(450, PAPER_DAMPING) == pytest.approx(0.013963, abs=5e-7)
    assert loops.sigma_from_settling(150, math.exp(-3)) == pytest.approx(0.02)
    assert loops.sigma_from_settling(450, math.exp(-4.5)) == pytest.approx(0.01)
    assert math.exp(-150 * loops.sigma_from_settling(150, 0.05)) == pytest.approx(0.05)


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


def test_steady_states_match_closed_forms():
    g, r = EARTH.values()
    nabla, eps_e, eps_u = 50e-6 * g, 0.02 * math.pi / 648e3, 0.02 * math.pi / 648e3
    level = np.linalg.solve(-loops.level_matrix(LEVEL, **EARTH), [nabla, -eps_e, 0])
    np.testing.assert_allclose(level, [0, -nabla / g, -eps_e], rtol=1e-12, atol=1e-15)
    matrix = loops.azimuth_matrix(AZIMUTH, **EARTH, rate_n=RATE_N)
    dv, phi_e, phi_u, rate = np.linalg.solve(-matrix, [nabla, -eps_e, -eps_u, 0])
    k1, k2, k3, k4 = AZIMUTH
    assert rate == pytest.approx(eps_u)
    assert dv == pytest.approx(k4 * RATE_N * eps_u / k3)
    assert phi_e == pytest.approx((k1 * dv - nabla) / g)
    assert phi_u == pytest.approx(-eps_e / RATE_N - (1 + k2) * k4 * eps_u / (r * k3))
    assert phi_u == pytest.approx(-eps_e / RATE_N - 2 * eps_u / 0.01)


def test_stability_check_is_batched_and_exact_for_short_samples():
    matrix = loops.azimuth_matrix(AZIMUTH, **EARTH, rate_n=RATE_N)
    got = loops.is_stable(matrix, np.array([1e-9, 0.005, 1.0, 1000.0]))
    assert got.tolist() == [True, True, True, False]
    level = loops.level_gains(np.array([0.02, 20.0, 2000.0]), PAPER_DAMPING, **EARTH)
    assert loops.is_stable(loops.level_matrix(level, **EARTH), 0.01).tolist() == [True, True, False]
    assert loops.is_stable(loops.level_matrix(LEVEL, **EARTH), 0.01).shape == ()
