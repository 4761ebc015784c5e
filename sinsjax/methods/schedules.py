"""Schedules of feedback, covariance resets and gains, as data.

Times are sample counts, kept as floating-point numbers: whole below 2^53, and compared without
leaving the vector units' float lanes.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths.algebra import Triangle, triangle_index
from sinsjax.types import Array, Flag, Scalar


class FeedbackSchedule(NamedTuple):
    """Times and gain of the closed-loop correction."""

    every: Scalar  # samples between two corrections
    gain: Scalar  # share of the estimate fed back each time, 1 for all of it
    # 1 if a reset restarts the count to the next correction, 0 if the count continues; None if
    # it continues in all runs
    restarts: Scalar | None = None


class CovarianceReset(NamedTuple):
    """Effect of a reset on P.

    Entries that touch a state of heading are multiplied by ``keep_yaw``, all others by ``keep``;
    then ``added`` times the variance that is reset to is added to each diagonal entry,
    ``added_yaw`` times for heading. So (0, 0, 1, 1) is the full reset, (1, 0, 0, 1) resets heading
    and clears its cross terms, (a, a, 0, 0) multiplies P by a, and (1, 1, 0, 0) leaves it.
    """

    keep: Scalar
    keep_yaw: Scalar
    added: Scalar
    added_yaw: Scalar


UNCHANGED = CovarianceReset(1.0, 1.0, 0.0, 0.0)
"""The covariance reset that leaves P as it is."""


class Resets(NamedTuple):
    """A reset schedule, [P1] section 3.2: what a reset does, and when.

    Smoothed, each reset is spread over a window, so that the outcome of a run can be differentiated
    by the times; the narrower the windows, the closer to hard resets. Only for covariance resets
    whose ``keep`` and ``keep_yaw`` are 0 or 1, such as 'full' and 'yaw': of these the parts, one
    after the other, make what a hard reset makes at once.
    """

    # (M,) samples after which, or about which, P is reset, in any order; inf for none
    samples: Array
    covariance_reset: CovarianceReset  # effect of a reset
    # Half the width of a window, some tens of samples or more: a shorter window leaves more
    # than it should, as 1/(1 + h) is not exp(-h). None for hard resets.
    width: Scalar | None = None


class PiecewiseConstant(NamedTuple):
    """A number that is constant between given samples."""

    samples: Array  # (M,) samples after which the number changes, increasing; inf for none
    values: Array  # (M + 1,) its values before the first change and after each


_NEVER = 1e15
"""Sample of a reset that never takes place; infinity has no derivative."""

WINDOW_STRENGTH = 8.0
"""A smoothed reset leaves exp(-8), 3e-4, of what a hard one removes."""


def smooth_resets(params: Any, width: Any) -> Any:
    """Return a method's params with each reset spread over a window; themselves without any."""

    def is_schedule(part: Any) -> bool:
        return isinstance(part, Resets)

    def smooth(part: Any) -> Any:
        if not is_schedule(part):
            return part
        samples = jnp.where(jnp.isfinite(part.samples), part.samples, _NEVER)
        return part._replace(samples=samples, width=width)

    if not any(map(is_schedule, jax.tree.leaves(params, is_leaf=is_schedule))):
        return params
    return jax.tree.map(smooth, params, is_leaf=is_schedule)


def reset_due(resets: Resets, n: Scalar) -> Flag | Scalar:
    """Return whether P is reset after the n-th sample; of a smoothed schedule, the share."""
    if resets.width is None:
        due = jnp.asarray(False)
        for sample in resets.samples:
            due = due | (n == sample)
        return due
    left = jnp.ones_like(resets.width)
    for sample in resets.samples:
        place = (n - sample) / resets.width
        # A biweight, whose integral over the window is 1: its slope is continuous.
        bump = 15 / 16 * jnp.maximum(1 - place * place, 0.0) ** 2 / resets.width
        left = left / (1 + WINDOW_STRENGTH * bump)
    return 1 - left


def next_due(feedback_at: Scalar, resets: Resets, n: Scalar) -> Scalar:
    """Return the sample of the first feedback or reset after the n-th sample."""
    ahead = jnp.where(resets.samples > n, resets.samples, jnp.inf)
    return jnp.minimum(jnp.ceil(feedback_at), jnp.min(ahead, initial=jnp.inf))


def next_feedback(
    feedback: FeedbackSchedule, feedback_at: Scalar, reset: Flag | Scalar, n: Scalar
) -> Scalar:
    """Return when the next feedback after the n-th sample is; before that it was ``feedback_at``.

    Both are counts of samples, and may lie between two.
    """
    later = jnp.where(n >= feedback_at, feedback_at + feedback.every, feedback_at)
    if feedback.restarts is None:
        return later
    return jnp.where(reset & (feedback.restarts > 0), n + feedback.every, later)


def interpolate(share: Array, one: Array | float, other: Array | float) -> Array:
    """Return ``one`` if a flag is set, else ``other``; for a share, the weighted mean of both."""
    if jnp.issubdtype(jnp.result_type(share), bool):
        return jnp.where(share, one, other)
    return other + share * (one - other)


def reset_covariance(
    effect: CovarianceReset, p: Triangle, variances: Sequence[Scalar], heading: Sequence[int]
) -> Triangle:
    """Return P after a reset, given the variances that it resets to and the heading's states."""
    keep, keep_yaw, new, new_yaw = effect
    out = list(p)
    for (i, j), k in triangle_index(len(variances)).items():
        if i <= j:
            out[k] = p[k] * (keep_yaw if i in heading or j in heading else keep)
        if i == j:
            out[k] = out[k] + (new_yaw if i in heading else new) * variances[i]
    return tuple(out)


def value_at(number: PiecewiseConstant, n: Scalar) -> Scalar:
    """Return the value during the n-th sample."""
    value = number.values[0]
    for begin, later in zip(number.samples, number.values[1:], strict=True):
        value = jnp.where(n > begin, later, value)
    return value
