"""The spread of a study's runs from one noise-free run of each variant: linear covariance analysis.

The noise-free run is the mean; beside it go the closed loop F of each record interval and the
covariance W of the noise that enters in it (`alignment.error_growth`). S <- F S F' + W is the
covariance of the true error, and e <- F e + chol(W) n are errors as runs with noise would have
them, which are judged as runs are.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.alignment import coloured_growth
from sinsjax.alignment.error_growth import ErrorParams, IncrementNoise
from sinsjax.alignment.schedules import mix
from sinsjax.engine import coloured_spread, metrics
from sinsjax.engine.lanes import Group
from sinsjax.engine.metrics import FIELDS
from sinsjax.engine.realisations import Environment, Static
from sinsjax.maths.algebra import Triangle, cholesky, triangle_index
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.types import Array, Count, Scalar

MOST_TOGETHER = 256
"""Sampled errors of a run that go side by side; multiples of them follow one another."""


class Spread(NamedTuple):
    """Of the errors of runs about their noise-free run; runs are the last axis of each leaf.

    Attributes:
        phi: (3, records) misalignment of the noise-free run, e, n, u, rad.
        sigma: (3, records) standard deviation of the misalignment about it, rad.
        belief: (3, records) that which the method itself tells, rad.
        outside_until: (2, B, samples) as `Metrics.outside_until`, of sampled errors.
    """

    phi: Array
    sigma: Array
    belief: Array
    outside_until: Array

    def at(self, records: Array | None) -> "Spread":
        """The same at some records alone, None for all, of leaves (3, records, ...)."""
        if records is None:
            return self
        phi, sigma, belief = (a[:, records] for a in self[:3])
        return Spread(phi, sigma, belief, self.outside_until)


def watched_program(static: Static, samples: int) -> Static:
    """The program of `watched` groups."""
    return static._replace(sampled_errors=samples, noisy=False, curves=True)


def watched(group: Group, samples: int, records: np.ndarray | None = None) -> Group:
    """The noise-free group of one draw whose runs tell the spread of those with noise.

    Args:
        group: of one draw.
        samples: sampled errors of a run, an even number; the same numbers for all runs.
        records: numbers, from 0, of the records at which the spread is told; None for all.
    """
    errors = group.environment.errors
    noise = IncrementNoise(_variances(errors.accel_noise), _variances(errors.gyro_noise))
    like = np.zeros_like(group.variants.ve)
    dt = group.static.options.dt
    coloured = coloured_growth.increments(group.environment.disturbances, dt)
    params = ErrorParams(
        group.variants.method,
        jax.tree.map(lambda a: a + like, noise),
        jax.tree.map(lambda a: np.broadcast_to(a, (len(like), *np.shape(a))), coloured),
    )
    undisturbed = group.environment._replace(disturbances=Disturbances())
    return group._replace(
        static=watched_program(group.static, samples),
        environment=undisturbed._replace(spread_at=records, coloured=coloured),
        variants=group.variants._replace(method=params),
    )


def spread(static: Static, environment: Environment, rows: Array, floor: Array) -> Spread:
    """Mean, covariance and sampled errors from what a watched method tells record by record.

    Args:
        static: program.
        environment: shared by all.
        rows: (records, fields, lanes): the observation, F, W, and phi by the states.
        floor: (lanes,) what phi_u should settle to, rad.
    """
    samples, key = static.sampled_errors, jax.random.key(environment.seed)
    blocks = 1 if samples % MOST_TOGETHER else samples // MOST_TOGETHER
    if blocks == 1:
        return _spread(static, environment, rows, floor, key)
    few = static._replace(sampled_errors=MOST_TOGETHER)

    def of_block(number: Count) -> Spread:
        return _spread(few, environment, rows, floor, jax.random.fold_in(key, number))

    found = jax.lax.map(of_block, jnp.arange(blocks))
    phi, sigma, belief = (a[0] for a in found[:3])
    # The second half of a block has the opposite noise of the first; so has that of all.
    _, sides, bands, _, lanes = found.outside_until.shape
    halves = found.outside_until.reshape(blocks, sides, bands, 2, MOST_TOGETHER // 2, lanes)
    outside = jnp.moveaxis(halves, 0, 3).reshape(sides, bands, samples, lanes)
    return Spread(phi, sigma, belief, outside)


def _spread(
    static: Static, environment: Environment, rows: Array, floor: Array, key: Array
) -> Spread:
    """`spread`, of sampled errors from one key."""
    sizes = coloured_spread.widths(environment.coloured)
    n, criteria = states_of(rows.shape[1], sum(sizes)), environment.criteria
    lanes, samples = len(floor), static.sampled_errors
    half, every = samples // 2, n + sum(sizes)
    normals = jax.random.normal(key, (len(rows), every, half), float)
    outside = jnp.zeros((lanes, 2, len(criteria.bands), samples))
    if sizes:
        over_interval = coloured_spread.inputs(environment.coloured, static.record_every)
        begun = _begun(over_interval, every, half, outside, key)
        one_record = partial(_over_coloured_record, criteria, over_interval, sizes, n)
    else:
        zero, none = jnp.zeros_like(floor), jnp.zeros((lanes, half))
        begun = _Carry((zero,) * (n * (n + 1) // 2), (none,) * n, outside)
        one_record = partial(_over_record, criteria)
    over_lanes = jax.vmap(one_record, in_axes=(0, None, None, 0, 0))

    def over(carry: _Carry, record: tuple[Scalar, Array, Array]) -> tuple[_Carry, Array]:
        time, row, normal = record
        # Numbers of all lanes side by side: as matrices of each lane they would be gathered.
        carry, told = over_lanes(carry, time, tuple(normal), tuple(row), floor)
        return carry, jnp.stack(told)  # several arrays XLA would copy with every record

    ended, told = jax.lax.scan(over, begun, (record_times(static), rows, normals))
    phi, sigma, belief = jnp.split(jnp.moveaxis(told, 0, 1), 3)
    return Spread(phi, sigma, belief, jnp.moveaxis(ended.outside, 0, -1))


def _begun(
    over: coloured_spread.Inputs, every: int, half: int, outside: Array, key: Array
) -> "_Carry":
    """Of so many states, before the first record: no error, and processes as they always are."""
    m = len(over.begin)
    normal = jax.random.normal(jax.random.fold_in(key, 2**31), (m, half), float)
    s = jnp.zeros((every, every)).at[every - m :, every - m :].set(over.begin @ over.begin.T)
    e = jnp.zeros((every, half)).at[every - m :].set(over.begin @ normal)
    s, e = (jnp.broadcast_to(a, (len(outside), *a.shape)) for a in (s, e))
    return _Carry(s, e, outside)


def _variances(sigmas: np.ndarray) -> tuple[np.float64, ...]:
    """Of the three axes, or one where all are alike."""
    return tuple(np.unique(sigmas) ** 2) if np.ptp(sigmas) == 0 else tuple(sigmas**2)


class _Carry(NamedTuple):
    """Of one run: S, half of the sampled errors by state (samples / 2,), and outside until, s.

    The other half has the opposite noise. ``outside`` is (2, B, samples).
    """

    s: Triangle | Array
    e: tuple[Array, ...] | Array
    outside: Array


def _over_record(
    criteria: metrics.Criteria,
    carry: _Carry,
    time: Scalar,
    normal: tuple[Array, ...],
    row: tuple[Scalar, ...],
    floor: Scalar,
) -> tuple[_Carry, tuple[Scalar, ...]]:
    """One run's errors a record interval later: misalignment, its sigma, the method's own sigma."""
    n, told = len(normal), row[FIELDS:]
    f = [told[i * n : (i + 1) * n] for i in range(n)]
    w = told[n * n : -3 * n]
    angles = [told[len(told) - (3 - i) * n :][:n] for i in range(3)]
    s, root = _propagated(f, carry.s, w), cholesky(w, n)
    e = tuple(
        sum(f[i][j] * carry.e[j] for j in range(n))
        + sum(root[i][j] * normal[j] for j in range(i + 1))
        for i in range(n)
    )
    away = sum(a * one for a, one in zip(angles[2], e, strict=True))
    now = _outside(criteria, row[2], away, floor)
    sigma = (jnp.sqrt(_variance(one, s)) for one in angles)
    outside = mix(now, time, carry.outside)
    return _Carry(s, e, outside), (*row[:3], *sigma, *row[3:6])


def _over_coloured_record(
    criteria: metrics.Criteria,
    over: coloured_spread.Inputs,
    sizes: tuple[int, ...],
    n: int,
    carry: _Carry,
    time: Scalar,
    normal: tuple[Array, ...],
    row: tuple[Scalar, ...],
    floor: Scalar,
) -> tuple[_Carry, tuple[Scalar, ...]]:
    """As `_over_record`, with the states of processes beside d."""
    told = jnp.stack(row[FIELDS:])
    w, at = n * n, triangle_index(n)
    angles = w + n * (n + 1) // 2
    whole = jnp.stack([told[w + at[i, j]] for i in range(n) for j in range(n)]).reshape(n, n)
    f, w_all = coloured_spread.joined(
        told[:w].reshape(n, n), whole, told[angles + 3 * n :], over, sizes
    )
    rows = told[angles : angles + 3 * n].reshape(3, n)
    s = f @ carry.s @ f.T + w_all
    e = f @ carry.e + coloured_spread.factor(w_all) @ jnp.stack(normal)
    away = rows[2] @ e[:n]
    now = _outside(criteria, row[2], away, floor)
    sigma = jnp.sqrt(jnp.maximum(jnp.einsum("ij,jk,ik->i", rows, s[:n, :n], rows), 0.0))
    return _Carry(s, e, mix(now, time, carry.outside)), (*row[:3], *sigma, *row[3:6])


def _outside(criteria: metrics.Criteria, mean: Scalar, away: Array, floor: Scalar) -> Array:
    """(2, B, samples) whether errors about a mean are outside the bands, rad.

    Args:
        criteria: with the bands.
        mean: of phi_u.
        away: (samples / 2,) from it; as many have the opposite noise.
        floor: what phi_u should settle to.
    """
    error = mean + jnp.concatenate([away, -away])
    return jnp.stack([over_bands(criteria, error - floor), over_bands(criteria, error)])


def states_of(fields: int, coloured: int = 0) -> int:
    """How many states a watched method has that tells so many numbers of a record.

    n^2 of F, n (n + 1)/2 of W, 3 n of phi, and 2 n of each of the processes' states.
    """
    each = (n * n + n * (n + 1) // 2 + (3 + 2 * coloured) * n for n in range(fields))
    return next(n for n, count in enumerate(each) if count == fields - FIELDS)


def record_times(static: Static) -> Array:
    """(records,) s."""
    return jnp.arange(1.0, static.records + 1) * (static.record_every * static.options.dt)


def over_bands(criteria: metrics.Criteria, error: Array) -> Array:
    """`metrics.outside` of errors of any shape, the bands before their axes."""
    outside = jnp.vectorize(partial(metrics.outside, criteria), signature="()->(b)")
    return jnp.moveaxis(outside(error), -1, 0)


def _propagated(f: list[tuple[Scalar, ...]], s: Triangle, w: Triangle) -> Triangle:
    """F S F' + W."""
    n = len(f)
    at = triangle_index(n)
    fs = [[sum(f[i][k] * s[at[k, j]] for k in range(n)) for j in range(n)] for i in range(n)]
    return tuple(
        sum(fs[i][k] * f[j][k] for k in range(n)) + w[at[i, j]]
        for i in range(n)
        for j in range(i, n)
    )


def _variance(row: tuple[Scalar, ...], s: Triangle) -> Scalar:
    """A S a'."""
    n = len(row)
    at = triangle_index(n)
    terms = (row[i] * row[j] * s[at[i, j]] for i in range(n) for j in range(n))
    return jnp.maximum(sum(terms), 0.0)
