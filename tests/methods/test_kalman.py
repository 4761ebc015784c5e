import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
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


@st.composite
def alignments(draw):
    """Numbers of an alignment filter over many decades, and a specific force in n."""
    log_uniform = lambda low, high: st.floats(low, high).map(lambda a: 10.0**a)  # noqa: E731
    p0 = [draw(log_uniform(-3, 0)) for _ in range(2)] + [draw(log_uniform(-4, 0)) for _ in "enu"]
    q = [draw(log_uniform(-8, -2)) for _ in range(2)] + [draw(log_uniform(-9, -5)) for _ in "enu"]
    force = [draw(st.floats(-1.5, 1.5)), draw(st.floats(-1.5, 1.5)), 9.8]
    return p0, q, draw(log_uniform(-3, 0)), force


@given(alignments())
def test_covariance_stays_symmetric_positive(case):
    p0, q, r, force = case
    covariance = covariances(run(np.square(p0), np.square(q), r * r, np.array(force)))
    # Scaled to unit diagonal, as the states have different units.
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.all(sigma > 0)
    correlation = covariance / (sigma[:, :, None] * sigma[:, None, :])
    assert np.linalg.eigvalsh(correlation).min() > 0


@jax.jit
def run(p0, q, r, force):
    dt, fe, fn, fu = 0.01, *force
    transition = {(0, 3): -fu, (0, 4): fn, (1, 2): fu, (1, 4): -fe, (2, 3): 4e-5, (2, 4): -6e-5}
    transition = {place: dt * value for place, value in transition.items()}

    def step(_, belief):
        belief = kalman.predict(belief, transition, tuple(q))
        return kalman.update(belief, (0, 1), (belief.x[0], belief.x[1]), r)

    def record(belief, _):
        belief = jax.lax.fori_loop(0, 20, step, belief)
        return belief, belief.p

    return jax.lax.scan(record, kalman.initial_belief(tuple(p0)), length=150)[1]
