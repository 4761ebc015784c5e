"""Zero-velocity alignment from an unknown heading: sine and cosine of the azimuth as states.

The computed frame n' is rotated from n by an azimuth a of any size and a small tilt:
C_{n'}^n = Rz(a) e, where e rotates u, the true vertical seen in n', to z. With s = sin a and
k = 1 - cos a as states, the model of a base at rest is linear for any heading, and constant:
P and the gains are the same for all runs of a variant.

    dV_E' =  2 w_U dV_N - g t_N          t_E' = -dV_N/R + w_U t_N - w_N s
    dV_N' = -2 w_U dV_E + g t_E          t_N' =  dV_E/R - w_U t_E + w_N k

with t_E = u_N and t_N = -u_E. The velocity is fed back, and the tilt as the shortest rotation of u
to z; s and k stay in the filter. They start from an unknown heading: sin a and cos a have mean zero
and variance 1/2 each. The deviation of sqrt(s^2 + cos^2 a) from 1 is the north gyro drift in units
of w_N. After Dmitriyev, Stepanov and Shepel (1997) and Rogers (1997).
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, Minus, triangle_index
from sinsjax.methods.filters.attitude import (
    rotate_covariance,
    rotation_from_tilt,
    shortest_rotation,
)
from sinsjax.methods.filters.keys import BIAS_KEYS, DIRECTION, LEVEL, VELOCITY
from sinsjax.methods.filters.loop import Filter, FilterParams, FilterState, initial_state
from sinsjax.methods.filters.params import filter_method
from sinsjax.methods.method import (
    UNKNOWN_ANGLE,
    AttitudeCovariance,
    Options,
)
from sinsjax.strapdown import mechanisation
from sinsjax.strapdown.earth import Place
from sinsjax.types import Flag, Navigation, Quat, Scalar, Vec3

STATES = (VELOCITY, VELOCITY, LEVEL, LEVEL, DIRECTION, DIRECTION)
VE, VN, TILT_E, TILT_N, SINE, VERSINE = range(6)

LEAST_AMPLITUDE = 0.05
"""sqrt(s^2 + cos^2 a) below which the heading is still unknown and keeps its initial value."""


class Direction(NamedTuple):
    """The estimated heading as a direction in the level plane."""

    known: Flag  # whether the measurements determine it; else it is that of the solution
    sine: Scalar  # of the azimuth
    cosine: Scalar  # of the azimuth
    amplitude: Scalar  # sqrt(s^2 + cos^2 a); 1 without gyro drift, and 1 where it is not known


def build_filter(options: Options) -> Filter:
    """Return the filter; `Options.specific_force` is always that of a base at rest."""
    dt = options.dt

    return Filter(
        transition=lambda state, here, f_dt: transition(here, dt),
        feed_back=_feed_back,
        init=init_unknown_heading,
        misalignment=_misalignment,
        attitude=_attitude,
        covariance=_covariance,
        shares_covariance=options.position == "fixed",
    )


def transition(place: Place, dt: Scalar) -> Entries:
    """Return the non-zero entries of A dt, see the module."""
    curvature = place.curvature_n * dt
    wn, wu, g = place.rate_n * dt, place.rate_u * dt, place.gravity * dt
    return {
        (VE, VN): 2 * wu,
        (VE, TILT_N): Minus(g),
        (VN, VE): Minus(2 * wu),
        (VN, TILT_E): g,
        (TILT_E, VN): Minus(curvature),
        (TILT_E, TILT_N): wu,
        (TILT_E, SINE): Minus(wn),
        (TILT_N, VE): place.curvature_e * dt,
        (TILT_N, TILT_E): Minus(wu),
        (TILT_N, VERSINE): wn,
    }


def init_unknown_heading(params: FilterParams, nav: Navigation) -> FilterState:
    """Return the state of a filter without a heading; states after the versine start at zero."""
    state = initial_state(params, nav)
    x = state.belief.x
    x = (*x[:VERSINE], 1.0 + x[VERSINE], *x[VERSINE + 1 :])  # mean zero of cos a
    return state._replace(belief=state.belief._replace(x=x))


def _feed_back(state: FilterState, share: Scalar) -> FilterState:
    """V <- V - dV and C <- e C by a share of the estimate; s and k stay in the filter."""
    x = state.belief.x
    fed_back = tuple(share * estimate for estimate in x[:SINE])
    nav = mechanisation.correct_velocity(state.nav, fed_back[VE], fed_back[VN])
    turn = shortest_rotation(fed_back[TILT_E], fed_back[TILT_N])
    left = (*(a - b for a, b in zip(x[:SINE], fed_back, strict=True)), *x[SINE:])
    return state._replace(
        nav=nav._replace(q=rotations.multiply(turn, nav.q)), belief=state.belief._replace(x=left)
    )


def _direction(state: Any) -> Direction:
    """Return sine and cosine of the azimuth by the estimate, normalised."""
    s, c = state.belief.x[SINE], 1 - state.belief.x[VERSINE]
    square = s * s + c * c
    known = square >= LEAST_AMPLITUDE**2
    # Selected before the root, which has no derivative at zero.
    amplitude = jnp.sqrt(jnp.where(known, square, 1.0))
    return Direction(
        known,
        jnp.where(known, s, 0.0) / amplitude,
        jnp.where(known, c, 1.0) / amplitude,
        amplitude,
    )


def _misalignment(state: FilterState) -> Vec3:
    """Return the tilt; the heading stays in the filter and is never fed back."""
    x = state.belief.x
    return Vec3(x[TILT_E], x[TILT_N], jnp.zeros_like(x[TILT_E]))


def _attitude(state: FilterState) -> Quat:
    x, d = state.belief.x, _direction(state)
    correction = rotation_from_tilt(x[TILT_E], x[TILT_N], d.sine, d.cosine)
    return rotations.multiply(correction, state.nav.q)


def _covariance(state: FilterState) -> AttitudeCovariance:
    """Return the covariance of tilt, rotated by a, and of a to first order.

    The variance of the heading is at most that of a heading anywhere on the circle.
    """
    at, p, d = triangle_index(len(state.belief.x)), state.belief.p, _direction(state)

    def entry(i: int, j: int) -> Scalar:
        return p[at[i, j]]

    # da = (C ds + s dk) / (s^2 + C^2).
    by_sine, by_versine = d.cosine / d.amplitude, d.sine / d.amplitude
    heading = by_sine * by_sine * entry(SINE, SINE) + by_versine * by_versine * entry(
        VERSINE, VERSINE
    )
    heading = heading + 2 * by_sine * by_versine * entry(SINE, VERSINE)
    is_known = d.known & (heading < UNKNOWN_ANGLE)
    tilt_e, tilt_n = (
        jnp.where(is_known, by_sine * entry(i, SINE) + by_versine * entry(i, VERSINE), 0.0)
        for i in (TILT_E, TILT_N)
    )
    tilt_covariance = AttitudeCovariance(
        ee=entry(TILT_E, TILT_E),
        en=entry(TILT_E, TILT_N),
        eu=tilt_e,
        nn=entry(TILT_N, TILT_N),
        nu=tilt_n,
        uu=jnp.where(is_known, heading, UNKNOWN_ANGLE),
    )
    return rotate_covariance(tilt_covariance, d.sine, d.cosine)


describe = partial(
    filter_method,
    without_effect=(*BIAS_KEYS, "p0_yaw_deg", "reset_yaw_deg"),
)
"""Return the `Method` of a filter with these states."""

SINCOS = describe(
    STATES,
    build_filter,
    name="kalman_sincos",
    summary="Kalman filter with sine and cosine of the azimuth, linear from any heading",
    source="Dmitriyev, Stepanov and Shepel (1997), Rogers (1997)",
    step_s=15e-9,
)
