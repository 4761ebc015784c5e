"""The spread of a study's runs from one noise-free run of each variant: linear covariance analysis.

The noise-free run is the mean; beside it go the closed loop F of each record interval and the
covariance W of the noise that enters in it (`methods.error_growth`). S <- F S F' + W is the
covariance of the true error, and e <- F e + chol(W) n are errors as runs with noise would have
them, which are judged as runs are.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.engine import coloured_spread, metrics
from sinsjax.engine.lanes import Group
from sinsjax.engine.metrics import FIELDS
from sinsjax.engine.realisations import Environment, Static
from sinsjax.engine.sensitivity import Sensitivity, limit_by_states
from sinsjax.maths.algebra import Triangle, cholesky, triangle_index
from sinsjax.methods import coloured_growth
from sinsjax.methods.error_growth import ErrorParams, IncrementNoise
from sinsjax.methods.schedules import mix
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
        from_floor: (records,) standard deviation of phi_u from the bias floor of its run, rad; None
            where runs have the same bias floor.
    """

    phi: Array
    sigma: Array
    belief: Array
    outside_until: Array
    from_floor: Array | None = None

    def at(self, records: Array | None) -> "Spread":
        """The same at some records alone, None for all, of leaves (3, records, ...)."""
        if records is None:
            return self
        phi, sigma, belief = (a[:, records] for a in self[:3])
        from_floor = None if self.from_floor is None else self.from_floor[records]
        return Spread(phi, sigma, belief, self.outside_until, from_floor)


def watched_program(static: Static, samples: int) -> Static:
    """The program of `watched` groups."""
    return static._replace(sampled_errors=samples, noisy=False, curves=True)


def watched(group: Group, samples: int, records: np.ndarray | None = None) -> Group:
    """The noise-free group of one draw whose runs tell the spread of those with noise.

    Args:
        group: of one draw, whose own starts and biases give way to the means.
        samples: sampled errors of a run, an even number; the same numbers for all runs.
        records: numbers, from 0, of the records at which the spread is told; None for all.
    """
    errors = group.environment.errors
    noise = IncrementNoise(_variances(errors.accel_noise), _variances(errors.gyro_noise))
    like = np.zeros_like(group.variants.ve)
    dt = group.static.options.dt
    drawn, draws = group.environment.drawn, group.draws
    own = () if drawn is None else (drawn.gyro_bias_sigma, drawn.accel_bias_sigma)
    coloured = coloured_growth.increments(group.environment.disturbances, dt, *own)
    params = ErrorParams(
        group.variants.method,
        jax.tree.map(lambda a: a + like, noise),
        jax.tree.map(lambda a: np.broadcast_to(a, (len(like), *np.shape(a))), coloured),
    )
    undisturbed = group.environment._replace(disturbances=Disturbances())
    return group._replace(
        static=watched_program(group.static, samples),
        environment=undisturbed._replace(spread_at=records, coloured=coloured),
        draws=draws if drawn is None else drawn.mean(draws),
        variants=group.variants._replace(method=params),
    )


def spread(
    static: Static,
    environment: Environment,
    rows: Array,
    floor: Array,
    drawn: Sensitivity | None = None,
) -> Spread:
    """Mean, covariance and sampled errors from what a watched method tells record by record.

    Args:
        static: program.
        environment: shared by all.
        rows: (records, fields, lanes): the observation, F, W, and phi by the states.
        floor: (lanes,) what phi_u should settle to, rad.
        drawn: to what is drawn normally; None where nothing is.
    """
    samples, key = static.sampled_errors, jax.random.key(environment.seed)
    blocks = 1 if samples % MOST_TOGETHER else samples // MOST_TOGETHER
    if blocks == 1:
        return _spread(static, environment, rows, floor, drawn, key)
    few = static._replace(sampled_errors=MOST_TOGETHER)

    def of_block(number: Count) -> Spread:
        return _spread(few, environment, rows, floor, drawn, jax.random.fold_in(key, number))

    found = jax.lax.map(of_block, jnp.arange(blocks))
    phi, sigma, belief = (a[0] for a in found[:3])
    # The second half of a block has the opposite noise of the first; so has that of all.
    _, sides, bands, _, lanes = found.outside_until.shape
    halves = found.outside_until.reshape(blocks, sides, bands, 2, MOST_TOGETHER // 2, lanes)
    outside = jnp.moveaxis(halves, 0, 3).reshape(sides, bands, samples, lanes)
    from_floor = None if found.from_floor is None else found.from_floor[0]
    return Spread(phi, sigma, belief, outside, from_floor)


def _spread(
    static: Static,
    environment: Environment,
    rows: Array,
    floor: Array,
    drawn: Sensitivity | None,
    key: Array,
) -> Spread:
    """`spread`, of sampled errors from one key."""
    sizes = coloured_spread.widths(environment.coloured)
    n, criteria = states_of(rows.shape[1], sum(sizes)), environment.criteria
    lanes, samples = len(floor), static.sampled_errors
    half, every = samples // 2, n + sum(sizes)
    normals = jax.random.normal(key, (len(rows), every, half), float)
    outside = jnp.zeros((lanes, 2, len(criteria.bands), samples))
    start, moved = jnp.zeros((lanes, n, 0)), None
    if drawn is not None:
        assert environment.drawn is not None
        start = drawn.start * jnp.asarray(environment.drawn.begins_sigma)[None, None]
        moved = limit_by_states(drawn, environment.drawn, sum(sizes))
    if sizes:
        over_interval = coloured_spread.inputs(environment.coloured, static.record_every)
        begun = _Carry(*_begun(over_interval.begin, start, half, key), outside)
        one_record = partial(_over_coloured_record, criteria, over_interval, sizes, n)
    else:
        s, e = _begun(jnp.zeros((0, 0)), start, half, key)
        triangle = tuple(s[:, i, j] for i in range(n) for j in range(i, n))
        begun = _Carry(triangle, tuple(jnp.moveaxis(e, 1, 0)), outside)
        one_record = partial(_over_record, criteria)
    over_lanes = jax.vmap(one_record, in_axes=(0, None, None, 0, 0, 0))

    def over(carry: _Carry, record: tuple[Scalar, Array, Array]) -> tuple[_Carry, Array]:
        time, row, normal = record
        # Numbers of all lanes side by side: as matrices of each lane they would be gathered.
        carry, told = over_lanes(carry, time, tuple(normal), tuple(row), floor, moved)
        return carry, jnp.stack(told)  # several arrays XLA would copy with every record

    ended, told = jax.lax.scan(over, begun, (record_times(static), rows, normals))
    told = jnp.moveaxis(told, 0, 1)
    phi, sigma, belief = jnp.split(told[:9], 3)
    from_floor = told[9] if len(told) > 9 else None
    return Spread(phi, sigma, belief, jnp.moveaxis(ended.outside, 0, -1), from_floor)


def _begun(processes: Array, start: Array, half: int, key: Array) -> tuple[Array, Array]:
    """S and e before the first record: what draws begin with, and processes as they always are.

    Args:
        processes: (m, m) factor of their covariance.
        start: (lanes, n, k) that of d.
        half: how many errors are sampled.
        key: of the numbers of all records.

    Returns:
        (lanes, n + m, n + m) and (lanes, n + m, half).
    """
    lanes, n, k = start.shape
    every = n + len(processes)
    numbers = jax.random.normal(jax.random.fold_in(key, 2**31), (len(processes), half), float)
    s, e = jnp.zeros((lanes, every, every)), jnp.zeros((lanes, every, half))
    s = s.at[:, n:, n:].set((processes @ processes.T)[None])
    e = e.at[:, n:].set((processes @ numbers)[None])
    if k:
        own = jax.random.normal(jax.random.fold_in(key, 2**31 + 1), (k, half), float)
        s, e = s.at[:, :n, :n].set(start @ jnp.swapaxes(start, 1, 2)), e.at[:, :n].set(start @ own)
    return s, e


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
    moved: None,
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
    now = _outside(criteria, row[2], away, away, floor)
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
    moved: Array | None,
) -> tuple[_Carry, tuple[Scalar, ...]]:
    """As `_over_record`, with the states of processes beside d, which move the floor so far."""
    fields = jnp.stack(row[FIELDS:])
    w, at = n * n, triangle_index(n)
    angles = w + n * (n + 1) // 2
    whole = jnp.stack([fields[w + at[i, j]] for i in range(n) for j in range(n)]).reshape(n, n)
    f, w_all = coloured_spread.joined(
        fields[:w].reshape(n, n), whole, fields[angles + 3 * n :], over, sizes
    )
    rows = fields[angles : angles + 3 * n].reshape(3, n)
    s = f @ carry.s @ f.T + w_all
    e = f @ carry.e + coloured_spread.factor(w_all) @ jnp.stack(normal)
    from_truth = from_floor = rows[2] @ e[:n]
    sigma = jnp.sqrt(jnp.maximum(jnp.einsum("ij,jk,ik->i", rows, s[:n, :n], rows), 0.0))
    if moved is not None:
        beyond = jnp.concatenate([rows[2], -moved])
        from_floor = beyond @ e
        sigma = jnp.append(sigma, jnp.sqrt(jnp.maximum(beyond @ s @ beyond, 0.0)))
    now = _outside(criteria, row[2], from_floor, from_truth, floor)
    told = (*row[:3], *sigma[:3], *row[3:6], *sigma[3:])
    return _Carry(s, e, mix(now, time, carry.outside)), told


def _outside(
    criteria: metrics.Criteria,
    mean: Scalar,
    from_floor: Array,
    from_truth: Array,
    floor: Scalar,
) -> Array:
    """(2, B, samples) whether errors about a mean are outside the bands, rad.

    Args:
        criteria: with the bands.
        mean: of phi_u.
        from_floor: (samples / 2,) what they have beyond it of their floor; as many have the
            opposite noise.
        from_truth: likewise, of the truth.
        floor: what phi_u should settle to, of the mean.
    """
    limit, truth = (mean + jnp.concatenate([a, -a]) for a in (from_floor, from_truth))
    return jnp.stack([over_bands(criteria, limit - floor), over_bands(criteria, truth)])


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
