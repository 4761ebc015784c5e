"""A Kalman filter in closed loop, stage by stage, and how the stages make up a method.

The order within a sample is that of [P1]: mechanise and predict, add the process noise, update by
the measured velocity; then, where they are due, feed the estimate back and reset P. What a filter
is watched by, a trigger (`triggers.watched`) or the sum of its innovations, wraps its stages and is
a filter itself.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.alignment import kalman
from sinsjax.alignment.base import AttitudeCovariance, Ending, FilterResults, Innovations, Method
from sinsjax.alignment.limits import Biases, Limit
from sinsjax.maths.algebra import Entries, triangle_index
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.error_model import VE, VN
from sinsjax.types import Flag, Navigation, Quat, Sample, Scalar, Vec3


class Prior(NamedTuple):
    """A filter between prediction and update.

    Attributes:
        nav: mechanised navigation solution.
        place: Earth rates and curvatures that it was mechanised with.
        belief: propagated, its process noise not yet added.
    """

    nav: Navigation
    place: Place
    belief: kalman.Belief


class Due(NamedTuple):
    """What is due after a sample.

    Attributes:
        feedback: whether the estimate is fed back.
        reset: whether P is reset, which feeds all of the estimate back first; or, of a relaxed
            schedule, which share of a reset.
    """

    feedback: Flag
    reset: Flag | Scalar


class Closed(NamedTuple):
    """A filter whose loop was closed.

    Attributes:
        state: after feedback and reset.
        fed: attitude correction that was fed back, rad.
    """

    state: Any
    fed: Vec3


class Filter(NamedTuple):
    """The stages of a filter; its measurement is the velocity of a base that does not travel.

    Attributes:
        init: (params, navigation) -> state.
        predict: (params, site, state, sample) -> `Prior`.
        update: (params, state, prior, n) -> state after the n-th sample's update.
        due: (params, state, n) -> `Due` after the n-th sample.
        close: (params, state, due, n) -> `Closed`.
        next_event: (params, state, n) -> see `Method.next_event`.
        reverse: (params, site, state) -> state with which the record is read in the other
            direction, see `Method.turn`.
        noise: params -> (variances added to the states each sample, variance of a measurement).
        at_rest: (state before the sample, prior) -> transition of a base at rest, whose specific
            force is (0, 0, g).
        belief: state -> mean and covariance; the first states are those of [P1] eq. (1).
        misalignment: state -> estimated misalignment that is not fed back yet, rad.
        attitude: state -> best attitude.
        covariance: state -> of that attitude.
        normalise: state -> state with its quaternion scaled to unit length.
        limit: see `Method.limit`.
        results: state -> `FilterResults`.
        called: see `Method.called`.
    """

    init: Callable[[Any, Navigation], Any]
    predict: Callable[[Any, Any, Any, Sample], Prior]
    update: Callable[[Any, Any, Prior, Scalar], Any]
    due: Callable[[Any, Any, Scalar], Due]
    close: Callable[[Any, Any, Due, Scalar], Closed]
    next_event: Callable[[Any, Any, Scalar], Scalar | None]
    reverse: Callable[[Any, Any, Any], Any]
    noise: Callable[[Any], tuple[tuple[Scalar, ...], Scalar]]
    at_rest: Callable[[Any, Prior], Entries]
    belief: Callable[[Any], kalman.Belief]
    misalignment: Callable[[Any], Vec3]
    attitude: Callable[[Any], Quat]
    covariance: Callable[[Any], AttitudeCovariance]
    normalise: Callable[[Any], Any]
    limit: Callable[[Any, Place, Biases, Ending], Limit]
    results: Callable[[Any], FilterResults]
    called: Callable[[Any, Scalar], Flag] | None = None


def closed_loop(filter_: Filter, *, common_covariance: bool = False) -> Method:
    """The method that a filter's stages make up.

    Args:
        filter_: stages.
        common_covariance: see `Method`.
    """

    def step(params: Any, site: Any, state: Any, sample: Sample, n: Scalar) -> Any:
        return filter_.update(params, state, filter_.predict(params, site, state, sample), n)

    def close(params: Any, state: Any, n: Scalar) -> Any:
        due = filter_.due(params, state, n)
        closed = filter_.close(params, state, due, n).state
        if not jnp.issubdtype(jnp.result_type(due.reset), bool):
            return closed  # a share of a reset is due at every sample
        # Chosen, not computed: nothing times infinity, and zero plus minus zero, would change it.
        any_due = due.feedback | due.reset
        return jax.tree.map(lambda new, old: jnp.where(any_due, new, old), closed, state)

    return Method(
        filter_.init,
        step,
        filter_.reverse,
        filter_.attitude,
        filter_.covariance,
        filter_.normalise,
        filter_.limit,
        results=filter_.results,
        close=close,
        next_event=filter_.next_event,
        called=filter_.called,
        common_covariance=common_covariance,
    )


class Innovation(NamedTuple):
    """An innovation, and its believed covariance.

    Attributes:
        r: measured minus predicted velocity, east and north, m/s.
        s: upper triangle of its covariance (ee, en, nn), (m/s)^2.
    """

    r: tuple[Scalar, Scalar]
    s: tuple[Scalar, Scalar, Scalar]


def innovation(filter_: Filter, params: Any, prior: Prior) -> Innovation:
    """The innovation that a filter is about to be updated by."""
    q, r = filter_.noise(params)
    x, p = kalman.add_noise(prior.belief, q)
    at = triangle_index(len(x))
    return Innovation(
        (prior.nav.ve - x[VE], prior.nav.vn - x[VN]),
        (p[at[VE, VE]] + r, p[at[VE, VN]], p[at[VN, VN]] + r),
    )


def normalised(r: tuple[Scalar, Scalar], s: tuple[Scalar, ...]) -> Scalar:
    """An innovation r squared and normalised, r' S^-1 r."""
    (e, n), (ee, en, nn) = r, s
    return (nn * e * e - 2 * en * e * n + ee * n * n) / (ee * nn - en * en)


class Summed(NamedTuple):
    """A filter, and the sum of its normalised innovations."""

    state: Any
    innovations: Innovations


def with_innovations(filter_: Filter) -> Filter:
    """A filter that sums up its normalised innovations."""

    def init(params: Any, nav: Navigation) -> Summed:
        zero = jnp.zeros_like(filter_.noise(params)[1])
        return Summed(filter_.init(params, nav), Innovations(zero, zero))

    def update(params: Any, state: Summed, prior: Prior, n: Scalar) -> Summed:
        so_far = state.innovations
        squared = normalised(*innovation(filter_, params, prior))
        return Summed(
            filter_.update(params, state.state, prior, n),
            Innovations(so_far.sum + squared, so_far.count + 1),
        )

    def results(state: Summed) -> FilterResults:
        return filter_.results(state.state)._replace(innovations=state.innovations)

    return wrapped(filter_)._replace(init=init, update=update, results=results)


def wrapped(filter_: Filter) -> Filter:
    """The stages of a filter whose state is a part of another: a tuple with field ``state``."""

    def inner(stage: Callable[..., Any]) -> Callable[..., Any]:
        return lambda state, *rest: stage(state.state, *rest)

    def predict(params: Any, site: Any, state: Any, sample: Sample) -> Prior:
        return filter_.predict(params, site, state.state, sample)

    def update(params: Any, state: Any, prior: Prior, n: Scalar) -> Any:
        return state._replace(state=filter_.update(params, state.state, prior, n))

    def due(params: Any, state: Any, n: Scalar) -> Due:
        return filter_.due(params, state.state, n)

    def close(params: Any, state: Any, due: Due, n: Scalar) -> Closed:
        closed = filter_.close(params, state.state, due, n)
        return Closed(state._replace(state=closed.state), closed.fed)

    def reverse(params: Any, site: Any, state: Any) -> Any:
        return state._replace(state=filter_.reverse(params, site, state.state))

    return filter_._replace(
        predict=predict,
        update=update,
        due=due,
        close=close,
        next_event=lambda params, state, n: filter_.next_event(params, state.state, n),
        reverse=reverse,
        at_rest=inner(filter_.at_rest),
        belief=inner(filter_.belief),
        misalignment=inner(filter_.misalignment),
        attitude=inner(filter_.attitude),
        covariance=inner(filter_.covariance),
        normalise=lambda state: state._replace(state=filter_.normalise(state.state)),
        results=inner(filter_.results),
        called=inner(filter_.called) if filter_.called else None,
    )
