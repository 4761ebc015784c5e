"""Zero-velocity alignment with the right-invariant error of attitude and velocity.

The error is that of the group: eta = (C C'^T, V - C C'^T V'), whose logarithm follows the error
model of a base at rest, (0, 0, g) for the specific force, exactly: P is the same for all runs of a
variant. What differs from [P1] is the feedback,

    C <- exp(phi x) C,    V <- exp(phi x) V - J(phi) dV,

with the left Jacobian J of the rotation group, and that the vertical velocity is integrated between
feedbacks, which mix it into the others. After Barrau and Bonnabel, IEEE TAC 62 (2017).
"""

import math

import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, add, cross, dot, scale
from sinsjax.methods.filters import kalman
from sinsjax.methods.filters.keys import FIVE_STATES
from sinsjax.methods.filters.loop import (
    Filter,
    FilterParams,
    FilterState,
    filter_method,
    initial_state,
    reverse_time,
    subtract_fed_back,
)
from sinsjax.methods.method import Options
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.mechanisation import PHI_E, PHI_N, PHI_U, VE, VN, five_state_transition
from sinsjax.types import Navigation, Scalar, Vec3

_TERMS = 20  # of a series in th^2, whose rest is below rounding for th = 2 pi


def build_filter(options: Options) -> Filter:
    """Return its filter, whose extra state is the vertical velocity, m/s."""
    dt = options.dt

    def init(params: FilterParams, nav: Navigation) -> FilterState:
        return initial_state(params, nav)._replace(extra=jnp.zeros_like(nav.ve))

    def transition(state: FilterState, here: Place, f_dt: Vec3) -> Entries:
        gravity = Vec3(0.0, 0.0, here.gravity * dt)
        return five_state_transition(state.nav._replace(ve=0.0, vn=0.0), here, gravity, dt)

    def predict(params: FilterParams, state: FilterState, here: Place, f_dt: Vec3) -> FilterState:
        up = state.extra + (f_dt.z - here.gravity * dt) + _coriolis_up(state.nav, here) * dt
        belief = kalman.propagate(state.belief, transition(state, here, f_dt))
        return state._replace(belief=belief, extra=up)

    return Filter(
        transition=transition,
        reverse=lambda signs, state: reverse_time(signs, state)._replace(extra=-state.extra),
        predict=predict,
        feed_back=_feed_back,
        init=init,
        shares_covariance=options.position == "fixed",
    )


def _coriolis_up(nav: Navigation, place: Place) -> Scalar:
    """Return the upward component of -(2 w_ie + w_en) x V, m/s^2."""
    east = nav.ve * (2 * place.rate_n + nav.ve * place.curvature_e)
    return east + nav.vn * nav.vn * place.curvature_n


def _feed_back(state: FilterState, share: Scalar) -> FilterState:
    """Return the state with a share of the estimate fed back."""
    fed_back = tuple(share * estimate for estimate in state.belief.x)
    phi = Vec3(fed_back[PHI_E], fed_back[PHI_N], fed_back[PHI_U])
    turn = rotations.exp(phi)
    velocity = rotations.rotate(turn, Vec3(state.nav.ve, state.nav.vn, state.extra))
    error = apply_left_jacobian(phi, Vec3(fed_back[VE], fed_back[VN], jnp.zeros_like(fed_back[VE])))
    return state._replace(
        nav=state.nav._replace(
            q=rotations.multiply(turn, state.nav.q),
            ve=velocity.x - error.x,
            vn=velocity.y - error.y,
        ),
        belief=subtract_fed_back(state.belief, fed_back),
        extra=jnp.zeros_like(state.extra),  # a base that does not travel
    )


def apply_left_jacobian(phi: Vec3, v: Vec3) -> Vec3:
    """Return J v for the left Jacobian J of the rotation group.

    J = I + (1 - cos th)/th^2 (phi x) + (th - sin th)/th^3 (phi x)^2, th = |phi| <= 2 pi.
    """
    across = cross(phi, v)
    square = dot(phi, phi)
    # As power series: the closed forms have no derivative at zero.
    first = second = jnp.zeros_like(square)
    for n in reversed(range(_TERMS)):
        first = 1 / math.factorial(2 * n + 2) - square * first
        second = 1 / math.factorial(2 * n + 3) - square * second
    return add(v, add(scale(first, across), scale(second, cross(phi, across))))


INVARIANT = filter_method(
    FIVE_STATES,
    build_filter,
    name="invariant",
    summary="right-invariant Kalman filter of a base at rest, fed back by the group",
    source="Barrau and Bonnabel (2017)",
    step_s=15e-9,
)
