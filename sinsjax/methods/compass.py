"""Compass alignment: levelling and azimuth loops of a mathematical platform, [P2] section 2.1.

Without covariance: velocity and its integral level the platform ([P2] Fig. 1, third order), then
the north velocity that a heading error causes through the Earth rate rotates it in azimuth ([P2]
Fig. 2, fourth order). The east channel levels throughout.

The transport rate is part of the mechanisation; the loops add K2 times that rate, which gives the
1 + K2 of the characteristic polynomials of `compass_design`.
"""

import math
from itertools import combinations
from typing import Annotated, Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from pydantic import Field

from sinsjax.maths import rotations
from sinsjax.methods import compass_design as loops
from sinsjax.methods.compass_design import AzimuthGains, LevelGains
from sinsjax.methods.floors import BiasFloor, MeanBiases, bias_floor
from sinsjax.methods.method import Method, Options, Passes, Program, RunEnd, Site, StudyKeys
from sinsjax.methods.schedules import PiecewiseConstant, value_at
from sinsjax.strapdown import mechanisation
from sinsjax.strapdown.earth import Place
from sinsjax.types import Navigation, Sample, Scalar, Vec3
from sinsjax.value_types import (
    Bandwidth,
    Count,
    Damping,
    Factors,
    Finite,
    KeyCondition,
    KeyInfo,
    PassNumbers,
    Seconds,
    SecondsOrZero,
    Section,
    Times,
    field,
)

_LOOPS, _SETTINGS = ("level", "azimuth"), ("gains", "adjustment_s", "sigma_per_s")
_ADJUSTMENTS = tuple(f"{loop}_adjustment_s" for loop in _LOOPS)
_GAIN = KeyInfo(usual_range=(-1e11, 1e11))


class CompassSection(Section):
    """[compass]: levelling and azimuth loops, and their gain schedule."""

    exclusive = (
        *((f"{loop}_{a}", f"{loop}_{b}") for loop in _LOOPS for a, b in combinations(_SETTINGS, 2)),
        ("level_passes", "level_time_s"),
        ("sigma_passes", "sigma_times_s"),
    )
    conditions = (
        KeyCondition(("level_damping",), ("level_gains",), lambda k: k is None, refused=True),
        KeyCondition(("azimuth_damping",), ("azimuth_gains",), lambda k: k is None, refused=True),
        KeyCondition(("adjustment_reading",), _ADJUSTMENTS, lambda *times_s: any(times_s)),
        KeyCondition(
            ("adjustment_remainder",),
            ("adjustment_reading", *_ADJUSTMENTS),
            lambda reading, *times_s: reading == "settling" and any(times_s),
        ),
    )

    level_sigma_per_s: Bandwidth | None = field(
        "decay rate sigma of the levelling loop", default=0.02
    )
    level_adjustment_s: Seconds | None = field(
        "alternative to level_sigma_per_s: see adjustment_reading"
    )
    level_gains: Annotated[tuple[Finite, Finite, Finite], _GAIN] | None = field(
        "gains instead of sigma: velocity damping K1 (1/s), platform rate K2 (transport rates),"
        " velocity integral K3 (rad/(m s))"
    )
    level_damping: Damping = field("damping ratio of the levelling loop", loops.PAPER_DAMPING)
    level_time_s: SecondsOrZero | None = field(
        "levelling of both channels before the azimuth loop", default=150.0, time="s"
    )
    level_passes: Annotated[Count, Field(ge=1)] | None = field(
        "levelling time in passes; alternative to level_time_s", time="pass"
    )
    azimuth_sigma_per_s: Bandwidth | None = field(
        "decay rate sigma of the azimuth loop", default=0.01
    )
    azimuth_adjustment_s: Seconds | None = field(
        "alternative to azimuth_sigma_per_s: see adjustment_reading"
    )
    azimuth_gains: Annotated[tuple[Finite, Finite, Finite, Finite], _GAIN] | None = field(
        "gains instead of sigma: K1 and K2 as in level_gains; K3 (1/(m s^2)) and K4 (1/s) of the"
        " azimuth control K3 / (omega_N (s + K4))"
    )
    azimuth_damping: Damping = field("damping ratio of the azimuth loop", loops.PAPER_DAMPING)
    adjustment_reading: Literal["period", "settling"] = field(
        "adjustment time. 'period': of the damped oscillation. 'settling': until exp(-sigma t)"
        " falls to adjustment_remainder",
        "period",
    )
    adjustment_remainder: Annotated[float, Field(gt=0, lt=1)] = field(
        "exp(-sigma t) after 'settling'", 0.05
    )
    sigma_factors: Factors = field(
        "factors on the azimuth sigma in intervals, the first from the start", (1.0,)
    )
    sigma_times_s: Times | None = field(
        "start times of the later intervals of sigma_factors", whole="sample", time="s"
    )
    sigma_passes: PassNumbers | None = field(
        "passes before the later intervals; alternative to sigma_times_s", time="pass"
    )
    allow_unstable: bool = field(
        "whether to run loops that are unstable, or too fast for the sample time", False
    )


def check_sigma_factors(study: StudyKeys) -> None:
    """Refuse sigma factors without as many times, and numbers of passes without a stored record."""
    if not study.has("compass"):
        return
    for point in study.combinations("sigma_factors", "sigma_times_s", "sigma_passes"):
        needed = len(point["sigma_factors"]) - 1
        key = "sigma_passes" if point["sigma_passes"] is not None else "sigma_times_s"
        if (given := len(point[key] or ())) != needed:
            study.refuse(key, f"needs {needed} entries for {needed + 1} sigma_factors, not {given}")
    stored = study.combinations("stored_s") if study.has("passes") else [{"stored_s": None}]
    has_stored = all(point["stored_s"] is not None for point in stored)
    for key in ("level_passes", "sigma_passes"):
        if not has_stored and any(p[key] is not None for p in study.combinations(key)):
            study.refuse(key, "needs passes over a stored record (give [passes] stored_s)")


# Numbers of the loops


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


REVERSALS = {
    "reflect": Reversal(-1.0, -1.0, 1.0, 1.0),
    "velocity": Reversal(-1.0, -1.0, 1.0, 0.0),
    "velocity_and_rate": Reversal(-1.0, -1.0, -1.0, 0.0),
    "velocity_drop_rate": Reversal(-1.0, -1.0, 0.0, 0.0),
    "restart": Reversal(0.0, 0.0, 0.0, 0.0),
    "keep": Reversal(1.0, -1.0, 1.0, 0.0),
}
"""Effect of a direction reversal by the names of ``turn``.

``velocity``, that of [P2], leaves azimuth rate and tilt, which a reversed Earth rate turns against
the loop. After ``reflect`` the next pass continues where this one stopped. ``restart`` keeps the
attitude alone.
"""


class LoopParams(NamedTuple):
    """Params of the loops.

    Attributes:
        azimuth: gains at pace 1.
        pace: factor on the sigma of the azimuth loop, with gains that move its roots by it.
        azimuth_from: samples before the azimuth loop takes over the north channel.
        smoothing: share of each new sample in each stage of the low-passed specific force.
    """

    level: LevelGains
    azimuth: AzimuthGains
    pace: PiecewiseConstant
    azimuth_from: Scalar
    smoothing: Scalar
    reversal: Reversal


def params(keys: StudyKeys, xp: Any) -> LoopParams:
    """Return the params of the loops, leaves (variants,)."""
    rate, passes = keys.rate_hz, keys.has("passes")
    stored = ("stored_s",) if passes else ()

    def level_s(time_s: Any, number: int | None, stored_s: Any = math.nan) -> Any:
        return time_s if number is None else number * stored_s

    def change_times_s(times_s: Any, numbers: Any, stored_s: Any = math.nan) -> tuple[Any, ...]:
        return times_s or () if numbers is None else tuple(n * stored_s for n in numbers)

    times_s = keys.lists(change_times_s, "sigma_times_s", "sigma_passes", *stored, padding=np.inf)
    factors = keys.lists(list, "sigma_factors", padding=1.0)
    levelling_s = keys.compute(level_s, "level_time_s", "level_passes", *stored)
    smoothing_s = keys.column("turn_smoothing_s") if passes else np.ones(keys.count)
    reversal = keys.compute(REVERSALS.__getitem__, "turn").T if passes else REVERSALS["keep"]
    level, azimuth = gains(keys, xp)
    return LoopParams(
        level=level,
        azimuth=azimuth,
        pace=PiecewiseConstant(xp.round(times_s * rate), factors),
        azimuth_from=xp.round(levelling_s * rate),
        smoothing=-xp.expm1(-2 / (rate * smoothing_s)),  # two stages share the delay
        reversal=Reversal(*(np.broadcast_to(factor, keys.count) for factor in reversal)),
    )


def gains(keys: StudyKeys, xp: Any) -> tuple[LevelGains, AzimuthGains]:
    """Return the gains of the loops: as given, or designed from sigma or adjustment time, damping.

    For the north channel; on an ellipsoid the east one differs in its K2 by some 0.1 %.
    """

    def of_loop(loop: str, design: Any) -> Any:
        damping, time_s = keys.column(f"{loop}_damping"), keys.column(f"{loop}_adjustment_s")
        adjusted = xp.where(
            keys.compute(lambda reading: reading == "settling", "adjustment_reading", dtype=bool),
            loops.sigma_from_settling(time_s, keys.column("adjustment_remainder"), xp),
            loops.sigma_from_period(time_s, damping),
        )
        sigma = keys.column(f"{loop}_sigma_per_s")
        sigma = xp.where(xp.isnan(sigma), adjusted, sigma)
        designed = design(sigma, damping, **_earth(keys.site))
        none = [math.nan] * len(designed)
        given = keys.compute(lambda found: none if found is None else found, f"{loop}_gains")
        rows = xp.where(xp.isnan(given), xp.stack(designed, axis=-1), given)
        return type(designed)(*rows.T)

    return of_loop("level", loops.level_gains), of_loop("azimuth", loops.azimuth_gains)


def _earth(site: Site) -> dict[str, float]:
    """Return gravity and radius, as `compass_design` reads them."""
    return {"gravity": float(site.place.gravity), "radius": float(1 / site.place.curvature_n)}


def check(keys: StudyKeys) -> None:
    """Refuse loops that are unstable or too fast for the sample, unless allowed; name the roots."""
    refused = ~keys.compute(bool, "allow_unstable", dtype=bool)
    earth, dt = _earth(keys.site), 1 / keys.rate_hz
    with np.errstate(over="ignore", invalid="ignore"):
        level, azimuth = gains(keys, np)
        azimuth = loops.scale_azimuth_gains(azimuth, keys.compute(max, "sigma_factors"))
    for loop, found in zip(_LOOPS, (level, azimuth), strict=True):
        for row in np.flatnonzero(~np.isfinite(np.stack(found)).all(axis=0)):
            _refuse_loop(keys, loop, int(row), "gives a gain that is no finite number")
    too_fast = f"a loop that a sample of {dt:g} s cannot carry"
    matrices = loops.level_matrix(level, **earth), loops.azimuth_matrix(azimuth, **earth)
    for loop, matrix in zip(_LOOPS, matrices, strict=True):
        roots = loops.roots(matrix)
        unstable = roots.real.max(axis=-1) >= 0
        for row in np.flatnonzero(refused & (unstable | ~loops.is_stable(matrix, dt))):
            what = "an unstable loop" if unstable[row] else too_fast
            text = f"makes {what}, its roots are {_format_roots(roots[row])} 1/s"
            _refuse_loop(keys, loop, int(row), f"{text} (allow_unstable = true runs it)")


def _refuse_loop(keys: StudyKeys, loop: str, row: int, text: str) -> None:
    """Refuse a variant's loop, naming the key that sets its gains, and the value."""
    names = [f"{loop}_{setting}" for setting in _SETTINGS]
    key, value = next((k, v) for k in names if (v := keys.value(k, row)) is not None)
    shown = list(value) if isinstance(value, tuple) else f"{value:g}"
    factor = max(keys.value("sigma_factors", row))
    if loop == "azimuth" and factor != 1:
        shown = f"{shown} with a sigma factor of {factor:g}"
    keys.refuse(key, f"{shown} {text}")


def _format_roots(found: np.ndarray) -> str:
    ordered = sorted(found, key=lambda r: (-round(r.real, 9), r.imag))
    return ", ".join(f"{r.real + 0.0:.4g}{f'{r.imag:+.4g}j' if r.imag else ''}" for r in ordered)


# A run


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
        integral_n: of the north velocity, likewise, while it is levelled.
        rate_u: azimuth rate of the platform, rad/s.
        force_e: low-passed specific force, m/s^2; also ``force_n``.
    """

    nav: Navigation
    integral_e: Scalar
    integral_n: Scalar
    rate_u: Scalar
    force_e: LowPassed
    force_n: LowPassed


def build(options: Options) -> Program:
    """Return the compass program; ``specific_force`` of the options concerns filters only."""
    dt = options.dt

    def step(
        params: LoopParams, site: Site, state: LoopState, sample: Sample, n: Scalar
    ) -> LoopState:
        before, place, level = state.nav, options.place(site, state.nav), params.level
        azimuth = loops.scale_azimuth_gains(params.azimuth, value_at(params.pace, n))
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
        passes=Passes(reverse=_reverse, rewind=_rewind),
    )


def _init(params: LoopParams, nav: Navigation) -> LoopState:
    zero = jnp.zeros_like(nav.ve)
    return LoopState(nav, zero, zero, zero, LowPassed(zero, zero), LowPassed(zero, zero))


def _low_pass(low: LowPassed, value: Scalar, share: Scalar) -> LowPassed:
    once = low.once + share * (value - low.once)
    return LowPassed(once, low.twice + share * (once - low.twice))


def _rewind(params: LoopParams, nav: Navigation, state: LoopState) -> LoopState:
    """Start again, but keep levelling integrals and azimuth rate, which balance gyro drift."""
    return _init(params, nav)._replace(
        integral_e=state.integral_e, integral_n=state.integral_n, rate_u=state.rate_u
    )


def _reverse(params: LoopParams, site: Site, state: LoopState) -> LoopState:
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
        integral_e=reversal.integral * state.integral_e,
        integral_n=reversal.integral * state.integral_n,
        rate_u=reversal.rate * state.rate_u,
        force_e=LowPassed(*(kept * stage for stage in state.force_e)),
        force_n=LowPassed(*(kept * stage for stage in state.force_n)),
    )


def _bias_floor(params: LoopParams, place: Place, biases: MeanBiases, end: RunEnd) -> BiasFloor:
    """Return the floor of biases attributed to the Earth, plus a lag, since K(s) leaks.

    The platform rate that cancels eps_U needs a constant north velocity, whose transport rate has
    the effect of the level rate of a heading error: (1 + K2) K4 eps_U / (R K3) of omega_N, which is
    2 eps_U/sigma for the gains of [P2] eq. (23). Its sign changes in a backward pass.
    """
    gains = loops.scale_azimuth_gains(params.azimuth, value_at(params.pace, end.n))
    eps = biases.eps
    lag = (1 + gains.k2) * gains.k4 * place.curvature_n * eps.z / gains.k3
    felt = jnp.hypot(eps.x, place.rate_n + eps.y)
    lag = jnp.arcsin(jnp.clip(lag * place.rate_n / felt, -1.0, 1.0))
    return bias_floor(place, biases, jnp.where(end.backward, lag, -lag))


COMPASS = Method(
    name="compass",
    summary="gyrocompass loops: levelling of third order, azimuth of fourth",
    source="[P2] section 2.1",
    sections={"compass": CompassSection},
    reads=("turn", "turn_smoothing_s"),
    build=build,
    params=params,
    check=check,
    rules=(check_sigma_factors,),
    turning="none",
    step_s=5e-9,
    compile_s=3.0,
)
