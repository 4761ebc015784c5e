"""Triggers: small pure objects that watch a filter as it runs and call for resets of P.

A trigger has a memory, which is cleared by every reset, and computes a score after each update; P
is reset when the score exceeds the threshold. `config.TRIGGERS` lists them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.maths.algebra import Entries, Triangle, select_tree
from sinsjax.methods.base import AttitudeCovariance, TriggerCounts
from sinsjax.methods.kalman import Belief
from sinsjax.types import Flag, Scalar, Vec3

Pair = tuple[Scalar, Scalar]
"""Components east and north."""


class TriggerParams(NamedTuple):
    """Numbers of a trigger; times in samples.

    Attributes:
        threshold: score above which P is reset.
        window: length of the window that scores are summed over.
        refractory: shortest time from the start, or from a reset, to a reset by the trigger.
        most: largest number of resets in a run.
        until: last sample after which the trigger may reset.
        at_feedback: 1 if a reset waits for the next feedback, else 0; None if it waits in no run.
    """

    threshold: Scalar
    window: Scalar
    refractory: Scalar
    most: Scalar
    until: Scalar
    at_feedback: Scalar | None = None


class AssumedNoise(NamedTuple):
    """The filter's Q and R: variances added to the states, and of a measurement."""

    q: tuple[Scalar, ...]
    r: Scalar


class FilterSnapshot(NamedTuple):
    """The filter after the update of a sample, as a trigger sees it.

    Attributes:
        innovation: measured minus predicted velocity, m/s.
        variance: upper triangle of its believed covariance S (ee, en, nn), (m/s)^2.
        belief: after the update.
        correction: of the attitude since the last reset or direction reversal: fed back, and
            estimated but not yet fed back, rad.
        not_fed_back: the latter part, rad.
        covariance: belief -> covariance of the misalignment under this belief.
        at_rest: transition of a base at rest, with specific force (0, 0, g).
    """

    innovation: Pair
    variance: tuple[Scalar, Scalar, Scalar]
    belief: Belief
    correction: Vec3
    not_fed_back: Vec3
    covariance: Callable[[Belief], AttitudeCovariance]
    at_rest: Entries


class TriggerState(NamedTuple):
    """A trigger between two samples.

    Attributes:
        memory: of the trigger.
        fed_back: attitude corrections fed back since the last reset or direction reversal, less
            the estimate before that reversal, rad.
        trigger_counts: its resets so far.
        last_reset: sample of the last reset of any kind.
        pending: whether a reset waits for feedback; None if none ever waits.
    """

    memory: Any
    fed_back: Vec3
    trigger_counts: TriggerCounts
    last_reset: Scalar
    pending: Flag | None = None


class Trigger(NamedTuple):
    """The functions of a trigger.

    Attributes:
        start: (params, P) -> memory at the start and after a reset that leaves P.
        score: (params, noise, memory, snapshot) -> memory and score.
    """

    start: Callable[[TriggerParams, Triangle], Any]
    score: Callable[[TriggerParams, AssumedNoise, Any, FilterSnapshot], tuple[Any, Scalar]]


def start(trigger: Trigger, trigger_params: TriggerParams, p: Triangle) -> TriggerState:
    """Return the state of a trigger before the first sample, for the initial covariance P."""
    zero = jnp.zeros_like(trigger_params.threshold)
    trigger_counts = TriggerCounts(zero, zero, zero)
    return TriggerState(
        trigger.start(trigger_params, p),
        Vec3(zero, zero, zero),
        trigger_counts,
        zero,
        None if trigger_params.at_feedback is None else zero > 0,
    )


def update_trigger(
    trigger: Trigger, params: Any, state: Any, snapshot: FilterSnapshot, n: Scalar
) -> Any:
    """Score one sample and record whether P is to be reset after it, see `fired`.

    Args:
        trigger: the trigger.
        params: `FilterParams` of the filter.
        state: `FilterState` after the update.
        snapshot: of that state.
        n: number of the sample.
    """
    trigger_state, limits = state.trigger_state, params.trigger
    noise = AssumedNoise(params.q, params.r)
    memory, score = trigger.score(limits, noise, trigger_state.memory, snapshot)
    counts = trigger_state.trigger_counts
    fires = (
        (score > limits.threshold)
        & (n - trigger_state.last_reset >= limits.refractory)
        & (counts.count < limits.most)
        & (n <= limits.until)
    )
    pending = trigger_state.pending
    if pending is not None:
        wanted = fires | pending
        fires = wanted & ((n >= state.feedback_at) | (limits.at_feedback == 0))
        pending = wanted & ~fires
    counts = TriggerCounts(
        count=jnp.where(fires, counts.count + 1, counts.count),
        first=jnp.where(fires & (counts.count == 0), n, counts.first),
        last=jnp.where(fires, n, counts.last),
    )
    trigger_state = trigger_state._replace(memory=memory, trigger_counts=counts, pending=pending)
    return state._replace(trigger_state=trigger_state)


def fired(trigger_state: TriggerState, n: Scalar) -> Flag:
    """Return whether the trigger called for a reset after the n-th sample."""
    return trigger_state.trigger_counts.last == n


def update_after_closing(
    trigger: Trigger, params: Any, state: Any, *, reset: Flag, correction: Vec3, n: Scalar
) -> Any:
    """Return a filter's state with its trigger's after a sample's feedback, and reset if any.

    Args:
        trigger: the trigger.
        params: `FilterParams` of the filter.
        state: `FilterState` with the loop closed.
        reset: whether P was reset.
        correction: attitude correction that was fed back, rad.
        n: number of the sample.
    """
    trigger_state = state.trigger_state
    cleared = trigger.start(params.trigger, state.belief.p)
    fed_back = Vec3(
        *(
            jnp.where(reset, 0.0, a + b)
            for a, b in zip(trigger_state.fed_back, correction, strict=True)
        )
    )
    trigger_state = trigger_state._replace(
        memory=select_tree(reset, cleared, trigger_state.memory),
        fed_back=fed_back,
        last_reset=jnp.where(reset, n, trigger_state.last_reset),
    )
    return state._replace(trigger_state=trigger_state)


def begin_pass(trigger: Trigger, params: Any, state: Any, *, misalignment: Vec3) -> Any:
    """Return a filter's first state of a pass, with its trigger's memory cleared.

    The counts of resets continue. A reset that still waits for feedback is forgotten with the
    memory that called for it.

    Args:
        trigger: the trigger.
        params: `FilterParams` of the filter.
        state: `FilterState` at the beginning of the pass.
        misalignment: estimated and not yet fed back, rad: no correction of this pass.
    """
    trigger_state = state.trigger_state
    pending = None if trigger_state.pending is None else jnp.zeros_like(trigger_state.pending)
    trigger_state = trigger_state._replace(
        memory=trigger.start(params.trigger, state.belief.p),
        fed_back=Vec3(*(-angle for angle in misalignment)),
        pending=pending,
    )
    return state._replace(trigger_state=trigger_state)
