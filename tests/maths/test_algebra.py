import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sinsjax.maths import algebra
from sinsjax.types import Vec3

number = st.floats(-10, 10)
vectors = st.builds(Vec3, number, number, number)


@given(vectors, vectors, number)
def test_vector_operations_match_numpy(a, b, factor):
    x, y = np.array(a), np.array(b)
    np.testing.assert_allclose(algebra.add(a, b), x + y)
    np.testing.assert_allclose(algebra.scale(factor, a), factor * x)
    np.testing.assert_allclose(algebra.dot(a, b), x @ y, atol=1e-13)
    np.testing.assert_allclose(algebra.cross(a, b), np.cross(x, y), atol=1e-13)


@pytest.mark.parametrize("n", [1, 2, 5, 10])
def test_triangle_index_is_row_major_upper_triangle(n):
    index = algebra.triangle_index(n)
    for k, (i, j) in enumerate(zip(*np.triu_indices(n), strict=True)):
        assert index[i, j] == index[j, i] == k
    assert len(index) == n * n


def symmetric(triangle, n):
    index = algebra.triangle_index(n)
    return np.array([[triangle[index[i, j]] for j in range(n)] for i in range(n)])


@st.composite
def sparse_matrices(draw):
    n = draw(st.integers(1, 8))
    place = st.tuples(st.integers(0, n - 1), st.integers(0, n - 1))
    entries = draw(st.dictionaries(place, st.sampled_from([0.0, -0.5]) | number, max_size=n * n))
    dense = np.eye(n)
    for (i, j), value in entries.items():
        dense[i, j] += value
    return n, entries, dense, draw(st.integers(0, 2**32 - 1))


@given(sparse_matrices())
def test_sparse_products_match_dense_products(case):
    n, entries, dense, seed = case
    rng = np.random.default_rng(seed)
    x, half = rng.normal(size=n), rng.normal(size=(n, n))
    p = half @ half.T
    np.testing.assert_allclose(algebra.times_plus_identity(entries, list(x)), dense @ x, atol=1e-12)
    out = algebra.congruence(entries, tuple(p[np.triu_indices(n)]), n)
    assert len(out) == n * (n + 1) // 2
    np.testing.assert_allclose(symmetric(out, n), dense @ p @ dense.T, rtol=1e-12, atol=1e-10)


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_change_signs_matches_dense_product(seed, n):
    rng = np.random.default_rng(seed)
    half, signs = rng.normal(size=(n, n)), rng.choice([-1.0, 1.0], n)
    p = half @ half.T
    out = algebra.change_signs(signs.tolist(), tuple(p[np.triu_indices(n)]))
    np.testing.assert_array_equal(symmetric(out, n), np.diag(signs) @ p @ np.diag(signs))


def test_zero_entry_ignores_infinite_operand():
    assert algebra.times_plus_identity({(0, 1): 0.0}, [1.0, np.inf]) == (1.0, np.inf)


@given(st.integers(0, 2**32 - 1))
def test_solve3_matches_numpy_solve(seed):
    rng = np.random.default_rng(seed)
    # Variances as unequal as those of level and yaw.
    spread = 10.0 ** rng.uniform(-4, 0, 3)
    half = spread[:, None] * rng.normal(size=(3, 6))
    p, b = half @ half.T, spread * rng.normal(size=3)
    x = spread * np.array(algebra.solve3(tuple(p[np.triu_indices(3)]), Vec3(*b)))
    expected = spread * np.linalg.solve(p, b)
    condition = np.linalg.cond(p / np.outer(spread, spread))
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-13 * condition * abs(expected).max())
