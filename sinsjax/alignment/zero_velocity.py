"""Zero-velocity alignment with a linear error model and a standard Kalman filter, [P1].

The filter measures the navigator's velocity, which should be zero, and feeds its estimate back
into velocity and attitude (closed loop, [P1] section 2.3). Its covariance is reset on a schedule
([P1] section 3.2). Order within a sample: mechanise, predict, update, feedback, reset.
"""

from typing import NamedTuple

import jax.numpy as jnp

from sinsjax import earth, kalman, mechanisation, rotations
from sinsjax.algebra import change_signs, triangle_index
from sinsjax.alignment.base import AttitudeCovariance, Method, Options, Site
from sinsjax.alignment.schedules import Feedback, Renewal, Resets, renew, reset_due, where_due
from sinsjax.error_model import PHI_E, PHI_N, PHI_U, VE, VN, ErrorModel
from sinsjax.types import Navigation, Quat, Sample, Scalar, Vec3


class Params(NamedTuple):
    """Numbers of the filter: what it believes, and its schedules.

    Attributes:
        p0: initial variances of the states, SI squared.
        q: variances added to the states each sample, SI squared.
        r: variance of each velocity measurement, (m/s)^2.
        feedback: when and how much is fed back.
        resets: when and how P is reset.
        turn: what becomes of P when the tape is turned.
    """

    p0: tuple[Scalar, ...]
    q: tuple[Scalar, ...]
    r: Scalar
    feedback: Feedback
    resets: Resets
    turn: Renewal


class State(NamedTuple):
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
    at_rest = options.specific_force == "gravity"
    integrated = options.position == "integrated"

    def init(params: Params, nav: Navigation) -> State:
        belief = kalman.start(params.p0)
        return State(nav, belief, belief.x[len(_LEVEL_AND_YAW) :], params.feedback.every)

    def step(params: Params, site: Site, state: State, sample: Sample, n: Scalar) -> State:
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
        belief = kalman.predict(state.belief, transition, params.q)
        belief = kalman.update(belief, (VE, VN), (nav.ve, nav.vn), params.r)
        return _close_loop(params, state._replace(nav=nav, belief=belief), n)

    def turn(params: Params, site: Site, state: State) -> State:
        # x stays where P is renewed: what it says of the attitude is the filter's best either way.
        signs = model.reversal
        flipped = tuple(s * x for s, x in zip(signs, state.belief.x, strict=True))
        p = change_signs(signs, state.belief.p)
        biases = zip(signs[len(_LEVEL_AND_YAW) :], state.bias, strict=True)
        return state._replace(
            nav=mechanisation.reverse(state.nav),
            belief=kalman.Belief(flipped, renew(params.turn, p, params.p0, yaw=PHI_U)),
            bias=tuple(s * b for s, b in biases),
        )

    return Method(
        init,
        step,
        turn,
        _attitude,
        _covariance,
        _normalise,
        common_covariance=at_rest and not integrated and not model.uses_attitude,
    )


_LEVEL_AND_YAW = (VE, VN, PHI_E, PHI_N, PHI_U)


def _close_loop(params: Params, state: State, n: Scalar) -> State:
    """Feed the estimate back and reset P where due; a reset first feeds all of x back."""
    reset = reset_due(params.resets, n)
    due = n >= state.feedback_at
    gain = jnp.where(reset, 1.0, jnp.where(due, params.feedback.gain, 0.0))
    fed = tuple(gain * x for x in state.belief.x)
    nav = mechanisation.correct_velocity(state.nav, fed[VE], fed[VN])
    phi = Vec3(fed[PHI_E], fed[PHI_N], fed[PHI_U])
    return State(
        nav=nav._replace(q=rotations.correct(phi, nav.q)),
        belief=kalman.Belief(
            x=tuple(x - f for x, f in zip(state.belief.x, fed, strict=True)),
            p=renew(where_due(reset, params.resets.renewal), state.belief.p, params.p0, yaw=PHI_U),
        ),
        bias=tuple(b + f for b, f in zip(state.bias, fed[len(_LEVEL_AND_YAW) :], strict=True)),
        feedback_at=jnp.where(due, state.feedback_at + params.feedback.every, state.feedback_at),
    )


def _attitude(state: State) -> Quat:
    x = state.belief.x
    return rotations.correct(Vec3(x[PHI_E], x[PHI_N], x[PHI_U]), state.nav.q)


def _covariance(state: State) -> AttitudeCovariance:
    at = triangle_index(len(state.belief.x))
    angles = (PHI_E, PHI_N, PHI_U)
    return AttitudeCovariance(*(state.belief.p[at[i, j]] for i in angles for j in angles if i <= j))


def _normalise(state: State) -> State:
    return state._replace(nav=state.nav._replace(q=rotations.normalise(state.nav.q)))
