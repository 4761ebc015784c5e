"""Triggers: small pure objects that watch a filter as it runs and call for resets of P.

A trigger has a memory, which is cleared by every reset, and computes a score after each update; P
is reset when the score exceeds the threshold. `TRIGGERS` lists them.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from sinsjax.maths.algebra import Entries, Triangle, add, select_tree
from sinsjax.methods.filters import kalman
from sinsjax.methods.filters.kalman import Belief, normalised_innovation_squared
from sinsjax.methods.method import AttitudeCovariance
from sinsjax.strapdown.error_model import VE, VN
from sinsjax.types import Flag, Scalar, Vec3
from sinsjax.units import DEG


class TriggerCounts(NamedTuple):
    """Resets by a trigger in a run.

    Attributes:
        count: number of resets.
        first: sample of the first of them, 0 for none.
        last: sample of the last of them, 0 for none.
    """

    count: Scalar
    first: Scalar
    last: Scalar


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
        innovation: measured minus predicted velocity east and north, m/s.
        variance: upper triangle of its believed covariance S (ee, en, nn), (m/s)^2.
        belief: after the update.
        correction: of the attitude since the last reset or direction reversal: fed back, and
            estimated but not yet fed back, rad.
        not_fed_back: the latter part, rad.
        covariance: belief -> covariance of the misalignment under this belief.
        at_rest: transition of a base at rest, with specific force (0, 0, g).
    """

    innovation: tuple[Scalar, Scalar]
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
    """A trigger.

    Attributes:
        summary: condition of its resets, in half a line.
        start: (params, P) -> memory at the start and after a reset that leaves P.
        score: (params, noise, memory, snapshot) -> memory and score.
    """

    summary: str
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
    fed_back = Vec3(*(jnp.where(reset, 0.0, a) for a in add(trigger_state.fed_back, correction)))
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


# The scores


class _Block(NamedTuple):
    """Sums over a window that begins anew when it is full."""

    count: Scalar
    sums: tuple[Scalar, ...]


def _start_block(trigger_params: TriggerParams, p: Triangle) -> _Block:
    zero = jnp.zeros_like(trigger_params.threshold)
    return _Block(zero, (zero,) * 5)


def _score_innovation(
    trigger_params: TriggerParams, noise: AssumedNoise, block: _Block, snapshot: FilterSnapshot
) -> Any:
    """Return (sum r)' (sum S)^-1 (sum r) over a window, chi-square with 2 degrees of freedom."""
    again = block.count >= trigger_params.window  # a full window begins anew
    terms = *snapshot.innovation, *snapshot.variance
    sums = tuple(jnp.where(again, 0.0, s) + t for s, t in zip(block.sums, terms, strict=True))
    count = jnp.where(again, 0.0, block.count) + 1
    e, n, *s = sums
    score = normalised_innovation_squared((e, n), s)
    return _Block(count, sums), jnp.where(count >= trigger_params.window, score, 0.0)


_SMALL_LEVEL, _SMALL_HEADING = 0.1 * DEG, 4 * DEG
"""Errors of the linearisation point that do no harm, rad."""


def _score_linearisation(
    trigger_params: TriggerParams, noise: AssumedNoise, p: Triangle, snapshot: FilterSnapshot
) -> Any:
    """Return how far the knowledge of heading in P exceeds that of an honest linear model.

    While the level is wrong, the horizontal specific force enters A(t), and heading seems to show
    in velocity. The honest covariance P* of a base at rest (f = (0, 0, g)) does without. Three
    shares of variance make up the score, the root of 1 and their sum:

    * P*_UU / P_UU - 1: knowledge of heading without basis; as far as the level was
      corrected since the last reset, in full from 0.1 deg: where it was not, the base moves, and
      heading does show;
    * P*_UU (phi_E^2 / P*_EE + phi_N^2 / P*_NN) / 4: the expected jump when the level phi that is
      not yet fed back (in units of 2 sigma) is, as the specific force changes; likewise from
      0.1 deg;
    * (d - sin d)^2 / (P_UU + (4 deg)^2): what a heading correction d since the last reset left
      out, since the tilt that reveals heading goes with sin d; up to 30 deg it is little.
    """
    zeros = tuple(jnp.zeros_like(v) for v in snapshot.belief.x)
    honest = kalman.predict(Belief(zeros, p), snapshot.at_rest, noise.q)
    honest = kalman.update(honest, (VE, VN), (zeros[VE], zeros[VN]), noise.r)
    p_star = snapshot.covariance(honest._replace(x=snapshot.belief.x))
    believed = snapshot.covariance(snapshot.belief).uu
    done, left = snapshot.correction, snapshot.not_fed_back
    known = _weight_of_level(done.x, done.y) * (p_star.uu / believed - 1)
    jump = _weight_of_level(left.x, left.y)
    jump = jump * p_star.uu * (left.x**2 / p_star.ee + left.y**2 / p_star.nn) / 4
    left_out = (done.z - _sine(done.z)) ** 2 / (believed + _SMALL_HEADING**2)
    return honest.p, jnp.sqrt(1 + known + jump + left_out)


def _sine(angle: Scalar) -> Scalar:
    """Return the sine to some 1e-15 by arithmetic alone: XLA:CPU calls the library lane by lane.

    Args:
        angle: rad, of no more than some turns, which it is reduced by.
    """
    within = angle - 2 * np.pi * jnp.round(angle / (2 * np.pi))
    folded = within - 2 * (within - jnp.clip(within, -np.pi / 2, np.pi / 2))
    square, series = folded * folded, 0.0
    for n in range(19, 0, -2):
        series = series * square + (-1) ** (n // 2) / math.factorial(n)
    return series * folded


def _weight_of_level(east: Scalar, north: Scalar) -> Scalar:
    """Return the weight of a level angle: its square over `_SMALL_LEVEL` squared, at most 1."""
    return jnp.minimum(1.0, (east**2 + north**2) / _SMALL_LEVEL**2)


TRIGGERS = {
    "innovation": Trigger(
        "innovations summed over a window, normalised", _start_block, _score_innovation
    ),
    "linearisation": Trigger(
        "P_UU below what a linear model can know", lambda params, p: p, _score_linearisation
    ),
}
"""All triggers by name; ``[resets] reset_trigger`` names one."""
