"""Triggers: small pure objects that watch a filter as it runs and call for resets of P.

A trigger has a memory, which is cleared by every reset, and computes a score after each update; P
is reset when the score exceeds the threshold. `TRIGGERS` lists them. The functions that `loop`
calls take a filter's whole `FilterParams` and `FilterState`.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from sinsjax.maths.algebra import Entries, Triangle, add, select_tree
from sinsjax.methods.filters import kalman
from sinsjax.methods.filters.kalman import Belief, Innovation
from sinsjax.methods.method import AttitudeCovariance
from sinsjax.strapdown.mechanisation import VE, VN
from sinsjax.types import Flag, Scalar, Vec3
from sinsjax.units import DEG


class TriggerParams(NamedTuple):
    """Numbers of the keys ``trigger_...`` of [resets], times in samples."""

    threshold: Scalar
    window: Scalar
    refractory: Scalar
    most: Scalar
    until: Scalar


class TriggerCounts(NamedTuple):
    """Resets by a trigger in a run: their number, and samples of the first and last, 0 for none."""

    count: Scalar
    first: Scalar
    last: Scalar


class TriggerState(NamedTuple):
    """A trigger between two samples."""

    memory: Any
    # Attitude corrections fed back since the last reset or direction reversal, less the
    # estimate before that reversal, rad
    fed_back: Vec3
    trigger_counts: TriggerCounts
    last_reset: Scalar  # sample of the last reset of any kind


class FilterSnapshot(NamedTuple):
    """The filter after the update of a sample, as a trigger sees it."""

    innovation: Innovation  # of the velocity, m/s
    belief: Belief
    # Of the attitude since the last reset or direction reversal: fed back, and estimated but
    # not yet fed back, rad
    correction: Vec3
    not_fed_back: Vec3  # the latter part, rad
    # (belief) -> covariance of the misalignment under this belief
    covariance: Callable[[Belief], AttitudeCovariance]
    at_rest: Entries  # transition of a base at rest, with specific force (0, 0, g)


class Trigger(NamedTuple):
    """A trigger."""

    start: Callable[[Triangle], Any]  # P -> memory at the start and after a reset that leaves P
    # (params of the filter, memory, snapshot) -> memory and score
    score: Callable[[Any, Any, FilterSnapshot], tuple[Any, Scalar]]


# What the loop of a filter calls


def start(trigger: Trigger, params: TriggerParams, p: Triangle) -> TriggerState:
    """Return the state of a trigger before the first sample, for the initial covariance P."""
    zero = jnp.zeros_like(params.threshold)
    counts = TriggerCounts(zero, zero, zero)
    return TriggerState(trigger.start(p), Vec3(zero, zero, zero), counts, zero)


def update_trigger_in_filter_state(
    trigger: Trigger, params: Any, state: Any, snapshot: FilterSnapshot, n: Scalar
) -> Any:
    """Return a filter's state with the n-th sample scored; `fired` says whether P is reset."""
    before, limits = state.trigger_state, params.trigger
    memory, score = trigger.score(params, before.memory, snapshot)
    counts = before.trigger_counts
    fires = (
        (score > limits.threshold)
        & (n - before.last_reset >= limits.refractory)
        & (counts.count < limits.most)
        & (n <= limits.until)
    )
    counts = TriggerCounts(
        count=jnp.where(fires, counts.count + 1, counts.count),
        first=jnp.where(fires & (counts.count == 0), n, counts.first),
        last=jnp.where(fires, n, counts.last),
    )
    return state._replace(trigger_state=before._replace(memory=memory, trigger_counts=counts))


def fired(state: Any, n: Scalar) -> Flag:
    """Return whether a filter's trigger called for a reset after the n-th sample."""
    return state.trigger_state.trigger_counts.last == n


def add_feedback_or_restart(
    trigger: Trigger, state: Any, reset: Flag, fed_back: Vec3, n: Scalar
) -> Any:
    """Return a filter's state after the n-th sample, with P reset or not and an angle fed back."""
    before = state.trigger_state
    fed_back = add(before.fed_back, fed_back)
    after = before._replace(
        memory=select_tree(reset, trigger.start(state.belief.p), before.memory),
        fed_back=Vec3(*(jnp.where(reset, 0.0, angle) for angle in fed_back)),
        last_reset=jnp.where(reset, n, before.last_reset),
    )
    return state._replace(trigger_state=after)


def clear_memory_for_pass(trigger: Trigger | None, filter_state: Any, misalignment: Vec3) -> Any:
    """Return a filter's first state of a pass, with the memory of its trigger, if any, cleared.

    The counts of resets continue. What is estimated and not yet fed back, the misalignment in rad,
    is no correction of this pass.
    """
    if trigger is None:
        return filter_state
    before = filter_state.trigger_state
    after = before._replace(
        memory=trigger.start(filter_state.belief.p),
        fed_back=Vec3(*(-angle for angle in misalignment)),
    )
    return filter_state._replace(trigger_state=after)


# Innovations over a window


class _Window(NamedTuple):
    """Sums over a window that begins anew when it is full."""

    count: Scalar
    sums: tuple[Scalar, ...]


def _empty_window(p: Triangle) -> _Window:
    zero = jnp.zeros_like(p[0])
    return _Window(zero, (zero,) * 5)


def _score_innovation(params: Any, block: _Window, snapshot: FilterSnapshot) -> tuple[_Window, Any]:
    """Return (sum r)' (sum S)^-1 (sum r) over a window, chi-square with 2 degrees of freedom."""
    window = params.trigger.window
    again = block.count >= window  # a full window begins anew
    terms = *snapshot.innovation.value, *snapshot.innovation.variance
    sums = tuple(jnp.where(again, 0.0, s) + t for s, t in zip(block.sums, terms, strict=True))
    count = jnp.where(again, 0.0, block.count) + 1
    score = kalman.normalised_innovation_squared(sums[:2], sums[2:])
    return _Window(count, sums), jnp.where(count >= window, score, 0.0)


# Knowledge of heading that a linear model cannot have

_SMALL_LEVEL, _SMALL_HEADING = 0.1 * DEG, 4 * DEG
"""Errors of the linearisation point that do no harm, rad."""


def _score_overconfidence(
    params: Any, honest_p: Triangle, snapshot: FilterSnapshot
) -> tuple[Triangle, Scalar]:
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

    def weight(level: Vec3) -> Scalar:
        return jnp.minimum(1.0, (level.x**2 + level.y**2) / _SMALL_LEVEL**2)

    zeros = tuple(jnp.zeros_like(v) for v in snapshot.belief.x)
    honest = kalman.add_noise(kalman.propagate(Belief(zeros, honest_p), snapshot.at_rest), params.q)
    honest, _ = kalman.update(honest, (VE, VN), (zeros[VE], zeros[VN]), params.r)
    p_star = snapshot.covariance(honest._replace(x=snapshot.belief.x))
    believed = snapshot.covariance(snapshot.belief).uu
    done, left = snapshot.correction, snapshot.not_fed_back
    known = weight(done) * (p_star.uu / believed - 1)
    jump = weight(left) * p_star.uu * (left.x**2 / p_star.ee + left.y**2 / p_star.nn) / 4
    left_out = (done.z - _sine_by_range_reduction(done.z)) ** 2 / (believed + _SMALL_HEADING**2)
    return honest.p, jnp.sqrt(1 + known + jump + left_out)


def _sine_by_range_reduction(angle: Scalar) -> Scalar:
    """Return the sine of an angle of some turns, to some 1e-15 by arithmetic alone.

    For `jnp.sin` XLA:CPU calls the library lane by lane.
    """
    within = angle - 2 * np.pi * jnp.round(angle / (2 * np.pi))
    folded = within - 2 * (within - jnp.clip(within, -np.pi / 2, np.pi / 2))
    square, series = folded * folded, 0.0
    for n in range(19, 0, -2):
        series = series * square + (-1) ** (n // 2) / math.factorial(n)
    return series * folded


TRIGGERS = {
    "innovation": Trigger(_empty_window, _score_innovation),
    "linearisation": Trigger(lambda p: p, _score_overconfidence),
}
"""All triggers by name; ``[resets] reset_trigger`` names one."""
