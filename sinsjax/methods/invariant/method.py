"""Zero-velocity alignment with the right-invariant error of attitude and velocity.

The error is that of the group: eta = (C C'^T, V - C C'^T V'), whose logarithm follows the error
model of a base at rest, (0, 0, g) for the specific force, exactly: P is the same for all runs of a
variant. What differs from [P1] is the feedback,

    C <- exp(phi x) C,    V <- exp(phi x) V - J(phi) dV,

with the left Jacobian J of the rotation group, and that the vertical velocity is integrated between
feedbacks, which mix it into the others. After Barrau and Bonnabel, IEEE TAC 62 (2017).
"""

import math
from functools import partial

import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, add, cross, dot, scale
from sinsjax.methods import kalman
from sinsjax.methods.base import Method, Options, Site
from sinsjax.methods.filters import misalignment
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
from sinsjax.methods.schedules import reset_covariance
from sinsjax.methods.triggers.watched import method_of
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.error_model import MODELS, PHI_E, PHI_N, PHI_U, VE, VN, five_state
from sinsjax.types import Navigation, Sample, Scalar, Vec3

_TERMS = 20  # of a series in th^2, whose rest is below rounding for th = 2 pi

STATES = MODELS["kalman5"].states


def build(options: Options) -> Method:
    """The method; `Options.specific_force` is always that of a base at rest."""
    return method_of(filter_of(options), options)


def filter_of(options: Options) -> Filter:
    """Its filter; its own state is the vertical velocity, m/s. Arguments as of `build`."""
    dt, mechanise = options.dt, mechaniser(options)

    def init(params: FilterParams, nav: Navigation) -> FilterState:
        return begin(params, nav)._replace(own=jnp.zeros_like(nav.ve))

    def transition(nav: Navigation, here: Place) -> Entries:
        gravity = Vec3(0.0, 0.0, here.gravity * dt)
        return five_state(nav._replace(ve=0.0, vn=0.0), here, gravity, dt)

    def propagate(
        params: FilterParams, site: Site, state: FilterState, sample: Sample
    ) -> tuple[FilterState, Entries]:
        before = state.nav
        nav, f_dt, here = mechanise(site, before, sample)
        up = state.own + (f_dt.z - here.gravity * dt) + _coriolis_up(before, here) * dt
        entries = transition(before, here)
        belief = kalman.propagate(state.belief, entries)
        return state._replace(nav=nav, belief=belief, own=up), entries

    return Filter(
        dt,
        init,
        propagate,
        update_by_velocity,
        _feed_back,
        partial(reset_covariance, heading=(PHI_U,)),
        _reverse,
        place_of(options.position),
        lambda state, here: transition(state.nav, here),
        misalignment.estimated,
        misalignment.corrected,
        misalignment.covariance,
        unaided,
        misalignment.inputs,
        misalignment.start_error,
        common_covariance=options.position == "fixed",
    )


def _coriolis_up(nav: Navigation, place: Place) -> Scalar:
    """Upward part of -(2 w_ie + w_en) x V, m/s^2."""
    east = nav.ve * (2 * place.rate_n + nav.ve * place.curvature_e)
    return east + nav.vn * nav.vn * place.curvature_n


def _feed_back(state: FilterState, share: Scalar) -> tuple[FilterState, Vec3]:
    x = state.belief.x
    fed = tuple(share * one for one in x)
    phi = Vec3(fed[PHI_E], fed[PHI_N], fed[PHI_U])
    turn = rotations.exp(phi)
    velocity = rotations.rotate(turn, Vec3(state.nav.ve, state.nav.vn, state.own))
    error = left_jacobian(phi, Vec3(fed[VE], fed[VN], jnp.zeros_like(fed[VE])))
    corrected = state._replace(
        nav=state.nav._replace(
            q=rotations.multiply(turn, state.nav.q),
            ve=velocity.x - error.x,
            vn=velocity.y - error.y,
        ),
        belief=state.belief._replace(x=tuple(a - b for a, b in zip(x, fed, strict=True))),
        own=jnp.zeros_like(state.own),  # a base that does not travel
    )
    return corrected, phi


def left_jacobian(phi: Vec3, v: Vec3) -> Vec3:
    """J v, J = I + (1 - cos th)/th^2 (phi x) + (th - sin th)/th^3 (phi x)^2, th = |phi| <= 2 pi."""
    across = cross(phi, v)
    square = dot(phi, phi)
    # By their series: the closed forms have no slope at zero.
    first = second = jnp.zeros_like(square)
    for n in reversed(range(_TERMS)):
        first = 1 / math.factorial(2 * n + 2) - square * first
        second = 1 / math.factorial(2 * n + 3) - square * second
    return add(v, add(scale(first, across), scale(second, cross(phi, across))))


def _reverse(state: FilterState) -> FilterState:
    turned = reversed_by(MODELS["kalman5"].reversal, state)
    return turned._replace(own=-state.own)
