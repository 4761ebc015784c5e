"""What every alignment method has to do, whatever it is made of."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.in_engine import (
    ARCMIN,
    PAPER1,
    loops,
    navigation,
    paper_params,
    site,
    step_and_close,
    swing_increments,
)
from oracles.naive import DEG, PAPER, Loops, azimuth_gains, exp, level_gains, log, of_quaternion
from support.studies import small_study

from sinsjax.engine.build import Scenario
from sinsjax.maths import rotations
from sinsjax.methods import passes
from sinsjax.methods.base import Options
from sinsjax.methods.compass.config import REVERSALS
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import sensors
from sinsjax.strapdown.error_model import MODELS

pytestmark = pytest.mark.optimised(False)

RATE, SECONDS, LATITUDE = 100, 60, 32 * DEG
SWING = PAPER1._replace(center=np.array([0.05, -0.1, 2.0]))
NEVER = 10**9

methods = pytest.mark.parametrize("name", sorted(METHODS))
READ_ONCE = {"optimisation", "optimisation_position", "inertial", "gravity_fit", "level"}
"""Methods without passes over a stored record."""
reversing = pytest.mark.parametrize("name", sorted(METHODS.keys() - READ_ONCE))
FILTERS = sorted({*MODELS, "ekf_azimuth", "invariant"})
"""Methods with [P1]'s states, a covariance and feedback."""
filters = pytest.mark.parametrize("name", FILTERS)
representative = pytest.mark.representative("compass", "kalman5", "kalman_sincos", "level")
few_filters = pytest.mark.representative("kalman5")
few_reversing = pytest.mark.representative("compass", "kalman10")
"""Methods of the fast tests: with and without P, biases and a heading of the start."""

COMPASS = Loops(level_gains(0.3, PAPER), ((20.0 * RATE, azimuth_gains(0.1, PAPER)),), 0.01)
"""Loops quick enough for a minute: sigma 0.3 1/s in level, from 20 s on 0.1 1/s in azimuth."""


def method_of(name):
    return METHODS[name](Options(1 / RATE))


def numbers(name, **changes):
    if name == "compass":
        return loops(COMPASS, REVERSALS["reflect"])
    if name in FILTERS:
        model = MODELS.get(name, MODELS["kalman5"])
        given = paper_params(model.states, **changes)
        return given._replace(extra=np.float64(1.0)) if name == "ekf_azimuth" else given
    group = Scenario(small_study(alignment={"method": name})).part(0).group
    return jax.tree.map(lambda a: np.asarray(a)[0], group.variants.method)


@cache
def increments():
    return swing_increments(SWING, PAPER, LATITUDE, rate=RATE, samples=RATE * SECONDS)


@cache
def runner(name):
    """A compiled run without sensor errors: corrected attitudes and covariances every second."""
    method = method_of(name)
    rows = increments()
    samples = jax.tree.map(
        lambda a: a.reshape(SECONDS, RATE), sensors.compensate_record(rows, rows[0])
    )
    here = site(PAPER, LATITUDE)

    def run(filt, nav):
        def one_second(state, xs):
            second, block = xs

            def step(i, state):
                sample = jax.tree.map(lambda a: a[i], block)
                return step_and_close(method, filt, here, state, sample, second * RATE + 1.0 + i)

            state = method.normalise(jax.lax.fori_loop(0, RATE, step, state))
            seen = method.attitude(state), method.covariance(state), state.nav
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


FROM_ANY_HEADING = {
    *("kalman_sincos", "kalman_surge"),
    *("optimisation", "optimisation_position", "inertial"),
}
"""Methods that take the heading of the start for no better than any other."""
LEAVE_TRUTH = {*FROM_ANY_HEADING, "unscented", "gravity_fit", "level"}
"""And one whose sigma points lie across the circle, so that their mean is off, one that is fitted
by the engine at record times, and one that finds the mean level of a base that sways."""


@pytest.mark.representative("compass", "kalman5")
@pytest.mark.parametrize("name", sorted(METHODS.keys() - LEAVE_TRUTH))
def test_run_started_at_truth_stays_at_truth(name):
    changes = {"every": 10} if name in FILTERS else {}
    left, _, speed = run(name, np.zeros(3), **changes)
    assert np.abs(left).max() < 1e-3 * ARCMIN
    assert speed.max() < 1e-6


FIND_NORTH = [
    (name, {}) for name in sorted(METHODS.keys() - LEAVE_TRUTH) if METHODS[name].has_floor
]
SLOWLY_FED_BACK = [(name, {"every": 100}) for name in FILTERS]


@pytest.mark.representative("compass-changes0", "kalman5-changes8")
@pytest.mark.parametrize(("name", "changes"), FIND_NORTH + SLOWLY_FED_BACK)
def test_run_levels_and_then_finds_north(name, changes):
    phi = np.array([10.0, -10.0, 60.0]) * ARCMIN
    left, p, _ = run(name, phi, v=(0.05, -0.05), **changes)
    # Level first, in seconds; north slowly, out of the Earth's rate.
    assert np.abs(left[20:, :2]).max() < 0.2 * ARCMIN
    assert abs(left[-1, 2]) < 30 * ARCMIN
    # Within what is believed, if anything is.
    sigma = np.sqrt(np.diagonal(p, axis1=1, axis2=2))
    assert np.all(sigma[-1] < sigma[0]) if name in FILTERS else np.all(np.isnan(sigma))


@few_filters
@filters
def test_covariance_is_symmetric_positive(name):
    _, p, _ = run(name, np.array([1.0, 2.0, 5.0]) * DEG, every=30, resets=(1000, 2000))
    assert np.linalg.eigvalsh(p).min() > 0


@few_filters
@filters
def test_feedback_interval_does_not_matter_for_small_errors(name):
    """The loop is linear there: what is fed back early or late is the same estimate."""
    phi = np.array([0.05, -0.05, 0.2]) * ARCMIN
    each, seldom, never = (run(name, phi, every=every)[0] for every in (1, 700, NEVER))
    np.testing.assert_allclose(seldom, each, rtol=0, atol=1e-3 * ARCMIN)
    np.testing.assert_allclose(never, each, rtol=0, atol=1e-3 * ARCMIN)


@few_filters
@filters
def test_reset_restores_initial_covariance(name):
    k = 40
    phi = np.array([10.0, -10.0, 60.0]) * ARCMIN
    _, p, _ = run(name, phi, every=100)
    _, again, _ = run(name, phi, every=100, resets=(RATE * k,))
    np.testing.assert_array_equal(again[: k - 1], p[: k - 1])
    p0 = np.array(numbers(name).p0[2:5])
    np.testing.assert_allclose(again[k - 1], np.diag(p0), rtol=1e-14, atol=0)
    assert np.all(np.diagonal(again[-1]) >= np.diagonal(p[-1]) * (1 - 1e-9))


@few_filters
@filters
def test_feedback_does_not_change_corrected_attitude(name):
    """The estimate moves into the solution: its sum with the solution, the user's, stays."""
    start = nav_off(np.array([1.0, -2.0, 5.0]) * DEG, (0.3, 0.4))
    given = []
    for gain, every in ((0.0, NEVER), (0.3, RATE), (1.0, RATE)):
        attitude, _, nav = runner(name)(numbers(name, every=every, gain=gain), start)
        given.append([np.stack(q, axis=1)[0] for q in (attitude, nav.q)])
    # Rz(a) e of a share and of the rest make that of the whole to third order only.
    third_order = np.radians(2.0) ** 2 * np.radians(5.0)
    of_shares = third_order if name == "ekf_azimuth" else 1e-13
    for (attitude, q), atol in zip(given[1:], (of_shares, 1e-13), strict=True):
        np.testing.assert_allclose(attitude, given[0][0], rtol=0, atol=atol)
        assert np.abs(q - given[0][1]).max() > 1e-3
    np.testing.assert_allclose(*given[2], rtol=0, atol=1e-14)


@representative
@methods
def test_init_keeps_given_navigation_and_initial_covariance(name):
    method = method_of(name)
    nav = nav_off([0.1, 0.2, 0.3], (0.5, -0.6))
    state = method.init(numbers(name), nav)
    for a, b in zip(
        jax.tree.leaves((method.attitude(state), state.nav)),
        jax.tree.leaves((nav.q, nav)),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-16)
    if name in FILTERS:
        p0 = numbers(name).p0
        believed = (p0[2], 0, 0, p0[3], 0, p0[4])
    elif not METHODS[name].finds_heading or METHODS[name].stores_blocks:
        believed = (np.pi**2 / 3, 0, 0, np.pi**2 / 3, 0, np.pi**2 / 3)
    elif METHODS[name].has_covariance:
        p0 = numbers(name).p0
        heading = np.pi**2 / 3 if name in FROM_ANY_HEADING else p0[4]
        believed = (p0[2], 0, 0, p0[3], 0, heading)
    else:
        believed = (np.nan,) * 6
    np.testing.assert_array_equal(method.covariance(state), believed)


@representative
@methods
def test_normalise_changes_only_quaternion_length(name):
    method = method_of(name)
    state = method.init(numbers(name), nav_off([0.1, 0.2, 0.3]))
    q = state.nav.q
    long = state._replace(nav=state.nav._replace(q=type(q)(*(1.5 * c for c in q))))
    for a, b in zip(*map(jax.tree.leaves, (method.normalise(long), state)), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)


@pytest.mark.representative("kalman5", "compass")
@pytest.mark.parametrize("name", sorted(METHODS.keys() - {"gravity_fit"}))
def test_tangents_are_finite_at_zero_error(name):
    """There a root or an arc tangent might have none."""
    method, here, filt = method_of(name), site(PAPER, LATITUDE), numbers(name, every=1)
    sample = jax.tree.map(
        lambda a: a[0], sensors.compensate_record(increments()[:1], increments()[0])
    )

    def after(filt, nav):
        state = step_and_close(method, filt, here, method.init(filt, nav), sample, 1.0)
        return method.attitude(state), method.covariance(state), state.nav

    point = filt, nav_off(np.zeros(3))
    ones = jax.tree.map(lambda a: np.ones_like(a, dtype=float), point)
    tangent = jax.jit(lambda *given: jax.jvp(after, *given)[1])(point, ones)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tangent))


@cache
def under_way(name, seconds):
    """A state some seconds after a start that is off in everything."""
    method, here, given = method_of(name), site(PAPER, LATITUDE), numbers(name)
    rows = increments()[: RATE * seconds]

    @jax.jit
    def fly(nav):
        samples = sensors.compensate_record(rows, rows[0])
        counts = 1.0 + jnp.arange(float(len(rows)))

        def step(state, xs):
            return step_and_close(method, given, here, state, *xs), None

        return jax.lax.scan(step, method.init(given, nav), (samples, counts))[0]

    return method, given, here, fly(nav_off(np.array([1.0, -2.0, 5.0]) * DEG, (0.3, 0.4)))


@methods
def test_only_some_methods_have_passes(name):
    assert (method_of(name).passes is None) == (name in READ_ONCE)


@few_reversing
@reversing
def test_two_turns_at_one_place_cancel(name):
    method, given, here, state = under_way(name, 2)
    once = method.passes.reverse(given, here, state)
    twice = method.passes.reverse(given, passes.site_of_pass(here, jnp.asarray(True)), once)
    for a, b in zip(jax.tree.leaves(twice), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15)
    assert once.nav.ve == -state.nav.ve != 0 and once.nav.vn == -state.nav.vn != 0
    assert (once.nav.latitude, once.nav.longitude) == (state.nav.latitude, state.nav.longitude)


@few_reversing
@reversing
def test_turn_does_not_change_heading(name):
    """It runs time the other way: the platform is not turned about the vertical."""
    method, given, here, state = under_way(name, 2)
    once = method.passes.reverse(given, here, state)
    turned = rotations.misalignment(method.attitude(once), method.attitude(state))
    assert abs(turned.z) < 1e-15
    # A filter does not touch its attitude, a compass levels by the specific force.
    if name in FILTERS or name == "compass":
        assert (max(abs(turned.x), abs(turned.y)) > 1e-6) == (name == "compass")
