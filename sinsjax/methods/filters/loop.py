"""A Kalman filter in closed loop: from the stages of a `Filter` to its `Program`.

The order within a sample is that of [P1]: mechanise and propagate, add the process noise, update
with the measured velocity; then, if they are due, feed the estimate back and reset P. Schedules of
feedback and resets, triggers, direction reversals and the sum of innovations are the same for every
filter, whatever its states.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.maths.algebra import Entries, Triangle, add, change_signs, select_tree
from sinsjax.methods.filters import kalman, triggers
from sinsjax.methods.filters.attitude import (
    corrected_attitude,
    estimated_misalignment,
    misalignment_covariance,
)
from sinsjax.methods.filters.kalman import Belief, Innovation
from sinsjax.methods.filters.triggers import TRIGGERS, Trigger, TriggerCounts
from sinsjax.methods.method import (
    AttitudeCovariance,
    Feedback,
    Options,
    Passes,
    Program,
    Site,
)
from sinsjax.methods.schedules import (
    CovarianceReset,
    Due,
    FeedbackSchedule,
    Resets,
    Windows,
    interpolate,
    next_due,
    next_feedback,
    reset_covariance,
    reset_due,
    reset_if_due,
)
from sinsjax.strapdown import mechanisation
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.error_model import VE, VN
from sinsjax.types import Flag, Navigation, Quat, Sample, Scalar, Vec3


class InnovationSum(NamedTuple):
    """Sum and number of the normalised innovations squared r' S^-1 r of a run."""

    sum: Scalar
    count: Scalar


class FilterResults(NamedTuple):
    """Basis of a filter's own result columns.

    Attributes:
        trigger_counts: resets by its trigger; None without one.
        innovations: sum of its innovations; None if they are not summed.
        extra: basis of the columns of this filter alone; None if the filter has none.
    """

    trigger_counts: TriggerCounts | None
    innovations: InnovationSum | None
    extra: Any = None


class FilterParams(NamedTuple):
    """Numbers of a filter: its belief and its schedules.

    Attributes:
        p0: initial variances of the states, SI squared.
        q: variances added to the states each sample, SI squared.
        r: variance of each velocity measurement, (m/s)^2.
        feedback: when and how much is fed back.
        resets: when and how P is reset.
        reset_to: variances that a full reset sets, SI squared.
        reversal: effect of a direction reversal on P.
        trigger: `triggers.TriggerParams`; None without a trigger.
        extra: numbers of this filter alone; None if the filter has none.
    """

    p0: tuple[Scalar, ...]
    q: tuple[Scalar, ...]
    r: Scalar
    feedback: FeedbackSchedule
    resets: Resets | Windows
    reset_to: tuple[Scalar, ...]
    reversal: CovarianceReset
    trigger: Any = None
    extra: Any = None


class FilterState(NamedTuple):
    """A filter between two samples.

    Attributes:
        nav: navigation solution.
        belief: estimated errors of ``nav`` and of the sensors, with covariance.
        bias: sensor biases fed back so far, one per bias state, SI.
        feedback_at: sample of the next feedback.
        trigger_state: `triggers.TriggerState`; None without a trigger.
        innovations: their sum so far; None if they are not summed.
        extra: state of this filter alone; None if the filter has none.
    """

    nav: Navigation
    belief: Belief
    bias: tuple[Scalar, ...]
    feedback_at: Scalar
    trigger_state: Any = None
    innovations: InnovationSum | None = None
    extra: Any = None


# Stages that filters share


def initial_state(params: FilterParams, nav: Navigation) -> FilterState:
    """Return the state of a filter whose estimates begin with zero, with no bias fed back."""
    return FilterState(nav, kalman.initial_belief(params.p0), (), params.feedback.every)


def update_with_velocity(params: Any, state: Any) -> tuple[Any, Innovation]:
    """Update with the velocity, which should be zero: [P1] eqs (10)-(12)."""
    measured = state.nav.ve, state.nav.vn
    innovation = kalman.innovation(state.belief, (VE, VN), measured, params.r)
    belief = kalman.update(state.belief, (VE, VN), measured, params.r)
    return state._replace(belief=belief), innovation


def reverse_time(signs: Sequence[float], state: Any) -> Any:
    """Return the state in reversed time: velocity negated, each estimate with its sign."""
    x, p = state.belief
    belief = Belief(tuple(s * a for s, a in zip(signs, x, strict=True)), change_signs(signs, p))
    return state._replace(nav=mechanisation.reverse_velocity(state.nav), belief=belief)


def subtract_fed_back(belief: Belief, fed_back: Sequence[Scalar]) -> Belief:
    """Return the belief after the given part of its estimates has been fed back."""
    x = tuple(a - b for a, b in zip(belief.x, fed_back, strict=True))
    return belief._replace(x=x)


# The loop


class Filter(NamedTuple):
    """The stages of a filter that measures the velocity of a base that does not travel.

    Its params have the fields of `FilterParams`, its state those of `FilterState`; both may have
    more. Its first two states are the velocity errors.

    Attributes:
        predict: (params, state, place, f dt in n, m/s) -> state with its belief propagated over a
            sample; the solution is still that before it, and the process noise is added later.
        feed_back: (state, share) -> state with that share of its estimate moved into the
            navigation solution, and the correction of its attitude, rad.
        reverse: state -> state with which the record is read in the other direction.
        at_rest: (state, place) -> transition of a base at rest, with specific force (0, 0, g).
        heading: numbers of the states of heading.
        init: (params, navigation) -> state.
        update: (params, state) -> state after the update with the velocity, and the `Innovation`.
        misalignment: state -> estimated misalignment that is not fed back yet, rad.
        attitude: state -> best attitude.
        covariance: state -> covariance of that attitude.
        correct: (state, sample) -> sample without the biases found; None if none are.
        extra_results: (site, state) -> `FilterResults.extra`; None if the filter has none.
        shares_covariance: see `Program.shares_covariance`.
        keep: (first state of a record, state at its end) -> the first with all that is no error of
            the navigation solution; None if the filter keeps nothing.
        gyro_bias: see `Passes.gyro_bias`.
    """

    predict: Callable[[Any, Any, Place, Vec3], Any]
    feed_back: Callable[[Any, Scalar], tuple[Any, Vec3]]
    reverse: Callable[[Any], Any]
    at_rest: Callable[[Any, Place], Entries]
    heading: tuple[int, ...]
    init: Callable[[Any, Navigation], Any] = initial_state
    update: Callable[[Any, Any], tuple[Any, Innovation]] = update_with_velocity
    misalignment: Callable[[Any], Vec3] = estimated_misalignment
    attitude: Callable[[Any], Quat] = corrected_attitude
    covariance: Callable[[Any], AttitudeCovariance] = misalignment_covariance
    correct: Callable[[Any, Sample], Sample] | None = None
    extra_results: Callable[[Site, Any], Any] | None = None
    shares_covariance: bool = False
    keep: Callable[[Any, Any], Any] | None = None
    gyro_bias: Callable[[Any], Vec3] | None = None


def closed_loop(filter_: Filter, options: Options) -> Program:
    """Return the program of a filter that feeds back and resets P on schedule or by a trigger."""
    trigger = None if options.trigger == "none" else TRIGGERS[options.trigger]
    loop = _ClosedLoop(filter_, options, trigger)
    return Program(
        init=loop.init,
        step=loop.step,
        attitude=filter_.attitude,
        covariance=filter_.covariance,
        results=loop.results,
        shares_covariance=filter_.shares_covariance and trigger is None,
        feedback=Feedback(
            close=loop.close,
            next_event=_next_event,
            triggered=None if trigger is None else _fired,
        ),
        passes=Passes(
            reverse=loop.reverse,
            rewind=loop.rewind,
            begin_after=_begin_after,
            gyro_bias=filter_.gyro_bias,
        ),
    )


class _ClosedLoop(NamedTuple):
    """A filter in closed loop, and the trigger that resets it in addition to the schedule."""

    filter: Filter
    options: Options
    trigger: Trigger | None

    def init(self, params: Any, nav: Navigation) -> Any:
        state = self.filter.init(params, nav)
        if self.options.innovations:
            zero = jnp.zeros_like(params.r)
            state = state._replace(innovations=InnovationSum(zero, zero))
        if self.trigger is not None:
            started = triggers.start(self.trigger, params.trigger, state.belief.p)
            state = state._replace(trigger_state=started)
        return state

    def step(self, params: Any, site: Site, state: Any, sample: Sample, n: Scalar) -> Any:
        before, dt, here = state, self.options.dt, self.options.place(site, state.nav)
        if self.filter.correct is not None:
            sample = self.filter.correct(state, sample)
        nav, f_dt = mechanisation.advance_navigation(state.nav, sample, here, dt)
        if self.options.position == "integrated":
            nav = mechanisation.advance_position(nav, here, dt)
        predicted = self.filter.predict(params, state, here, f_dt)  # [P1] eqs (8) and (9)
        belief = kalman.add_noise(predicted.belief, params.q)
        state = predicted._replace(nav=nav, belief=belief)
        state, innovation = self.filter.update(params, state)
        if self.options.innovations:
            total, count = state.innovations
            total = total + kalman.normalised_innovation_squared(*innovation)
            state = state._replace(innovations=InnovationSum(total, count + 1))
        if self.trigger is not None:
            state = self._update_trigger(params, site, before, state, innovation, n)
        return state

    def close(self, params: Any, state: Any, n: Scalar) -> Any:
        due = Due(n >= state.feedback_at, reset_due(params.resets, n))
        if self.trigger is not None:
            due = due._replace(reset=due.reset | _fired(state, n))
        closed, correction = self._feed_back_and_reset(params, state, due, n)
        if self.trigger is not None:
            closed = triggers.update_after_closing(
                self.trigger, params, closed, reset=due.reset, correction=correction, n=n
            )
        return _where_due(due, closed, state)

    def reverse(self, params: Any, site: Site, state: Any) -> Any:
        # x stays even if P is reset: its part of the attitude is the filter's best either way.
        state = self.filter.reverse(state)
        p = self._reset(params.reversal, state.belief.p, params.p0)
        return self._begin_pass(params, state._replace(belief=state.belief._replace(p=p)))

    def rewind(self, params: Any, nav: Navigation, state: Any) -> Any:
        # All knowledge of the solution's errors is in the solution; P is that of a start.
        first = self.filter.init(params, nav)
        kept = first if self.filter.keep is None else self.filter.keep(first, state)
        kept = kept._replace(
            feedback_at=state.feedback_at,
            innovations=state.innovations,
            trigger_state=state.trigger_state,
        )
        return self._begin_pass(params, kept)

    def results(self, site: Site, state: Any) -> FilterResults:
        extra = self.filter.extra_results
        return FilterResults(
            None if self.trigger is None else state.trigger_state.trigger_counts,
            state.innovations,
            None if extra is None else extra(site, state),
        )

    def _feed_back_and_reset(
        self, params: Any, state: Any, due: Due, n: Scalar
    ) -> tuple[Any, Vec3]:
        """Feed back, all of the estimate before a reset, and reset; also the correction, rad."""
        share = interpolate(due.reset, 1.0, jnp.where(due.feedback, params.feedback.gain, 0.0))
        corrected, correction = self.filter.feed_back(state, share)
        covariance_reset = reset_if_due(due.reset, params.resets.covariance_reset)
        p = self._reset(covariance_reset, state.belief.p, params.reset_to)
        feedback_at = next_feedback(params.feedback, state.feedback_at, due, n)
        belief = corrected.belief._replace(p=p)
        return corrected._replace(belief=belief, feedback_at=feedback_at), correction

    def _reset(
        self, covariance_reset: CovarianceReset, p: Triangle, to: tuple[Scalar, ...]
    ) -> Triangle:
        return reset_covariance(covariance_reset, p, to, heading=self.filter.heading)

    def _update_trigger(
        self, params: Any, site: Site, before: Any, state: Any, innovation: Innovation, n: Scalar
    ) -> Any:
        """Return the state with the sample taken into account by the trigger."""
        assert self.trigger is not None
        not_fed_back = self.filter.misalignment(state)
        snapshot = triggers.FilterSnapshot(
            innovation=innovation,
            belief=state.belief,
            correction=add(state.trigger_state.fed_back, not_fed_back),
            not_fed_back=not_fed_back,
            covariance=lambda belief: self.filter.covariance(state._replace(belief=belief)),
            at_rest=self.filter.at_rest(before, self.options.place(site, before.nav)),
        )
        return triggers.update_trigger(self.trigger, params, state, snapshot, n)

    def _begin_pass(self, params: Any, state: Any) -> Any:
        """Return the first state of a pass, with the trigger's memory of the last one cleared."""
        if self.trigger is None:
            return state
        return triggers.begin_pass(
            self.trigger, params, state, misalignment=self.filter.misalignment(state)
        )


def _next_event(params: Any, state: Any, n: Scalar) -> Scalar | None:
    if isinstance(params.resets, Windows):
        return None  # a share of a reset is due at every sample
    return next_due(state.feedback_at, params.resets, n)


def _fired(state: Any, n: Scalar) -> Flag:
    return triggers.fired(state.trigger_state, n)


def _where_due(due: Due, closed: Any, state: Any) -> Any:
    """Return the closed state if anything is due, else the state unchanged to the bit."""
    if not jnp.issubdtype(jnp.result_type(due.reset), bool):
        return closed  # a share of a reset is due at every sample
    # Chosen, not computed: nothing times infinity, and zero plus minus zero, would change it.
    either = due.feedback | due.reset
    return select_tree(either, closed, state)


def _begin_after(state: Any, n: Scalar) -> Any:
    state = state._replace(feedback_at=state.feedback_at + n)
    if state.trigger_state is None:
        return state
    last_reset = state.trigger_state.last_reset + n
    return state._replace(trigger_state=state.trigger_state._replace(last_reset=last_reset))
