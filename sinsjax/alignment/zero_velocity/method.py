"""Zero-velocity alignment with a linear error model and a standard Kalman filter, [P1].

The filter measures the navigator's velocity, which should be zero, and feeds its estimate back
into velocity and attitude (closed loop, [P1] section 2.3). Its covariance is reset on a schedule
([P1] section 3.2).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.alignment import kalman
from sinsjax.alignment.base import AttitudeCovariance, Ending, FilterResults, Method, Options, Site
from sinsjax.alignment.filters import Closed, Due, Filter, Prior, closed_loop, with_innovations
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
from sinsjax.alignment.triggers.watched import triggered
from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, change_signs, triangle_index
from sinsjax.strapdown import earth, mechanisation
from sinsjax.strapdown.error_model import PHI_E, PHI_N, PHI_U, VE, VN, ErrorModel
from sinsjax.types import Navigation, Quat, Sample, Scalar, Vec3


class FilterParams(NamedTuple):
    """Numbers of the filter: what it believes, and its schedules.

    Attributes:
        p0: initial variances of the states, SI squared.
        q: variances added to the states each sample, SI squared.
        r: variance of each velocity measurement, (m/s)^2.
        feedback: when and how much is fed back.
        resets: when and how P is reset.
        reset_to: variances that a full reset sets, SI squared.
        turn: what becomes of P when the direction is reversed.
        trigger: `triggers.base.TriggerParams`, None without a trigger.
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
    """

    nav: Navigation
    belief: kalman.Belief
    bias: tuple[Scalar, ...]
    feedback_at: Scalar


def build(model: ErrorModel, options: Options) -> Method:
    """The zero-velocity Kalman method for one error model.

    Args:
        model: linear error model; its first five states are those of [P1] eq. (1).
        options: what decides the program.
    """
    plain = triggered(filter_of(model, options), options.trigger, options.dt)
    at_rest, integrated = options.specific_force == "gravity", options.position == "integrated"
    return closed_loop(
        with_innovations(plain) if options.innovations else plain,
        common_covariance=at_rest
        and not integrated
        and not model.uses_attitude
        and options.trigger == "none",
    )


def filter_of(model: ErrorModel, options: Options) -> Filter:
    """The filter of [P1]; arguments as of `build`."""
    at_rest = options.specific_force == "gravity"
    integrated = options.position == "integrated"
    dt = options.dt

    def init(params: FilterParams, nav: Navigation) -> FilterState:
        belief = kalman.start(params.p0)
        biases = belief.x[len(_LEVEL_AND_YAW) :]
        return FilterState(nav, belief, biases, params.feedback.every)

    def predict(params: FilterParams, site: Site, state: FilterState, sample: Sample) -> Prior:
        before = state.nav
        place = earth.place(site.earth, before.latitude) if integrated else site.place
        sample = model.correct_sample(sample, state.bias, dt)
        nav, f_dt = mechanisation.step(before, sample, place, dt)
        if integrated:
            nav = mechanisation.travel(nav, place, dt)
        if at_rest:
            f_dt = Vec3(0.0, 0.0, place.gravity * dt)
            before = before._replace(ve=0.0, vn=0.0)
        transition = model.transition(before, place, f_dt, dt)
        return Prior(nav, place, kalman.propagate(state.belief, transition))

    def update(params: FilterParams, state: FilterState, prior: Prior, n: Scalar) -> FilterState:
        predicted = kalman.add_noise(prior.belief, params.q)
        belief = kalman.update(predicted, (VE, VN), (prior.nav.ve, prior.nav.vn), params.r)
        return state._replace(nav=prior.nav, belief=belief)

    def reverse(params: FilterParams, site: Site, state: FilterState) -> FilterState:
        # x stays where P is reset: what it says of the attitude is the filter's best either way.
        signs = model.reversal
        flipped = tuple(s * x for s, x in zip(signs, state.belief.x, strict=True))
        p = change_signs(signs, state.belief.p)
        p = reset_covariance(params.turn, p, params.p0, yaw=PHI_U)
        biases = zip(signs[len(_LEVEL_AND_YAW) :], state.bias, strict=True)
        return state._replace(
            nav=mechanisation.reverse(state.nav),
            belief=kalman.Belief(flipped, p),
            bias=tuple(s * b for s, b in biases),
        )

    def still(state: FilterState, prior: Prior) -> Entries:
        gravity = Vec3(0.0, 0.0, prior.place.gravity * dt)
        return model.transition(state.nav._replace(ve=0.0, vn=0.0), prior.place, gravity, dt)

    return Filter(
        init=init,
        predict=predict,
        update=update,
        due=_due,
        close=_close,
        next_event=_next_event,
        reverse=reverse,
        noise=lambda params: (params.q, params.r),
        at_rest=still,
        belief=lambda state: state.belief,
        misalignment=lambda state: _misalignment(state.belief),
        attitude=_attitude,
        covariance=_covariance,
        normalise=_normalise,
        limit=_limit,
        results=lambda state: FilterResults(None, None),
    )


_LEVEL_AND_YAW = (VE, VN, PHI_E, PHI_N, PHI_U)


def _due(params: FilterParams, state: FilterState, n: Scalar) -> Due:
    return Due(n >= state.feedback_at, reset_due(params.resets, n))


def _next_event(params: FilterParams, state: FilterState, n: Scalar) -> Scalar | None:
    if isinstance(params.resets, Windows):
        return None  # a share of a reset is due at every sample
    return next_due(state.feedback_at, params.resets, n)


def _close(params: FilterParams, state: FilterState, due: Due, n: Scalar) -> Closed:
    """Feed the estimate back, all of it at a reset; reset P."""
    gain = mix(due.reset, 1.0, jnp.where(due.feedback, params.feedback.gain, 0.0))
    fed = tuple(gain * x for x in state.belief.x)
    nav = mechanisation.correct_velocity(state.nav, fed[VE], fed[VN])
    phi = Vec3(fed[PHI_E], fed[PHI_N], fed[PHI_U])
    covariance_reset = where_due(due.reset, params.resets.covariance_reset)
    later = state.feedback_at + params.feedback.every
    closed = FilterState(
        nav=nav._replace(q=rotations.correct(phi, nav.q)),
        belief=kalman.Belief(
            x=tuple(x - f for x, f in zip(state.belief.x, fed, strict=True)),
            p=reset_covariance(covariance_reset, state.belief.p, params.reset_to, yaw=PHI_U),
        ),
        bias=tuple(b + f for b, f in zip(state.bias, fed[len(_LEVEL_AND_YAW) :], strict=True)),
        feedback_at=jnp.where(due.feedback, later, state.feedback_at),
    )
    return Closed(closed, phi)


def _limit(params: FilterParams, place: earth.Place, biases: Biases, ending: Ending) -> Limit:
    return unaided(place, biases)


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
