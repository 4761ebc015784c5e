"""Compass alignment: levelling and azimuth loops of a mathematical platform, [P2] section 2.1.

Without covariance: velocity and its integral level the platform ([P2] Fig. 1, third order), then
the north velocity that a heading error causes through the Earth rate rotates it in azimuth ([P2]
Fig. 2, fourth order). The east channel levels throughout.

Gains are designed from a decay rate sigma (> 0, 1/s) and a damping ratio xi (0 < xi <= 1): the
complex roots are -sigma +- j omega_d with xi = sigma / sqrt(sigma^2 + omega_d^2). The transport
rate is part of the mechanisation; the loops add K2 times that rate, so they see (1 + K2)/R dV, and
their characteristic polynomials are, [P2] eqs (16) and (21),

    s^3 + K1 s^2 + (1 + K2) (g/R) s + g K3,    s (s + K4) (s^2 + K1 s + (1 + K2) g/R) + g K3.

Nothing keeps given gains stable: runs of an unstable loop diverge.
"""

import math
from typing import Annotated, Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np

from sinsjax.maths import rotations
from sinsjax.methods.floors import BiasFloor, MeanBiases, bias_floor
from sinsjax.methods.method import Method, Options, Passes, Program, Site, StudyKeys
from sinsjax.methods.schedules import PiecewiseConstant, value_at
from sinsjax.strapdown import mechanisation
from sinsjax.strapdown.earth import Place
from sinsjax.types import Flag, Navigation, Sample, Scalar, Vec3
from sinsjax.value_types import (
    Bandwidth,
    Damping,
    Factors,
    Finite,
    KeyCondition,
    KeyInfo,
    SecondsOrZero,
    Section,
    Times,
    key_field,
)

PAPER_DAMPING = math.sqrt(0.5)
"""The damping ratio of [P2] section 3.1."""

_LOOPS = ("level", "azimuth")
_GAIN = KeyInfo(usual_range=(-1e11, 1e11))


class CompassSection(Section):
    """[compass]: levelling and azimuth loops, and their gain schedule."""

    exclusive = tuple((f"{loop}_gains", f"{loop}_sigma_per_s") for loop in _LOOPS)
    conditions = tuple(
        KeyCondition((f"{loop}_damping",), (f"{loop}_gains",), lambda k: k is None, refused=True)
        for loop in _LOOPS
    )

    level_sigma_per_s: Bandwidth | None = key_field(
        "decay rate sigma of the levelling loop", default=0.02
    )
    level_gains: Annotated[tuple[Finite, Finite, Finite], _GAIN] | None = key_field(
        "gains instead of sigma: velocity damping K1 (1/s), platform rate K2 (transport rates),"
        " velocity integral K3 (rad/(m s))"
    )
    level_damping: Damping = key_field("damping ratio of the levelling loop", PAPER_DAMPING)
    level_time_s: SecondsOrZero | None = key_field(
        "levelling of both channels before the azimuth loop", default=150.0, time="s"
    )
    azimuth_sigma_per_s: Bandwidth | None = key_field(
        "decay rate sigma of the azimuth loop", default=0.01
    )
    azimuth_gains: Annotated[tuple[Finite, Finite, Finite, Finite], _GAIN] | None = key_field(
        "gains instead of sigma: K1 and K2 as in level_gains; K3 (1/(m s^2)) and K4 (1/s) of the"
        " azimuth control K3 / (omega_N (s + K4))"
    )
    azimuth_damping: Damping = key_field("damping ratio of the azimuth loop", PAPER_DAMPING)
    sigma_factors: Factors = key_field(
        "factors on the azimuth sigma in intervals, the first from the start", (1.0,)
    )
    sigma_times_s: Times = key_field(
        "start times of the later intervals of sigma_factors", (), whole="sample", time="s"
    )


def check_sigma_factors(study: StudyKeys) -> None:
    """Refuse sigma factors without as many times."""
    keys = ("sigma_factors", "sigma_times_s")
    for point in study.combinations(*keys) if study.has("compass") else ():
        needed, given = (len(point[key]) for key in keys)
        if given != needed - 1:
            text = f"needs {needed - 1} entries for {needed} sigma_factors, not {given}"
            study.refuse("sigma_times_s", text)


# Design


Number: TypeAlias = Any
"""A float, a NumPy array, or a traced number."""


class LevelGains(NamedTuple):
    """Gains of a levelling loop, [P2] Fig. 1: w_c = K2/R dV + K3 (integral of dV)."""

    k1: Number  # velocity damping, 1/s
    k2: Number  # of the platform rate from the velocity, in units of the transport rate 1/R
    k3: Number  # of the platform rate from the integral of the velocity, rad/(m s)


class AzimuthGains(NamedTuple):
    """Gains of the azimuth loop, [P2] Fig. 2: w_cU = K(s) dV_N, K(s) = K3 / (omega_N (s + K4))."""

    k1: Number  # as of `LevelGains`, likewise ``k2``
    k2: Number
    k3: Number  # of the azimuth acceleration from the velocity, times omega_N, 1/(m s^2)
    k4: Number  # of the lag in K(s), 1/s


def level_gains(sigma: Number, damping: Number, *, gravity: Number, radius: Number) -> LevelGains:
    """Return the gains that put the roots at -sigma and -sigma +- j omega_d, [P2] eqs (17), (18).

    K1 = 3 sigma, K2 = sigma^2 (2 + 1/xi^2) R/g - 1, K3 = sigma^3 / (g xi^2), for gravity g in
    m/s^2 and the radius R of the transport rate in m. All numbers broadcast, and may be traced.
    """
    inverse_square = damping**-2
    k2 = sigma**2 * (2 + inverse_square) * radius / gravity - 1
    return LevelGains(3 * sigma, k2, sigma**3 * inverse_square / gravity)


def azimuth_gains(
    sigma: Number, damping: Number, *, gravity: Number, radius: Number
) -> AzimuthGains:
    """Return gains with K1 = K4 and double roots at -sigma +- j omega_d, [P2] eqs (22) and (23).

    K1 = K4 = 2 sigma, K2 = 2 W R/g - 1, K3 = W^2/g with W = sigma^2/xi^2. The paper has only
    xi = sqrt(1/2): K2 = 4 sigma^2 R/g - 1, K3 = 4 sigma^4/g.
    """
    square = (sigma / damping) ** 2
    k2 = 2 * square * radius / gravity - 1
    return AzimuthGains(2 * sigma, k2, square**2 / gravity, 2 * sigma)


def scale_azimuth_gains(gains: AzimuthGains, pace: Number) -> AzimuthGains:
    """Return gains whose roots lie a factor > 0 further out: sigma times the pace, xi kept."""
    k1, k2, k3, k4 = gains
    return AzimuthGains(pace * k1, pace**2 * (1 + k2) - 1, pace**4 * k3, pace * k4)


# Numbers of the loops


class Reversal(NamedTuple):
    """Factors on the loops' state at a direction reversal.

    The levelling integrals, which balance gyro drift and the Earth rate of a heading error, change
    their sign with those.
    """

    velocity: Scalar  # on both velocities
    rate: Scalar  # on the azimuth rate
    # Share by which each tilt is reflected about its equilibrium: 1 rotates the platform by
    # twice the tilt of the low-passed specific force, 0 not at all
    reflection: Scalar


REVERSALS = {
    "reflect": Reversal(-1.0, 1.0, 1.0),
    "velocity": Reversal(-1.0, 1.0, 0.0),
    "velocity_and_rate": Reversal(-1.0, -1.0, 0.0),
    "keep": Reversal(1.0, 1.0, 0.0),
}
"""Effect of a direction reversal by the names of ``turn``.

``velocity``, that of [P2], leaves azimuth rate and tilt, which a reversed Earth rate turns against
the loop. After ``reflect`` the next pass continues where this one stopped.
"""


class LoopParams(NamedTuple):
    """Params of the loops."""

    level: LevelGains
    azimuth: AzimuthGains  # gains at pace 1
    # Factor on the sigma of the azimuth loop, with gains that move its roots by it
    pace: PiecewiseConstant
    azimuth_from: Scalar  # samples before the azimuth loop takes over the north channel
    smoothing: Scalar  # share of each new sample in each stage of the low-passed specific force
    reversal: Reversal


def params(keys: StudyKeys, xp: Any) -> LoopParams:
    """Return the params of the loops, leaves (variants,)."""
    rate, passes = keys.rate_hz, keys.has("passes")
    times_s = keys.lists(list, "sigma_times_s", padding=np.inf)
    factors = keys.lists(list, "sigma_factors", padding=1.0)
    smoothing_s = keys.column("turn_smoothing_s") if passes else np.ones(keys.count)
    reversal = keys.compute(REVERSALS.__getitem__, "turn").T if passes else REVERSALS["keep"]
    level, azimuth = gains(keys, xp)
    return LoopParams(
        level=level,
        azimuth=azimuth,
        pace=PiecewiseConstant(xp.round(times_s * rate), factors),
        azimuth_from=xp.round(keys.column("level_time_s") * rate),
        smoothing=-xp.expm1(-2 / (rate * smoothing_s)),  # two stages share the delay
        reversal=Reversal(*(np.broadcast_to(factor, keys.count) for factor in reversal)),
    )


def gains(keys: StudyKeys, xp: Any) -> tuple[LevelGains, AzimuthGains]:
    """Return the gains of the loops: as given, or designed from sigma and damping.

    For the north channel; on an ellipsoid the east one differs in its K2 by some 0.1 %.
    """
    place = keys.site.place
    earth = {"gravity": float(place.gravity), "radius": float(1 / place.curvature_n)}

    def of_loop(loop: str, design: Any) -> Any:
        sigma, damping = keys.column(f"{loop}_sigma_per_s"), keys.column(f"{loop}_damping")
        designed = design(sigma, damping, **earth)
        none = [math.nan] * len(designed)
        given = keys.compute(lambda found: none if found is None else found, f"{loop}_gains")
        rows = xp.where(xp.isnan(given), xp.stack(designed, axis=-1), given)
        return type(designed)(*rows.T)

    return of_loop("level", level_gains), of_loop("azimuth", azimuth_gains)


# A run


class LowPassed(NamedTuple):
    """A number low-passed by two equal stages, one after the other.

    A single stage of the same delay passes as much white noise, and far more of a base's sway.
    """

    once: Scalar
    twice: Scalar


class LoopState(NamedTuple):
    """The loops between two samples."""

    nav: Navigation  # navigation solution; its velocity is an error, since the base does not travel
    integral_e: Scalar  # K3 times the integral of the east velocity, rad/s
    integral_n: Scalar  # of the north velocity, likewise, while it is levelled
    rate_u: Scalar  # azimuth rate of the platform, rad/s
    force_e: LowPassed  # low-passed specific force, m/s^2; also ``force_n``
    force_n: LowPassed


def build(options: Options) -> Program:
    """Return the compass program; ``specific_force`` of the options concerns filters only."""
    dt = options.dt

    def step(
        params: LoopParams, site: Site, state: LoopState, sample: Sample, n: Scalar
    ) -> LoopState:
        before, place, level = state.nav, options.place(site, state.nav), params.level
        azimuth = scale_azimuth_gains(params.azimuth, value_at(params.pace, n))
        levelling = n <= params.azimuth_from  # of the north channel
        k1, k2 = (jnp.where(levelling, *pair) for pair in zip(level[:2], azimuth[:2], strict=True))
        # In addition to w_in, rad/s in n.
        control = Vec3(
            -k2 * place.curvature_n * before.vn - jnp.where(levelling, state.integral_n, 0.0),
            level.k2 * place.curvature_e * before.ve + state.integral_e,
            state.rate_u,
        )
        nav, f_dt = mechanisation.advance_navigation(before, sample, place, dt, control)
        if options.position == "integrated":
            nav = mechanisation.advance_position(nav, place, dt)
        spin = azimuth.k3 / place.rate_n * before.vn - azimuth.k4 * state.rate_u
        return LoopState(
            nav=mechanisation.correct_velocity(nav, level.k1 * dt * before.ve, k1 * dt * before.vn),
            integral_e=state.integral_e + level.k3 * dt * before.ve,
            integral_n=state.integral_n + jnp.where(levelling, level.k3 * dt * before.vn, 0.0),
            rate_u=state.rate_u + jnp.where(levelling, 0.0, spin * dt),
            force_e=_low_pass(state.force_e, f_dt.x / dt, params.smoothing),
            force_n=_low_pass(state.force_n, f_dt.y / dt, params.smoothing),
        )

    return Program(
        init=_init,
        step=step,
        attitude=lambda state: state.nav.q,
        floor=_bias_floor,
        passes=Passes(_reverse_and_reflect_tilts),
    )


def _init(params: LoopParams, nav: Navigation) -> LoopState:
    zero = jnp.zeros_like(nav.ve)
    return LoopState(nav, zero, zero, zero, LowPassed(zero, zero), LowPassed(zero, zero))


def _low_pass(low: LowPassed, value: Scalar, share: Scalar) -> LowPassed:
    once = low.once + share * (value - low.once)
    return LowPassed(once, low.twice + share * (once - low.twice))


def _reverse_and_reflect_tilts(params: LoopParams, site: Site, state: LoopState) -> LoopState:
    """Return the state at the start of a pass in the other direction, [P2] section 3."""
    reversal, nav = params.reversal, state.nav
    # f = (-g phi_N + nabla_E, g phi_E + nabla_N): g times the tilts from their equilibria.
    angle = 2 * reversal.reflection / site.place.gravity
    tilt = Vec3(angle * state.force_n.twice, -angle * state.force_e.twice, jnp.zeros_like(angle))
    kept = 1 - 2 * reversal.reflection
    return LoopState(
        nav=nav._replace(
            q=rotations.correct(tilt, nav.q),
            ve=reversal.velocity * nav.ve,
            vn=reversal.velocity * nav.vn,
        ),
        integral_e=-state.integral_e,
        integral_n=-state.integral_n,
        rate_u=reversal.rate * state.rate_u,
        force_e=LowPassed(*(kept * stage for stage in state.force_e)),
        force_n=LowPassed(*(kept * stage for stage in state.force_n)),
    )


def _bias_floor(
    params: LoopParams, place: Place, biases: MeanBiases, n: Scalar, backward: Flag
) -> BiasFloor:
    """Return the floor of biases attributed to the Earth, plus a lag, since K(s) leaks.

    The platform rate that cancels eps_U needs a constant north velocity, whose transport rate has
    the effect of the level rate of a heading error: (1 + K2) K4 eps_U / (R K3) of omega_N, which is
    2 eps_U/sigma for the gains of [P2] eq. (23). Its sign changes in a backward pass.
    """
    gains = scale_azimuth_gains(params.azimuth, value_at(params.pace, n))
    eps = biases.eps
    lag = (1 + gains.k2) * gains.k4 * place.curvature_n * eps.z / gains.k3
    felt = jnp.hypot(eps.x, place.rate_n + eps.y)
    lag = jnp.arcsin(jnp.clip(lag * place.rate_n / felt, -1.0, 1.0))
    return bias_floor(place, biases, jnp.where(backward, lag, -lag))


COMPASS = Method(
    name="compass",
    summary="gyrocompass loops: levelling of third order, azimuth of fourth",
    source="[P2] section 2.1",
    sections={"compass": CompassSection},
    reads=("turn", "turn_smoothing_s"),
    build=build,
    params=params,
    rules=(check_sigma_factors,),
    turning="none",
    step_s=5e-9,
    compile_s=3.0,
)
