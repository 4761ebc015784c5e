"""3-vectors and symmetric matrices written out in scalars.

Small arrays are slow inside a scan on a CPU, whereas the scalars of one run become contiguous
arrays over runs when mapped. So a 3-vector is three scalars, a symmetric matrix is its upper
triangle, and products are unrolled while tracing, skipping structural zeros.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.types import Flag, Scalar, Vec3


class Minus(NamedTuple):
    """A negated entry, stored with its sign unchanged: products subtract it.

    Negating it up front would add an array that every step writes and reads back.
    """

    of: Scalar


Entries = Mapping[tuple[int, int], Scalar | Minus]
"""The non-zero entries of a square matrix, by row and column."""

Triangle = tuple[Scalar, ...]
"""Upper triangle of a symmetric matrix, row by row."""


def add(a: Vec3, b: Vec3) -> Vec3:
    """Return a + b."""
    return Vec3(a.x + b.x, a.y + b.y, a.z + b.z)


def scale(factor: Scalar, a: Vec3) -> Vec3:
    """Return the product of a scalar and a vector."""
    return Vec3(factor * a.x, factor * a.y, factor * a.z)


def dot(a: Vec3, b: Vec3) -> Scalar:
    """Return the inner product of a and b."""
    return a.x * b.x + a.y * b.y + a.z * b.z


def cross(a: Vec3, b: Vec3) -> Vec3:
    """Return the cross product of a and b."""
    return Vec3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


@cache
def triangle_index(n: int) -> dict[tuple[int, int], int]:
    """Return the position in its `Triangle` of each entry (i, j) of an n x n symmetric matrix."""
    upper = [(i, j) for i in range(n) for j in range(i, n)]
    return {entry: k for k, (i, j) in enumerate(upper) for entry in ((i, j), (j, i))}


def times_plus_identity(entries: Entries, x: Sequence[Scalar]) -> tuple[Scalar, ...]:
    """Return (I + A) x for the non-zero ``entries`` of A; float zeros are skipped."""
    out = list(x)
    for (i, j), a in entries.items():
        if isinstance(a, Minus):
            out[i] = out[i] - a.of * x[j]
        elif not (isinstance(a, float) and a == 0):
            out[i] = out[i] + a * x[j]
    return tuple(out)


def congruence(entries: Entries, p: Triangle, n: int) -> Triangle:
    """Return (I + A) P (I + A)' for the non-zero ``entries`` of A and symmetric P (n x n)."""
    at = triangle_index(n)
    columns = [times_plus_identity(entries, [p[at[i, j]] for i in range(n)]) for j in range(n)]
    # The product is symmetric: only its upper triangle is computed below.
    out = [times_plus_identity(entries, [columns[j][i] for j in range(n)]) for i in range(n)]
    return tuple(out[i][j] for i in range(n) for j in range(i, n))


def change_signs(signs: Sequence[float], p: Triangle) -> Triangle:
    """Return T P T for the diagonal matrix T of n signs and symmetric P (n x n)."""
    n = len(signs)
    pairs = (signs[i] * signs[j] for i in range(n) for j in range(i, n))
    return tuple(sign * entry for sign, entry in zip(pairs, p, strict=True))


def solve3(p: Triangle, b: Vec3) -> Vec3:
    """Solve the symmetric 3 x 3 system P x = b in closed form (cofactors)."""
    a, h, g, d, f, c = p
    ca, ch, cg = d * c - f * f, g * f - h * c, h * f - g * d
    cd, cf, cc = a * c - g * g, g * h - a * f, a * d - h * h
    inverse_determinant = 1 / (a * ca + h * ch + g * cg)
    rows = (Vec3(ca, ch, cg), Vec3(ch, cd, cf), Vec3(cg, cf, cc))
    return scale(inverse_determinant, Vec3(*(dot(row, b) for row in rows)))


def select_tree(flag: Flag, if_set: Any, otherwise: Any) -> Any:
    """Return one of two trees of the same structure, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(flag, a, b), if_set, otherwise)
