"""The spread of runs whose inputs are not all white: covariance of the error and of the inputs.

The states of the processes (`strapdown.processes`) stand beside the error d of the corrected
solution. What a record interval makes of all of them is put together from what a watched method
tells of d (`methods.error_growth`) and from the processes themselves, the same for all runs.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag

from sinsjax.methods import coloured_growth
from sinsjax.methods.coloured_growth import Coloured
from sinsjax.strapdown.processes import Process
from sinsjax.types import Array

_LEAST_SHARE = 1e-12
"""Of a variance: what others leave of it less than that is rounding."""


class Inputs(NamedTuple):
    """The processes over a record interval; m their states on all axes.

    Attributes:
        transition: (m, m).
        noise: (m, m) covariance of what is driven meanwhile.
        begin: (m, m) factor of the covariance before the first sample.
    """

    transition: Array
    noise: Array
    begin: Array


def widths(coloured: Coloured) -> tuple[int, ...]:
    """States of each process on its three axes."""
    return tuple(3 * one.output.shape[-1] for one, _ in coloured_growth.each(coloured))


def inputs(coloured: Coloured, samples: int) -> Inputs:
    """What processes do over an interval of so many samples."""
    each = [_over(process, samples) for process, _ in coloured_growth.each(coloured)]
    return Inputs(*(block_diag(*matrices) for matrices in zip(*each, strict=True)))


def _over(process: Process, samples: int) -> tuple[Array, Array, Array]:
    a, b = jnp.asarray(process.transition), jnp.asarray(process.drive)

    def later(_: Array, moments: tuple[Array, Array]) -> tuple[Array, Array]:
        power, noise = moments
        return a @ power, a @ noise @ a.T + jnp.outer(b, b)

    begun = jnp.eye(len(b)), jnp.zeros((len(b), len(b)))
    power, noise = jax.lax.fori_loop(0, samples, later, begun)
    axes = jnp.eye(3)
    return jnp.kron(power, axes), jnp.kron(noise, axes), jnp.kron(process.begin, axes)


def joined(
    f: Array, w: Array, told: Array, over: Inputs, sizes: tuple[int, ...]
) -> tuple[Array, Array]:
    """F and W of d and of the processes together.

    Args:
        f: (n, n) of d.
        w: (n, n) likewise, of white noise and of the processes.
        told: what the method has of each process, see `coloured_growth.told`.
        over: the interval.
        sizes: `widths`.
    """
    n, m = len(f), sum(sizes)
    ends = np.cumsum(np.repeat(sizes, 2) * n)
    parts = [part.reshape(n, -1) for part in jnp.split(told, ends[:-1])]
    response, cross = (jnp.concatenate(parts[kind::2], axis=1) for kind in (0, 1))
    whole = jnp.block([[f, response], [jnp.zeros((m, n)), over.transition]])
    return whole, jnp.block([[w, cross], [cross.T, over.noise]])


def factor(p: Array) -> Array:
    """Lower triangular L with P = L L', P symmetric and positive semidefinite (n, n).

    What rounding leaves of a variance that others explain wholly counts as nothing.
    """
    n = len(p)
    out = jnp.zeros_like(p)
    for j in range(n):
        left = p[j, j] - jnp.sum(out[j] ** 2)
        is_told = left > _LEAST_SHARE * p[j, j]
        root = jnp.sqrt(jnp.where(is_told, left, 1.0))
        column = jnp.where(is_told, (p[:, j] - out @ out[j]) / root, 0.0)
        out = out.at[:, j].set(jnp.where(jnp.arange(n) >= j, column, 0.0))
    return out
