"""What every alignment method has to do, whatever it is made of."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine import (
    ARCMIN,
    PAPER1,
    RESETS,
    navigation,
    paper_filter,
    params,
    site,
    swing_increments,
)
from naive import DEG, PAPER, exp, log, of_quaternion

from sinsjax import imu
from sinsjax.alignment import METHODS
from sinsjax.alignment.base import Options
from sinsjax.error_model import MODELS

RATE, SECONDS, LATITUDE = 100, 60, 32 * DEG
SWING = PAPER1._replace(center=np.array([0.05, -0.1, 2.0]))
NEVER = 10**9

methods = pytest.mark.parametrize("name", sorted(METHODS))


def method_of(name):
    return METHODS[name](Options(1 / RATE))


def numbers(name, **changes):
    return params(paper_filter(len(MODELS[name].states), **changes))


@cache
def increments():
    return swing_increments(SWING, PAPER, LATITUDE, rate=RATE, samples=RATE * SECONDS)


@cache
def runner(name):
    """A compiled run without sensor errors: corrected attitudes and covariances every second."""
    method = method_of(name)
    rows = increments()
    samples = jax.tree.map(lambda a: a.reshape(SECONDS, RATE), imu.compensate(rows, rows[0]))
    here = site(PAPER, LATITUDE)

    def run(filt, nav):
        def one_second(state, xs):
            second, block = xs

            def step(i, state):
                sample = jax.tree.map(lambda a: a[i], block)
                return method.step(filt, here, state, sample, second * RATE + 1.0 + i)

            state = method.normalise(jax.lax.fori_loop(0, RATE, step, state))
            seen = method.attitude(state), method.covariance(state), method.navigation(state)
            return state, seen

        seconds = jnp.arange(float(SECONDS))
        return jax.lax.scan(one_second, method.init(filt, nav), (seconds, samples))[1]

    return jax.jit(run)


def nav_off(phi, v=(0.0, 0.0)):
    return navigation(exp(-np.asarray(phi)) @ SWING.matrix(0.0), v, LATITUDE)


def run(name, phi, v=(0.0, 0.0), **changes):
    """Misalignment left every second (rad), covariances (seconds, 3, 3), and speed (m/s)."""
    q, covariance, nav = runner(name)(numbers(name, **changes), nav_off(phi, v))
    c = of_quaternion(np.stack(q, axis=1))
    left = [log(SWING.matrix(k + 1.0) @ c[k].T) for k in range(SECONDS)]
    ee, en, eu, nn, nu, uu = np.array(covariance)
    p = np.moveaxis(np.array([[ee, en, eu], [en, nn, nu], [eu, nu, uu]]), -1, 0)
    return np.array(left), p, np.hypot(nav.ve, nav.vn)


@methods
def test_at_truth_it_stays_at_truth(name):
    left, _, speed = run(name, np.zeros(3), every=10)
    assert np.abs(left).max() < 1e-3 * ARCMIN
    assert speed.max() < 1e-6


@methods
@pytest.mark.parametrize("every", [1, 100])
def test_it_levels_and_then_finds_north(name, every):
    phi = np.array([10.0, -10.0, 60.0]) * ARCMIN
    left, p, _ = run(name, phi, v=(0.05, -0.05), every=every)
    # Level first, in seconds; north slowly, out of the Earth's rate.
    assert np.abs(left[20:, :2]).max() < 1.5 * ARCMIN
    assert abs(left[-1, 2]) < abs(left[9, 2]) < 60 * ARCMIN
    assert abs(left[-1, 2]) < 20 * ARCMIN
    sigma = np.sqrt(np.diagonal(p, axis1=1, axis2=2))
    assert np.all(sigma[-1] < sigma[0])


@methods
def test_covariance_is_symmetric_positive(name):
    _, p, _ = run(name, np.array([1.0, 2.0, 5.0]) * DEG, every=30, resets=(1000, 2000))
    assert np.linalg.eigvalsh(p).min() > 0


@methods
def test_feedback_interval_does_not_matter_while_errors_are_small(name):
    """The loop is linear there: what is fed back early or late is the same estimate."""
    phi = np.array([0.5, -0.5, 2.0]) * ARCMIN
    each, seldom, never = (run(name, phi, every=every)[0] for every in (1, 700, NEVER))
    np.testing.assert_allclose(seldom, each, rtol=0, atol=0.01 * ARCMIN)
    np.testing.assert_allclose(never, each, rtol=0, atol=0.01 * ARCMIN)


@methods
def test_a_reset_believes_the_start_again(name):
    k = 40
    phi = np.array([10.0, -10.0, 60.0]) * ARCMIN
    _, p, _ = run(name, phi, every=100)
    _, again, _ = run(name, phi, every=100, resets=(RATE * k,))
    np.testing.assert_array_equal(again[: k - 1], p[: k - 1])
    p0 = np.array(numbers(name).p0[2:5])
    np.testing.assert_allclose(again[k - 1], np.diag(p0), rtol=1e-14, atol=0)
    assert np.all(np.diagonal(again[-1]) >= np.diagonal(p[-1]) * (1 - 1e-9))


@methods
def test_feedback_leaves_the_given_attitude_alone(name):
    """The estimate moves into the solution: its sum with the solution, the user's, stays."""
    method, here, dt = method_of(name), site(PAPER, LATITUDE), 1 / RATE
    rows = increments()[:3]
    samples = imu.compensate(rows, rows[0])
    given = []
    for gain, every in ((0.0, NEVER), (0.3, 3.0), (1.0, 3.0)):
        filt = numbers(name, every=every, gain=gain)
        state = method.init(filt, nav_off(np.array([1.0, -2.0, 5.0]) * DEG, (0.3, 0.4)))
        step = jax.jit(method.step)
        for n in range(3):
            sample = jax.tree.map(lambda a, n=n: a[n], samples)
            state = step(filt, here, state, sample, n + 1.0)
        given.append((np.array(method.attitude(state)), np.array(method.navigation(state).q)))
    assert dt == 0.01
    for attitude, q in given[1:]:
        np.testing.assert_allclose(attitude, given[0][0], rtol=0, atol=1e-15)
        assert np.abs(q - given[0][1]).max() > 1e-6
    np.testing.assert_allclose(*given[2], rtol=0, atol=1e-15)


@methods
def test_it_begins_with_what_it_is_given(name):
    method = method_of(name)
    nav = nav_off([0.1, 0.2, 0.3], (0.5, -0.6))
    state = method.init(numbers(name), nav)
    for a, b in zip(
        jax.tree.leaves((method.attitude(state), method.navigation(state))),
        jax.tree.leaves((nav.q, nav)),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-16)
    p0 = numbers(name).p0
    np.testing.assert_allclose(
        method.covariance(state), (p0[2], 0, 0, p0[3], 0, p0[4]), rtol=0, atol=0
    )


@methods
def test_normalise_touches_only_the_length_of_the_quaternion(name):
    method = method_of(name)
    state = method.init(numbers(name), nav_off([0.1, 0.2, 0.3]))
    q = method.navigation(state).q
    long = state._replace(nav=state.nav._replace(q=type(q)(*(1.5 * c for c in q))))
    for a, b in zip(*map(jax.tree.leaves, (method.normalise(long), state)), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)


@methods
def test_many_runs_are_single_runs(name):
    phis = np.array([[0.1, 0.0, 0.0], [0.0, -0.2, 0.5], [0.05, 0.05, 3.0]])
    navs = jax.tree.map(lambda *a: jnp.stack(a), *(nav_off(phi) for phi in phis))
    resets = [(), (500,), (100, 300)]
    filters = [numbers(name, every=50 + i, resets=r) for i, r in enumerate(resets)]
    assert all(f.resets.samples.shape == (RESETS,) for f in filters)
    filts = jax.tree.map(lambda *a: np.stack(a), *filters)
    many = jax.vmap(runner(name))(filts, navs)
    for i, filt in enumerate(filters):
        one = runner(name)(filt, jax.tree.map(lambda a, i=i: a[i], navs))
        for a, b in zip(jax.tree.leaves(many), jax.tree.leaves(one), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-9, atol=1e-11)


@methods
def test_tangents_are_finite(name):
    """Also where nothing is off, where a root or an arc tangent would give none."""
    start = numbers(name, every=10)
    ones = jax.tree.map(lambda a: np.zeros_like(a, dtype=float), start)._replace(r=np.float64(1e-3))
    tangent = jax.jvp(lambda filt: runner(name)(filt, nav_off(np.zeros(3))), (start,), (ones,))[1]
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tangent))
