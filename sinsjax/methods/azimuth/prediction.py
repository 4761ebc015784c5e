"""How belief in the errors of `model` is taken over a sample: linearised, or by sigma points."""

import jax.numpy as jnp

from sinsjax.maths.algebra import Triangle, congruence, triangle_index
from sinsjax.methods.azimuth.model import Errors, after, derivative
from sinsjax.methods.kalman import Belief
from sinsjax.strapdown.earth import Place
from sinsjax.types import Scalar

BETA = 2.0
"""Weight of the spread of the mean, for a normal distribution (Wan and van der Merwe 2000)."""


def linearised(belief: Belief, place: Place, dt: Scalar, alpha: Scalar) -> Belief:
    """The extended Kalman filter: the mean by the model, P by its derivative at the mean."""
    x, p = belief
    return Belief(after(x, place, dt), congruence(derivative(x, place, dt), p, len(x)))


def unscented(belief: Belief, place: Place, dt: Scalar, alpha: Scalar) -> Belief:
    """The scaled unscented transform (Julier 2002): the model at 2 n + 1 sigma points.

    Sums are of differences from the point in the middle, whose large weight then drops out:
    with d_i from it and s = sum d_i / (2 h^2), h = alpha sqrt(n), the mean is off by s, and
    P = sum d_i d_i' / (2 h^2) + (beta - alpha^2) s s'.
    """
    x, p = belief
    n = len(x)
    h = alpha * n**0.5
    weight = 1 / (2 * h * h)
    middle = after(x, place, dt)
    differences: list[Errors] = []
    for column in _root(p, n):
        for side in (1.0, -1.0):
            point = tuple(a + side * h * b for a, b in zip(x, column, strict=True))
            moved = after(point, place, dt)
            differences.append(tuple(a - b for a, b in zip(moved, middle, strict=True)))
    shift = [weight * sum(d[i] for d in differences) for i in range(n)]
    spread = tuple(
        weight * sum(d[i] * d[j] for d in differences) + (BETA - alpha**2) * shift[i] * shift[j]
        for i in range(n)
        for j in range(i, n)
    )
    return Belief(tuple(a + b for a, b in zip(middle, shift, strict=True)), spread)


def _root(p: Triangle, n: int) -> list[Errors]:
    """Columns of the lower triangular L with P = L L'."""
    at, zero = triangle_index(n), jnp.zeros_like(p[0])
    rows: list[list[Scalar]] = [[zero] * n for _ in range(n)]
    for j in range(n):
        left = p[at[j, j]] - sum(rows[j][k] ** 2 for k in range(j))
        # Rounding may leave nothing of a variance, or less.
        rows[j][j] = jnp.sqrt(jnp.maximum(left, jnp.finfo(zero.dtype).tiny))
        for i in range(j + 1, n):
            off = p[at[i, j]] - sum(rows[i][k] * rows[j][k] for k in range(j))
            rows[i][j] = off / rows[j][j]
    return [tuple(rows[i][j] for i in range(n)) for j in range(n)]
