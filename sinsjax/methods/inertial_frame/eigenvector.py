"""The eigenvector of the largest eigenvalue of Davenport's matrix, in scalars.

Where all vectors are close to one another, as gravity's directions within a minute are, the two
largest eigenvalues differ by 1e-8 of their size: power iteration does not get anywhere, and the
roots of the characteristic polynomial lose half their digits. The two smaller ones are far away,
so that the plane of the two larger is found in two inverse iterations; within it the matrix is
2 x 2.
"""

import jax.numpy as jnp

from sinsjax.maths.algebra import Triangle, triangle_index
from sinsjax.types import Quat, Scalar

_STARTS = ((1.0, 2.0, -3.0, 5.0), (-2.0, 3.0, 5.0, 1.0))
_AT = triangle_index(4)
_ABOVE = 1 + 1e-12
"""Keeps the shift above the largest eigenvalue where that is the bound itself."""

Vector = tuple[Scalar, ...]


def of_largest(k: Triangle, bound: Scalar) -> Quat:
    """Unit eigenvector of a symmetric 4 x 4 matrix whose two largest eigenvalues may be close.

    Args:
        k: upper triangle.
        bound: no less than the largest eigenvalue, and close to it; > 0, or all is zero.
    """
    inverse = 1 / jnp.where(bound > 0, bound, 1.0)
    k = tuple(entry * inverse for entry in k)
    shifted = tuple(_ABOVE - k[_AT[i, j]] if i == j else -k[_AT[i, j]] for i, j in _upper())
    factors = _factors(shifted)
    one, other = ([jnp.full_like(bound, v) for v in start] for start in _STARTS)
    for _ in range(2):
        one = _unit(_solve(factors, one))
        # Twice: the first leaves what rounding does to a vector that is nearly parallel.
        other = _across(one, _across(one, _solve(factors, other)))
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


def _upper() -> list[tuple[int, int]]:
    return [(i, j) for i in range(4) for j in range(i, 4)]


def _dot(a: list[Scalar], b: list[Scalar]) -> Scalar:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _unit(v: list[Scalar]) -> list[Scalar]:
    inverse = 1 / jnp.sqrt(_dot(v, v))
    return [inverse * x for x in v]


def _across(one: list[Scalar], other: list[Scalar]) -> list[Scalar]:
    """The unit vector of what of ``other`` is at right angles to the unit vector ``one``."""
    along = _dot(one, other)
    return _unit([b - along * a for a, b in zip(one, other, strict=True)])


def _times(k: Triangle, v: list[Scalar]) -> list[Scalar]:
    return [sum(k[_AT[i, j]] * v[j] for j in range(4)) for i in range(4)]


def _factors(m: Triangle) -> tuple[dict[tuple[int, int], Scalar], list[Scalar]]:
    """L (unit, below the diagonal) and 1/D of M = L D L', M positive definite."""
    below: dict[tuple[int, int], Scalar] = {}
    d: list[Scalar] = []
    for j in range(4):
        d.append(m[_AT[j, j]] - sum(below[j, k] ** 2 * d[k] for k in range(j)))
        for i in range(j + 1, 4):
            off = m[_AT[j, i]] - sum(below[i, k] * below[j, k] * d[k] for k in range(j))
            below[i, j] = off / d[j]
    return below, [1 / one for one in d]


def _solve(
    factors: tuple[dict[tuple[int, int], Scalar], list[Scalar]], b: list[Scalar]
) -> list[Scalar]:
    below, inverse = factors
    x = list(b)
    for i in range(4):
        for k in range(i):
            x[i] = x[i] - below[i, k] * x[k]
    x = [one * by for one, by in zip(x, inverse, strict=True)]
    for i in reversed(range(4)):
        for k in range(i + 1, 4):
            x[i] = x[i] - below[k, i] * x[k]
    return x
