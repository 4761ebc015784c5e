"""The linear part of a method's step, and what becomes of errors over many of them."""

from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.studies import small_study

from sinsjax.covariance import error_growth
from sinsjax.covariance.coloured_noise import ColouredInputs
from sinsjax.engine import build
from sinsjax.engine.environment import Static, build_method
from sinsjax.maths import rotations
from sinsjax.maths.algebra import Minus, entries_as_numbers, triangle_index
from sinsjax.methods import kalman
from sinsjax.methods.base import ErrorStep
from sinsjax.types import Increments, Navigation, Quat, Sample, Vec3

FILTERS = ("kalman5", "kalman10", "kalman_sincos", "ekf_azimuth", "invariant", "unscented")
few = pytest.mark.nightly(fast=("kalman10", "kalman_sincos"))
seeds = st.integers(0, 2**32 - 1)


def dense(triangle: Any, n: int) -> np.ndarray:
    at, numbers = triangle_index(n), np.array(triangle)
    return np.array([[numbers[at[i, j]] for j in range(n)] for i in range(n)])


def matrix(entries: Any, shape: tuple[int, int]) -> np.ndarray:
    out = np.zeros(shape)
    for at, value in entries_as_numbers(entries).items():
        out[at] = value
    return out


def random_step(rng: np.random.Generator, n: int) -> ErrorStep:
    """Any transition, inputs and gains, a negated entry in each."""
    places = [tuple(map(int, at)) for at in np.argwhere(rng.random((n, n)) < 0.4)]
    transition: dict = {at: float(rng.normal(scale=0.1)) for at in places}
    transition[0, n - 1] = Minus(float(rng.normal(scale=0.1)))
    inputs: dict = {(i, int(rng.integers(6))): float(rng.normal()) for i in range(n)}
    inputs[n - 1, 5] = Minus(float(rng.normal()))
    gains = tuple(tuple(rng.normal(scale=0.3, size=n).tolist()) for _ in range(2))
    return ErrorStep(transition, inputs, gains, (0, 1))


@given(seeds, st.sampled_from([5, 6, 10]), st.booleans())
def test_error_growth_matches_dense_matrices(seed: int, n: int, alike: bool) -> None:
    rng = np.random.default_rng(seed)
    columns = tuple(tuple(float(i == j) for i in range(n)) for j in range(n))
    growth = error_growth.ErrorGrowth(columns, (0.0,) * (n * (n + 1) // 2))
    f, w, d = np.eye(n), np.zeros((n, n)), rng.normal(size=n)
    errors = tuple(d)
    for _ in range(3):
        step = random_step(rng, n)
        turned = Rotation.random(rng=rng)
        q = Quat(*turned.as_quat(scalar_first=True))
        variances = rng.uniform(0.1, 2, 6)
        velocity, angle = tuple(variances[:3]), tuple(variances[3:])
        if alike:
            velocity, variances[:3] = velocity[:1], velocity[0]
        noise = error_growth.IncrementNoise(velocity, angle)
        excess = rng.normal(size=6)
        increments = Increments(dtheta=Vec3(*excess[3:]), dv=Vec3(*excess[:3]))
        growth = error_growth.apply_step(growth, step, q, noise, ColouredInputs())
        errors = error_growth.propagate_error(step, q, increments, errors)

        phi = np.eye(n) + matrix(step.transition, (n, n))
        c = turned.as_matrix()
        g = matrix(step.inputs, (n, 6)) @ np.kron(np.eye(2), c)
        closed = np.eye(n)
        for k, m in zip(step.gains, step.measured, strict=True):
            closed = (np.eye(n) - np.outer(k, np.eye(n)[m])) @ closed
        f = closed @ phi @ f
        w = closed @ (phi @ w @ phi.T + g @ np.diag(variances) @ g.T) @ closed.T
        d = closed @ (phi @ d + g @ excess)
    np.testing.assert_allclose(np.transpose(growth.columns), f, atol=1e-11)
    np.testing.assert_allclose(dense(growth.noise, n), w, atol=1e-10 * np.abs(w).max())
    np.testing.assert_allclose(errors, d, atol=1e-11)


@given(seeds, st.sampled_from([5, 10]))
def test_kalman_gains_reproduce_update(seed: int, n: int) -> None:
    """X after an update is x + sum of gains times what each measurement still had to tell."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    p = root @ root.T
    belief = kalman.Belief(tuple(rng.normal(size=n)), tuple(p[np.triu_indices(n)]))
    z, r = rng.normal(size=2), 0.3
    x = np.array(belief.x)
    for k, m, value in zip(kalman.gains(belief.p, (0, 1), r, n), (0, 1), z, strict=True):
        x = x + np.array(k) * (value - x[m])
    np.testing.assert_allclose(kalman.update(belief, (0, 1), tuple(z), r).x, x, rtol=1e-12)


def _program(name: str, **changes: Any) -> tuple[Static, Any]:
    study = small_study(
        study={"draws": 1, "duration_s": 2.0, "window_s": [0, 2]},
        alignment={"method": name, "phi_e0_deg": 0.1, "phi_n0_deg": 0.1, "phi_u0_deg": 0.1},
        **changes,
    )
    (part,) = build.parts(study)
    return part.group.static, part.group


def _states(name: str, off: float) -> tuple[Any, ...]:
    """Method, params, site and a state whose navigation is off by an angle (rad) and a velocity."""
    static, group = _program(name)
    method, site = build_method(static), group.environment.site
    params = jax.tree.map(lambda a: a[0], group.variants.method)
    q = rotations.misalign(Vec3(off, -off, 2 * off), Quat(1.0, 0.0, 0.0, 0.0))
    state = method.init(params, Navigation(q, 3 * off, -2 * off, site.latitude, 0.0))
    if name == "kalman_sincos":  # with a heading, of which it knows nothing when it begins
        belief = state.belief._replace(x=(*state.belief.x[:-1], 0.0))
        state = state._replace(belief=belief)
    return method, params, site, state


@few
@pytest.mark.parametrize("name", FILTERS)
def test_linear_error_step_predicts_error_of_corrected_solution(name: str) -> None:
    """Of two runs that begin a little apart, on a base at rest; the states' order is the filter's.

    The error is taken by what it means: the corrected attitude and velocity of both.
    """
    method, params, site, one = _states(name, 0.0)
    assert method.error_model is not None
    dt, place = 0.01, site.place
    rate = Vec3(0.0, place.rate_n * dt, place.rate_u * dt)
    sample = Sample(turn=rotations.exp(rate), dv=Vec3(0.0, 0.0, place.gravity * dt))
    size = 1e-8  # of first order: P follows the tilt, so that gains differ by some 20 times it
    _, _, _, other = _states(name, size)
    step = method.error_model.step(params, site, one, sample, 1.0)
    n = len(step.gains[0])
    angles = np.array(method.error_model.angles(one))

    def errors(a: Any, b: Any) -> np.ndarray:
        """Velocity and misalignment of b's corrected solution against a's."""
        phi = rotations.misalignment(method.attitude(a), method.attitude(b))
        velocities = [
            np.subtract((state.nav.ve, state.nav.vn), state.belief.x[:2]) for state in (a, b)
        ]
        return np.array([*(velocities[1] - velocities[0]), *phi], float)

    # What the states mean: rows of velocities and angles by d.
    rows = np.vstack([np.eye(n)[:2], angles])
    d = np.linalg.pinv(rows) @ errors(one, other)
    np.testing.assert_allclose(rows @ d, errors(one, other), atol=1e-12)
    moved = error_growth.propagate_error(
        step, one.nav.q, Increments(Vec3(0.0, 0.0, 0.0), Vec3(0.0, 0.0, 0.0)), tuple(d)
    )
    after = [method.step(params, site, state, sample, 1.0) for state in (one, other)]
    np.testing.assert_allclose(rows @ np.array(moved), errors(*after), atol=1e-5 * size)


@few
@pytest.mark.parametrize("name", FILTERS)
def test_linear_error_step_predicts_effect_of_increment_errors(name: str) -> None:
    """One step with increments a little off, against the step with exact ones."""
    method, params, site, state = _states(name, 0.0)
    assert method.error_model is not None
    place, size = site.place, 1e-7
    rate = Vec3(0.0, place.rate_n * 0.01, place.rate_u * 0.01)
    sample = Sample(turn=rotations.exp(rate), dv=Vec3(0.0, 0.0, place.gravity * 0.01))
    excess = Increments(dtheta=Vec3(size, -2 * size, 3 * size), dv=Vec3(2 * size, size, 5 * size))
    off = Sample(
        turn=rotations.exp(Vec3(*(a + b for a, b in zip(rate, excess.dtheta, strict=True)))),
        dv=Vec3(*(a + b for a, b in zip(sample.dv, excess.dv, strict=True))),
    )
    step = method.error_model.step(params, site, state, sample, 1.0)
    zero = (0.0,) * len(step.gains[0])
    d = error_growth.propagate_error(step, state.nav.q, excess, zero)
    exact, moved = (method.step(params, site, state, s, 1.0) for s in (sample, off))
    phi = rotations.misalignment(method.attitude(exact), method.attitude(moved))
    told = np.array(method.error_model.angles(exact)) @ np.array(d)
    np.testing.assert_allclose(told, np.array(phi), atol=1e-4 * size)
    velocity = [m.nav.ve - m.belief.x[0] for m in (exact, moved)]
    np.testing.assert_allclose(d[0], velocity[1] - velocity[0], atol=1e-4 * size)


def _compass_error(state: Any, rate: Any) -> np.ndarray:
    """The error that grows as a state of the compass changes at a rate: its eight numbers."""
    turn = rotations.multiply(rate.nav.q, rotations.conjugate(state.nav.q))
    phi = (-2 * turn.x, -2 * turn.y, -2 * turn.z)
    loops = (rate.integral_e, rate.integral_n, rate.rate_u)
    return np.array([rate.nav.ve, rate.nav.vn, *phi, *loops], float)


@pytest.mark.parametrize("n", [1.0, 1e9])
def test_compass_error_step_is_derivative_of_its_step(n: float) -> None:
    """By each state and each increment, while levelling and after, in any state of the loops."""
    method, params, site, state = _states("compass", 0.02)
    assert method.error_model is not None
    state = state._replace(integral_e=3e-4, integral_n=-2e-4, rate_u=5e-4)
    state = jax.tree.map(np.float64, state)
    turn = rotations.exp(Vec3(2e-3, -1e-3, 3e-3))
    sample = jax.tree.map(np.float64, Sample(turn=turn, dv=Vec3(0.01, -0.02, 0.098)))
    step = method.error_model.step(params, site, state, sample, n)
    still, idle = (jax.tree.map(np.zeros_like, one) for one in (state, sample))
    still = jax.tree.map(np.float64, still)
    after = method.step(params, site, state, sample, n)

    def derivative(state_rate: Any, sample_rate: Any) -> np.ndarray:
        def taken(state: Any, sample: Sample) -> Any:
            return method.step(params, site, state, sample, n)

        given = (state, sample), (state_rate, jax.tree.map(np.float64, sample_rate))
        return _compass_error(after, jax.jvp(taken, *given)[1])

    def turned(q: Quat, axis: int, sign: float) -> Quat:
        half = Quat(0.0, *(0.5 * sign * float(i == axis) for i in range(3)))
        return jax.tree.map(np.float64, rotations.multiply(half, q))

    one = np.float64(1.0)
    nav = still.nav
    rates = [
        *(still._replace(nav=nav._replace(**{name: one})) for name in ("ve", "vn")),
        *(still._replace(nav=nav._replace(q=turned(state.nav.q, i, -1.0))) for i in range(3)),
        *(still._replace(**{name: one}) for name in ("integral_e", "integral_n", "rate_u")),
    ]
    columns = np.transpose([derivative(rate, idle) for rate in rates])
    told = np.eye(8) + matrix(step.transition, (8, 8))
    # But for half the turn that the platform makes within the sample itself.
    np.testing.assert_allclose(told[:2], columns[:2], rtol=0, atol=0.51 * 9.8 * 0.01**2)
    np.testing.assert_allclose(told[2:], columns[2:], rtol=2e-4, atol=4e-8)
    axes = np.transpose([rotations.rotate(state.nav.q, Vec3(*axis)) for axis in np.eye(3)])
    pushed = [idle._replace(dv=Vec3(*map(np.float64, axis))) for axis in np.eye(3)]
    # About the axes of the body when the sample ends.
    turns = [
        idle._replace(turn=rotations.multiply(sample.turn, Quat(0.0, *(0.5 * axis))))
        for axis in np.eye(3)
    ]
    columns = np.transpose([derivative(still, rate) for rate in (*pushed, *turns)])
    told = matrix(step.inputs, (8, 6)) @ np.kron(np.eye(2), axes)
    np.testing.assert_allclose(told, columns, atol=5e-3)
