"""Least squares of integrated specific forces: sums over samples, and the rotation they give.

C_{b0}^{n0} rotates the velocities alpha, the integral of C_b^{b0} f, closest to beta, the integral
of gravity's reaction, of a base that starts at rest. On one that surges every alpha is off by the
velocity v(0) of the first sample, which costs more than all that follows. The fit of positions uses
a and b, sums of alpha and beta:

    C a_n - b_n = (s_n - s_0)/dt - n v(0) + noise.

On a base that stays near its place s this is bounded except for n v(0). To allow any v(0), the
part of a and b that is linear in n is removed from them.

All vectors within a minute, such as the directions of gravity, are close to one another, and the
two largest eigenvalues of Davenport's matrix differ by 1e-8 of their size: power iteration does not
converge, and the roots of the characteristic polynomial lose half their digits. The two smaller
ones are far away, so two inverse iterations find the plane of the two larger eigenvectors, in which
the matrix is 2 x 2.
"""

from collections.abc import Callable
from operator import mul
from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.maths.algebra import Triangle, add, cross, dot, scale, triangle_index
from sinsjax.strapdown.earth import Place
from sinsjax.types import Quat, Scalar, Vec3


def earth_rate(place: Place) -> Vec3:
    """Return w_ie in n, rad/s."""
    return Vec3(jnp.zeros_like(place.rate_n), place.rate_n, place.rate_u)


class Fit(NamedTuple):
    """C_{b0}^{n0} from sums over samples."""

    start: Any  # sums before the first sample, of zeros
    add_sample: Callable[[Any, Vec3, Place, Scalar, float], Any]
    """(sums, velocity increment in b0, m/s, place, n, dt, s) -> sums with the n-th sample."""
    solve: Callable[[Any, Scalar], Quat]
    """(sums, samples so far) -> C_{b0}^{n0}."""


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


class PairSums(NamedTuple):
    """Sums over pairs of vectors, y in b0 and x in n0, of which C_{b0}^{n0} rotates y to x."""

    products: tuple[Vec3, ...]  # rows of the sum of x y'
    weight: Scalar  # half the sum of |x|^2 + |y|^2, an upper bound of the largest eigenvalue


def _add_pair(sums: PairSums, x: Vec3, y: Vec3, divisor: Scalar = 1.0) -> PairSums:
    """Return the sums with a pair of weight 1/divisor."""
    rows = zip(sums.products, scale(1 / divisor, x), strict=True)
    weight = sums.weight + 0.5 * (dot(y, y) + dot(x, x)) / divisor
    return PairSums(tuple(add(row, scale(entry, y)) for row, entry in rows), weight)


class VelocitySums(NamedTuple):
    """Velocity alpha up to the last sample, m/s, and sums over pairs of beta and alpha."""

    velocity: Vec3
    pairs: PairSums


def _add_velocity(
    sums: VelocitySums, force: Vec3, place: Place, n: Scalar, dt: float
) -> VelocitySums:
    alpha, beta = add(sums.velocity, force), reaction_velocity(place, n * dt)
    return VelocitySums(alpha, _add_pair(sums.pairs, beta, alpha))


class PositionSums(NamedTuple):
    """Sums of the velocities up to the last sample, m/s, and over pairs of b and a."""

    velocity: Vec3  # alpha
    measured: Vec3  # a
    expected: Vec3  # b
    measured_trend: Vec3  # sum of n a
    expected_trend: Vec3  # sum of n b
    pairs: PairSums


def _add_position(
    sums: PositionSums, force: Vec3, place: Place, n: Scalar, dt: float
) -> PositionSums:
    alpha = add(sums.velocity, force)
    a, b = add(sums.measured, alpha), add(sums.expected, reaction_velocity(place, n * dt))
    a_trend, b_trend = add(sums.measured_trend, scale(n, a)), add(sums.expected_trend, scale(n, b))
    return PositionSums(alpha, a, b, a_trend, b_trend, _add_pair(sums.pairs, b, a))


def _fit_positions(sums: PositionSums, count: Scalar) -> Quat:
    """Return C_{b0}^{n0} from a and b without their linear trends, as a pair that is taken away."""
    squares = jnp.maximum(count * (count + 1) * (2 * count + 1) / 6, 1.0)
    a, b = sums.measured_trend, sums.expected_trend
    return _solve_wahba(_add_pair(sums.pairs, b, a, -squares))


ZERO = Vec3(0.0, 0.0, 0.0)
_NO_PAIRS = PairSums((ZERO, ZERO, ZERO), 0.0)
VELOCITY_FIT = Fit(
    VelocitySums(ZERO, _NO_PAIRS), _add_velocity, lambda sums, count: _solve_wahba(sums.pairs)
)
POSITION_FIT = Fit(PositionSums(*(ZERO,) * 5, _NO_PAIRS), _add_position, _fit_positions)


def _solve_wahba(sums: PairSums) -> Quat:
    """Return C_{b0}^{n0} by Davenport: the dominant eigenvector of K of B = sum of x y'."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = sums.products
    first = xx + yy + zz, zy - yz, xz - zx, yx - xy
    second, third = (xx - yy - zz, xy + yx, xz + zx), (yy - xx - zz, yz + zy)
    return dominant_eigenvector((*first, *second, *third, zz - xx - yy), sums.weight)


_STARTS = ((1.0, 2.0, -3.0, 5.0), (-2.0, 3.0, 5.0, 1.0))
_AT = triangle_index(4)
_ABOVE = 1 + 1e-12
"""Keeps the shift above the largest eigenvalue if that equals the bound."""

_Vector = list[Scalar]  # four scalars, which are contiguous over runs


def dominant_eigenvector(k: Triangle, bound: Scalar) -> Quat:
    """Return the unit eigenvector of a symmetric 4 x 4 matrix's largest eigenvalue.

    The ``bound``, a close upper one of that eigenvalue, is > 0, or all entries are zero. The two
    largest eigenvalues may be close.
    """
    inverse = 1 / jnp.where(bound > 0, bound, 1.0)
    k = tuple(entry * inverse for entry in k)
    diagonal = [_AT[i, i] for i in range(4)]
    solve = _ldl_solver([_ABOVE - a if at in diagonal else -a for at, a in enumerate(k)])
    one, other = ([jnp.full_like(bound, v) for v in start] for start in _STARTS)
    for _ in range(2):
        one = _unit(solve(one))
        # Twice, since the vectors are nearly parallel and the first leaves rounding errors.
        other = _orthogonal_unit(one, _orthogonal_unit(one, solve(other)))
    by_one, by_other = (
        [sum(k[_AT[i, j]] * v[j] for j in range(4)) for i in range(4)] for v in (one, other)
    )
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
    return Quat(*_unit([first * x + second * y for x, y in zip(one, other, strict=True)]))


def _dot(a: _Vector, b: _Vector) -> Scalar:
    return sum(map(mul, a, b))


def _unit(v: _Vector) -> _Vector:
    inverse = 1 / jnp.sqrt(_dot(v, v))
    return [inverse * x for x in v]


def _orthogonal_unit(one: _Vector, other: _Vector) -> _Vector:
    """Return the unit vector of the part of ``other`` orthogonal to the unit vector ``one``."""
    along = _dot(one, other)
    return _unit([b - along * a for a, b in zip(one, other, strict=True)])


def _ldl_solver(m: _Vector) -> Callable[[_Vector], _Vector]:
    """Return b -> x of M x = b for a positive definite M = L D L', L with a unit diagonal."""
    below, d = dict[tuple[int, int], Scalar](), _Vector()
    for j in range(4):
        d.append(m[_AT[j, j]] - sum(below[j, k] ** 2 * d[k] for k in range(j)))
        for i in range(j + 1, 4):
            off = m[_AT[j, i]] - sum(below[i, k] * below[j, k] * d[k] for k in range(j))
            below[i, j] = off / d[j]
    inverse_d = [1 / one for one in d]

    def solve(b: _Vector) -> _Vector:
        x = list(b)
        for (i, k), entry in below.items():
            x[i] = x[i] - entry * x[k]
        x = [*map(mul, x, inverse_d)]
        for i in reversed(range(4)):
            for k in range(i + 1, 4):
                x[i] = x[i] - below[k, i] * x[k]
        return x

    return solve
