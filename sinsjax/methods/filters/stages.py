"""A Kalman filter in closed loop: from the stages of a filter to its method.

The order within a sample is that of [P1]: mechanise and propagate, add the process noise, update by
the measured velocity; then, where they are due, feed the estimate back and reset P. Schedules of
feedback and resets and direction reversals are the same for every filter, whatever its states. So
are the sum of innovations and triggers (`triggers.watched`), which come in between its stages.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, Triangle, change_signs
from sinsjax.methods import kalman, limits
from sinsjax.methods.base import (
    AttitudeCovariance,
    Ending,
    ErrorStep,
    FilterResults,
    Innovations,
    Method,
    Options,
    Site,
    StartChange,
)
from sinsjax.methods.kalman import Belief, Innovation
from sinsjax.methods.limits import Biases, Limit
from sinsjax.methods.schedules import (
    CovarianceReset,
    Due,
    Feedback,
    Resets,
    Windows,
    feedback_after,
    mix,
    next_due,
    reset_due,
    where_due,
)
from sinsjax.strapdown import earth, mechanisation
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.error_model import VE, VN
from sinsjax.types import Navigation, Quat, Sample, Scalar, Vec3


class FilterParams(NamedTuple):
    """Numbers of a filter: what it believes, and its schedules.

    Attributes:
        p0: initial variances of the states, SI squared.
        q: variances added to the states each sample, SI squared.
        r: variance of each velocity measurement, (m/s)^2.
        feedback: when and how much is fed back.
        resets: when and how P is reset.
        reset_to: variances that a full reset sets, SI squared.
        turn: what becomes of P when the direction is reversed.
        trigger: `triggers.base.TriggerParams`, None without a trigger.
        own: numbers of this filter alone; None of one without.
    """

    p0: tuple[Scalar, ...]
    q: tuple[Scalar, ...]
    r: Scalar
    feedback: Feedback
    resets: Resets | Windows
    reset_to: tuple[Scalar, ...]
    turn: CovarianceReset
    trigger: Any = None
    own: Any = None


class FilterState(NamedTuple):
    """One run under way.

    Attributes:
        nav: navigation solution.
        belief: estimated errors of ``nav`` and of the sensors, with covariance.
        bias: sensor biases fed back so far, one for each state of a bias, SI.
        feedback_at: sample count of the next feedback.
        trigger_state: `triggers.base.TriggerState`, None without a trigger.
        innovations: `Innovations` so far, None where none are summed up.
        own: what this filter alone carries along; None of one without.
    """

    nav: Navigation
    belief: kalman.Belief
    bias: tuple[Scalar, ...]
    feedback_at: Scalar
    trigger_state: Any = None
    innovations: Innovations | None = None
    own: Any = None


class Filter(NamedTuple):
    """The stages of a filter; its measurement is the velocity of a base that does not travel.

    Its params have the fields of `FilterParams`, its state those of `FilterState`; both may have
    more. Its first two states are the velocity errors.

    Attributes:
        dt: sample time, s.
        init: (params, navigation) -> state.
        propagate: (params, site, state, sample) -> state at the end of the sample: mechanised,
            belief propagated, its process noise not yet added; and the transition of its errors,
            the non-zero entries of A dt.
        update: (params, state) -> state after the update by the velocity, and the `Innovation`.
        feed_back: (state, share) -> state with that share of its estimate moved into the
            navigation solution, and by how much its attitude was corrected, rad.
        reset: (covariance reset, P, variances) -> P.
        reverse: state -> state with which the record is read in the other direction.
        place: (site, navigation) -> Earth there.
        at_rest: (state, place) -> transition of a base at rest, whose specific force is
            (0, 0, g).
        misalignment: state -> estimated misalignment that is not fed back yet, rad.
        attitude: state -> best attitude.
        covariance: state -> of that attitude.
        limit: see `Method.limit`.
        inputs: state -> `ErrorStep.inputs`.
        start_error: see `Method.start_error`.
        own_results: (site, state) -> `FilterResults.own`; None of a filter without.
        common_covariance: see `Method.common_covariance`.
        keep: (state that begins a record again, state at its end) -> the first with what is no
            error of the navigation solution; None of a filter that has nothing of the kind.
        gyro_bias: see `Method.gyro_bias`.
    """

    dt: float
    init: Callable[[Any, Navigation], Any]
    propagate: Callable[[Any, Site, Any, Sample], tuple[Any, Entries]]
    update: Callable[[Any, Any], tuple[Any, Innovation]]
    feed_back: Callable[[Any, Scalar], tuple[Any, Vec3]]
    reset: Callable[[CovarianceReset, Triangle, tuple[Scalar, ...]], Triangle]
    reverse: Callable[[Any], Any]
    place: Callable[[Site, Navigation], Place]
    at_rest: Callable[[Any, Place], Entries]
    misalignment: Callable[[Any], Vec3]
    attitude: Callable[[Any], Quat]
    covariance: Callable[[Any], AttitudeCovariance]
    limit: Callable[[Any, Place, Biases, Ending], Limit]
    inputs: Callable[[Any], Entries]
    start_error: Callable[[Any, StartChange], tuple[Scalar, ...]]
    own_results: Callable[[Site, Any], Any] | None = None
    common_covariance: bool = False
    keep: Callable[[Any, Any], Any] | None = None
    gyro_bias: Callable[[Any], Vec3] | None = None


def closed_loop(filter_: Filter) -> Method:
    """The method of a filter that feeds back, and resets P, on schedule."""
    return Method(
        filter_.init,
        partial(_step, filter_),
        partial(_turn, filter_),
        filter_.attitude,
        filter_.covariance,
        _normalise,
        filter_.limit,
        results=partial(_results, filter_),
        close=partial(_close, filter_),
        next_event=_next_event,
        common_covariance=filter_.common_covariance,
        rewind=partial(_rewind, filter_),
        gyro_bias=filter_.gyro_bias,
        error_step=partial(_error_step, filter_),
        error_angles=partial(_error_angles, filter_),
        start_error=filter_.start_error,
        begin_after=_begin_after,
    )


def _results(filter_: Filter, site: Site, state: Any) -> FilterResults:
    own = None if filter_.own_results is None else filter_.own_results(site, state)
    return FilterResults(None, state.innovations, own)


def _step(filter_: Filter, params: Any, site: Site, state: Any, sample: Sample, n: Scalar) -> Any:
    propagated, _ = filter_.propagate(params, site, state, sample)
    updated, _ = filter_.update(params, with_process_noise(params, propagated))
    return updated


def _error_step(
    filter_: Filter, params: Any, site: Site, state: Any, sample: Sample, n: Scalar
) -> ErrorStep:
    propagated, transition = filter_.propagate(params, site, state, sample)
    predicted = with_process_noise(params, propagated).belief
    gains = kalman.gains(predicted.p, (VE, VN), params.r, len(predicted.x))
    return ErrorStep(transition, filter_.inputs(state), gains, (VE, VN))


def _error_angles(filter_: Filter, state: Any) -> tuple[tuple[Scalar, ...], ...]:
    """The corrected attitude's derivative by the estimates, whose errors are -d."""
    x, angles = state.belief.x, []

    def attitude(x: tuple[Scalar, ...]) -> Quat:
        return filter_.attitude(state._replace(belief=state.belief._replace(x=x)))

    zero = tuple(jnp.zeros_like(one) for one in x)
    for i in range(len(x)):
        unit = (*zero[:i], jnp.ones_like(x[i]), *zero[i + 1 :])
        q, rate = jax.jvp(attitude, (x,), (unit,))
        # Of q = exp(phi/2) q_0: twice the vector part of its rate times its conjugate.
        turn = rotations.multiply(rate, rotations.conjugate(q))
        angles.append((2 * turn.x, 2 * turn.y, 2 * turn.z))
    return tuple(zip(*angles, strict=True))


def with_process_noise(params: Any, state: Any) -> Any:
    """The state with a sample's process noise added to P, Q of [P1] eq. (9)."""
    return state._replace(belief=kalman.add_noise(state.belief, params.q))


def _close(filter_: Filter, params: Any, state: Any, n: Scalar) -> Any:
    due = scheduled(params, state, n)
    return only_where(due, fed_back_and_reset(filter_, params, state, due, n)[0], state)


def scheduled(params: Any, state: Any, n: Scalar) -> Due:
    """What is due after the n-th sample."""
    return Due(n >= state.feedback_at, reset_due(params.resets, n))


def _next_event(params: Any, state: Any, n: Scalar) -> Scalar | None:
    if isinstance(params.resets, Windows):
        return None  # a share of a reset is due at every sample
    return next_due(state.feedback_at, params.resets, n)


def fed_back_and_reset(
    filter_: Filter, params: Any, state: Any, due: Due, n: Scalar
) -> tuple[Any, Vec3]:
    """The state after feedback, all of the estimate at a reset, and reset, at the n-th sample.

    Returns:
        The state, and the attitude correction that was fed back, rad.
    """
    share = mix(due.reset, 1.0, jnp.where(due.feedback, params.feedback.gain, 0.0))
    fed_back, correction = filter_.feed_back(state, share)
    covariance_reset = where_due(due.reset, params.resets.covariance_reset)
    p = filter_.reset(covariance_reset, state.belief.p, params.reset_to)
    feedback_at = feedback_after(params.feedback, state.feedback_at, due, n)
    belief = fed_back.belief._replace(p=p)
    return fed_back._replace(belief=belief, feedback_at=feedback_at), correction


def only_where(due: Due, closed: Any, state: Any) -> Any:
    """The state after feedback and reset where either is due, else as it stands, to the bit."""
    if not jnp.issubdtype(jnp.result_type(due.reset), bool):
        return closed  # a share of a reset is due at every sample
    # Chosen, not computed: nothing times infinity, and zero plus minus zero, would change it.
    either = due.feedback | due.reset
    return jax.tree.map(lambda new, old: jnp.where(either, new, old), closed, state)


def _turn(filter_: Filter, params: Any, site: Site, state: Any) -> Any:
    # x stays where P is reset: what it says of the attitude is the filter's best either way.
    state = filter_.reverse(state)
    p = filter_.reset(params.turn, state.belief.p, params.p0)
    return state._replace(belief=state.belief._replace(p=p))


def _rewind(filter_: Filter, params: Any, nav: Navigation, state: Any) -> Any:
    # All that was known of the solution's errors is in the solution; P is that of a start.
    begun = filter_.init(params, nav)
    kept = begun if filter_.keep is None else filter_.keep(begun, state)
    return kept._replace(feedback_at=state.feedback_at, innovations=state.innovations)


def _begin_after(state: Any, n: Scalar) -> Any:
    return state._replace(feedback_at=state.feedback_at + n)


def _normalise(state: Any) -> Any:
    return state._replace(nav=state.nav._replace(q=rotations.normalise(state.nav.q)))


def with_innovations(filter_: Filter) -> Filter:
    """A filter that sums up its normalised innovations."""

    def init(params: Any, nav: Navigation) -> Any:
        zero = jnp.zeros_like(params.r)
        return filter_.init(params, nav)._replace(innovations=Innovations(zero, zero))

    def update(params: Any, state: Any) -> tuple[Any, Innovation]:
        updated, innovation = filter_.update(params, state)
        total, count = state.innovations
        total = total + kalman.normalised(*innovation)
        return updated._replace(innovations=Innovations(total, count + 1)), innovation

    return filter_._replace(init=init, update=update)


def place_of(position: str) -> Callable[[Site, Navigation], Place]:
    """`Filter.place` by `Options.position`: fixed, or at the latitude of the solution."""
    if position == "integrated":
        return lambda site, nav: earth.place(site.earth, nav.latitude)
    return lambda site, nav: site.place


def mechaniser(
    options: Options,
) -> Callable[[Site, Navigation, Sample], tuple[Navigation, Vec3, Place]]:
    """One sample of navigation: (site, navigation, sample) -> what `Filter.propagate` goes by.

    Returns:
        A function that gives the solution at the end of the sample, the specific force in n times
        dt, m/s, and the Earth where the sample began, by `Options.position`.
    """
    place = place_of(options.position)

    def mechanise(site: Site, nav: Navigation, sample: Sample) -> tuple[Navigation, Vec3, Place]:
        here = place(site, nav)
        later, f_dt = mechanisation.step(nav, sample, here, options.dt)
        if options.position == "integrated":
            later = mechanisation.travel(later, here, options.dt)
        return later, f_dt, here

    return mechanise


def begin(params: FilterParams, nav: Navigation) -> FilterState:
    """A filter whose estimates begin with zero; it has fed no bias back."""
    return FilterState(nav, kalman.start(params.p0), (), params.feedback.every)


def update_by_velocity(params: Any, state: Any) -> tuple[Any, Innovation]:
    """Velocity should be zero: [P1] eqs (10)-(12)."""
    measured = state.nav.ve, state.nav.vn
    innovation = kalman.innovation(state.belief, (VE, VN), measured, params.r)
    belief = kalman.update(state.belief, (VE, VN), measured, params.r)
    return state._replace(belief=belief), innovation


def reversed_by(signs: Sequence[float], state: Any) -> Any:
    """The state in reversed time: velocity the other way, each estimate with its sign."""
    x, p = state.belief
    belief = Belief(tuple(s * a for s, a in zip(signs, x, strict=True)), change_signs(signs, p))
    return state._replace(nav=mechanisation.reverse(state.nav), belief=belief)


def unaided(params: Any, place: Place, biases: Biases, ending: Ending) -> Limit:
    """`Filter.limit` of a filter that does not tell sensor biases from misalignment."""
    return limits.unaided(place, biases)
