"""The spread of a study's runs from one noise-free run of each variant: linear covariance analysis.

The noise-free run is the mean; beside it go the closed loop F of each record interval and the
covariance W of the noise that enters in it (`alignment.error_growth`). S <- F S F' + W is the
covariance of the true error, and e <- F e + chol(W) n are errors as runs with noise would have
them, which are judged as runs are.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.alignment.error_growth import ErrorParams, IncrementNoise
from sinsjax.engine import metrics
from sinsjax.engine.lanes import Group
from sinsjax.engine.metrics import FIELDS
from sinsjax.engine.realisations import Environment, Static
from sinsjax.maths.algebra import Triangle, cholesky, triangle_index
from sinsjax.types import Array, Count


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


def watched(group: Group, samples: int) -> Group:
    """The noise-free group of one draw whose runs tell the spread of those with noise.

    Args:
        group: of one draw.
        samples: sampled errors of a run, an even number; the same numbers for all runs.
    """
    errors = group.environment.errors
    noise = IncrementNoise(tuple(errors.accel_noise**2), tuple(errors.gyro_noise**2))
    like = np.zeros_like(group.variants.ve)
    params = ErrorParams(group.variants.method, jax.tree.map(lambda a: a + like, noise))
    return group._replace(
        static=group.static._replace(sampled_errors=samples, noisy=False, curves=True),
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
    n, samples = states_of(rows.shape[1]), static.sampled_errors
    squares = n * n
    normals = standard_normals(environment.seed, len(rows), n, samples)
    zero = jnp.zeros_like(floor)
    criteria = environment.criteria

    def over(carry: tuple, record: tuple[Array, Array, Array]) -> tuple[tuple, tuple]:
        s, e, outside = carry
        number, row, normal = record
        told = row[FIELDS:]
        f = [[told[i * n + j] for j in range(n)] for i in range(n)]
        w = tuple(told[squares + k] for k in range(len(at_entries)))
        angles = [[told[squares + len(w) + i * n + j] for j in range(n)] for i in range(3)]
        s = _propagated(f, s, w)
        e = _sampled(f, e, cholesky(w, n), normal)
        sigma = jnp.sqrt(jnp.stack([_variance(a, s) for a in angles]))
        error = row[2] + sum(a * d for a, d in zip(angles[2], e, strict=True))
        time = (number + 1) * static.record_every * static.options.dt
        now = jnp.stack([over_bands(criteria, error - floor), over_bands(criteria, error)])
        return (s, e, metrics.mix(now, time, outside)), (row[:3], sigma, row[3:6])

    at_entries = range(n * (n + 1) // 2)
    s = tuple(zero for _ in at_entries)
    e = tuple(jnp.zeros((samples, *zero.shape)) for _ in range(n))
    outside = jnp.zeros((2, len(criteria.bands), samples, *zero.shape))
    numbers = jnp.arange(len(rows))
    (_, _, outside), told = jax.lax.scan(over, (s, e, outside), (numbers, rows, normals))
    phi, sigma, belief = (jnp.moveaxis(a, 0, 1) for a in told)
    return Spread(phi, sigma, belief, outside)


def states_of(fields: int) -> int:
    """How many states a watched method has that tells so many numbers: n^2 + n (n + 1)/2 + 3 n."""
    return next(n for n in range(fields) if n * n + n * (n + 1) // 2 + 3 * n == fields - FIELDS)


def over_bands(criteria: metrics.Criteria, error: Array) -> Array:
    """`metrics.outside` with the bands before the axes of the errors."""
    return jnp.moveaxis(metrics.outside(criteria, error[..., None]), -1, 0)


def _propagated(f: list[list[Array]], s: Triangle, w: Triangle) -> Triangle:
    """F S F' + W."""
    n = len(f)
    at = triangle_index(n)
    fs = [[sum(f[i][k] * s[at[k, j]] for k in range(n)) for j in range(n)] for i in range(n)]
    return tuple(
        sum(fs[i][k] * f[j][k] for k in range(n)) + w[at[i, j]]
        for i in range(n)
        for j in range(i, n)
    )


def _sampled(
    f: list[list[Array]], e: tuple[Array, ...], root: list[list[Array]], normal: Array
) -> tuple[Array, ...]:
    """F e + L n."""
    n = len(f)
    return tuple(
        sum(f[i][j] * e[j] for j in range(n))
        + sum(root[i][j] * normal[j][:, None] for j in range(i + 1))
        for i in range(n)
    )


def _variance(row: list[Array], s: Triangle) -> Array:
    """A S a'."""
    n = len(row)
    at = triangle_index(n)
    terms = (row[i] * row[j] * s[at[i, j]] for i in range(n) for j in range(n))
    return jnp.maximum(sum(terms), 0.0)


def standard_normals(seed: Count, records: int, n: int, samples: int) -> Array:
    """(records, n, samples) standard normal numbers, half of them the others' opposites."""
    half = jax.random.normal(jax.random.key(seed), (records, n, samples // 2), float)
    return jnp.concatenate([half, -half], axis=-1)
