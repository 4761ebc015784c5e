"""Zero-velocity alignment with a linear error model and a standard Kalman filter, [P1].

The filter measures the navigator's velocity, which should be zero, and feeds its estimate back
into velocity and attitude (closed loop, [P1] section 2.3). Its covariance is reset on a schedule
([P1] section 3.2), and where a trigger calls for it. Order within a sample: mechanise, predict,
update, and where they are due feedback and reset, which close the loop.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.alignment import kalman
from sinsjax.alignment.base import (
    AttitudeCovariance,
    Ending,
    FilterResults,
    Innovations,
    Method,
    Options,
    Site,
)
from sinsjax.alignment.limits import Biases, Limit, unaided
from sinsjax.alignment.schedules import (
    CovarianceReset,
    Feedback,
    Resets,
    Windows,
    mix,
    next_due,
    reset_covariance,
    reset_due,
    where_due,
)
from sinsjax.alignment.triggers import base as triggers
from sinsjax.alignment.triggers.base import AssumedNoise, FilterSnapshot, Trigger
from sinsjax.alignment.triggers.scores import TRIGGERS, normalised
from sinsjax.maths import rotations
from sinsjax.maths.algebra import add, change_signs, triangle_index
from sinsjax.strapdown import earth, mechanisation
from sinsjax.strapdown.error_model import PHI_E, PHI_N, PHI_U, VE, VN, ErrorModel
from sinsjax.types import Flag, Navigation, Quat, Sample, Scalar, Vec3


class FilterParams(NamedTuple):
    """Numbers of the filter: what it believes, and its schedules.

    Attributes:
        p0: initial variances of the states, SI squared.
        q: variances added to the states each sample, SI squared.
        r: variance of each velocity measurement, (m/s)^2.
        feedback: when and how much is fed back.
        resets: when and how P is reset.
        reset_to: variances that a full reset sets, SI squared.
        turn: what becomes of P when the tape is turned.
        trigger: `triggers.Numbers`, None without a trigger.
    """

    p0: tuple[Scalar, ...]
    q: tuple[Scalar, ...]
    r: Scalar
    feedback: Feedback
    resets: Resets | Windows
    reset_to: tuple[Scalar, ...]
    turn: CovarianceReset
    trigger: Any = None


class FilterState(NamedTuple):
    """One run under way.

    Attributes:
        nav: navigation solution.
        belief: estimated errors of ``nav`` and of the sensors, with covariance.
        bias: sensor biases fed back so far, one for each state beyond the fifth, SI.
        feedback_at: sample count of the next feedback.
        trigger_state: `triggers.Watch`, None without a trigger.
        innovations: `Innovations` so far, None where none are summed up.
    """

    nav: Navigation
    belief: kalman.Belief
    bias: tuple[Scalar, ...]
    feedback_at: Scalar
    trigger_state: Any = None
    innovations: Innovations | None = None


def build(model: ErrorModel, options: Options) -> Method:
    """The zero-velocity Kalman method for one error model.

    Args:
        model: linear error model; its first five states are those of [P1] eq. (1).
        options: what decides the program.
    """
    at_rest = options.specific_force == "gravity"
    integrated = options.position == "integrated"
    trigger = TRIGGERS.get(options.trigger)

    def init(params: FilterParams, nav: Navigation) -> FilterState:
        belief = kalman.start(params.p0)
        trigger_state = triggers.start(trigger, params.trigger, belief.p) if trigger else None
        biases, zero = belief.x[len(_LEVEL_AND_YAW) :], jnp.zeros_like(params.r)
        summed = Innovations(zero, zero) if options.innovations else None
        return FilterState(nav, belief, biases, params.feedback.every, trigger_state, summed)

    def step(
        params: FilterParams, site: Site, state: FilterState, sample: Sample, n: Scalar
    ) -> FilterState:
        before = state.nav
        place = earth.place(site.earth, before.latitude) if integrated else site.place
        sample = model.correct_sample(sample, state.bias, options.dt)
        nav, f_dt = mechanisation.step(before, sample, place, options.dt)
        if integrated:
            nav = mechanisation.travel(nav, place, options.dt)
        if at_rest:
            f_dt = Vec3(0.0, 0.0, place.gravity * options.dt)
            before = before._replace(ve=0.0, vn=0.0)
        transition = model.transition(before, place, f_dt, options.dt)
        measured = nav.ve, nav.vn
        belief, trigger_state = kalman.propagate(state.belief, transition), state.trigger_state
        noise = AssumedNoise(params.q, params.r)
        if trigger is not None:
            trigger_state, belief = triggers.fade(
                trigger, params.trigger, noise, trigger_state, belief, measured
            )
        predicted = kalman.add_noise(belief, params.q)
        belief = kalman.update(predicted, (VE, VN), measured, params.r)
        summed = state.innovations
        innovation = measured[0] - predicted.x[VE], measured[1] - predicted.x[VN]
        variance = _innovation_variance(predicted, params.r)
        if summed is not None:
            squared = normalised(innovation, variance)
            summed = Innovations(summed.sum + squared, summed.count + 1)
        if trigger is not None:
            gravity = Vec3(0.0, 0.0, place.gravity * options.dt)
            still = before._replace(ve=0.0, vn=0.0)
            snapshot = FilterSnapshot(
                innovation=innovation,
                variance=variance,
                belief=belief,
                correction=add(trigger_state.fed, _misalignment(belief)),
                at_rest=model.transition(still, place, gravity, options.dt),
                place=place,
                dt=options.dt,
            )
            trigger_state = triggers.take_in(
                trigger, params.trigger, noise, trigger_state, snapshot, n
            )
        return state._replace(
            nav=nav, belief=belief, trigger_state=trigger_state, innovations=summed
        )

    def turn(params: FilterParams, site: Site, state: FilterState) -> FilterState:
        # x stays where P is renewed: what it says of the attitude is the filter's best either way.
        signs = model.reversal
        flipped = tuple(s * x for s, x in zip(signs, state.belief.x, strict=True))
        p = change_signs(signs, state.belief.p)
        p = reset_covariance(params.turn, p, params.p0, yaw=PHI_U)
        belief = kalman.Belief(flipped, p)
        biases = zip(signs[len(_LEVEL_AND_YAW) :], state.bias, strict=True)
        trigger_state = state.trigger_state
        if trigger is not None:
            left = _misalignment(belief)
            trigger_state = triggers.reversed_in_time(
                trigger, params.trigger, trigger_state, p=p, misalignment=left
            )
        return state._replace(
            nav=mechanisation.reverse(state.nav),
            belief=belief,
            bias=tuple(s * b for s, b in biases),
            trigger_state=trigger_state,
        )

    return Method(
        init,
        step,
        turn,
        _attitude,
        _covariance,
        _normalise,
        _limit,
        results=_results,
        close=partial(_close, trigger),
        next_event=_next_event,
        called=_called if trigger and trigger.look else None,
        common_covariance=at_rest
        and not integrated
        and not model.uses_attitude
        and trigger is None,
    )


_LEVEL_AND_YAW = (VE, VN, PHI_E, PHI_N, PHI_U)


def _next_event(params: FilterParams, state: FilterState, n: Scalar) -> Scalar | None:
    if isinstance(params.resets, Windows):
        return None  # a share of a reset is due at every sample
    return next_due(state.feedback_at, params.resets, n)


def _called(state: FilterState, n: Scalar) -> Flag:
    return triggers.fires(state.trigger_state, n)


def _close(
    trigger: Trigger | None, params: FilterParams, state: FilterState, n: Scalar
) -> FilterState:
    """Feed the estimate back and reset P where due."""
    due = n >= state.feedback_at
    reset = reset_due(params.resets, n)
    if isinstance(params.resets, Windows):
        return _closed(trigger, params, state, due, reset, n)
    if trigger is not None:
        reset = reset | triggers.fires(state.trigger_state, n)
    # Chosen, not computed: nothing times infinity, and zero plus minus zero, would not leave it.
    closed = _closed(trigger, params, state, due, reset, n)
    return jax.tree.map(lambda new, old: jnp.where(due | reset, new, old), closed, state)


def _closed(
    trigger: Trigger | None,
    params: FilterParams,
    state: FilterState,
    due: Flag,
    reset: Flag | Scalar,
    n: Scalar,
) -> FilterState:
    """The state after a feedback or a reset; a reset first feeds all of x back."""
    gain = mix(reset, 1.0, jnp.where(due, params.feedback.gain, 0.0))
    fed = tuple(gain * x for x in state.belief.x)
    nav = mechanisation.correct_velocity(state.nav, fed[VE], fed[VN])
    phi = Vec3(fed[PHI_E], fed[PHI_N], fed[PHI_U])
    covariance_reset = where_due(reset, params.resets.covariance_reset)
    p = reset_covariance(covariance_reset, state.belief.p, params.reset_to, yaw=PHI_U)
    trigger_state = state.trigger_state
    if trigger is not None:
        trigger_state = triggers.after(
            trigger, params.trigger, trigger_state, reset=reset, p=p, fed=phi, n=n
        )
    return FilterState(
        nav=nav._replace(q=rotations.correct(phi, nav.q)),
        belief=kalman.Belief(
            x=tuple(x - f for x, f in zip(state.belief.x, fed, strict=True)),
            p=p,
        ),
        bias=tuple(b + f for b, f in zip(state.bias, fed[len(_LEVEL_AND_YAW) :], strict=True)),
        feedback_at=jnp.where(due, state.feedback_at + params.feedback.every, state.feedback_at),
        trigger_state=trigger_state,
        innovations=state.innovations,
    )


def _limit(params: FilterParams, place: earth.Place, biases: Biases, ending: Ending) -> Limit:
    return unaided(place, biases)


def _results(state: FilterState) -> FilterResults:
    watched = state.trigger_state
    return FilterResults(None if watched is None else watched.trigger_counts, state.innovations)


def _innovation_variance(predicted: kalman.Belief, r: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    at = triangle_index(len(predicted.x))
    return predicted.p[at[VE, VE]] + r, predicted.p[at[VE, VN]], predicted.p[at[VN, VN]] + r


def _misalignment(belief: kalman.Belief) -> Vec3:
    return Vec3(belief.x[PHI_E], belief.x[PHI_N], belief.x[PHI_U])


def _attitude(state: FilterState) -> Quat:
    return rotations.correct(_misalignment(state.belief), state.nav.q)


def _covariance(state: FilterState) -> AttitudeCovariance:
    at = triangle_index(len(state.belief.x))
    angles = (PHI_E, PHI_N, PHI_U)
    return AttitudeCovariance(*(state.belief.p[at[i, j]] for i in angles for j in angles if i <= j))


def _normalise(state: FilterState) -> FilterState:
    return state._replace(nav=state.nav._replace(q=rotations.normalise(state.nav.q)))
