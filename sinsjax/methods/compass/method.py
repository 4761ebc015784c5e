"""Compass alignment: levelling and azimuth loops of a mathematical platform, [P2] section 2.1.

Without covariance: velocity and its integral level the platform ([P2] Fig. 1, third order), then
the north velocity that a heading error causes through the Earth rate rotates it in azimuth ([P2]
Fig. 2, fourth order). The east channel levels throughout.

The transport rate is part of the mechanisation; the loops add K2 times that rate, which gives the
1 + K2 of the characteristic polynomials.
"""

from typing import NamedTuple

import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.methods.compass.design import AzimuthGains, LevelGains, scale_azimuth_gains
from sinsjax.methods.floors import BiasFloor, MeanBiases, bias_floor
from sinsjax.methods.method import (
    Options,
    Passes,
    Program,
    RunEnd,
    Site,
)
from sinsjax.methods.schedules import PiecewiseConstant, value_at
from sinsjax.strapdown import earth, mechanisation
from sinsjax.types import Flag, Navigation, Sample, Scalar, Vec3


class Reversal(NamedTuple):
    """Factors on the loops' state at a direction reversal.

    Attributes:
        velocity: on both velocities.
        integral: on both levelling integrals, which balance gyro drift and the Earth rate of a
            heading error; both change sign with time.
        rate: on the azimuth rate.
        reflection: share by which each tilt is reflected about its equilibrium: 1 rotates the
            platform by twice the tilt of the low-passed specific force, 0 not at all.
    """

    velocity: Scalar
    integral: Scalar
    rate: Scalar
    reflection: Scalar


class LoopParams(NamedTuple):
    """Params of the loops.

    Attributes:
        level: gains of the levelling loop.
        azimuth: gains of the azimuth loop at pace 1.
        pace: factor on the sigma of the azimuth loop, with gains that move its roots by it.
        azimuth_from: samples before the azimuth loop takes over the north channel.
        smoothing: share of each new sample in each stage of the low-passed specific force.
        reversal: effect of a direction reversal.
    """

    level: LevelGains
    azimuth: AzimuthGains
    pace: PiecewiseConstant
    azimuth_from: Scalar
    smoothing: Scalar
    reversal: Reversal


class LowPassed(NamedTuple):
    """A number low-passed by two equal stages, one after the other.

    A single stage of the same delay passes as much white noise, and far more of a base's sway.
    """

    once: Scalar
    twice: Scalar


class LoopState(NamedTuple):
    """The loops between two samples.

    Attributes:
        nav: navigation solution; its velocity is an error, since the base does not travel.
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


def build(options: Options) -> Program:
    """Return the compass method.

    Args:
        options: choices that decide the program; ``specific_force`` concerns filters only.
    """
    dt = options.dt

    def init(params: LoopParams, nav: Navigation) -> LoopState:
        zero = jnp.zeros_like(nav.ve)
        return LoopState(nav, zero, zero, zero, LowPassed(zero, zero), LowPassed(zero, zero))

    def step(
        params: LoopParams, site: Site, state: LoopState, sample: Sample, n: Scalar
    ) -> LoopState:
        before, place, gains = state.nav, options.place(site, state.nav), gains_at(params, n)
        level, azimuth, levelling = params.level, gains.azimuth, gains.levelling
        control = platform_control(gains, state, place)
        nav, f_dt = mechanisation.advance_navigation(before, sample, place, dt, control)
        if options.position == "integrated":
            nav = mechanisation.advance_position(nav, place, dt)
        spin = azimuth.k3 / place.rate_n * before.vn - azimuth.k4 * state.rate_u
        return LoopState(
            nav=mechanisation.correct_velocity(
                nav, level.k1 * dt * before.ve, gains.k1 * dt * before.vn
            ),
            integral_e=state.integral_e + level.k3 * dt * before.ve,
            integral_n=state.integral_n + jnp.where(levelling, level.k3 * dt * before.vn, 0.0),
            rate_u=state.rate_u + jnp.where(levelling, 0.0, spin * dt),
            force_e=_low_pass(state.force_e, f_dt.x / dt, params.smoothing),
            force_n=_low_pass(state.force_n, f_dt.y / dt, params.smoothing),
        )

    def rewind(params: LoopParams, nav: Navigation, state: LoopState) -> LoopState:
        """Start again, but keep levelling integrals and azimuth rate, which balance gyro drift."""
        return init(params, nav)._replace(
            integral_e=state.integral_e, integral_n=state.integral_n, rate_u=state.rate_u
        )

    return Program(
        init=init,
        step=step,
        attitude=lambda state: state.nav.q,
        normalise=_normalise,
        floor=_bias_floor,
        passes=Passes(reverse=_reverse, rewind=rewind),
    )


class Gains(NamedTuple):
    """Gains at one sample; the north channel has those of levelling or those of the azimuth.

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
    """Return the gains at the n-th sample."""
    level, azimuth = params.level, scale_azimuth_gains(params.azimuth, value_at(params.pace, n))
    levelling = n <= params.azimuth_from
    k1 = jnp.where(levelling, level.k1, azimuth.k1)
    k2 = jnp.where(levelling, level.k2, azimuth.k2)
    return Gains(level, azimuth, k1, k2, levelling)


def platform_control(gains: Gains, state: LoopState, place: earth.Place) -> Vec3:
    """Return the commanded rate of the platform in addition to w_in, in n, rad/s."""
    nav, level = state.nav, gains.level
    return Vec3(
        -gains.k2 * place.curvature_n * nav.vn - jnp.where(gains.levelling, state.integral_n, 0.0),
        level.k2 * place.curvature_e * nav.ve + state.integral_e,
        state.rate_u,
    )


def _low_pass(low: LowPassed, value: Scalar, share: Scalar) -> LowPassed:
    once = low.once + share * (value - low.once)
    return LowPassed(once, low.twice + share * (once - low.twice))


def _reverse(params: LoopParams, site: Site, state: LoopState) -> LoopState:
    """Return the state at the start of a pass in the other direction, [P2] section 3."""
    reversal = params.reversal
    # f = (-g phi_N + nabla_E, g phi_E + nabla_N): g times the tilts from their equilibria.
    angle = 2 * reversal.reflection / site.place.gravity
    tilt = Vec3(angle * state.force_n.twice, -angle * state.force_e.twice, jnp.zeros_like(angle))
    nav = state.nav
    kept = 1 - 2 * reversal.reflection
    return LoopState(
        nav=nav._replace(
            q=rotations.correct(tilt, nav.q),
            ve=reversal.velocity * nav.ve,
            vn=reversal.velocity * nav.vn,
        ),
        integral_e=reversal.integral * state.integral_e,
        integral_n=reversal.integral * state.integral_n,
        rate_u=reversal.rate * state.rate_u,
        force_e=LowPassed(*(kept * stage for stage in state.force_e)),
        force_n=LowPassed(*(kept * stage for stage in state.force_n)),
    )


def _bias_floor(
    params: LoopParams, place: earth.Place, biases: MeanBiases, end: RunEnd
) -> BiasFloor:
    """Return the floor of biases attributed to the Earth, plus a lag, since K(s) leaks.

    The platform rate that cancels eps_U needs a constant north velocity, whose transport rate has
    the effect of the level rate of a heading error: (1 + K2) K4 eps_U / (R K3) of omega_N, which is
    2 eps_U/sigma for the gains of [P2] eq. (23). Its sign changes in a backward pass.
    """
    gains = scale_azimuth_gains(params.azimuth, value_at(params.pace, end.n))
    eps = biases.eps
    lag = (1 + gains.k2) * gains.k4 * place.curvature_n * eps.z / gains.k3
    felt = jnp.hypot(eps.x, place.rate_n + eps.y)
    lag = jnp.arcsin(jnp.clip(lag * place.rate_n / felt, -1.0, 1.0))
    return bias_floor(place, biases, jnp.where(end.backward, lag, -lag))


def _normalise(state: LoopState) -> LoopState:
    return state._replace(nav=state.nav._replace(q=rotations.normalise(state.nav.q)))
