"""Zero-velocity alignment with a model that is nonlinear in the azimuth, and linear else.

The loop is that of [P1]; what differs is how the belief is predicted (`prediction`), and how the
attitude is fed back: as small angles, or as the azimuth and the shortest turn of the vertical.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, Minus, triangle_index
from sinsjax.methods.azimuth.model import (
    AZIMUTH,
    REVERSAL,
    STATES,
    TILT_E,
    TILT_N,
    VE,
    VN,
    derivative,
)
from sinsjax.methods.base import AttitudeCovariance, Method, Options, Site, StartChange
from sinsjax.methods.filters.stages import (
    Filter,
    FilterParams,
    FilterState,
    begin,
    mechaniser,
    place_of,
    reversed_by,
    unaided,
    update_by_velocity,
)
from sinsjax.methods.filters.tilt import changed, of_attitude, turned, turned_covariance
from sinsjax.methods.kalman import Belief
from sinsjax.methods.schedules import reset_covariance
from sinsjax.methods.triggers.watched import method_of
from sinsjax.strapdown import mechanisation
from sinsjax.strapdown.earth import Place
from sinsjax.types import Navigation, Quat, Sample, Scalar, Vec3

Prediction = Callable[[Belief, Place, Scalar, Scalar], Belief]
"""(belief, place, dt, alpha) -> belief a sample later, its process noise not yet added."""


class AzimuthParams(NamedTuple):
    """`FilterParams.own`, which is `FilterState.own` too.

    Attributes:
        by_angles: 1 where the attitude is fed back as small angles, else 0.
        alpha: spread of the sigma points; 1 where there are none.
    """

    by_angles: Scalar
    alpha: Scalar


def build(predict: Prediction, options: Options) -> Method:
    """The method; `Options.specific_force` is always that of a base at rest.

    Args:
        predict: see `Prediction`.
        options: what decides the program.
    """
    return method_of(filter_of(predict, options), options)


def filter_of(predict: Prediction, options: Options) -> Filter:
    """Its filter; arguments as of `build`."""
    dt, mechanise = options.dt, mechaniser(options)

    def init(params: FilterParams, nav: Navigation) -> FilterState:
        return begin(params, nav)._replace(own=params.own)

    def propagate(
        params: FilterParams, site: Site, state: FilterState, sample: Sample
    ) -> tuple[FilterState, Entries]:
        nav, _, here = mechanise(site, state.nav, sample)
        belief = predict(state.belief, here, dt, params.own.alpha)
        return state._replace(nav=nav, belief=belief), at_rest(state, here)

    def at_rest(state: FilterState, here: Place) -> Entries:
        return derivative(state.belief.x, here, dt)

    return Filter(
        dt,
        init,
        propagate,
        update_by_velocity,
        _feed_back,
        partial(reset_covariance, heading=(AZIMUTH,)),
        partial(reversed_by, REVERSAL),
        place_of(options.position),
        at_rest,
        _misalignment,
        _attitude,
        _covariance,
        unaided,
        _inputs,
        _start_error,
    )


def _rotation(state: FilterState, phi: Vec3) -> Quat:
    """What takes the attitude to one that is corrected by tilt and azimuth (rad)."""
    by_angles = rotations.exp(phi)
    sine, cosine = rotations.sin_cos(phi.z)
    by_vector = turned(phi.x, phi.y, sine, cosine)
    return jax.tree.map(lambda a, b: jnp.where(state.own.by_angles > 0, a, b), by_angles, by_vector)


def _inputs(state: FilterState) -> Entries:
    turned_by = {(i, 3 + k): Minus(1.0) for k, i in enumerate((TILT_E, TILT_N, AZIMUTH))}
    return {(VE, 0): 1.0, (VN, 1): 1.0, **turned_by}


def _start_error(state: FilterState, change: StartChange) -> tuple[Scalar, ...]:
    tilt_e, tilt_n, sine, cosine = changed(change)
    _, _, s, c = of_attitude(change.attitude)
    return (change.ve, change.vn, tilt_e, tilt_n, c * sine - s * cosine)


def _feed_back(state: FilterState, share: Scalar) -> tuple[FilterState, Vec3]:
    x = state.belief.x
    fed = tuple(share * one for one in x)
    nav = mechanisation.correct_velocity(state.nav, fed[VE], fed[VN])
    phi = Vec3(fed[TILT_E], fed[TILT_N], fed[AZIMUTH])
    corrected = state._replace(
        nav=nav._replace(q=rotations.multiply(_rotation(state, phi), nav.q)),
        belief=state.belief._replace(x=tuple(a - b for a, b in zip(x, fed, strict=True))),
    )
    return corrected, phi


def _misalignment(state: FilterState) -> Vec3:
    x = state.belief.x
    return Vec3(x[TILT_E], x[TILT_N], x[AZIMUTH])


def _attitude(state: FilterState) -> Quat:
    return rotations.multiply(_rotation(state, _misalignment(state)), state.nav.q)


def _covariance(state: FilterState) -> AttitudeCovariance:
    at = triangle_index(len(STATES))
    angles = (TILT_E, TILT_N, AZIMUTH)
    of_tilt = AttitudeCovariance(
        *(state.belief.p[at[i, j]] for i in angles for j in angles if i <= j)
    )
    return turned_covariance(of_tilt, *rotations.sin_cos(state.belief.x[AZIMUTH]))
