"""A filter that resets itself: its stages, watched by a trigger."""

from typing import Any

from sinsjax.maths.algebra import add
from sinsjax.methods.base import FilterResults, Method, Options, Site
from sinsjax.methods.filters.stages import (
    Filter,
    closed_loop,
    fed_back_and_reset,
    only_where,
    scheduled,
    with_innovations,
    with_process_noise,
)
from sinsjax.methods.triggers import base as triggers
from sinsjax.methods.triggers.base import AssumedNoise, FilterSnapshot
from sinsjax.methods.triggers.description import TRIGGERS
from sinsjax.types import Flag, Navigation, Sample, Scalar


def method_of(filter_: Filter, options: Options) -> Method:
    """The method of a filter, with its innovations summed up and a trigger as options say."""
    watched = with_innovations(filter_) if options.innovations else filter_
    return with_trigger(watched, options.trigger)


def with_trigger(filter_: Filter, name: str) -> Method:
    """The method of a filter whose P is reset on schedule, and resets or fades by a trigger.

    Args:
        filter_: stages.
        name: of a trigger in `description.TRIGGERS`, or 'none' for the filter on schedule alone.
    """
    plain = closed_loop(filter_)
    if name == "none":
        return plain
    trigger = TRIGGERS[name].trigger

    def init(params: Any, nav: Navigation) -> Any:
        state = plain.init(params, nav)
        return state._replace(trigger_state=triggers.start(trigger, params.trigger, state.belief.p))

    def step(params: Any, site: Site, state: Any, sample: Sample, n: Scalar) -> Any:
        before, noise = state, AssumedNoise(params.q, params.r)
        state, _ = filter_.propagate(params, site, state, sample)
        measured = state.nav.ve, state.nav.vn
        watched, belief = triggers.fade(
            trigger, params.trigger, noise, state.trigger_state, state.belief, measured
        )
        faded = with_process_noise(params, state._replace(belief=belief))
        state, innovation = filter_.update(params, faded)
        place = filter_.place(site, before.nav)
        left = filter_.misalignment(state)
        snapshot = FilterSnapshot(
            innovation=innovation.value,
            variance=innovation.variance,
            belief=state.belief,
            correction=add(watched.fed, left),
            left=left,
            covariance=lambda belief: filter_.covariance(state._replace(belief=belief)),
            at_rest=filter_.at_rest(before, place),
            place=place,
            dt=filter_.dt,
        )
        watched = triggers.take_in(
            trigger, params.trigger, noise, watched, snapshot, n, feedback_at=state.feedback_at
        )
        return state._replace(trigger_state=watched)

    def close(params: Any, state: Any, n: Scalar) -> Any:
        due = scheduled(params, state, n)
        due = due._replace(reset=due.reset | called(state, n))
        closed, fed = fed_back_and_reset(filter_, params, state, due, n)
        watched, p = state.trigger_state, closed.belief.p
        watched = triggers.after(
            trigger, params.trigger, watched, reset=due.reset, p=p, fed=fed, n=n
        )
        return only_where(due, closed._replace(trigger_state=watched), state)

    def turn(params: Any, site: Site, state: Any) -> Any:
        return with_memory_anew(params, plain.turn(params, site, state), state)

    def begin_after(state: Any, n: Scalar) -> Any:
        assert plain.begin_after is not None
        watched = state.trigger_state
        since = watched.since + n
        return plain.begin_after(state, n)._replace(trigger_state=watched._replace(since=since))

    def with_memory_anew(params: Any, opened: Any, state: Any) -> Any:
        """The state that opens a pass, the trigger's memory of the one before forgotten."""
        watched = triggers.in_another_pass(
            trigger,
            params.trigger,
            state.trigger_state,
            p=opened.belief.p,
            misalignment=filter_.misalignment(opened),
        )
        return opened._replace(trigger_state=watched)

    def rewind(params: Any, nav: Navigation, state: Any) -> Any:
        assert plain.rewind is not None
        return with_memory_anew(params, plain.rewind(params, nav, state), state)

    def called(state: Any, n: Scalar) -> Flag:
        return triggers.fires(state.trigger_state, n)

    def results(site: Site, state: Any) -> FilterResults:
        assert plain.results is not None
        return plain.results(site, state)._replace(
            trigger_counts=state.trigger_state.trigger_counts
        )

    return plain._replace(
        init=init,
        step=step,
        turn=turn,
        rewind=rewind,
        begin_after=begin_after,
        results=results,
        close=close,
        called=called if trigger.look else None,
        common_covariance=False,
    )
