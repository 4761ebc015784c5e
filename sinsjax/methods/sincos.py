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

`SURGE` is for a base that surges, on which a zero-velocity filter takes the base's own velocity for
white measurement noise. The velocity of a base that stays near its place is not white: it changes
over seconds, and cancels over minutes. Four more states model it, on either axis

    s' = v,    v' = -s/T^2 - v/T + w,    V = dV + v,

with a place s that wanders within bounds, correlation time T and rms velocity sigma: w has density
2 sigma^2/T, s starts with variance (sigma T)^2. The measured V is that of the solution, whose error
is dV alone; only dV and the tilt are fed back. With T and sigma of the base, Q of the sensors and a
small R, the heading comes within a few percent of the information bound (`bounds.information`),
and P is true.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, Minus, triangle_index
from sinsjax.methods.azimuth_and_tilt import (
    rotate_covariance,
    rotation_from_tilt,
    shortest_rotation,
)
from sinsjax.methods.filters import kalman
from sinsjax.methods.filters.kalman import Innovation
from sinsjax.methods.filters.keys import (
    BIAS_KEYS,
    DIRECTION,
    LEVEL,
    VELOCITY,
    FilterSection,
    ResetsSection,
    StateKind,
    check_reset_times_and_schedules,
    has_trigger,
)
from sinsjax.methods.filters.loop import (
    Filter,
    FilterParams,
    FilterState,
    filter_method,
    filter_params,
    initial_state,
)
from sinsjax.methods.method import (
    UNKNOWN_ANGLE,
    AttitudeCovariance,
    Options,
    StudyKeys,
)
from sinsjax.strapdown import mechanisation
from sinsjax.strapdown.earth import Place
from sinsjax.types import Flag, Navigation, Quat, Scalar, Vec3
from sinsjax.value_types import Seconds, Section, SpeedSigma, key_field

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


def _azimuth_direction(state: Any) -> Direction:
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
    x, d = state.belief.x, _azimuth_direction(state)
    correction = rotation_from_tilt(x[TILT_E], x[TILT_N], d.sine, d.cosine)
    return rotations.multiply(correction, state.nav.q)


def _covariance(state: FilterState) -> AttitudeCovariance:
    """Return the covariance of tilt, rotated by a, and of a to first order.

    The variance of the heading is at most that of a heading anywhere on the circle.
    """
    at, p, d = triangle_index(len(state.belief.x)), state.belief.p, _azimuth_direction(state)

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


_describe = partial(filter_method, without_effect=(*BIAS_KEYS, "p0_yaw_deg", "reset_yaw_deg"))

SINCOS = _describe(
    STATES,
    build_filter,
    name="kalman_sincos",
    summary="Kalman filter with sine and cosine of the azimuth, linear from any heading",
    source="Dmitriyev, Stepanov and Shepel (1997), Rogers (1997)",
    step_s=15e-9,
)


# States of a surge

PLACE_E, PLACE_N, SURGE_E, SURGE_N = range(6, 10)
PLACE, SPEED = StateKind(None, None), StateKind(None, None, sign=-1.0)
SURGE_STATES = (*STATES, PLACE, PLACE, SPEED, SPEED)

_ADD_SURGE: Entries = {(VE, SURGE_E): 1.0, (VN, SURGE_N): 1.0}
_SUBTRACT_SURGE: Entries = {(VE, SURGE_E): Minus(1.0), (VN, SURGE_N): Minus(1.0)}
"""From dV to the measured V, and back."""


def build_surge_filter(options: Options) -> Filter:
    """Return the filter; its extra params and state are 1/T of the surge, 1/s.

    `Options.specific_force` is always that of a base at rest.
    """
    dt = options.dt

    def init(params: FilterParams, nav: Navigation) -> FilterState:
        return init_unknown_heading(params, nav)._replace(extra=params.extra)

    return build_filter(options)._replace(
        init=init,
        transition=lambda state, here, f_dt: transition_with_surge(here, state.extra, dt),
        update=_update_with_surge,
    )


def transition_with_surge(place: Place, rate: Scalar, dt: Scalar) -> Entries:
    """Return the non-zero entries of A dt with the states of the surge, see the module."""
    damping = rate * dt
    restoring = rate * damping
    return {
        **transition(place, dt),
        (PLACE_E, SURGE_E): dt,
        (PLACE_N, SURGE_N): dt,
        (SURGE_E, PLACE_E): Minus(restoring),
        (SURGE_N, PLACE_N): Minus(restoring),
        (SURGE_E, SURGE_E): Minus(damping),
        (SURGE_N, SURGE_N): Minus(damping),
    }


def _update_with_surge(params: Any, state: Any) -> tuple[Any, Innovation]:
    """Update with the velocity of the solution, which should be that of the base."""
    measured = state.nav.ve, state.nav.vn
    predicted = kalman.propagate(state.belief, _ADD_SURGE)
    updated, innovation = kalman.update(predicted, (VE, VN), measured, params.r)
    return state._replace(belief=kalman.propagate(updated, _SUBTRACT_SURGE)), innovation


class SurgeSection(Section):
    """[surge]: assumed surge of the base."""

    r_surge_m_per_s: SpeedSigma = key_field("rms velocity along east and north", 0.1)
    r_surge_time_s: Seconds = key_field("correlation time of the velocity", 5.0)


def surge_params(keys: StudyKeys, xp: Any) -> FilterParams:
    """Return the params of the filter with states of the surge, leaves (variants,)."""
    own = filter_params(STATES, keys, xp, has_surge_states=True)
    variance = keys.column("r_surge_m_per_s") ** 2
    time = keys.column("r_surge_time_s")
    p0 = (*(variance * time**2,) * 2, *(variance,) * 2)
    q = 2 * variance / time / keys.rate_hz
    return own._replace(
        p0=(*own.p0, *p0),
        q=(*own.q, *(0.0 * q,) * 2, *(q,) * 2),
        reset_to=(*own.reset_to, *p0),
        extra=1 / time,
    )


def check_no_trigger(study: StudyKeys) -> None:
    """Refuse triggers, which assume that the first two states are measured."""
    if not study.has("resets"):
        return
    for point in study.combinations("method", "reset_trigger"):
        if point["method"] == SURGE.name and has_trigger(point["reset_trigger"]):
            text = f"does not apply to method {SURGE.name} (use reset_times_s or reset_count)"
            study.refuse("reset_trigger", text)


SURGE = _describe(
    SURGE_STATES,
    build_surge_filter,
    name="kalman_surge",
    summary="the same with states for the velocity of a base that surges",
    source="`methods.sincos`",
    sections={"filter": FilterSection, "resets": ResetsSection, "surge": SurgeSection},
    params=surge_params,
    rules=(check_no_trigger, check_reset_times_and_schedules),
    turning="many",
    step_s=25e-9,
    compile_s=9.0,
)
