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

from sinsjax.alignment.error_growth import ErrorParams, IncrementNoise
from sinsjax.alignment.schedules import mix
from sinsjax.engine import metrics
from sinsjax.engine.lanes import Group
from sinsjax.engine.metrics import FIELDS
from sinsjax.engine.realisations import Environment, Static
from sinsjax.maths.algebra import Triangle, cholesky, triangle_index
from sinsjax.types import Array, Count, Scalar


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
    n = states_of(rows.shape[1])
    normals = standard_normals(environment.seed, len(rows), n, static.sampled_errors)
    over = partial(_over_records, static, environment.criteria, normals)
    return jax.vmap(over, in_axes=(-1, 0), out_axes=-1)(rows, floor)


def _over_records(
    static: Static, criteria: metrics.Criteria, normals: Array, rows: Array, floor: Scalar
) -> Spread:
    """`spread` of one run."""
    n, samples = normals.shape[1:]
    squares, triangle = n * n, n * (n + 1) // 2

    def over(carry: tuple, record: tuple[Scalar, Array, Array]) -> tuple[tuple, tuple]:
        s, e, outside = carry
        time, row, normal = record
        f, w, angles = jnp.split(row[FIELDS:], [squares, squares + triangle])
        f, angles = f.reshape(n, n), angles.reshape(3, n)
        noise = tuple(w)
        s = _propagated(f, s, noise)
        e = _sampled(f, cholesky(noise, n), e, normal)
        error = row[2] + sum(angles[2, i] * e[i] for i in range(n))
        now = [over_bands(criteria, error - floor), over_bands(criteria, error)]
        sigma = jnp.sqrt(jnp.stack([_variance(one, s) for one in angles]))
        return (s, e, mix(jnp.stack(now), time, outside)), (row[:3], sigma, row[3:6])

    zero = jnp.zeros_like(floor)
    nothing = jnp.zeros((2, len(criteria.bands), samples))
    begun = (zero,) * triangle, jnp.zeros((n, samples)), nothing
    (_, _, outside), told = jax.lax.scan(over, begun, (record_times(static), rows, normals))
    phi, sigma, belief = (a.T for a in told)
    return Spread(phi, sigma, belief, outside)


def states_of(fields: int) -> int:
    """How many states a watched method has that tells so many numbers: n^2 + n (n + 1)/2 + 3 n."""
    return next(n for n in range(fields) if n * n + n * (n + 1) // 2 + 3 * n == fields - FIELDS)


def record_times(static: Static) -> Array:
    """(records,) s."""
    return jnp.arange(1.0, static.records + 1) * (static.record_every * static.options.dt)


def over_bands(criteria: metrics.Criteria, error: Array) -> Array:
    """`metrics.outside` of errors of any shape, the bands before their axes."""
    outside = jnp.vectorize(partial(metrics.outside, criteria), signature="()->(b)")
    return jnp.moveaxis(outside(error), -1, 0)


def _propagated(f: Array, s: Triangle, w: Triangle) -> Triangle:
    """F S F' + W."""
    n = len(f)
    at = triangle_index(n)
    fs = [[sum(f[i, k] * s[at[k, j]] for k in range(n)) for j in range(n)] for i in range(n)]
    return tuple(
        sum(fs[i][k] * f[j, k] for k in range(n)) + w[at[i, j]]
        for i in range(n)
        for j in range(i, n)
    )


def _sampled(f: Array, root: list[list[Scalar]], e: Array, normal: Array) -> Array:
    """F e + L n of sampled errors, (n, samples)."""
    n = len(f)
    turned = [sum(f[i, j] * e[j] for j in range(n)) for i in range(n)]
    added = [sum(root[i][j] * normal[j] for j in range(i + 1)) for i in range(n)]
    return jnp.stack([a + b for a, b in zip(turned, added, strict=True)])


def _variance(row: Array, s: Triangle) -> Scalar:
    """A S a'."""
    n = len(row)
    at = triangle_index(n)
    terms = (row[i] * row[j] * s[at[i, j]] for i in range(n) for j in range(n))
    return jnp.maximum(sum(terms), 0.0)


def standard_normals(seed: Count, records: int, n: int, samples: int) -> Array:
    """(records, n, samples) standard normal numbers, half of them the others' opposites."""
    half = jax.random.normal(jax.random.key(seed), (records, n, samples // 2), float)
    return jnp.concatenate([half, -half], axis=-1)
