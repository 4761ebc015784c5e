"""When a filter resets itself: small pure objects that watch it and are carried along with it.

A trigger has a memory, which begins anew with every reset, and gives a score after each update; P
is reset where the score exceeds the threshold. Two rivals do not reset: they fade, multiplying the
propagated P before the process noise is added. Which there are stands in `description`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths.algebra import Entries, Triangle
from sinsjax.methods.base import AttitudeCovariance, TriggerCounts
from sinsjax.methods.kalman import Belief
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.error_model import VE, VN
from sinsjax.types import Flag, Scalar, Vec3

Pair = tuple[Scalar, Scalar]
"""Of east and north."""


class TriggerParams(NamedTuple):
    """Numbers of a trigger; times in samples.

    Attributes:
        threshold: that the score has to exceed; of what fades, see there.
        window: over which a trigger that looks back sums up.
        refractory: that a reset has to be after the start, and after the reset before it.
        most: resets that it may call for.
        until: last sample after which it may.
        at_feedback: 1 where a reset that it calls for is put off to the next feedback, else 0;
            None where that is so in no run.
    """

    threshold: Scalar
    window: Scalar
    refractory: Scalar
    most: Scalar
    until: Scalar
    at_feedback: Scalar | None = None


class AssumedNoise(NamedTuple):
    """What the filter believes: variances added to the states, variance of a measurement."""

    q: tuple[Scalar, ...]
    r: Scalar


class FilterSnapshot(NamedTuple):
    """What a trigger sees after the update of a sample.

    Attributes:
        innovation: measured minus predicted velocity, m/s.
        variance: upper triangle of its believed covariance S (ee, en, nn), (m/s)^2.
        belief: after the update.
        correction: of the attitude since the last reset or direction reversal: what was fed back
            and what is not yet, rad.
        left: estimated misalignment that is not yet fed back, rad.
        covariance: belief -> of the misalignment, were this what the filter believes.
        at_rest: transition of a base at rest, its specific force (0, 0, g).
        place: Earth rates there.
        dt: s.
    """

    innovation: Pair
    variance: tuple[Scalar, Scalar, Scalar]
    belief: Belief
    correction: Vec3
    left: Vec3
    covariance: Callable[[Belief], AttitudeCovariance]
    at_rest: Entries
    place: Place
    dt: float


class TriggerState(NamedTuple):
    """A trigger at work.

    Attributes:
        memory: of the trigger.
        fed: attitude corrections fed back since the last reset or direction reversal, less what
            was estimated before that reversal, rad.
        trigger_counts: what it did so far.
        since: sample of the last reset of any kind.
        put_off: whether a reset waits for feedback; None where none ever does.
    """

    memory: Any
    fed: Vec3
    trigger_counts: TriggerCounts
    since: Scalar
    put_off: Flag | None = None


class Trigger(NamedTuple):
    """A trigger.

    Attributes:
        start: (numbers, P) -> memory at the start and after a reset, which leaves P.
        look: (numbers, noise, memory, seen) -> memory and score.
        fade: (numbers, noise, memory, propagated P, innovation) -> memory and factor on P.
    """

    start: Callable[[TriggerParams, Triangle], Any]
    look: (
        Callable[[TriggerParams, AssumedNoise, Any, FilterSnapshot], tuple[Any, Scalar]] | None
    ) = None
    fade: (
        Callable[[TriggerParams, AssumedNoise, Any, Triangle, Pair], tuple[Any, Scalar]] | None
    ) = None


def start(trigger: Trigger, trigger_params: TriggerParams, p: Triangle) -> TriggerState:
    """A trigger before the first sample, and the covariance P of the start."""
    zero = jnp.zeros_like(trigger_params.threshold)
    trigger_counts = TriggerCounts(zero, zero, zero)
    return TriggerState(
        trigger.start(trigger_params, p),
        Vec3(zero, zero, zero),
        trigger_counts,
        zero,
        None if trigger_params.at_feedback is None else zero > 0,
    )


def fade(
    trigger: Trigger,
    trigger_params: TriggerParams,
    noise: AssumedNoise,
    trigger_state: TriggerState,
    belief: Belief,
    measured: Pair,
) -> tuple[TriggerState, Belief]:
    """Multiply P by the trigger's factor, if it has one.

    Args:
        trigger: which.
        trigger_params: its numbers.
        noise: that the filter believes in.
        trigger_state: so far.
        belief: propagated, its process noise not yet added.
        measured: velocity, m/s.
    """
    if trigger.fade is None:
        return trigger_state, belief
    r = (measured[0] - belief.x[VE], measured[1] - belief.x[VN])
    memory, factor = trigger.fade(trigger_params, noise, trigger_state.memory, belief.p, r)
    return trigger_state._replace(memory=memory), Belief(
        belief.x, tuple(factor * v for v in belief.p)
    )


def take_in(
    trigger: Trigger,
    trigger_params: TriggerParams,
    noise: AssumedNoise,
    trigger_state: TriggerState,
    snapshot: FilterSnapshot,
    n: Scalar,
    *,
    feedback_at: Scalar,
) -> TriggerState:
    """Take one sample in, and note whether P is to be reset after it, see `fires`.

    Args:
        trigger: which.
        trigger_params: its numbers.
        noise: that the filter believes in.
        trigger_state: so far.
        snapshot: what there is to see.
        n: number of the sample.
        feedback_at: sample of the next feedback.
    """
    if trigger.look is None:
        return trigger_state
    memory, score = trigger.look(trigger_params, noise, trigger_state.memory, snapshot)
    trigger_counts = trigger_state.trigger_counts
    calls = (
        (score > trigger_params.threshold)
        & (n - trigger_state.since >= trigger_params.refractory)
        & (trigger_counts.count < trigger_params.most)
        & (n <= trigger_params.until)
    )
    put_off = trigger_state.put_off
    if put_off is not None:
        wanted = calls | put_off
        calls = wanted & ((n >= feedback_at) | (trigger_params.at_feedback == 0))
        put_off = wanted & ~calls
    trigger_counts = TriggerCounts(
        count=jnp.where(calls, trigger_counts.count + 1, trigger_counts.count),
        first=jnp.where(calls & (trigger_counts.count == 0), n, trigger_counts.first),
        last=jnp.where(calls, n, trigger_counts.last),
    )
    return trigger_state._replace(memory=memory, trigger_counts=trigger_counts, put_off=put_off)


def fires(trigger_state: TriggerState, n: Scalar) -> Flag:
    """Whether the trigger called for a reset after the n-th sample."""
    return trigger_state.trigger_counts.last == n


def after(
    trigger: Trigger,
    trigger_params: TriggerParams,
    trigger_state: TriggerState,
    *,
    reset: Flag,
    p: Triangle,
    fed: Vec3,
    n: Scalar,
) -> TriggerState:
    """The trigger's state after a sample's feedback, and after its reset if there was one.

    Args:
        trigger: which.
        trigger_params: its numbers.
        trigger_state: so far.
        reset: whether P was reset.
        p: the covariance that is left.
        fed: attitude correction that was fed back, rad.
        n: number of the sample.
    """
    anew = trigger.start(trigger_params, p)
    total = Vec3(
        *(jnp.where(reset, 0.0, a + b) for a, b in zip(trigger_state.fed, fed, strict=True))
    )
    return trigger_state._replace(
        memory=jax.tree.map(lambda a, b: jnp.where(reset, a, b), anew, trigger_state.memory),
        fed=total,
        since=jnp.where(reset, n, trigger_state.since),
    )


def in_another_pass(
    trigger: Trigger,
    trigger_params: TriggerParams,
    trigger_state: TriggerState,
    *,
    p: Triangle,
    misalignment: Vec3,
) -> TriggerState:
    """The trigger's state as a pass begins: its memory begins anew, its counts stay.

    A reset that still waits for feedback is forgotten with the memory that called for it.

    Args:
        trigger: which.
        trigger_params: its numbers.
        trigger_state: so far.
        p: the covariance that is left.
        misalignment: estimated and not yet fed back, rad: no correction of the pass that begins.
    """
    fed = Vec3(*(-angle for angle in misalignment))
    put_off = None if trigger_state.put_off is None else jnp.zeros_like(trigger_state.put_off)
    memory = trigger.start(trigger_params, p)
    return trigger_state._replace(memory=memory, fed=fed, put_off=put_off)
