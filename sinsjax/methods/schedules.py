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
    """Times and gain of the closed-loop correction.

    Attributes:
        every: samples between two corrections.
        gain: share of the estimate fed back each time, 1 for all of it.
        restarts: 1 if a reset restarts the count to the next correction, 0 if the count continues;
            None if it continues in all runs.
    """

    every: Scalar
    gain: Scalar
    restarts: Scalar | None = None


class CovarianceReset(NamedTuple):
    """Effect of a reset on P.

    Entries that touch a state of heading are multiplied by ``keep_yaw``, all others by ``keep``;
    then ``added`` times the variance that is reset to is added to each diagonal entry,
    ``added_yaw`` times for heading. So (0, 0, 1, 1) is the full reset, (1, 0, 0, 1) resets heading
    and clears its cross terms, (a, a, 0, 0) multiplies P by a, and (1, 1, 0, 0) leaves it.

    Attributes:
        keep: factor on entries of other states.
        keep_yaw: factor on entries that touch heading.
        added: variances added to other states.
        added_yaw: variance added to heading.
    """

    keep: Scalar
    keep_yaw: Scalar
    added: Scalar
    added_yaw: Scalar


UNCHANGED = CovarianceReset(1.0, 1.0, 0.0, 0.0)
"""The covariance reset that leaves P as it is."""


class Resets(NamedTuple):
    """A reset schedule, [P1] section 3.2.

    Attributes:
        samples: (M,) counts of the samples after which P is reset, in any order; inf for none.
        covariance_reset: effect of a reset.
    """

    samples: Array
    covariance_reset: CovarianceReset


class Windows(NamedTuple):
    """A smoothed reset schedule: each reset is spread over a smooth window.

    The outcome of a run can then be differentiated by the times. The narrower the windows, the
    closer to `Resets`.

    Only for covariance resets whose ``keep`` and ``keep_yaw`` are 0 or 1, such as 'full' and 'yaw':
    of these the parts, one after the other, make what a hard reset makes at once.

    Attributes:
        samples: (M,) counts of the samples about which P is reset, in any order.
        width: half the width of a window, some tens of samples or more: a shorter window leaves
            more than it should, as 1/(1 + h) is not exp(-h).
        covariance_reset: total effect of the window of one reset.
    """

    samples: Array
    width: Scalar
    covariance_reset: CovarianceReset


class Due(NamedTuple):
    """The actions due after a sample.

    Attributes:
        feedback: whether the estimate is fed back.
        reset: whether P is reset; of a smoothed schedule, the share of a reset.
    """

    feedback: Flag
    reset: Flag | Scalar


def smooth_resets(params: Any, width: Any) -> Any:
    """Return the params of a method with each reset spread over a window; themselves without any.

    Args:
        params: of any method.
        width: see `Windows`.
    """
    found = False

    def smooth(part: Any) -> Any:
        nonlocal found
        if not isinstance(part, Resets):
            return part
        found = True
        samples = jnp.where(jnp.isfinite(part.samples), part.samples, _NEVER)
        return Windows(samples, width, part.covariance_reset)

    smoothed = jax.tree.map(smooth, params, is_leaf=lambda part: isinstance(part, Resets))
    return smoothed if found else params


_NEVER = 1e15
"""Sample of a reset that never takes place; infinity has no derivative."""

WINDOW_STRENGTH = 8.0
"""A smoothed reset leaves exp(-8), 3e-4, of what a hard one removes."""


class PiecewiseConstant(NamedTuple):
    """A number that is constant between given samples.

    Attributes:
        samples: (M,) samples after which the number changes, increasing; inf for none.
        values: (M + 1,) its values before the first change and after each.
    """

    samples: Array
    values: Array


def reset_due(resets: Resets | Windows, n: Scalar) -> Flag | Scalar:
    """Return whether P is reset after the n-th sample; of a smoothed schedule, the share."""
    if isinstance(resets, Windows):
        return _window_share(resets, n)
    due = jnp.asarray(False)
    for sample in resets.samples:
        due = due | (n == sample)
    return due


def next_due(feedback_at: Scalar, resets: Resets, n: Scalar) -> Scalar:
    """Return the sample of the first feedback or reset after the n-th sample.

    Args:
        feedback_at: sample of the next feedback.
        resets: reset schedule.
        n: number of a sample.
    """
    ahead = jnp.where(resets.samples > n, resets.samples, jnp.inf)
    return jnp.minimum(jnp.ceil(feedback_at), jnp.min(ahead, initial=jnp.inf))


def next_feedback(feedback: FeedbackSchedule, feedback_at: Scalar, due: Due, n: Scalar) -> Scalar:
    """Return the sample of the next feedback after the loop was closed at the n-th sample.

    Args:
        feedback: its schedule.
        feedback_at: sample of the next feedback before that.
        due: the actions at the n-th sample.
        n: number of that sample.
    """
    later = jnp.where(due.feedback, feedback_at + feedback.every, feedback_at)
    if feedback.restarts is None:
        return later
    return jnp.where(due.reset & (feedback.restarts > 0), n + feedback.every, later)


def _window_share(windows: Windows, n: Scalar) -> Scalar:
    left = jnp.ones_like(windows.width)
    for sample in windows.samples:
        place = (n - sample) / windows.width
        # A biweight, whose integral over the window is 1: its slope is continuous.
        bump = 15 / 16 * jnp.maximum(1 - place * place, 0.0) ** 2 / windows.width
        left = left / (1 + WINDOW_STRENGTH * bump)
    return 1 - left


def interpolate(share: Array, one: Array | float, other: Array | float) -> Array:
    """Return ``one`` if a flag is set, else ``other``; for a share, the weighted mean of both."""
    if jnp.issubdtype(jnp.result_type(share), bool):
        return jnp.where(share, one, other)
    return other + share * (one - other)


def reset_covariance(
    covariance_reset: CovarianceReset,
    p: Triangle,
    to: tuple[Scalar, ...],
    *,
    heading: Sequence[int],
) -> Triangle:
    """Return P after a reset.

    Args:
        covariance_reset: effect of the reset.
        p: covariance of n states.
        to: n variances that a full reset sets.
        heading: state numbers of heading.
    """
    keep, keep_yaw, new, new_yaw = covariance_reset
    out = list(p)
    for (i, j), k in triangle_index(len(to)).items():
        if i <= j:
            out[k] = p[k] * (keep_yaw if i in heading or j in heading else keep)
        if i == j:
            out[k] = out[k] + (new_yaw if i in heading else new) * to[i]
    return tuple(out)


def reset_if_due(due: Flag | Scalar, covariance_reset: CovarianceReset) -> CovarianceReset:
    """Return the reset if it is due, else the one that leaves P unchanged; or between them."""
    return CovarianceReset(
        *(interpolate(due, a, b) for a, b in zip(covariance_reset, UNCHANGED, strict=True))
    )


def value_at(number: PiecewiseConstant, n: Scalar) -> Scalar:
    """Return the value during the n-th sample."""
    value = number.values[0]
    for begin, later in zip(number.samples, number.values[1:], strict=True):
        value = jnp.where(n > begin, later, value)
    return value
