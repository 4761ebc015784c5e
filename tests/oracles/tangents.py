"""The covariance of the true error by derivatives of a method's own steps, whatever it tells of it.

All numbers of a run's state are carried as they are, those of P too: gains that follow the error
are part of the linear part. It takes some sixty times as long as a plain run, and knows nothing of
error models.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from support.alone import set_up_alone

from sinsjax.engine.environment import RunParams, stored_attitude
from sinsjax.engine.lanes import Group
from sinsjax.engine.samples import previous_increments
from sinsjax.maths import rotations
from sinsjax.methods import passes
from sinsjax.types import Increments, Quat, Vec3

BLOCK = 50
"""Samples over which the noise is held, scaled so that the variance of its sum stays. Sigma is then
off by 0.3 %."""


class Spread(NamedTuple):
    """Of the runs of some variants, (variants, records, 3) each, about e, n, u, rad.

    Attributes:
        phi: misalignment of the noise-free run.
        sigma: standard deviation about it.
    """

    phi: np.ndarray
    sigma: np.ndarray


def spread(group: Group, block: int = BLOCK) -> Spread:
    """Mean and sigma of the misalignment of all variants of a group's first draw.

    Args:
        group: simulated in a single pass, of white noise.
        block: samples over which the noise is held; it divides those of a record interval.
    """
    first = jax.tree.map(lambda a: np.asarray(a[0] if np.ndim(a) else a), group.draws)
    static = group.static._replace(sensors=group.static.sensors._replace(noisy=False))
    params = group.variants._replace(q=None)
    q = Quat(*map(np.asarray, group.q[0]))

    def one(params: RunParams) -> Spread:
        return _one(static, group.environment, first, params._replace(q=q), block)

    made = jax.jit(jax.vmap(one))(params)
    return Spread(*map(np.asarray, made))


def _one(static, environment, draw, params: RunParams, block: int) -> Spread:
    runs = set_up_alone(static, environment, draw, params)
    method, site, method_params = runs.method, runs.site, jax.tree.map(_only, runs.params.method)
    start, restore = ravel_pytree(jax.tree.map(_only, runs.start().state))
    blocks = static.record_every // block
    noise = _of_a_sample(environment.sensors.errors, block)
    truth = stored_attitude(environment.truth, draw, jnp.arange(static.records))

    def over_block(vector, w, samples):
        """The state's numbers a block later; w are six standard normal numbers."""
        held = jax.tree.map(lambda size, one: size * one, noise, _split(w))

        def over_sample(state, xs):
            n, increments, earlier = xs
            off = jax.tree.map(jnp.add, increments, held)
            sample = passes.compensate(off, earlier, None)
            state = method.step(method_params, site, state, sample, n)
            if method.feedback is not None:
                state = method.feedback.close(method_params, state, n)
            return state, None

        state, _ = jax.lax.scan(over_sample, restore(vector), samples)
        return ravel_pytree(state)[0]

    def spread_over_block(carry, samples):
        vector, s = carry
        at = vector, jnp.zeros(6)
        f, g = jax.jacfwd(over_block, argnums=(0, 1))(*at, samples)
        return (over_block(*at, samples), f @ s @ f.T + g @ g.T), None

    def misalignment(q_true: Quat, vector):
        state = method.normalise(restore(vector))
        return jnp.stack(rotations.misalignment(q_true, method.attitude(state)))

    def over_record(carry, record):
        (vector, s), before = carry
        number, q_true = record
        places = number * static.record_every + jnp.arange(static.record_every)
        measure = runs.sensors.make_sampler(places)
        increments, before = measure(before, jnp.arange(static.record_every))
        increments = jax.tree.map(lambda a: a[:, 0], increments)
        earlier, last = previous_increments(increments, jax.tree.map(_only, before.last))
        last = jax.tree.map(lambda a: a[None], last)
        n = (places + 1).astype(environment.dtype)
        samples = jax.tree.map(
            lambda a: a.reshape(blocks, block, *a.shape[1:]), (n, increments, earlier)
        )
        (vector, s), _ = jax.lax.scan(spread_over_block, (vector, s), samples)
        rows = jax.jacfwd(partial(misalignment, q_true))(vector)
        sigma = jnp.sqrt(jnp.einsum("ai,ij,aj->a", rows, s, rows))
        told = misalignment(q_true, vector), sigma
        return ((vector, s), before._replace(last=last)), told

    begun = (start, jnp.zeros((start.size, start.size))), runs.sensors.initial_state()
    _, told = jax.lax.scan(over_record, begun, (jnp.arange(static.records), truth))
    return Spread(*told)


def _only(a):
    """The single lane, or draw."""
    return a[0]


def _of_a_sample(errors, block: int) -> Increments:
    """Standard deviations of the noise of a sample's increments, held over a block."""
    gyro, accel = (sigmas / np.sqrt(block) for sigmas in (errors.gyro_noise, errors.accel_noise))
    return Increments(dtheta=Vec3(*gyro), dv=Vec3(*accel))


def _split(w) -> Increments:
    return Increments(dtheta=Vec3(*w[:3]), dv=Vec3(*w[3:]))
