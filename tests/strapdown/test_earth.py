import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.naive import DEG, WGS84

from sinsjax.strapdown import earth

# Far below any angle, XLA flushes products with the Earth rate to zero.
latitudes = st.floats(-89.9, 89.9).map(lambda degrees: round(degrees, 9))


@pytest.mark.parametrize(
    ("latitude_deg", "published"),
    # NIMA TR8350.2 table 3.4 (equator, pole) and WGS-84 normal gravity at 45 deg.
    [(0.0, 9.7803253359), (90.0, 9.8321849378), (-90.0, 9.8321849378), (45.0, 9.8061977694)],
)
def test_normal_gravity_matches_published_values(latitude_deg, published):
    place = earth.place(earth.wgs84(), latitude_deg * DEG)
    np.testing.assert_allclose(place.gravity, published, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("latitude_deg", "meridian", "prime_vertical"),
    # a (1 - e^2) = b^2/a and a at the equator, the polar radius a^2/b = 6399593.6258 m at the pole.
    [(0.0, 6335439.3273, 6378137.0), (90.0, 6399593.6258, 6399593.6258)],
)
def test_radii_of_curvature_match_published_values(latitude_deg, meridian, prime_vertical):
    place = earth.place(earth.wgs84(), latitude_deg * DEG)
    radii = 1 / place.curvature_n, 1 / place.curvature_e
    np.testing.assert_allclose(radii, (meridian, prime_vertical), rtol=0, atol=1e-4)


@given(latitudes)
def test_wgs84_radii_and_gravity_match_naive_formulas(latitude_deg):
    latitude = latitude_deg * DEG
    place = earth.place(earth.wgs84(), latitude)
    radii = 1 / place.curvature_n, 1 / place.curvature_e
    np.testing.assert_allclose(radii, WGS84.radii(latitude), rtol=1e-11)
    np.testing.assert_allclose(place.gravity, WGS84.g(latitude), rtol=1e-11)


@given(latitudes, st.sampled_from(["wgs84", "sphere"]))
def test_earth_rate_points_north_and_up_by_latitude(latitude_deg, model):
    rate = 7.292115e-5
    planet = earth.wgs84() if model == "wgs84" else earth.sphere(rate, 6378165.0, 9.8)
    place = earth.place(planet, latitude_deg * DEG)
    np.testing.assert_allclose(place.rate_n, rate * np.cos(latitude_deg * DEG), rtol=1e-14)
    np.testing.assert_allclose(place.rate_u, rate * np.sin(latitude_deg * DEG), rtol=1e-14)
    np.testing.assert_allclose(place.rate_u / place.rate_n, place.tan_latitude, rtol=1e-13)
    assert place.rate_n > 0
    assert np.sign(place.rate_u) == np.sign(latitude_deg)


@given(latitudes)
def test_sphere_has_constant_gravity_and_radii(latitude_deg):
    place = earth.place(earth.sphere(7e-5, 6378165.0, 9.8, 1000.0), latitude_deg * DEG)
    np.testing.assert_allclose(place.gravity, 9.8, rtol=0)
    np.testing.assert_allclose(1 / place.curvature_n, 6379165.0, rtol=1e-14)
    np.testing.assert_allclose(1 / place.curvature_e, 6379165.0, rtol=1e-14)


def test_gravity_gradient_with_height_matches_free_air_value():
    gravity = jax.grad(lambda h: earth.place(earth.wgs84(h), 45 * DEG).gravity)
    # -0.3086 mGal/m at 45 deg (free-air correction), -0.30877 at the equator.
    np.testing.assert_allclose(gravity(0.0) * 1e5, -0.3086, atol=5e-5)


@given(latitudes, st.floats(-400.0, 20000.0))
def test_gravity_with_height_matches_exact_ellipsoid_potential(latitude_deg, height):
    """Against gravity of the level ellipsoid by its exact potential (spheroidal coordinates)."""
    latitude = latitude_deg * DEG
    exact = ellipsoid_gravity(latitude, height)
    place = earth.place(earth.wgs84(height), latitude)
    # The series in height leaves out f^2 and (h/a)^3: 1.1e-10 m/s^2 a metre at the equator.
    tolerance = 1e-11 + 1.2e-10 * abs(height)
    np.testing.assert_allclose(place.gravity, exact, rtol=0, atol=tolerance)
    rm, rn = WGS84.radii(latitude)
    np.testing.assert_allclose(1 / place.curvature_n, rm + height, rtol=1e-11)
    np.testing.assert_allclose(1 / place.curvature_e, rn + height, rtol=1e-11)


def ellipsoid_gravity(latitude, height):
    """Size of the gradient of the normal potential, GM = 3986004.418e8 (TR8350.2 eqs 4-5 ff)."""
    gm, rate, a, b = 3986004.418e8, 7.292115e-5, WGS84.a, WGS84.b
    focus = np.sqrt(a * a - b * b)

    def q(u):
        return ((1 + 3 * (u / focus) ** 2) * np.arctan(focus / u) - 3 * u / focus) / 2

    def slope(u):
        return 3 * (1 + (u / focus) ** 2) * (1 - u / focus * np.arctan(focus / u)) - 1

    rn = WGS84.radii(latitude)[1]
    x = (rn + height) * np.cos(latitude)
    z = (rn * (b / a) ** 2 + height) * np.sin(latitude)
    away = x * x + z * z - focus**2
    u = np.sqrt(away / 2 * (1 + np.sqrt(1 + 4 * (focus * z / away) ** 2)))
    beta = np.arctan2(z * np.hypot(u, focus), u * x)
    w = np.sqrt((u * u + (focus * np.sin(beta)) ** 2) / (u * u + focus**2))
    root = u * u + focus**2
    along_u = (
        -(
            gm / root
            + rate**2 * a**2 * focus / root * slope(u) / q(b) * (np.sin(beta) ** 2 / 2 - 1 / 6)
        )
        + rate**2 * u * np.cos(beta) ** 2
    ) / w
    along_beta = (rate**2 * a**2 / np.sqrt(root) * q(u) / q(b) - rate**2 * np.sqrt(root)) * (
        np.sin(beta) * np.cos(beta) / w
    )
    return np.hypot(along_u, along_beta)
