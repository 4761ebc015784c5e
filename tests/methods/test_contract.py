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
from sinsjax.methods.method import Options
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import sensors

pytestmark = pytest.mark.optimised(False)

RATE, SECONDS, LATITUDE = 100, 60, 32 * DEG
SWING = PAPER1._replace(center=np.array([0.05, -0.1, 2.0]))

FITTED = [name for name, method in METHODS.items() if method.program.block_fit]
STEPPED = [name for name in METHODS if name not in FITTED]


def method_of(name, **choices):
    blocks = {"record_every": RATE, "records": SECONDS} if name in FITTED else {}
    return METHODS[name].build(Options(1 / RATE, **blocks | choices))


@cache
def numbers(name, **alignment):
    """The method's params of a small study."""
    group = Scenario(small_study(alignment={"method": name} | alignment)).batch(0)
    return jax.tree.map(lambda a: np.asarray(a)[0], group.params.method)


def nav_off(phi, v=(0.0, 0.0)):
    return navigation(exp(-np.asarray(phi)) @ SWING.matrix(0.0), v, LATITUDE)


@cache
def increments():
    """Two seconds of a swing."""
    return swing_increments(SWING, PAPER, LATITUDE, rate=RATE, samples=2 * RATE)


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
    method = method_of(name, specific_force=force, position=position)
    here, given, rows = site(PAPER, LATITUDE), numbers(name), increments()

    @jax.jit
    def final_covariance(nav):
        def step(state, xs):
            return step_and_close(method, given, here, state, *xs), None

        read = sensors.compensate_record(rows, rows[0]), 1.0 + jnp.arange(float(len(rows)))
        return jax.lax.scan(step, method.init(given, nav), read)[0].belief.p

    off = nav_off(np.array([1.0, -2.0, 5.0]) * DEG, (0.3, 0.4))
    one, other = map(final_covariance, (off, nav_off(np.zeros(3))))
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
