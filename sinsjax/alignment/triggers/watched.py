"""A filter that resets itself: its stages, watched by a trigger."""

from typing import Any, NamedTuple

from sinsjax.alignment.base import FilterResults
from sinsjax.alignment.filters import Closed, Due, Filter, Prior, innovation, wrapped
from sinsjax.alignment.triggers import base as triggers
from sinsjax.alignment.triggers.base import AssumedNoise, FilterSnapshot, TriggerState
from sinsjax.alignment.triggers.description import TRIGGERS
from sinsjax.maths.algebra import add
from sinsjax.types import Flag, Navigation, Scalar


class Watched(NamedTuple):
    """A filter and its trigger at work."""

    state: Any
    trigger_state: TriggerState


def triggered(filter_: Filter, name: str, dt: float) -> Filter:
    """A filter whose P is reset, or fades, where a trigger calls for it.

    Args:
        filter_: stages; their params have the trigger's numbers as ``trigger``.
        name: in `description.TRIGGERS`, or 'none' for the filter as it is.
        dt: sample time, s.
    """
    if name == "none":
        return filter_
    trigger, plain = TRIGGERS[name].trigger, wrapped(filter_)

    def init(params: Any, nav: Navigation) -> Watched:
        state = filter_.init(params, nav)
        return Watched(state, triggers.start(trigger, params.trigger, filter_.belief(state).p))

    def update(params: Any, watched: Watched, prior: Prior, n: Scalar) -> Watched:
        noise = AssumedNoise(*filter_.noise(params))
        measured = prior.nav.ve, prior.nav.vn
        trigger_state, belief = triggers.fade(
            trigger, params.trigger, noise, watched.trigger_state, prior.belief, measured
        )
        prior = prior._replace(belief=belief)
        state = filter_.update(params, watched.state, prior, n)
        r, s = innovation(filter_, params, prior)
        snapshot = FilterSnapshot(
            innovation=r,
            variance=s,
            belief=filter_.belief(state),
            correction=add(trigger_state.fed, filter_.misalignment(state)),
            at_rest=filter_.at_rest(watched.state, prior),
            place=prior.place,
            dt=dt,
        )
        return Watched(
            state, triggers.take_in(trigger, params.trigger, noise, trigger_state, snapshot, n)
        )

    def due(params: Any, watched: Watched, n: Scalar) -> Due:
        feedback, reset = filter_.due(params, watched.state, n)
        return Due(feedback, reset | triggers.fires(watched.trigger_state, n))

    def close(params: Any, watched: Watched, due: Due, n: Scalar) -> Closed:
        state, fed = filter_.close(params, watched.state, due, n)
        p = filter_.belief(state).p
        trigger_state = triggers.after(
            trigger, params.trigger, watched.trigger_state, reset=due.reset, p=p, fed=fed, n=n
        )
        return Closed(Watched(state, trigger_state), fed)

    def reverse(params: Any, site: Any, watched: Watched) -> Watched:
        state = filter_.reverse(params, site, watched.state)
        trigger_state = triggers.reversed_in_time(
            trigger,
            params.trigger,
            watched.trigger_state,
            p=filter_.belief(state).p,
            misalignment=filter_.misalignment(state),
        )
        return Watched(state, trigger_state)

    def called(watched: Watched, n: Scalar) -> Flag:
        return triggers.fires(watched.trigger_state, n)

    def results(watched: Watched) -> FilterResults:
        counts = watched.trigger_state.trigger_counts
        return filter_.results(watched.state)._replace(trigger_counts=counts)

    return plain._replace(
        init=init,
        update=update,
        due=due,
        close=close,
        reverse=reverse,
        results=results,
        called=called if trigger.look else None,
    )
