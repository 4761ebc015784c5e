"""Zero-velocity alignment from an unknown heading: sine and cosine of the azimuth as states.

The computed frame n' is turned from n by an azimuth a of any size and a tilt that is small:
C_{n'}^n = Rz(a) e, where e turns u, the true vertical seen in n', to z. With s = sin a and
k = 1 - cos a as states the model of a base at rest is linear whatever the heading, and constant:
P and the gains are the same for all runs of a variant.

    dV_E' =  2 w_U dV_N - g t_N          t_E' = -dV_N/R + w_U t_N - w_N s
    dV_N' = -2 w_U dV_E + g t_E          t_N' =  dV_E/R - w_U t_E + w_N k

with t_E = u_N and t_N = -u_E. The velocity is fed back, and the tilt as the shortest turn of u to
z; s and k stay with the filter. They begin as of a heading of which nothing is known: mean zero of
sin a and cos a, variance 1/2 each. What sqrt(s^2 + cos^2 a) differs from 1 by is the north gyro
drift in units of w_N. After Dmitriyev, Stepanov and Shepel (1997) and Rogers (1997).
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, Minus, triangle_index
from sinsjax.methods import kalman
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
from sinsjax.methods.filters.tilt import changed, shortest_turn, turned, turned_covariance
from sinsjax.methods.schedules import reset_covariance
from sinsjax.methods.triggers.watched import method_of
from sinsjax.strapdown import mechanisation
from sinsjax.strapdown.earth import Place
from sinsjax.types import Navigation, Quat, Sample, Scalar, Vec3

STATES = ("dve", "dvn", "tilt_e", "tilt_n", "heading_sine", "heading_versine")
VE, VN, TILT_E, TILT_N, SINE, VERSINE = range(6)
REVERSAL = (-1.0, -1.0, 1.0, 1.0, 1.0, 1.0)
"""Sign of each state under time reversal."""

LEAST_AMPLITUDE = 0.05
"""sqrt(s^2 + cos^2 a) under which the heading is not known yet: that of the start holds."""

UNKNOWN_VARIANCE = math.pi**2 / 3
"""Of a heading anywhere on the circle, rad^2."""


class Direction(NamedTuple):
    """The estimated heading as a direction in the level plane.

    Attributes:
        known: whether it is told by the measurements; otherwise it is the solution's own.
        sine: of the azimuth.
        cosine: of the azimuth.
        amplitude: sqrt(s^2 + cos^2 a); 1 without gyro drift, and 1 where it is not known.
    """

    known: Scalar
    sine: Scalar
    cosine: Scalar
    amplitude: Scalar


def build(options: Options) -> Method:
    """The method; `Options.specific_force` is always that of a base at rest."""
    return method_of(filter_of(options), options)


def filter_of(options: Options) -> Filter:
    """Its filter; arguments as of `build`."""
    dt, mechanise = options.dt, mechaniser(options)

    def propagate(
        params: FilterParams, site: Site, state: FilterState, sample: Sample
    ) -> tuple[FilterState, Entries]:
        nav, _, here = mechanise(site, state.nav, sample)
        entries = transition(here, dt)
        return state._replace(nav=nav, belief=kalman.propagate(state.belief, entries)), entries

    return Filter(
        dt,
        begun_anywhere,
        propagate,
        update_by_velocity,
        _feed_back,
        partial(reset_covariance, heading=(SINE, VERSINE)),
        partial(reversed_by, REVERSAL),
        place_of(options.position),
        lambda state, here: transition(here, dt),
        _misalignment,
        _attitude,
        _covariance,
        unaided,
        _inputs,
        start_error,
        own_results=_north_drift,
        common_covariance=options.position == "fixed",
        keep=_keep_amplitude,
    )


def transition(place: Place, dt: Scalar) -> Entries:
    """Non-zero entries of A dt, see the module."""
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


def begun_anywhere(params: FilterParams, nav: Navigation) -> FilterState:
    """A filter that has no heading yet; states after the versine begin with zero."""
    state = begin(params, nav)
    return _with_versine(state, 1.0 + state.belief.x[VERSINE])  # mean zero of cos a


def _keep_amplitude(begun: FilterState, ended: FilterState) -> FilterState:
    """Sine and cosine stay as at a reset: the solution has their azimuth, they its amplitude."""
    direction = _direction(ended)
    versine = jnp.where(direction.known, 1 - direction.amplitude, begun.belief.x[VERSINE])
    return _with_versine(begun, versine)


def _with_versine(state: FilterState, versine: Scalar) -> FilterState:
    x = (*state.belief.x[:VERSINE], versine, *state.belief.x[VERSINE + 1 :])
    return state._replace(belief=state.belief._replace(x=x))


def _feed_back(state: FilterState, share: Scalar) -> tuple[FilterState, Vec3]:
    """V <- V - dV and C <- e C, by a share of the estimate; s and k stay as they are."""
    x = state.belief.x
    fed = tuple(share * one for one in x[:SINE])
    nav = mechanisation.correct_velocity(state.nav, fed[VE], fed[VN])
    turn = shortest_turn(fed[TILT_E], fed[TILT_N])
    left = (*(a - b for a, b in zip(x[:SINE], fed, strict=True)), *x[SINE:])
    corrected = state._replace(
        nav=nav._replace(q=rotations.multiply(turn, nav.q)),
        belief=state.belief._replace(x=left),
    )
    return corrected, Vec3(fed[TILT_E], fed[TILT_N], jnp.zeros_like(fed[TILT_E]))


def _direction(state: Any) -> Direction:
    s, c = state.belief.x[SINE], 1 - state.belief.x[VERSINE]
    square = s * s + c * c
    known = square >= LEAST_AMPLITUDE**2
    # Chosen before the root, which has no slope at zero.
    amplitude = jnp.sqrt(jnp.where(known, square, 1.0))
    return Direction(
        known,
        jnp.where(known, s, 0.0) / amplitude,
        jnp.where(known, c, 1.0) / amplitude,
        amplitude,
    )


def _inputs(state: FilterState) -> Entries:
    """`Filter.inputs`: a turn about the vertical moves sine and cosine of the azimuth."""
    d = _direction(state)
    return {
        **{(VE, 0): 1.0, (VN, 1): 1.0, (TILT_E, 3): Minus(1.0), (TILT_N, 4): Minus(1.0)},
        **{(SINE, 5): Minus(d.cosine), (VERSINE, 5): Minus(d.sine)},
    }


def start_error(state: FilterState, change: StartChange) -> tuple[Scalar, ...]:
    """`Filter.start_error`: of the true sine and versine, that of a heading which is not known."""
    tilt_e, tilt_n, sine, cosine = changed(change)
    zeros = (jnp.zeros_like(change.ve),) * len(state.belief.x[VERSINE + 1 :])
    return (change.ve, change.vn, tilt_e, tilt_n, sine, -cosine, *zeros)


def _misalignment(state: FilterState) -> Vec3:
    """The tilt; heading is a state of its own, that is never fed back."""
    x = state.belief.x
    return Vec3(x[TILT_E], x[TILT_N], jnp.zeros_like(x[TILT_E]))


def _attitude(state: FilterState) -> Quat:
    x, at = state.belief.x, _direction(state)
    return rotations.multiply(turned(x[TILT_E], x[TILT_N], at.sine, at.cosine), state.nav.q)


def _covariance(state: FilterState) -> AttitudeCovariance:
    """Of the misalignment: the tilt's, turned by a, and to first order that of a.

    A heading is never known less than if it were anywhere.
    """
    at, p, d = triangle_index(len(state.belief.x)), state.belief.p, _direction(state)

    def of(i: int, j: int) -> Scalar:
        return p[at[i, j]]

    # da = (C ds + s dk) / (s^2 + C^2).
    by_sine, by_versine = d.cosine / d.amplitude, d.sine / d.amplitude
    heading = by_sine * by_sine * of(SINE, SINE) + by_versine * by_versine * of(VERSINE, VERSINE)
    heading = heading + 2 * by_sine * by_versine * of(SINE, VERSINE)
    told = d.known & (heading < UNKNOWN_VARIANCE)
    tilt_e, tilt_n = (
        jnp.where(told, by_sine * of(i, SINE) + by_versine * of(i, VERSINE), 0.0)
        for i in (TILT_E, TILT_N)
    )
    of_tilt = AttitudeCovariance(
        ee=of(TILT_E, TILT_E),
        en=of(TILT_E, TILT_N),
        eu=tilt_e,
        nn=of(TILT_N, TILT_N),
        nu=tilt_n,
        uu=jnp.where(told, heading, UNKNOWN_VARIANCE),
    )
    return turned_covariance(of_tilt, d.sine, d.cosine)


class NorthDrift(NamedTuple):
    """What the filter tells of the gyros' north drift, rad/s; NaN where it has no heading yet."""

    value: Scalar
    sigma: Scalar


def _north_drift(site: Site, state: FilterState) -> NorthDrift:
    """From the amplitude: sqrt(s^2 + C^2) - 1, times w_N."""
    at, p, d = triangle_index(len(state.belief.x)), state.belief.p, _direction(state)
    c, s = d.cosine, d.sine
    variance = s * s * p[at[SINE, SINE]] - 2 * s * c * p[at[SINE, VERSINE]]
    variance = variance + c * c * p[at[VERSINE, VERSINE]]
    rate = jnp.abs(site.place.rate_n)
    value, sigma = rate * (d.amplitude - 1), rate * jnp.sqrt(variance)
    return NorthDrift(*(jnp.where(d.known, number, jnp.nan) for number in (value, sigma)))
