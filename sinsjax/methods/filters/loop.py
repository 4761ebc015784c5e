"""A Kalman filter in closed loop: from its stages, a `Filter`, to its `Program` and its `Method`.

The order within a sample is that of [P1]: mechanise and propagate, add the process noise, update
with the measured velocity; then, if they are due, feed the estimate back and reset P. Schedules of
feedback and resets, triggers, direction reversals and the sum of innovations are the same for every
filter, whatever its states.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, add, change_signs, scale, select_tree, triangle_index
from sinsjax.methods import schedules
from sinsjax.methods.filters import kalman, triggers
from sinsjax.methods.filters import keys as filter_keys
from sinsjax.methods.filters.kalman import Belief, Innovation
from sinsjax.methods.filters.keys import (
    ACCEL_NOISE,
    BIAS_KEYS,
    FILTER_COLUMNS,
    GYRO_NOISE,
    FilterSection,
    ProcessNoise,
    ResetsSection,
    StateKind,
    check_reset_times_and_schedules,
)
from sinsjax.methods.filters.triggers import TriggerParams
from sinsjax.methods.method import (
    AttitudeCovariance,
    Feedback,
    Method,
    Options,
    Passes,
    Program,
    Site,
    StudyKeys,
)
from sinsjax.methods.schedules import UNCHANGED, CovarianceReset, FeedbackSchedule, Resets
from sinsjax.strapdown import mechanisation
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.mechanisation import PHI_E, PHI_N, PHI_U, VE, VN
from sinsjax.types import Navigation, Quat, Sample, Scalar, Vec3
from sinsjax.units import si_factor
from sinsjax.value_types import keys_of

FIRST_BIAS = PHI_U + 1
"""Number of the first state after those of velocity and attitude, in filters of biases."""

_ANGLES = (PHI_E, PHI_N, PHI_U)


class InnovationSum(NamedTuple):
    """Sum and number of the normalised innovations squared r' S^-1 r of a run."""

    sum: Scalar
    count: Scalar


class FilterResults(NamedTuple):
    """Basis of the result columns of filters; None for what one does not have."""

    trigger_counts: triggers.TriggerCounts | None
    innovations: InnovationSum | None


class FilterParams(NamedTuple):
    """Numbers of a filter: variances of its states, SI squared, and its schedules."""

    p0: tuple[Scalar, ...]  # variances at the start
    q: tuple[Scalar, ...]  # variances added each sample
    r: Scalar  # variance of each velocity measurement, (m/s)^2
    feedback: FeedbackSchedule
    resets: Resets
    reset_to: tuple[Scalar, ...]  # variances that a full reset sets
    reversal: CovarianceReset  # effect of a direction reversal on P
    trigger: Any = None  # `triggers.TriggerParams`; None without a trigger
    extra: Any = None  # numbers of this filter alone; None if it has none


class FilterState(NamedTuple):
    """A filter between two samples."""

    nav: Navigation
    belief: Belief  # estimated errors of the solution ``nav`` and of the sensors, with covariance
    bias: tuple[Scalar, ...]  # sensor biases fed back so far, one per bias state, SI
    feedback_at: Scalar  # sample of the next feedback
    trigger_state: Any = None  # `triggers.TriggerState`; None without a trigger
    innovations: InnovationSum | None = None  # their sum so far; None if they are not summed
    extra: Any = None  # state of this filter alone; None if it has none


# Stages that filters share


def initial_state(params: FilterParams, nav: Navigation) -> FilterState:
    """Return the state of a filter whose estimates begin with zero, with no bias fed back."""
    return FilterState(nav, kalman.initial_belief(params.p0), (), params.feedback.every)


def estimated_misalignment(state: Any) -> Vec3:
    """Return the estimated rotation vector, rad: `Filter.misalignment`."""
    return Vec3(*(state.belief.x[i] for i in _ANGLES))


def corrected_attitude(state: Any) -> Quat:
    """Return exp(phi x) C: `Filter.attitude`."""
    return rotations.correct(estimated_misalignment(state), state.nav.q)


def misalignment_covariance(state: Any) -> AttitudeCovariance:
    """Return the covariance of phi, rad^2: `Filter.covariance`."""
    at = triangle_index(len(state.belief.x))
    pairs = combinations_with_replacement(_ANGLES, 2)
    return AttitudeCovariance(*(state.belief.p[at[pair]] for pair in pairs))


def update_with_velocity(params: Any, state: Any) -> tuple[Any, Innovation]:
    """Update with the velocity, which should be zero: [P1] eqs (10)-(12)."""
    measured = state.nav.ve, state.nav.vn
    belief, innovation = kalman.update(state.belief, (VE, VN), measured, params.r)
    return state._replace(belief=belief), innovation


def reverse_time(signs: Sequence[float], state: Any) -> Any:
    """Return the state in reversed time: velocity negated, each estimate with its sign."""
    x, p = state.belief
    belief = Belief(tuple(s * a for s, a in zip(signs, x, strict=True)), change_signs(signs, p))
    bias = tuple(s * b for s, b in zip(signs[FIRST_BIAS:], state.bias, strict=False))
    return state._replace(nav=mechanisation.reverse_velocity(state.nav), belief=belief, bias=bias)


def subtract_fed_back(belief: Belief, fed_back: Sequence[Scalar]) -> Belief:
    """Return the belief after the given part of its estimates has been fed back."""
    x = tuple(a - b for a, b in zip(belief.x, fed_back, strict=True))
    return belief._replace(x=x)


def feed_back(
    state: FilterState,
    share: Scalar,
    rotate: Callable[[Vec3, Quat], Quat] = rotations.correct,
) -> FilterState:
    """Return the state with a share of its estimate fed back, [P1] section 2.3.

    V <- V - dV, C <- exp(phi x) C or as ``rotate`` has it, and x loses the part fed back. States
    after those of the attitude are biases.
    """
    fed_back = tuple(share * estimate for estimate in state.belief.x)
    nav = mechanisation.correct_velocity(state.nav, fed_back[VE], fed_back[VN])
    phi = Vec3(fed_back[PHI_E], fed_back[PHI_N], fed_back[PHI_U])
    return state._replace(
        nav=nav._replace(q=rotate(phi, nav.q)),
        belief=subtract_fed_back(state.belief, fed_back),
        bias=tuple(b + x for b, x in zip(state.bias, fed_back[FIRST_BIAS:], strict=True)),
    )


# The loop


class Filter(NamedTuple):
    """The stages of a filter that measures the velocity of a base that does not travel.

    Its params have the fields of `FilterParams`, its state those of `FilterState`; both may have
    more. Its first two states are the velocity errors.

    Attributes:
        transition: (state, place, f dt in n, m/s) -> non-zero entries of A dt.
        predict: (params, state, place, f dt) -> state with its belief propagated over a sample; the
            solution is still that before it, and the process noise is added later. None for a
            prediction by ``transition``.
        feed_back: (state, share) -> state with that share of its estimate moved into the
            navigation solution.
        init: (params, navigation) -> state.
        reverse: (sign of each estimate, state) -> state with which the record is read in the other
            direction.
        update: (params, state) -> state after the update with the velocity, and the `Innovation`.
        misalignment: state -> estimated misalignment that is not fed back yet, rad.
        attitude: state -> best attitude.
        covariance: state -> covariance of that attitude.
        correct: (state, sample) -> sample without the biases found; None if none are.
        shares_covariance: see `Program`.
    """

    transition: Callable[[Any, Place, Vec3], Entries]
    predict: Callable[[Any, Any, Place, Vec3], Any] | None = None
    feed_back: Callable[[Any, Scalar], Any] = feed_back
    init: Callable[[Any, Navigation], Any] = initial_state
    reverse: Callable[[Sequence[float], Any], Any] = reverse_time
    update: Callable[[Any, Any], tuple[Any, Innovation]] = update_with_velocity
    misalignment: Callable[[Any], Vec3] = estimated_misalignment
    attitude: Callable[[Any], Quat] = corrected_attitude
    covariance: Callable[[Any], AttitudeCovariance] = misalignment_covariance
    correct: Callable[[Any, Sample], Sample] | None = None
    shares_covariance: bool = False


def closed_loop(states: Sequence[StateKind], filter_: Filter, options: Options) -> Program:
    """Return the program of a filter that feeds back and resets P on schedule or by a trigger."""
    trigger = None if options.trigger == "none" else triggers.TRIGGERS[options.trigger]
    loop = _ClosedLoop((*states,), filter_, options, trigger)
    fired = None if trigger is None else triggers.fired
    return Program(
        init=loop.init,
        step=loop.update_filter,
        attitude=filter_.attitude,
        covariance=filter_.covariance,
        results=loop.results,
        shares_covariance=filter_.shares_covariance and trigger is None,
        feedback=Feedback(loop.feed_back_and_reset, _next_event, fired),
        passes=Passes(loop.reverse, _shift_counts),
    )


class _ClosedLoop(NamedTuple):
    """A filter in closed loop, and the trigger that resets it in addition to the schedule."""

    states: tuple[StateKind, ...]
    filter: Filter
    options: Options
    trigger: triggers.Trigger | None

    @property
    def heading(self) -> list[int]:
        """Numbers of the states of heading."""
        return [number for number, kind in enumerate(self.states) if kind.is_heading]

    def init(self, params: Any, nav: Navigation) -> Any:
        state = self.filter.init(params, nav)
        if self.options.innovations:
            zero = jnp.zeros_like(params.r)
            state = state._replace(innovations=InnovationSum(zero, zero))
        if self.trigger is not None:
            started = triggers.start(self.trigger, params.trigger, state.belief.p)
            state = state._replace(trigger_state=started)
        return state

    def update_filter(self, params: Any, site: Site, before: Any, sample: Sample, n: Scalar) -> Any:
        dt, here = self.options.dt, self.options.place(site, before.nav)
        if self.filter.correct is not None:
            sample = self.filter.correct(before, sample)
        nav, f_dt = mechanisation.advance_navigation(before.nav, sample, here, dt)
        if self.options.position == "integrated":
            nav = mechanisation.advance_position(nav, here, dt)
        predicted = self._predict(params, before, here, f_dt)  # [P1] eqs (8) and (9)
        belief = kalman.add_noise(predicted.belief, params.q)
        state, innovation = self.filter.update(params, predicted._replace(nav=nav, belief=belief))
        if self.options.innovations:
            total, count = state.innovations
            total = total + kalman.normalised_innovation_squared(*innovation)
            state = state._replace(innovations=InnovationSum(total, count + 1))
        if self.trigger is None:
            return state
        not_fed_back = self.filter.misalignment(state)
        snapshot = triggers.FilterSnapshot(
            innovation=innovation,
            belief=state.belief,
            correction=add(state.trigger_state.fed_back, not_fed_back),
            not_fed_back=not_fed_back,
            covariance=lambda belief: self.filter.covariance(state._replace(belief=belief)),
            at_rest=self.filter.transition(
                before._replace(nav=before.nav._replace(ve=0.0, vn=0.0)),
                here,
                Vec3(0.0, 0.0, here.gravity * dt),
            ),
        )
        return triggers.update_trigger_in_filter_state(self.trigger, params, state, snapshot, n)

    def _predict(self, params: Any, state: Any, here: Place, f_dt: Vec3) -> Any:
        if self.filter.predict is not None:
            return self.filter.predict(params, state, here, f_dt)
        entries = self.filter.transition(state, here, f_dt)
        return state._replace(belief=kalman.propagate(state.belief, entries))

    def feed_back_and_reset(self, params: Any, state: Any, n: Scalar) -> Any:
        feeds_back, resets = n >= state.feedback_at, schedules.reset_due(params.resets, n)
        if self.trigger is not None:
            resets = resets | triggers.fired(state, n)
        # Before a reset, all of the estimate is fed back.
        gain = jnp.where(feeds_back, params.feedback.gain, 0.0)
        share = schedules.interpolate(resets, 1.0, gain)
        closed = self.filter.feed_back(state, share)
        due = partial(schedules.interpolate, resets)  # else a reset that leaves P unchanged
        effect = CovarianceReset(*map(due, params.resets.covariance_reset, UNCHANGED))
        p = schedules.reset_covariance(effect, state.belief.p, params.reset_to, self.heading)
        closed = closed._replace(
            belief=closed.belief._replace(p=p),
            feedback_at=schedules.next_feedback(params.feedback, state.feedback_at, resets, n),
        )
        if self.trigger is not None:
            fed_back = scale(share, self.filter.misalignment(state))
            closed = triggers.add_feedback_or_restart(self.trigger, closed, resets, fed_back, n)
        if params.resets.width is not None:
            return closed  # a share of a reset is due at every sample
        # Chosen, not computed: nothing times infinity, and zero plus minus zero, would change it.
        return select_tree(feeds_back | resets, closed, state)

    def reverse(self, params: Any, site: Site, state: Any) -> Any:
        # x stays even if P is reset: its part of the attitude is the filter's best either way.
        state = self.filter.reverse([kind.sign for kind in self.states], state)
        p = schedules.reset_covariance(params.reversal, state.belief.p, params.p0, self.heading)
        state = state._replace(belief=state.belief._replace(p=p))
        return triggers.clear_memory_for_pass(self.trigger, state, self.filter.misalignment(state))

    def results(self, site: Site, state: Any) -> FilterResults:
        counts = None if self.trigger is None else state.trigger_state.trigger_counts
        return FilterResults(counts, state.innovations)


def _next_event(params: Any, state: Any, n: Scalar) -> Scalar | None:
    if params.resets.width is not None:
        return None  # a share of a reset is due at every sample
    return schedules.next_due(state.feedback_at, params.resets, n)


def _shift_counts(state: Any, n: Scalar) -> Any:
    state = state._replace(feedback_at=state.feedback_at + n)
    if state.trigger_state is None:
        return state
    last_reset = state.trigger_state.last_reset + n
    return state._replace(trigger_state=state.trigger_state._replace(last_reset=last_reset))


# The method, and its params from the keys of a study

LOOP_KEYS = (
    *("feedback_interval_s", "feedback_time_constant_s"),
    *("turn_covariance", "turn_inflation"),
)
"""The keys of [alignment] and [passes] that act on every filter."""


def filter_method(
    states: Sequence[StateKind], build: Callable[[Options], Filter], **parts: Any
) -> Method:
    """Return the method of a filter in closed loop, by default one without sensor bias states."""
    usual: dict[str, Any] = {
        "params": partial(filter_params, states),
        "sections": {"filter": FilterSection, "resets": ResetsSection},
        "reads": LOOP_KEYS,
        "without_effect": BIAS_KEYS,
        "turning": "none",
        "rules": (check_reset_times_and_schedules,),
        "columns": FILTER_COLUMNS,
    }
    return Method(
        build=lambda options: closed_loop(states, build(options), options), **usual | parts
    )


def filter_params(
    states: Sequence[StateKind], keys: StudyKeys, xp: Any, *, has_surge_states: bool = False
) -> FilterParams:
    """Return the params of a filter with states of these kinds, leaves (variants,).

    R does not follow the surge if other states model that; see `Method.params`.
    """
    zero = np.zeros(keys.count)

    def variances(when: str) -> list[Any]:
        return [
            zero + kind.variance if kind.name is None else keys.si(f"{when}_{kind.name}") ** 2
            for kind in states
        ]

    p0, after = variances("p0"), variances("reset")
    q_scale = keys.compute(lambda scale: 1.0 if scale is None else scale, "q_scale")
    q = {noise: _step_variance(keys, noise) * q_scale for noise in (ACCEL_NOISE, GYRO_NOISE)}
    reads_surge = keys.has("motion") and not has_surge_states
    of_r = keys_of(filter_keys.update_variance)[: None if reads_surge else 3]
    return FilterParams(
        p0=tuple(p0),
        q=tuple(zero if kind.q is None else q[kind.q] for kind in states),
        r=keys.compute(partial(filter_keys.update_variance, keys.rate_hz), *of_r),
        feedback=_feedback_schedule(keys, xp),
        resets=_reset_schedule(keys),
        # Left out, a reset sets P as at the start.
        reset_to=tuple(
            xp.where(xp.isnan(to), start, to) for to, start in zip(after, p0, strict=True)
        ),
        reversal=_covariance_reset(keys, "turn_covariance", "turn_inflation")
        if keys.has("passes")
        else CovarianceReset(*(np.broadcast_to(k, zero.shape) for k in UNCHANGED)),
        trigger=_trigger_params(keys),
    )


def _step_variance(keys: StudyKeys, noise: ProcessNoise) -> Any:
    """Return the variance added per step, (variants,), by a form of a key or the sensors' noise."""
    readings = filter_keys.q_unit_factors(1 / keys.rate_hz)
    given = next((form for form in noise.forms if keys.common(form) is not None), None)
    if given is None:
        white = keys.compute(partial(noise.density, keys.rate_hz), *noise.white)
        return (white * si_factor(noise.key, keys.micro_g)) ** 2 * readings["psd"]
    reading = keys.compute(readings.__getitem__, "q_reading")
    return keys.si(given) ** 2 * reading


def _trigger_params(keys: StudyKeys) -> TriggerParams | None:
    """Return the params of the trigger; None without one."""
    if not filter_keys.has_trigger(keys.common("reset_trigger")):
        return None
    rate_hz = keys.rate_hz
    until = keys.compute(lambda time: np.inf if time is None else time, "trigger_until_s")
    return TriggerParams(
        threshold=keys.column("trigger_threshold"),
        window=np.round(keys.column("trigger_window_s") * rate_hz),
        refractory=np.round(keys.column("trigger_refractory_s") * rate_hz),
        most=keys.column("trigger_most"),
        until=np.round(until * rate_hz),
    )


def _feedback_schedule(keys: StudyKeys, xp: Any) -> FeedbackSchedule:
    """Return intervals in samples and gains 1 - exp(-interval/time constant)."""
    every = xp.round(keys.column("feedback_interval_s") * keys.rate_hz)
    constant_s = keys.column("feedback_time_constant_s")
    lags = constant_s > 0
    gain = -xp.expm1(-every / keys.rate_hz / xp.where(lags, constant_s, 1.0))
    restarts = keys.compute(float, "reset_restarts_feedback")
    gain = xp.where(lags, gain, 1.0)
    return FeedbackSchedule(every, gain, restarts if restarts.any() else None)


def _reset_schedule(keys: StudyKeys) -> Resets:
    acting = partial(filter_keys.acting_reset_times, keys.rate_hz)
    samples = keys.lists(acting, *filter_keys.RESET_KEYS, padding=np.inf) * keys.rate_hz
    if isinstance(samples, np.ndarray):  # traced, a window moves with its time
        samples = np.round(samples)
    return Resets(samples, _covariance_reset(keys, "reset_kind", "reset_scale"))


def _covariance_reset(keys: StudyKeys, kind: str, factor: str) -> CovarianceReset:
    """Return the effects on P of ``reset_kind`` or ``turn_covariance``."""

    def numbers(name: str, given: Any) -> Sequence[Any]:
        full, scaled = (0.0, 0.0, 1.0, 1.0), (given, given, 0.0, 0.0)
        kinds = {"full": full, "yaw": (1.0, 0.0, 0.0, 1.0), "scale": scaled}
        return {**kinds, "carried": UNCHANGED, "inflated": scaled, "reset": full}[name]

    return CovarianceReset(*keys.compute(numbers, kind, factor).T)
