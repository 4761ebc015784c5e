"""When a filter feeds its estimate back and when its covariance is reset, as data.

Times are sample counts, kept as floating-point numbers: whole below 2^53, and compared without
leaving the vector units' float lanes.
"""

from typing import NamedTuple

import jax.numpy as jnp

from sinsjax.algebra import Triangle, triangle_index
from sinsjax.types import Array, Flag, Scalar


class Feedback(NamedTuple):
    """Closed-loop correction.

    Attributes:
        every: samples between two corrections.
        gain: share of the estimate fed back each time, 1 for all of it.
    """

    every: Scalar
    gain: Scalar


class Resets(NamedTuple):
    """A reset schedule ([P1] section 3.2) and what a reset does to P.

    Entries that touch the yaw state are multiplied by ``keep_yaw``, all others by ``keep``; then
    ``renew`` times the initial variance is added to each diagonal entry, ``renew_yaw`` times for
    yaw. So (0, 0, 1, 1) is the full reset to P0, (1, 0, 0, 1) resets yaw and clears its cross
    terms, and (a, a, 0, 0) multiplies P by a.

    Attributes:
        samples: (M,) counts of the samples after which P is reset, in any order; inf for none.
        keep: see above.
        keep_yaw: see above.
        renew: see above.
        renew_yaw: see above.
    """

    samples: Array
    keep: Scalar
    keep_yaw: Scalar
    renew: Scalar
    renew_yaw: Scalar


def reset_due(resets: Resets, n: Scalar) -> Flag:
    """Whether P is reset after the n-th sample."""
    due = jnp.asarray(False)
    for sample in resets.samples:
        due = due | (n == sample)
    return due


def reset_covariance(
    resets: Resets, due: Flag, p: Triangle, p0: tuple[Scalar, ...], *, yaw: int
) -> Triangle:
    """P after a reset where one is due, P as it is elsewhere.

    Args:
        resets: schedule.
        due: whether to reset now.
        p: covariance of n states.
        p0: n initial variances.
        yaw: number of the yaw state.
    """
    keep = jnp.where(due, resets.keep, 1.0)
    keep_yaw = jnp.where(due, resets.keep_yaw, 1.0)
    renew = jnp.where(due, resets.renew, 0.0)
    renew_yaw = jnp.where(due, resets.renew_yaw, 0.0)
    out = list(p)
    for (i, j), k in triangle_index(len(p0)).items():
        if i <= j:
            out[k] = p[k] * (keep_yaw if yaw in (i, j) else keep)
        if i == j:
            out[k] = out[k] + (renew_yaw if i == yaw else renew) * p0[i]
    return tuple(out)
