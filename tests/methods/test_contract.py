"""What every alignment method has to do, whatever it is made of.

A new method is found in the registry.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.in_engine import (
    PAPER1,
    navigation,
    site,
    step_and_close,
    swing_increments,
)
from oracles.naive import DEG, PAPER, exp
from support.studies import small_study

from sinsjax.engine.scenario import Scenario
from sinsjax.methods.method import UNKNOWN_ANGLE, Options
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import sensors

pytestmark = pytest.mark.optimised(False)

RATE, SECONDS, LATITUDE = 100, 60, 32 * DEG
SWING = PAPER1._replace(center=np.array([0.05, -0.1, 2.0]))

FITTED = [name for name, method in METHODS.items() if method.program.block_fit]
STEPPED = [name for name in METHODS if name not in FITTED]
methods = pytest.mark.parametrize("name", METHODS)
few = pytest.mark.nightly(fast=("compass", "kalman5", "kalman_sincos", "level"))
"""With and without P, and with and without a heading of the start."""


def method_of(name, **choices):
    blocks = {"record_every": RATE, "records": SECONDS} if name in FITTED else {}
    return METHODS[name].build(Options(1 / RATE, **blocks | choices))


@cache
def numbers(name, **alignment):
    """The method's params of a small study."""
    group = Scenario(small_study(alignment={"method": name} | alignment)).batch(0)
    return jax.tree.map(lambda a: np.asarray(a)[0], group.params.method)


# Its steps


@cache
def increments():
    return swing_increments(SWING, PAPER, LATITUDE, rate=RATE, samples=RATE * SECONDS)


def nav_off(phi, v=(0.0, 0.0)):
    return navigation(exp(-np.asarray(phi)) @ SWING.matrix(0.0), v, LATITUDE)


@few
@methods
def test_init_keeps_given_navigation_and_initial_covariance(name):
    method, nav = method_of(name), nav_off([0.1, 0.2, 0.3], (0.5, -0.6))
    state = method.init(numbers(name), nav)
    found, given = (method.attitude(state), state.nav), (nav.q, nav)
    for a, b in zip(*map(jax.tree.leaves, (found, given)), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-16)
    if "filter" in METHODS[name].sections:
        p0 = numbers(name).p0
        heading = UNKNOWN_ANGLE if "p0_yaw_deg" in METHODS[name].without_effect else p0[4]
        believed = (p0[2], 0, 0, p0[3], 0, heading)
        np.testing.assert_array_equal(method.covariance(state), believed)


@few
@methods
def test_normalise_changes_only_quaternion_length(name):
    method = method_of(name)
    state = method.init(numbers(name), nav_off([0.1, 0.2, 0.3]))
    q = state.nav.q
    long = state._replace(nav=state.nav._replace(q=type(q)(*(1.5 * c for c in q))))
    for a, b in zip(*map(jax.tree.leaves, (method.normalise(long), state)), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)


@cache
def flight(name, **choices):
    """Two seconds of a run: navigation -> its state; and the same for several."""
    method, here, given = method_of(name, **choices), site(PAPER, LATITUDE), numbers(name)
    rows = increments()[: RATE * 2]

    def fly(nav):
        samples = sensors.compensate_record(rows, rows[0])

        def step(state, xs):
            return step_and_close(method, given, here, state, *xs), None

        counts = 1.0 + jnp.arange(float(len(rows)))
        return jax.lax.scan(step, method.init(given, nav), (samples, counts))[0]

    return jax.jit(fly), jax.jit(jax.vmap(fly))


START = nav_off(np.array([1.0, -2.0, 5.0]) * DEG, (0.3, 0.4))
"""Off in everything."""


@pytest.mark.nightly(fast=("compass", "level"))
@methods
def test_run_depends_on_its_own_start_alone(name):
    """Again it has the same bits; side by side with a broken one, what it has alone."""
    alone, mapped = flight(name)
    other, broken = nav_off([0.0, 0.1, -1.0]), jax.tree.map(lambda a: a * np.nan, START)
    together = mapped(jax.tree.map(lambda *leaves: jnp.stack(leaves), START, broken, other))
    for place, nav in ((0, START), (2, other)):
        once, again = (jax.tree.leaves(alone(nav)) for _ in "ab")
        for a, b, c in zip(once, again, jax.tree.leaves(together), strict=True):
            np.testing.assert_array_equal(a, b)
            np.testing.assert_allclose(c[place], a, rtol=1e-9, atol=1e-12)


SHARING = [
    (name, force, position)
    for name in METHODS
    for force in ("measured", "gravity")
    for position in ("fixed", "integrated")
    if method_of(name, specific_force=force, position=position).shares_covariance
]


@pytest.mark.nightly(fast=("kalman_sincos-measured-fixed",))
@pytest.mark.parametrize(("name", "force", "position"), SHARING)
def test_shared_covariance_does_not_depend_on_the_start(name, force, position):
    """To the bit; runs that differ in their draw have it in common."""
    alone, _ = flight(name, specific_force=force, position=position)
    one, other = (alone(nav).belief.p for nav in (START, nav_off(np.zeros(3))))
    np.testing.assert_array_equal(one, other)


@pytest.mark.nightly(fast=("kalman5", "compass"))
@pytest.mark.parametrize("name", STEPPED)
def test_tangents_are_finite_at_zero_error(name):
    """There a root or an arc tangent might have none."""
    method, here, filt = (
        method_of(name),
        site(PAPER, LATITUDE),
        numbers(name, feedback_interval_s=0.01),
    )
    sample = jax.tree.map(
        lambda a: a[0], sensors.compensate_record(increments()[:1], increments()[0])
    )

    def after(filt, nav):
        state = step_and_close(method, filt, here, method.init(filt, nav), sample, 1.0)
        return method.attitude(state), method.covariance and method.covariance(state), state.nav

    point = filt, nav_off(np.zeros(3))
    ones = jax.tree.map(lambda a: np.ones_like(a, dtype=float), point)
    tangent = jax.jit(lambda *given: jax.jvp(after, *given)[1])(point, ones)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tangent))
