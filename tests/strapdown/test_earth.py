import jax
import jax.numpy as jnp
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


@given(latitudes, st.sampled_from(["wgs84", "sphere"]))
def test_earth_rate_points_north_and_up_and_the_sphere_is_uniform(latitude_deg, model):
    rate = 7.292115e-5
    planet = earth.wgs84() if model == "wgs84" else earth.sphere(rate, 6378165.0, 9.8, 1000.0)
    place = earth.place(planet, latitude_deg * DEG)
    np.testing.assert_allclose(place.rate_n, rate * np.cos(latitude_deg * DEG), rtol=1e-14)
    np.testing.assert_allclose(place.rate_u, rate * np.sin(latitude_deg * DEG), rtol=1e-14)
    np.testing.assert_allclose(place.rate_u / place.rate_n, place.tan_latitude, rtol=1e-13)
    assert place.rate_n > 0 and np.sign(place.rate_u) == np.sign(latitude_deg)
    if model == "sphere":
        np.testing.assert_allclose(place.gravity, 9.8, rtol=0)
        radii = 1 / place.curvature_n, 1 / place.curvature_e
        np.testing.assert_allclose(radii, 6379165.0, rtol=1e-14)


@given(latitudes, st.floats(-400.0, 20000.0))
def test_gravity_with_height_matches_exact_ellipsoid_potential(latitude_deg, height):
    """Against gravity of the level ellipsoid by its exact potential (spheroidal coordinates)."""
    latitude = latitude_deg * DEG
    exact = ellipsoid_gravity(latitude, height)
    place = earth.place(earth.wgs84(height), latitude)
    # The series in height leaves out f^2 and (h/a)^3: 1.1e-10 m/s^2 a metre at the equator.
    tolerance = 1e-11 + 1.2e-10 * abs(height)
    np.testing.assert_allclose(place.gravity, exact, rtol=0, atol=tolerance)
    radii = 1 / place.curvature_n, 1 / place.curvature_e
    np.testing.assert_allclose(radii, np.add(WGS84.radii(latitude), height), rtol=1e-11)


@jax.jit
def ellipsoid_gravity(latitude, height):
    """Size of the gradient of the normal potential, GM = 3986004.418e8 (TR8350.2 eqs 4-5 ff)."""
    gm, rate, a, b = 3986004.418e8, 7.292115e-5, WGS84.a, WGS84.b
    focus = np.sqrt(a * a - b * b)

    def q(u):
        return ((1 + 3 * (u / focus) ** 2) * jnp.arctan(focus / u) - 3 * u / focus) / 2

    def potential(x, z):
        away = x * x + z * z - focus**2
        u = jnp.sqrt(away / 2 * (1 + jnp.sqrt(1 + 4 * (focus * z / away) ** 2)))
        shape = q(u) / q(b) * ((z / u) ** 2 - 1 / 3)
        return gm / focus * jnp.arctan(focus / u) + rate**2 / 2 * (a * a * shape + x * x)

    rn = a * a / jnp.hypot(a * jnp.cos(latitude), b * jnp.sin(latitude))
    x = (rn + height) * jnp.cos(latitude)
    z = (rn * (b / a) ** 2 + height) * jnp.sin(latitude)
    return jnp.hypot(*jax.grad(potential, (0, 1))(x, z))
