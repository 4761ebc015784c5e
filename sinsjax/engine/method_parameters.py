"""The numbers of each alignment method, from the units of a study to SI.

What a filter believes and when it is reset, or the gains of compass loops and when they change;
leaves (variants, ...).
"""

import math
from typing import Any

import numpy as np

from sinsjax.alignment.base import Site
from sinsjax.alignment.compass import design as loops
from sinsjax.alignment.compass import method as compass
from sinsjax.alignment.compass.design import AzimuthGains, LevelGains
from sinsjax.alignment.schedules import UNCHANGED, CovarianceReset, Feedback, Pieces, Resets
from sinsjax.alignment.triggers import base as triggers
from sinsjax.alignment.zero_velocity import method as zero_velocity
from sinsjax.errors import InputError
from sinsjax.strapdown.error_model import MODELS
from sinsjax.study.resolved import Coded
from sinsjax.study.study import Q_DENSITIES, Study
from sinsjax.study.variants import Variants
from sinsjax.units import DEG, DEG_PER_H

_COVARIANCE_RESETS: dict[str, tuple[float | None, ...]] = {
    # keep, keep_yaw, renew, renew_yaw; None for the study's factor
    "full": (0.0, 0.0, 1.0, 1.0),
    "yaw": (1.0, 0.0, 0.0, 1.0),
    "scale": (None, None, 0.0, 0.0),
    "carried": UNCHANGED,
    "inflated": (None, None, 0.0, 0.0),
    "reset": (0.0, 0.0, 1.0, 1.0),
}
"""What becomes of P, by the names of ``reset_kind`` and ``turn_covariance``."""

REVERSALS = {
    # velocity, integral, rate, reflection
    "reflect": compass.Reversal(-1.0, -1.0, 1.0, 1.0),
    "velocity": compass.Reversal(-1.0, -1.0, 1.0, 0.0),
    "velocity_and_rate": compass.Reversal(-1.0, -1.0, -1.0, 0.0),
    "velocity_drop_rate": compass.Reversal(-1.0, -1.0, 0.0, 0.0),
    "restart": compass.Reversal(0.0, 0.0, 0.0, 0.0),
    "keep": compass.Reversal(1.0, -1.0, 1.0, 0.0),
}
"""What compass loops do at a turn of the tape, by the names of ``turn``.

``velocity``, [P2]'s own, changes the sign of the velocity and leaves azimuth rate and tilt, which a
reversed Earth rate turns against the loop; ``velocity_and_rate`` changes that of the azimuth rate
too, ``velocity_drop_rate`` sets it to zero. ``reflect`` changes the signs of velocity and tilt, so
that the next pass goes on where this one stopped. ``restart`` begins again with the attitude alone,
``keep`` goes on as if nothing had happened. All but ``restart`` change the sign of the levelling
integrals.
"""


def of_method(study: Study, variants: Variants, site: Site, ug: float) -> Any:
    """Numbers of the one method that some variants share.

    Args:
        study: of the variants.
        variants: with one method and one site.
        site: Earth and place.
        ug: micro-g in m/s^2.
    """
    if variants.common("method") == "compass":
        return _compass(study, variants, site)
    return _filter(study, variants, ug)


def _filter(study: Study, variants: Variants, ug: float) -> zero_velocity.FilterParams:
    states = MODELS[variants.common("method")].states
    dt = 1 / study.rate_hz
    velocity = variants.column("p0_velocity_m_per_s") ** 2
    level = variants.column("p0_level_deg", DEG) ** 2
    yaw = variants.column("p0_yaw_deg", DEG) ** 2
    nabla = variants.column("p0_accel_bias_ug", ug) ** 2
    eps = variants.column("p0_gyro_bias_deg_per_h", DEG_PER_H) ** 2
    readings = {"per_step": 1.0, "psd": dt, "per_sample": dt * dt}
    reading = variants.coded("q_reading").each(readings.__getitem__)
    q_scale, r_scale = (_column_or(variants, key, 1.0) for key in ("q_scale", "r_scale"))
    q_v = (_q(variants, "q_accel_ug") * ug) ** 2 * reading * q_scale
    q_phi = (_q(variants, "q_gyro_deg_per_h") * DEG_PER_H) ** 2 * reading * q_scale
    spread = variants.coded("r_reading").each(lambda name: 1.0 if name == "per_update" else dt)
    zero = np.zeros_like(velocity)
    p0 = {"dve": velocity, "dvn": velocity, "phi_e": level, "phi_n": level, "phi_u": yaw}
    p0 |= {f"nabla_{axis}": nabla for axis in "xyz"} | {f"eps_{axis}": eps for axis in "xyz"}
    q = {"dve": q_v, "dvn": q_v, "phi_e": q_phi, "phi_n": q_phi, "phi_u": q_phi}
    start = tuple(p0[state] for state in states)
    return zero_velocity.FilterParams(
        p0=start,
        q=tuple(q.get(state, zero) for state in states),  # biases are constant
        r=variants.column("r_velocity_m_per_s") ** 2 / spread * r_scale,
        feedback=_feedback(variants, study.rate_hz),
        resets=_resets(study, variants),
        reset_to=tuple(
            _reset_to(variants, state, p, ug) for state, p in zip(states, start, strict=True)
        ),
        turn=_covariance_reset(variants, "turn_covariance", "turn_inflation")
        if study.passes
        else CovarianceReset(*(np.broadcast_to(k, zero.shape) for k in UNCHANGED)),
        trigger=_trigger(variants, study.rate_hz),
    )


def _q(variants: Variants, key: str) -> np.ndarray:
    """Values of a key of Q, (variants,), from whichever of its forms the study gives."""
    forms = {key: 1.0, **Q_DENSITIES[key]}
    given = next(form for form in forms if variants.common(form) is not None)
    return variants.column(given, forms[given])


def _reset_to(variants: Variants, state: str, p0: np.ndarray, ug: float) -> np.ndarray:
    """The variance of a state that P is reset to: its own, or that of the start."""
    key, unit = {
        "dve": ("reset_velocity_m_per_s", 1.0),
        "dvn": ("reset_velocity_m_per_s", 1.0),
        "phi_e": ("reset_level_deg", DEG),
        "phi_n": ("reset_level_deg", DEG),
        "phi_u": ("reset_yaw_deg", DEG),
        "nabla": ("reset_accel_bias_ug", ug),
        "eps": ("reset_gyro_bias_deg_per_h", DEG_PER_H),
    }[state if state.startswith(("d", "phi")) else state.partition("_")[0]]
    column = variants.coded(key)
    if column.choices == (None,):
        return p0
    own = column.each(lambda v: math.nan if v is None else (v * unit) ** 2)
    return np.where(np.isnan(own), p0, own)


def _trigger(variants: Variants, rate_hz: float) -> triggers.TriggerParams | None:
    if variants.common("reset_trigger") in (None, "none"):
        return None
    return triggers.TriggerParams(
        threshold=variants.column("trigger_threshold"),
        window=np.round(variants.column("trigger_window_s") * rate_hz),
        refractory=np.round(variants.column("trigger_refractory_s") * rate_hz),
        most=variants.column("trigger_most"),
        until=np.round(_column_or(variants, "trigger_until_s", math.inf) * rate_hz),
    )


def _column_or(variants: Variants, key: str, default: float) -> np.ndarray:
    """Values of a numeric key, (variants,); the default where a variant leaves it out."""
    return variants.coded(key).each(lambda value: default if value is None else value)


def _feedback(variants: Variants, rate_hz: float) -> Feedback:
    def one(values: tuple[float, float]) -> tuple[float, float]:
        samples, constant = np.round(values[0] * rate_hz), values[1]
        return samples, -np.expm1(-samples / rate_hz / constant) if constant > 0 else 1.0

    both = variants.coded("feedback_interval_s", "feedback_time_constant_s").each(one)
    return Feedback(*both.T)


def _resets(study: Study, variants: Variants) -> Resets:
    samples = _in_samples(variants.of(study.schedules), study.rate_hz)
    return Resets(samples, _covariance_reset(variants, "reset_kind", "reset_scale"))


def _covariance_reset(variants: Variants, kind: str, factor: str) -> CovarianceReset:
    def numbers(values: tuple[str, float]) -> list[float]:
        name, own = values
        return [own if number is None else number for number in _COVARIANCE_RESETS[name]]

    return CovarianceReset(*variants.coded(kind, factor).each(numbers).T)


def _in_samples(times: Coded, rate_hz: float) -> np.ndarray:
    """(variants, M) times in samples; inf where a variant has fewer."""
    return _padded(times.map(lambda own: np.round(np.asarray(own) * rate_hz).tolist()), np.inf)


def _padded(lists: Coded, rest: float) -> np.ndarray:
    """(variants, M) numbers of which variants have a list each; the rest where one is shorter."""
    taken = np.flatnonzero(np.bincount(lists.codes, minlength=len(lists.choices)))
    most = max(len(lists.choices[code]) for code in taken)
    return lists.each(lambda own: [*own, *([rest] * (most - len(own)))][:most])


def _compass(study: Study, variants: Variants, site: Site) -> compass.LoopParams:
    rate = study.rate_hz
    level_gains, azimuth_gains = gains(variants, site)
    passes = study.passes is not None
    tape = ("tape_s",) if passes else ()
    count = len(variants.ids)

    def level_s(values: tuple[Any, ...]) -> float:
        time, number, *tape_s = values
        return time if number is None else number * tape_s[0]

    def pieces_s(values: tuple[Any, ...]) -> tuple[float, ...]:
        times, numbers, *tape_s = values
        return times or () if numbers is None else tuple(n * tape_s[0] for n in numbers)

    pieces = variants.coded("sigma_times_s", "sigma_passes", *tape).map(pieces_s)
    from_s = variants.coded("level_time_s", "level_passes", *tape).each(level_s)
    turns = variants.coded("turn") if passes else Coded(np.zeros(count, int), ("keep",))
    smoothing = variants.column("turn_smoothing_s") if passes else np.ones(count)
    return compass.LoopParams(
        level=level_gains,
        azimuth=azimuth_gains,
        pace=Pieces(_in_samples(pieces, rate), _padded(variants.coded("sigma_factors"), 1.0)),
        azimuth_from=np.round(from_s * rate),
        smoothing=-np.expm1(-2 / (rate * smoothing)),  # two stages share the delay
        turn=compass.Reversal(*turns.each(REVERSALS.__getitem__).T),
    )


def gains(variants: Variants, site: Site) -> tuple[LevelGains, AzimuthGains]:
    """Gains of the loops: as given, or designed from sigma or an adjustment time and damping.

    They are designed for the north channel; on an ellipsoid the east one differs in its K2 by some
    0.1 %.
    """
    earth = earth_numbers(site)
    level = loops.level_gains(*_sigma(variants, "level"), **earth)
    azimuth = loops.azimuth_gains(*_sigma(variants, "azimuth"), **earth)
    return _given(variants, "level_gains", level), _given(variants, "azimuth_gains", azimuth)


def check_loops(study: Study, variants: Variants, site: Site) -> None:
    """Refuses compass loops that are unstable, or that a sample interval cannot carry.

    Args:
        study: of the variants.
        variants: with one method and one site.
        site: Earth and place.

    Raises:
        InputError: names the roots; not where ``allow_unstable`` is set.
    """
    if variants.common("method") != "compass":
        return
    refused = ~variants.coded("allow_unstable").each(bool, bool)
    earth = earth_numbers(site)
    fastest = variants.coded("sigma_factors").each(max)
    with np.errstate(over="ignore", invalid="ignore"):
        level, azimuth = gains(variants, site)
        azimuth = loops.at_pace(azimuth, fastest)
    for loop, found in (("level", level), ("azimuth", azimuth)):
        for row in np.flatnonzero(~np.isfinite(np.stack(found)).all(axis=0)):
            raise _refusal(study, variants, loop, int(row), "gives a gain that is no finite number")
    dt = 1 / study.rate_hz
    rate_n = float(site.place.rate_n)
    for loop, polynomial, matrix in (
        (
            "level",
            loops.level_polynomial(level, **earth),
            loops.level_matrix(level, **earth),
        ),
        (
            "azimuth",
            loops.azimuth_polynomial(azimuth, **earth),
            loops.azimuth_matrix(azimuth, rate_n=rate_n, **earth),
        ),
    ):
        roots = loops.roots(polynomial)
        unstable = roots.real.max(axis=-1) >= 0
        for row in np.flatnonzero(refused & (unstable | ~loops.carries(matrix, dt))):
            what = (
                "makes an unstable loop"
                if unstable[row]
                else f"makes a loop that a sample of {dt:g} s cannot carry"
            )
            text = f"{what}, its roots are {_roots_text(roots[row])} 1/s"
            raise _refusal(
                study, variants, loop, int(row), f"{text} (allow_unstable = true runs it)"
            )


def _refusal(study: Study, variants: Variants, loop: str, row: int, text: str) -> InputError:
    """The error of a variant's loop, naming the key that decides its gains, and the value."""
    keys = [f"{loop}_{kind}" for kind in ("gains", "adjustment_s", "sigma_per_s")]
    key, value = next((k, v) for k in keys if (v := variants.raw(k)[row]) is not None)
    shown = list(value) if isinstance(value, tuple) else f"{value:g}"
    factor = max(variants.raw("sigma_factors")[row])
    if loop == "azimuth" and factor != 1:
        shown = f"{shown} with a sigma factor of {factor:g}"
    zipped = (f"[axes.{name}]" for name, keys in study.zips.items() if key in keys)
    where = next(zipped, "[axes]" if key in study.axes else "[compass]")
    if study.cases and key in study.cases[0]:
        where = "[cases]"
    return InputError(f"{study.name}: {where} {key}: {shown} {text}")


def earth_numbers(site: Site) -> dict[str, Any]:
    """Gravity and radius as `compass.design` takes them."""
    return {"gravity": float(site.place.gravity), "radius": float(1 / site.place.curvature_n)}


def _roots_text(found: np.ndarray) -> str:
    ordered = sorted(found, key=lambda r: (-round(r.real, 9), r.imag))
    return ", ".join(f"{r.real + 0.0:.4g}{f'{r.imag:+.4g}j' if r.imag else ''}" for r in ordered)


def _given(variants: Variants, key: str, designed: Any) -> Any:
    """The gains, replaced where a variant gives its own."""
    rows, count = np.stack(designed, axis=-1), len(designed)
    own = variants.coded(key).each(lambda v: [math.nan] * count if v is None else v)
    return type(designed)(*np.where(np.isnan(own), rows, own).T)


def _sigma(variants: Variants, loop: str) -> tuple[np.ndarray, np.ndarray]:
    """Sigma (1/s) and damping of a loop; a variant with gains of its own has some sigma."""
    keys = ("sigma_per_s", "adjustment_s", "damping")
    how = ("adjustment_reading", "adjustment_remainder")

    def sigma(values: tuple[Any, ...]) -> float:
        own, time, damping, reading, remainder = values
        if own is not None:
            return own
        if time is None:
            return 1.0
        if reading == "period":
            return loops.sigma_of_period(time, damping)
        return loops.sigma_of_settling(time, remainder)

    sigmas = variants.coded(*(f"{loop}_{key}" for key in keys), *how).each(sigma)
    return sigmas, variants.column(f"{loop}_damping")
