"""A filter on a base that is turned: no update during a turn, and P partly reopened after it.

A turn adds errors of scale factor, cross-axis and lever arm to velocity and level, which no state
of the filter models. The base is at rest again after the turn, so velocity restarts from zero, and
level and accelerometer biases are found anew. Heading and gyro biases keep the knowledge from
earlier positions.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from sinsjax.maths.algebra import Triangle, select_tree, triangle_index
from sinsjax.maths.rotations import matrix
from sinsjax.methods.filters.closed_loop import Filter
from sinsjax.methods.kalman import Innovation
from sinsjax.strapdown.error_model import VE, VN
from sinsjax.types import Flag, Navigation, Sample, Scalar, Vec3

_STILL, _TURNING, _STOPPED = 0.0, 1.0, 2.0
"""Values of the state ``turning``: at rest, during a turn, in the first sample after it."""


def reopen_after_turns(filter_: Filter, kept: Sequence[int]) -> Filter:
    """Return the filter that skips updates while the base turns, and reopens P afterwards.

    Args:
        filter_: its params have ``turning_rate``, its state has ``turning``.
        kept: numbers of the states whose part of P is kept over a turn.
    """

    def init(params: Any, nav: Navigation) -> Any:
        return filter_.init(params, nav)._replace(turning=jnp.zeros_like(params.r))

    def propagate(params: Any, site: Any, state: Any, sample: Sample) -> Any:
        turns = is_turning(state.nav, sample, params.turning_rate, filter_.dt)
        at_rest = jnp.where(_is_turning(state), _STOPPED, _STILL)
        turning = jnp.where(turns, _TURNING, at_rest)
        return filter_.propagate(params, site, state, sample)._replace(turning=turning)

    def update(params: Any, state: Any) -> tuple[Any, Innovation]:
        updated, innovation = filter_.update(params, state)
        updated = select_tree(_is_turning(state), state, updated)
        stopped = _restart_from_rest(state, params.p0, kept)
        return select_tree(_has_stopped(state), stopped, updated), innovation

    return filter_._replace(
        init=init,
        propagate=propagate,
        update=update,
        has_update=_is_still,
    )


def is_turning(nav: Navigation, sample: Sample, rate: Scalar, dt: float) -> Flag:
    """Return whether the gyros sense a rate about the computed vertical above a limit.

    Sways in pitch and roll hardly have such a rate, however large they are.

    Args:
        nav: navigation solution before the sample.
        sample: sample, with all its gyro errors.
        rate: limit, rad/s.
        dt: sample time, s.
    """
    up, half = matrix(nav.q)[2], Vec3(sample.turn.x, sample.turn.y, sample.turn.z)
    return jnp.abs(up.x * half.x + up.y * half.y + up.z * half.z) > 0.5 * dt * rate


def reopen(p: Triangle, p0: tuple[Scalar, ...], kept: Sequence[int]) -> Triangle:
    """Return P of some states with the variances P0 of all others, without their covariances.

    Args:
        p: covariance.
        p0: variances of all states at the start.
        kept: numbers of the states whose variances and covariances stay.
    """
    out = list(p)
    for (i, j), place in triangle_index(len(p0)).items():
        if i not in kept or j not in kept:
            out[place] = p0[i] if i == j else jnp.zeros_like(p0[i])
    return tuple(out)


def _restart_from_rest(state: Any, p0: tuple[Scalar, ...], kept: Sequence[int]) -> Any:
    zero = jnp.zeros_like(state.nav.ve)
    x = tuple(zero if place in (VE, VN) else value for place, value in enumerate(state.belief.x))
    belief = state.belief._replace(x=x, p=reopen(state.belief.p, p0, kept))
    return state._replace(nav=state.nav._replace(ve=zero, vn=zero), belief=belief)


def _is_turning(state: Any) -> Flag:
    return state.turning == _TURNING


def _has_stopped(state: Any) -> Flag:
    return state.turning == _STOPPED


def _is_still(state: Any) -> Flag:
    return state.turning == _STILL
