"""Compass alignment: levelling and azimuth loops of a mathematical platform, [P2] section 2.1.

No covariance, no error model: the platform is levelled by what velocity and its integral show
([P2] Fig. 1, third order), then turned in azimuth by the north velocity that the Earth rate drives
through a heading error ([P2] Fig. 2, fourth order). The east channel levels throughout.

The transport rate is part of the mechanisation; the loops turn the platform by K2 times it on top,
which makes up the 1 + K2 of the characteristic polynomials.
"""

from typing import NamedTuple

import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, Minus
from sinsjax.methods.base import (
    AttitudeCovariance,
    Ending,
    ErrorStep,
    Method,
    Options,
    Site,
    StartChange,
    no_covariance,
)
from sinsjax.methods.compass.design import AzimuthGains, LevelGains, at_pace
from sinsjax.methods.limits import Biases, Limit, unaided
from sinsjax.methods.schedules import Pieces, value_at
from sinsjax.strapdown import earth, mechanisation
from sinsjax.strapdown.error_model import PHI_E, PHI_N, PHI_U, VE, VN, five_state
from sinsjax.types import Flag, Navigation, Quat, Sample, Scalar, Vec3

INTEGRAL_E, INTEGRAL_N, RATE_U = range(5, 8)
"""States of the error beyond those of `error_model.five_state`."""

_INPUTS: Entries = {
    **{(VE, 0): 1.0, (VN, 1): 1.0},
    **{(angle, 3 + axis): Minus(1.0) for axis, angle in enumerate((PHI_E, PHI_N, PHI_U))},
}
"""See `ErrorStep.inputs`: velocities by velocity increments, phi against the angles."""


class Reversal(NamedTuple):
    """What becomes of the loops' state at a direction reversal: factors.

    Attributes:
        velocity: of both velocities.
        integral: of both levelling integrals. They stand for gyro drift and for the Earth rate that
            a heading error leaves, both of which change their sign with that of time.
        rate: of the azimuth rate.
        reflection: share by which each tilt is reflected about its equilibrium: 1 turns the
            platform by twice what the low-passed specific force says, 0 leaves it.
    """

    velocity: Scalar
    integral: Scalar
    rate: Scalar
    reflection: Scalar


class LoopParams(NamedTuple):
    """Numbers of the loops.

    Attributes:
        level: gains of the levelling loop.
        azimuth: gains of the azimuth loop at pace 1.
        pace: factor on the sigma of the azimuth loop, whose gains follow: a loop of pace p has its
            roots p times as far out.
        azimuth_from: samples before the azimuth loop takes over the north channel.
        smoothing: share of each new sample in each stage of the low-passed specific force.
        turn: what happens at a direction reversal.
    """

    level: LevelGains
    azimuth: AzimuthGains
    pace: Pieces
    azimuth_from: Scalar
    smoothing: Scalar
    turn: Reversal


class LowPassed(NamedTuple):
    """A number low-passed by two equal stages, one after the other.

    A single stage of the same delay passes as much white noise, and far more of a base's sway.
    """

    once: Scalar
    twice: Scalar


class LoopState(NamedTuple):
    """One run under way.

    Attributes:
        nav: navigation solution; its velocity is an error, as the base does not travel.
        integral_e: K3 times the integral of the east velocity, rad/s.
        integral_n: K3 times the integral of the north velocity while levelling, rad/s.
        rate_u: azimuth rate of the platform, rad/s.
        force_e: low-passed specific force east, m/s^2.
        force_n: low-passed specific force north, m/s^2.
    """

    nav: Navigation
    integral_e: Scalar
    integral_n: Scalar
    rate_u: Scalar
    force_e: LowPassed
    force_n: LowPassed


def build(options: Options) -> Method:
    """The compass method.

    Args:
        options: what decides the program; ``specific_force`` concerns filters only.
    """
    dt = options.dt
    integrated = options.position == "integrated"

    def init(params: LoopParams, nav: Navigation) -> LoopState:
        zero = jnp.zeros_like(nav.ve)
        return LoopState(nav, zero, zero, zero, LowPassed(zero, zero), LowPassed(zero, zero))

    def place_of(site: Site, nav: Navigation) -> earth.Place:
        return earth.place(site.earth, nav.latitude) if integrated else site.place

    def step(
        params: LoopParams, site: Site, state: LoopState, sample: Sample, n: Scalar
    ) -> LoopState:
        before, place, gains = state.nav, place_of(site, state.nav), gains_at(params, n)
        level, azimuth, levelling = params.level, gains.azimuth, gains.levelling
        control = platform_control(gains, state, place)
        nav, f_dt = mechanisation.step(before, sample, place, dt, control)
        if integrated:
            nav = mechanisation.travel(nav, place, dt)
        spin = azimuth.k3 / place.rate_n * before.vn - azimuth.k4 * state.rate_u
        return LoopState(
            nav=mechanisation.correct_velocity(
                nav, level.k1 * dt * before.ve, gains.k1 * dt * before.vn
            ),
            integral_e=state.integral_e + level.k3 * dt * before.ve,
            integral_n=state.integral_n + jnp.where(levelling, level.k3 * dt * before.vn, 0.0),
            rate_u=state.rate_u + jnp.where(levelling, 0.0, spin * dt),
            force_e=_follow(state.force_e, f_dt.x / dt, params.smoothing),
            force_n=_follow(state.force_n, f_dt.y / dt, params.smoothing),
        )

    def error_step(
        params: LoopParams, site: Site, state: LoopState, sample: Sample, n: Scalar
    ) -> ErrorStep:
        place, gains = place_of(site, state.nav), gains_at(params, n)
        control = platform_control(gains, state, place)
        _, f_dt = mechanisation.step(state.nav, sample, place, dt, control)
        transition = linear_part(gains, state.nav, control, place, f_dt, dt)
        return ErrorStep(transition, _INPUTS, (), ())

    def rewind(params: LoopParams, nav: Navigation, state: LoopState) -> LoopState:
        """Levelling integrals and azimuth rate, which stand for gyro drift, go on as they are."""
        return init(params, nav)._replace(
            integral_e=state.integral_e, integral_n=state.integral_n, rate_u=state.rate_u
        )

    return Method(
        init,
        step,
        _reverse,
        _attitude,
        _covariance,
        _normalise,
        _limit,
        rewind=rewind,
        error_step=error_step,
        error_angles=_error_angles,
        start_error=_start_error,
    )


class Gains(NamedTuple):
    """Gains in force at a sample; those of the north channel are of levelling or of the azimuth.

    Attributes:
        level: of the levelling loop.
        azimuth: of the azimuth loop, at its pace.
        k1: of the north channel.
        k2: of the north channel.
        levelling: whether the north channel levels.
    """

    level: LevelGains
    azimuth: AzimuthGains
    k1: Scalar
    k2: Scalar
    levelling: Flag


def gains_at(params: LoopParams, n: Scalar) -> Gains:
    """The gains in force at the n-th sample."""
    level, azimuth = params.level, at_pace(params.azimuth, value_at(params.pace, n))
    levelling = n <= params.azimuth_from
    k1 = jnp.where(levelling, level.k1, azimuth.k1)
    k2 = jnp.where(levelling, level.k2, azimuth.k2)
    return Gains(level, azimuth, k1, k2, levelling)


def platform_control(gains: Gains, state: LoopState, place: earth.Place) -> Vec3:
    """Commanded rate of the platform in addition to w_in, in n, rad/s."""
    nav, level = state.nav, gains.level
    return Vec3(
        -gains.k2 * place.curvature_n * nav.vn - jnp.where(gains.levelling, state.integral_n, 0.0),
        level.k2 * place.curvature_e * nav.ve + state.integral_e,
        state.rate_u,
    )


def linear_part(
    gains: Gains, nav: Navigation, control: Vec3, place: earth.Place, f_dt: Vec3, dt: Scalar
) -> Entries:
    """Non-zero entries of A dt of the closed loops, by the states of the error.

    Those of `error_model.five_state`, then the levelling integrals and the azimuth rate, whose
    errors turn the platform. The latitude's error, of metres, is left out.

    Args:
        gains: in force.
        nav: solution before the sample.
        control: `platform_control`.
        place: Earth at the solution's latitude.
        f_dt: specific force in n times dt, m/s.
        dt: sample time, s.
    """
    level, azimuth = gains.level, gains.azimuth
    entries = dict(five_state(nav, place, f_dt, dt))

    def add(row: int, column: int, value: Scalar) -> None:
        before = entries.get((row, column), 0.0)
        entries[row, column] = value + (-before.of if isinstance(before, Minus) else before)

    add(VE, VE, -level.k1 * dt)
    add(VN, VN, -gains.k1 * dt)
    add(PHI_E, VN, -gains.k2 * place.curvature_n * dt)
    add(PHI_N, VE, level.k2 * place.curvature_e * dt)
    # phi' = phi x control, as with w_in.
    for i, j, rate in ((PHI_E, PHI_N, control.z), (PHI_N, PHI_U, control.x)):
        add(i, j, rate * dt)
        add(j, i, -rate * dt)
    add(PHI_U, PHI_E, control.y * dt)
    add(PHI_E, PHI_U, -control.y * dt)
    once = jnp.where(gains.levelling, dt, 0.0)  # the azimuth loop is its complement
    then = dt - once
    return entries | {
        (PHI_E, INTEGRAL_N): Minus(once),
        (PHI_N, INTEGRAL_E): dt,
        (PHI_U, RATE_U): dt,
        (INTEGRAL_E, VE): level.k3 * dt,
        (INTEGRAL_N, VN): level.k3 * once,
        (RATE_U, VN): azimuth.k3 / place.rate_n * then,
        (RATE_U, RATE_U): Minus(azimuth.k4 * then),
    }


def _follow(low: LowPassed, value: Scalar, share: Scalar) -> LowPassed:
    once = low.once + share * (value - low.once)
    return LowPassed(once, low.twice + share * (once - low.twice))


def _reverse(params: LoopParams, site: Site, state: LoopState) -> LoopState:
    turn = params.turn
    # f = (-g phi_N + nabla_E, g phi_E + nabla_N): g times the tilts from their equilibria.
    angle = 2 * turn.reflection / site.place.gravity
    tilt = Vec3(angle * state.force_n.twice, -angle * state.force_e.twice, jnp.zeros_like(angle))
    nav = state.nav
    left = 1 - 2 * turn.reflection
    return LoopState(
        nav=nav._replace(
            q=rotations.correct(tilt, nav.q),
            ve=turn.velocity * nav.ve,
            vn=turn.velocity * nav.vn,
        ),
        integral_e=turn.integral * state.integral_e,
        integral_n=turn.integral * state.integral_n,
        rate_u=turn.rate * state.rate_u,
        force_e=LowPassed(*(left * stage for stage in state.force_e)),
        force_n=LowPassed(*(left * stage for stage in state.force_n)),
    )


def _limit(params: LoopParams, place: earth.Place, biases: Biases, ending: Ending) -> Limit:
    """Biases taken for what the Earth does, and a lag: K(s) leaks.

    A platform rate that cancels eps_U has to be kept up by a north velocity, whose transport rate
    stands for a level rate that a heading error makes: (1 + K2) K4 eps_U / (R K3) of omega_N,
    2 eps_U/sigma for the gains of [P2] eq. (23). It is of the other sign in a backward pass.
    """
    gains = at_pace(params.azimuth, value_at(params.pace, ending.n))
    eps = biases.eps
    lag = (1 + gains.k2) * gains.k4 * place.curvature_n * eps.z / gains.k3
    felt = jnp.hypot(eps.x, place.rate_n + eps.y)
    lag = jnp.arcsin(jnp.clip(lag * place.rate_n / felt, -1.0, 1.0))
    return unaided(place, biases, jnp.where(ending.backward, lag, -lag))


def _attitude(state: LoopState) -> Quat:
    return state.nav.q


def _covariance(state: LoopState) -> AttitudeCovariance:
    return no_covariance(state.rate_u)


def _error_angles(state: LoopState) -> tuple[tuple[Scalar, ...], ...]:
    zero = jnp.zeros_like(state.rate_u)
    states = range(RATE_U + 1)
    return tuple(tuple(zero + float(i == angle) for i in states) for angle in (PHI_E, PHI_N, PHI_U))


def _start_error(state: LoopState, change: StartChange) -> tuple[Scalar, ...]:
    zero = jnp.zeros_like(state.rate_u)
    return (change.ve, change.vn, *change.phi, zero, zero, zero)


def _normalise(state: LoopState) -> LoopState:
    return state._replace(nav=state.nav._replace(q=rotations.normalise(state.nav.q)))
