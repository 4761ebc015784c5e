import jax
import numpy as np
import pytest
from oracles.in_engine import covariances
from oracles.naive import update as joint_update

from sinsjax.methods.filters import kalman


@pytest.mark.nightly(fast=("5-measured2",))
@pytest.mark.parametrize(
    ("n", "measured"), [(5, (0, 1)), (1, (0,)), (5, (4, 0, 2)), (10, (0, 1)), (12, (3,))]
)
def test_predict_and_update_match_dense_joint_filter(n, measured):
    rng = np.random.default_rng(n)
    # Where a random transition has entries, its diagonal among them.
    places = [(int(i), int(j)) for i, j in np.argwhere(rng.random((n, n)) < 0.4)] or [(0, 0)]
    h = np.eye(n)[list(measured)]
    p0 = 10.0 ** rng.uniform(-2, 2, n)
    r = 0.3

    @jax.jit
    def step(belief, values, q, z):
        transition = dict(zip(places, values, strict=True))
        return kalman.update(kalman.predict(belief, transition, tuple(q)), measured, tuple(z), r)

    belief = kalman.initial_belief(tuple(p0))
    x, p = np.zeros(n), np.diag(p0)
    np.testing.assert_array_equal(belief.x, x)
    np.testing.assert_array_equal(covariances(belief.p), p)
    for _ in range(300):
        values = rng.normal(scale=0.1, size=len(places))
        q = 10.0 ** rng.uniform(-4, -1, n)
        z = rng.normal(size=len(measured))
        belief = step(belief, values, q, z)
        phi = np.eye(n)
        phi[tuple(zip(*places, strict=True))] += values
        x, p = joint_update(phi @ x, phi @ p @ phi.T + np.diag(q), h, z, r)
        np.testing.assert_allclose(belief.x, x, rtol=0, atol=1e-10 * np.abs(x).max())
        np.testing.assert_allclose(covariances(belief.p), p, rtol=0, atol=1e-10 * np.abs(p).max())
