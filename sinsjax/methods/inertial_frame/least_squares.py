"""Least squares of integrated specific forces: sums over samples, and the rotation they give.

C_{b0}^{n0} rotates the velocities alpha, the integral of C_b^{b0} f, closest to beta, the integral
of gravity's reaction: Davenport's matrix of the sum of beta alpha'. This assumes a base that starts
at rest. On one that surges every alpha is off by the velocity v(0) of the first sample, which costs
more than all that follows. The fit of positions uses a and b, sums of alpha and beta:

    C a_n - b_n = (s_n - s_0)/dt - n v(0) + noise.

On a base that stays near its place s this is bounded except for n v(0). To allow any v(0), the
part of a and b that is linear in n is removed from them.

All vectors within a minute, such as the directions of gravity, are close to one another, and the
two largest eigenvalues of Davenport's matrix differ by 1e-8 of their size: power iteration does not
converge, and the roots of the characteristic polynomial lose half their digits. The two smaller
ones are far away, so two inverse iterations find the plane of the two larger eigenvectors, in which
the matrix is 2 x 2.
"""

from typing import NamedTuple

import jax.numpy as jnp

from sinsjax.maths.algebra import Triangle, add, cross, dot, scale, triangle_index
from sinsjax.strapdown.earth import Place
from sinsjax.types import Quat, Scalar, Vec3

Profile = tuple[Vec3, Vec3, Vec3]
"""Rows of a sum of products x y'."""


def earth_rate(place: Place) -> Vec3:
    """w_ie in n, rad/s."""
    return Vec3(jnp.zeros_like(place.rate_n), place.rate_n, place.rate_u)


class VelocitySums(NamedTuple):
    """Sums of the integrated specific forces alpha in b0 and beta in n0, m/s.

    Attributes:
        velocity: alpha up to the last sample.
        profile: rows of the sum of beta alpha'.
        weight: half the sum of |alpha|^2 + |beta|^2, an upper bound of the largest eigenvalue.
    """

    velocity: Vec3
    profile: Profile
    weight: Scalar


def no_velocities(zero: Scalar) -> VelocitySums:
    """Return the sums before the first sample."""
    none = Vec3(zero, zero, zero)
    return VelocitySums(none, (none, none, none), zero)


def add_velocity(
    sums: VelocitySums, force: Vec3, place: Place, n: Scalar, dt: Scalar
) -> VelocitySums:
    """Add the n-th sample: its velocity increment in b0, m/s, with the sample time dt, s."""
    alpha, beta = add(sums.velocity, force), reaction_velocity(place, n * dt)
    return VelocitySums(
        alpha,
        _add_product(sums.profile, beta, alpha),
        sums.weight + 0.5 * (dot(alpha, alpha) + dot(beta, beta)),
    )


def reaction_velocity(place: Place, t: Scalar) -> Vec3:
    """Return the integral of gravity's reaction in n0 over t (s), m/s.

    With e = w_ie / W: g [z sin(Wt)/W + (e x z)(1 - cos Wt)/W + e (e.z)(t - sin(Wt)/W)].
    """
    rate = jnp.sqrt(place.rate_n**2 + place.rate_u**2)
    e = scale(1 / rate, earth_rate(place))
    up = Vec3(jnp.zeros_like(e.z), jnp.zeros_like(e.z), jnp.ones_like(e.z))
    sine, versine = jnp.sin(rate * t) / rate, 2 * jnp.sin(rate * t / 2) ** 2 / rate
    across = add(scale(sine, up), scale(versine, cross(e, up)))
    return scale(place.gravity, add(across, scale(e.z * (t - sine), e)))


def fit_velocities(sums: VelocitySums, count: Scalar) -> Quat:
    """Return C_{b0}^{n0}; unlike `fit_positions`, it does not depend on ``count``."""
    return _solve_wahba(sums.profile, sums.weight)


class PositionSums(NamedTuple):
    """Sums of a and b, the running sums of alpha and beta, m/s.

    Attributes:
        velocity: alpha up to the last sample.
        measured: a, likewise.
        expected: b, likewise.
        measured_trend: sum of n a.
        expected_trend: sum of n b.
        profile: rows of the sum of b a'.
        weight: half the sum of |a|^2 + |b|^2.
    """

    velocity: Vec3
    measured: Vec3
    expected: Vec3
    measured_trend: Vec3
    expected_trend: Vec3
    profile: Profile
    weight: Scalar


def no_positions(zero: Scalar) -> PositionSums:
    """Return the sums before the first sample."""
    none = Vec3(zero, zero, zero)
    return PositionSums(none, none, none, none, none, (none, none, none), zero)


def add_position(
    sums: PositionSums, force: Vec3, place: Place, n: Scalar, dt: Scalar
) -> PositionSums:
    """Add the n-th sample, see `add_velocity`."""
    alpha = add(sums.velocity, force)
    a, b = add(sums.measured, alpha), add(sums.expected, reaction_velocity(place, n * dt))
    return PositionSums(
        alpha,
        a,
        b,
        add(sums.measured_trend, scale(n, a)),
        add(sums.expected_trend, scale(n, b)),
        _add_product(sums.profile, b, a),
        sums.weight + 0.5 * (dot(a, a) + dot(b, b)),
    )


def fit_positions(sums: PositionSums, count: Scalar) -> Quat:
    """Return C_{b0}^{n0} after ``count`` samples, from a and b without their linear trend."""
    squares = jnp.maximum(count * (count + 1) * (2 * count + 1) / 6, 1.0)
    a, b = sums.measured_trend, sums.expected_trend
    profile = _add_product(sums.profile, scale(-1 / squares, b), a)
    of_trend = 0.5 * (dot(a, a) + dot(b, b)) / squares
    return _solve_wahba(profile, sums.weight - of_trend)


def _add_product(profile: Profile, x: Vec3, y: Vec3) -> Profile:
    east, north, up = (add(row, scale(factor, y)) for row, factor in zip(profile, x, strict=True))
    return east, north, up


def _solve_wahba(profile: Profile, weight: Scalar) -> Quat:
    """Return C_{b0}^{n0} by Davenport: the dominant eigenvector of K of B = sum of beta alpha'."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = profile
    return dominant_eigenvector(
        (
            *(xx + yy + zz, zy - yz, xz - zx, yx - xy),
            *(xx - yy - zz, xy + yx, xz + zx),
            *(yy - xx - zz, yz + zy),
            zz - xx - yy,
        ),
        weight,
    )


_STARTS = ((1.0, 2.0, -3.0, 5.0), (-2.0, 3.0, 5.0, 1.0))
_AT = triangle_index(4)
_ABOVE = 1 + 1e-12
"""Keeps the shift above the largest eigenvalue if that equals the bound."""

Vector = tuple[Scalar, ...]


def dominant_eigenvector(k: Triangle, bound: Scalar) -> Quat:
    """Return the unit eigenvector of a symmetric 4 x 4 matrix's largest eigenvalue.

    The two largest eigenvalues may be close.

    Args:
        k: upper triangle.
        bound: close upper bound of the largest eigenvalue; > 0, or all entries are zero.
    """
    inverse = 1 / jnp.where(bound > 0, bound, 1.0)
    k = tuple(entry * inverse for entry in k)
    shifted = tuple(
        _ABOVE - k[_AT[i, j]] if i == j else -k[_AT[i, j]] for i, j in _upper_triangle()
    )
    factors = _ldl_factors(shifted)
    one, other = ([jnp.full_like(bound, v) for v in start] for start in _STARTS)
    for _ in range(2):
        one = _unit(_solve_factored(factors, one))
        # Twice, since the vectors are nearly parallel and the first leaves rounding errors.
        other = _orthogonal_unit(one, _orthogonal_unit(one, _solve_factored(factors, other)))
    by_one, by_other = _times(k, one), _times(k, other)
    a, b, c = _dot(one, by_one), _dot(one, by_other), _dot(other, by_other)
    # The larger eigenvalue's eigenvector of [[a, b], [b, c]], by half the angle of (a - c, 2b).
    half = 0.5 * (a - c)
    radius = jnp.sqrt(jnp.maximum(half * half + b * b, jnp.finfo(bound.dtype).tiny))
    cosine, sine = half / radius, b / radius
    ahead = cosine >= 0
    larger = jnp.sqrt(0.5 * (1 + jnp.abs(cosine)))
    smaller = 0.5 * jnp.abs(sine) / larger
    first = jnp.where(ahead, larger, smaller)
    second = jnp.where(sine < 0, -1.0, 1.0) * jnp.where(ahead, smaller, larger)
    vector = [first * x + second * y for x, y in zip(one, other, strict=True)]
    return Quat(*_unit(vector))


def _upper_triangle() -> list[tuple[int, int]]:
    return [(i, j) for i in range(4) for j in range(i, 4)]


def _dot(a: list[Scalar], b: list[Scalar]) -> Scalar:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _unit(v: list[Scalar]) -> list[Scalar]:
    inverse = 1 / jnp.sqrt(_dot(v, v))
    return [inverse * x for x in v]


def _orthogonal_unit(one: list[Scalar], other: list[Scalar]) -> list[Scalar]:
    """Return the unit vector of the part of ``other`` orthogonal to the unit vector ``one``."""
    along = _dot(one, other)
    return _unit([b - along * a for a, b in zip(one, other, strict=True)])


def _times(k: Triangle, v: list[Scalar]) -> list[Scalar]:
    return [sum(k[_AT[i, j]] * v[j] for j in range(4)) for i in range(4)]


def _ldl_factors(m: Triangle) -> tuple[dict[tuple[int, int], Scalar], list[Scalar]]:
    """Return L (unit, below the diagonal) and 1/D of M = L D L', M positive definite."""
    below: dict[tuple[int, int], Scalar] = {}
    d: list[Scalar] = []
    for j in range(4):
        d.append(m[_AT[j, j]] - sum(below[j, k] ** 2 * d[k] for k in range(j)))
        for i in range(j + 1, 4):
            off = m[_AT[j, i]] - sum(below[i, k] * below[j, k] * d[k] for k in range(j))
            below[i, j] = off / d[j]
    return below, [1 / one for one in d]


def _solve_factored(
    factors: tuple[dict[tuple[int, int], Scalar], list[Scalar]], b: list[Scalar]
) -> list[Scalar]:
    """Return x of L D L' x = b, given L and the inverse of D."""
    below, inverse = factors
    x = list(b)
    for i in range(4):
        for k in range(i):
            x[i] = x[i] - below[i, k] * x[k]
    x = [value * factor for value, factor in zip(x, inverse, strict=True)]
    for i in reversed(range(4)):
        for k in range(i + 1, 4):
            x[i] = x[i] - below[k, i] * x[k]
    return x
