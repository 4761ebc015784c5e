"""Earth models: rotation rate, radii of curvature and gravity at a latitude."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.types import Scalar

WGS84_RATE = 7.292115e-5
"""Earth rate, rad/s (NIMA TR8350.2)."""
_A, _E2 = 6378137.0, 6.69437999014e-3
_GE, _K, _M, _F = 9.7803253359, 1.931852652458e-3, 3.449786506841e-3, 1 / 298.257223563


class Earth(NamedTuple):
    """Parameters of an Earth model; sphere and ellipsoid run the same code.

    The ellipsoid with ``eccentricity2`` = 0 and ``gravity_formula`` = 0 is the papers' sphere.

    Attributes:
        rate: rotation rate, rad/s.
        radius: equatorial radius, m.
        eccentricity2: first eccentricity squared.
        gravity: gravity at the equator, or everywhere on the sphere, m/s^2.
        gravity_formula: 1 for Somigliana's formula with height, 0 for constant gravity.
        height: above the ellipsoid, m.
    """

    rate: Scalar
    radius: Scalar
    eccentricity2: Scalar
    gravity: Scalar
    gravity_formula: Scalar
    height: Scalar


class Place(NamedTuple):
    """Earth rate, curvatures and gravity at one latitude, for mechanisation and error model.

    Attributes:
        rate_n: north component of the Earth rate, rad/s.
        rate_u: up component of the Earth rate, rad/s.
        tan_latitude: tangent of the latitude.
        curvature_n: 1/(R_M + h), 1/m: north velocity turns the frame about east.
        curvature_e: 1/(R_N + h), 1/m: east velocity turns the frame about north.
        gravity: m/s^2.
    """

    rate_n: Scalar
    rate_u: Scalar
    tan_latitude: Scalar
    curvature_n: Scalar
    curvature_e: Scalar
    gravity: Scalar


def wgs84(height: Scalar = 0.0) -> Earth:
    """WGS-84 ellipsoid and normal gravity at a height (m)."""
    return Earth(WGS84_RATE, _A, _E2, _GE, 1.0, height)


def sphere(rate: Scalar, radius: Scalar, gravity: Scalar, height: Scalar = 0.0) -> Earth:
    """The papers' Earth: constant gravity (m/s^2), a single radius (m), a given rate (rad/s)."""
    return Earth(rate, radius, 0.0, gravity, 0.0, height)


def place(earth: Earth, latitude: Scalar) -> Place:
    """Rates, curvatures and gravity at a latitude (rad).

    Normal gravity is Somigliana's closed formula with the second-order height correction
    (NIMA TR8350.2, eqs 4-1 and 4-3). Plain numbers are evaluated with NumPy, compiling nothing.
    """
    xp = jnp if any(isinstance(number, jax.Array) for number in (latitude, *earth)) else np
    sin, cos = xp.sin(latitude), xp.cos(latitude)
    w2 = 1 - earth.eccentricity2 * sin * sin
    radius_n = earth.radius / xp.sqrt(w2)
    radius_m = radius_n * (1 - earth.eccentricity2) / w2
    h = earth.height / earth.radius
    normal = earth.gravity * (1 + _K * sin * sin) / xp.sqrt(w2)
    normal = normal * (1 - 2 * (1 + _F + _M - 2 * _F * sin * sin) * h + 3 * h * h)
    gravity = xp.where(earth.gravity_formula > 0, normal, earth.gravity)
    return Place(
        rate_n=earth.rate * cos,
        rate_u=earth.rate * sin,
        tan_latitude=sin / cos,
        curvature_n=1 / (radius_m + earth.height),
        curvature_e=1 / (radius_n + earth.height),
        gravity=gravity,
    )


def reverse_rotation(place: Place, sign: Scalar) -> Place:
    """Earth in reversed time where ``sign`` is -1: it rotates the other way, [P2] eq. (12)."""
    return place._replace(rate_n=sign * place.rate_n, rate_u=sign * place.rate_u)
