"""The params of a filter from [filter], [resets] and [alignment], and their dependence on keys."""

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from sinsjax.methods.base import Change, Relaxation, Site
from sinsjax.methods.description import StudyView
from sinsjax.methods.filters.closed_loop import FilterParams
from sinsjax.methods.filters.section import (
    OF_R,
    OF_RESETS,
    OF_SURGE,
    Q_DENSITIES,
    WHITE_NOISE,
    acting_reset_times,
    q_unit_factors,
    sensor_noise_density,
    update_variance,
)
from sinsjax.methods.parameters import Columns, column_with_default, times_in_samples
from sinsjax.methods.schedules import UNCHANGED, CovarianceReset, FeedbackSchedule, Resets, Windows
from sinsjax.methods.triggers.config import any_trigger
from sinsjax.methods.triggers.trigger import TriggerParams
from sinsjax.types import Array, Scalar
from sinsjax.units import DEG, DEG_PER_H, STANDARD_GRAVITY


class StateKind(NamedTuple):
    """The keys of [filter] and [resets] for one kind of state.

    Attributes:
        p0: key of its initial standard deviation; None if ``variance`` gives that.
        reset_to: key of its standard deviation after a reset.
        unit: of both keys in SI; None for a micro-g.
        q: key of its process noise; None of a constant state.
        variance: its variance at the start and after a reset, if no key gives them.
    """

    p0: str | None
    reset_to: str | None
    unit: float | None
    q: str | None
    variance: float = 0.0


VELOCITY = StateKind("p0_velocity_m_per_s", "reset_velocity_m_per_s", 1.0, "q_accel_ug")
LEVEL = StateKind("p0_level_deg", "reset_level_deg", DEG, "q_gyro_deg_per_h")
HEADING = StateKind("p0_yaw_deg", "reset_yaw_deg", DEG, "q_gyro_deg_per_h")
DIRECTION = StateKind(None, None, 1.0, "q_gyro_deg_per_h", variance=0.5)
"""Sine or cosine of an unknown heading: all headings are equally likely."""
ACCEL_BIAS = StateKind("p0_accel_bias_ug", "reset_accel_bias_ug", None, None)
GYRO_BIAS = StateKind("p0_gyro_bias_deg_per_h", "reset_gyro_bias_deg_per_h", DEG_PER_H, None)

STATES: dict[str, StateKind] = {
    **dict.fromkeys(("dve", "dvn"), VELOCITY),
    **dict.fromkeys(("phi_e", "phi_n", "tilt_e", "tilt_n"), LEVEL),
    **dict.fromkeys(("phi_u", "heading"), HEADING),
    **dict.fromkeys(("heading_sine", "heading_versine"), DIRECTION),
    **dict.fromkeys(("nabla_x", "nabla_y"), ACCEL_BIAS),
    **dict.fromkeys(("eps_x", "eps_y", "eps_z"), GYRO_BIAS),
}


_COVARIANCE_RESETS: dict[str, tuple[float | None, ...]] = {
    # keep, keep_yaw, added, added_yaw; None for the factor that the study gives
    "full": (0.0, 0.0, 1.0, 1.0),
    "yaw": (1.0, 0.0, 0.0, 1.0),
    "scale": (None, None, 0.0, 0.0),
    "carried": UNCHANGED,
    "inflated": (None, None, 0.0, 0.0),
    "reset": (0.0, 0.0, 1.0, 1.0),
}
"""Effect on P by the names of ``reset_kind`` and ``turn_covariance``."""


def parameters(
    states: Sequence[str], columns: Columns, site: Site, ug: float, *, models_surge: bool = False
) -> FilterParams:
    """Return the params of a filter, leaves (variants,).

    Args:
        states: names of its states in `STATES`.
        columns: keys of variants with one method.
        site: Earth and place, which a filter does not need.
        ug: micro-g in m/s^2.
        models_surge: whether other states model the surge, so that R does not follow it.
    """
    zero = np.zeros(columns.count)
    q_scale = column_with_default(columns, "q_scale", 1.0)
    units = {"q_accel_ug": ug, "q_gyro_deg_per_h": DEG_PER_H}
    q = {key: _process_noise(columns, key, unit) * q_scale for key, unit in units.items()}
    of_r = (*OF_R, *(OF_SURGE if columns.has("motion") and not models_surge else ()))
    kinds = [STATES[state] for state in states]
    p0 = [_initial_variance(columns, kind, ug) for kind in kinds]
    return FilterParams(
        p0=tuple(p0),
        q=tuple(zero if kind.q is None else q[kind.q] for kind in kinds),
        r=columns.compute(partial(update_variance, columns.rate_hz), *of_r),
        feedback=_feedback_schedule(columns),
        resets=_reset_schedule(columns),
        reset_to=tuple(
            _reset_variance(columns, kind, start, ug) for kind, start in zip(kinds, p0, strict=True)
        ),
        reversal=_covariance_reset(columns, "turn_covariance", "turn_inflation")
        if columns.has("passes")
        else CovarianceReset(*(np.broadcast_to(k, zero.shape) for k in UNCHANGED)),
        trigger=_trigger_params(columns),
    )


def level_settling_s(
    rate_hz: float, p0_velocity_m_per_s: float, p0_level_deg: float, r: float
) -> float:
    """Return the time in which the standard deviation of level falls to a tenth of its P0, s.

    In that time a level error phi is a slope g phi of the velocity, measured with R at each sample.
    The information on it after n samples is 1/p0^2 + S2/R - (S1/R)^2 / (1/p_v^2 + n/R), with S1 and
    S2 the sums of g t and (g t)^2: from a large p_v it grows as g^2 t^3 / (12 R dt). Q is left out,
    since its effect comes later.

    Args:
        rate_hz: samples per second.
        p0_velocity_m_per_s: initial standard deviation of the velocity errors, m/s.
        p0_level_deg: initial standard deviation of level, deg.
        r: variance R of an update, (m/s)^2.
    """
    dt = 1 / rate_hz
    step = STANDARD_GRAVITY * dt
    information_at_start = (p0_level_deg * DEG) ** -2

    def information(n: int) -> float:
        s1, s2 = step * n * (n + 1) / 2, step**2 * n * (n + 1) * (2 * n + 1) / 6
        return information_at_start + s2 / r - (s1 / r) ** 2 / (p0_velocity_m_per_s**-2 + n / r)

    longest = range(1, 10**8)
    return (1 + bisect_left(longest, 100 * information_at_start, key=information)) * dt


def _initial_variance(columns: Columns, kind: StateKind, ug: float) -> np.ndarray:
    """Return the initial variance of a state, (variants,)."""
    if kind.p0 is None:
        return np.full(columns.count, kind.variance)
    return columns.column(kind.p0, ug if kind.unit is None else kind.unit) ** 2


def _process_noise(columns: Columns, key: str, unit: float) -> np.ndarray:
    """Return the variance added per step, (variants,), by a form of a key or the sensors' noise."""
    forms, readings = {key: 1.0, **Q_DENSITIES[key]}, q_unit_factors(1 / columns.rate_hz)
    given = next((form for form in forms if columns.common(form) is not None), None)
    if given is None:
        white = partial(sensor_noise_density, key, columns.rate_hz)
        return (columns.compute(white, *WHITE_NOISE[key][:2]) * unit) ** 2 * readings["psd"]
    reading = columns.compute(readings.__getitem__, "q_reading")
    return (columns.column(given, forms[given]) * unit) ** 2 * reading


def _reset_variance(columns: Columns, kind: StateKind, p0: np.ndarray, ug: float) -> np.ndarray:
    """Return the variance of a state after a reset: as its key gives it, or as at the start."""
    if kind.reset_to is None:
        return p0
    unit = ug if kind.unit is None else kind.unit
    given = columns.compute(lambda v: math.nan if v is None else (v * unit) ** 2, kind.reset_to)
    return np.where(np.isnan(given), p0, given)


def _trigger_params(columns: Columns) -> TriggerParams | None:
    """Return the params of the triggers; None without one."""
    if columns.common("reset_trigger") in (None, "none"):
        return None
    rate_hz = columns.rate_hz
    return TriggerParams(
        threshold=columns.column("trigger_threshold"),
        window=np.round(columns.column("trigger_window_s") * rate_hz),
        refractory=np.round(columns.column("trigger_refractory_s") * rate_hz),
        most=columns.column("trigger_most"),
        until=np.round(column_with_default(columns, "trigger_until_s", math.inf) * rate_hz),
        at_feedback=_flags_or_none(columns, "reset_at_feedback"),
    )


def _feedback_schedule(columns: Columns) -> FeedbackSchedule:
    """Return intervals in samples and gains 1 - exp(-interval/time constant)."""
    rate_hz = columns.rate_hz

    def samples_and_gain(interval_s: float, constant_s: float) -> tuple[float, float]:
        samples = np.round(interval_s * rate_hz)
        return samples, -np.expm1(-samples / rate_hz / constant_s) if constant_s > 0 else 1.0

    every, gain = columns.compute(
        samples_and_gain, "feedback_interval_s", "feedback_time_constant_s"
    ).T
    return FeedbackSchedule(every, gain, _flags_or_none(columns, "reset_restarts_feedback"))


def _reset_schedule(columns: Columns) -> Resets:
    samples = times_in_samples(columns, partial(acting_reset_times, columns.rate_hz), *OF_RESETS)
    return Resets(samples, _covariance_reset(columns, "reset_kind", "reset_scale"))


def _flags_or_none(columns: Columns, key: str) -> np.ndarray | None:
    """Return 1 where a flag is set, else 0, (variants,); None if it is set in no variant."""
    flags = columns.compute(float, key)
    return flags if flags.any() else None


def _covariance_reset(columns: Columns, kind: str, factor: str) -> CovarianceReset:
    def numbers(name: str, given: float) -> list[float]:
        return [given if number is None else number for number in _COVARIANCE_RESETS[name]]

    return CovarianceReset(*columns.compute(numbers, kind, factor).T)


_NEVER = 1e15
"""Sample of a reset that never takes place; infinity has no derivative."""


def _scale_states(values: tuple[Scalar, ...], states: Sequence[int], factor: Scalar) -> tuple:
    return tuple(factor * v if i in states else v for i, v in enumerate(values))


def _change_p0(states: Sequence[int]) -> Change:
    def change(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
        return params._replace(p0=_scale_states(params.p0, states, (value / base) ** 2))

    return change


def _change_reset_to(states: Sequence[int]) -> Change:
    def change(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
        return params._replace(reset_to=_scale_states(params.reset_to, states, (value / base) ** 2))

    return change


def _change_q(states: Sequence[int], power: int) -> Change:
    def change(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
        return params._replace(q=_scale_states(params.q, states, (value / base) ** power))

    return change


def _change_r(power: int) -> Change:
    def change(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
        return params._replace(r=params.r * (value / base) ** power)

    return change


def _change_time_constant(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
    # 1 - gain = exp(-interval / constant).
    gain = -jnp.expm1(jnp.log1p(-params.feedback.gain) * base / value)
    return params._replace(feedback=params.feedback._replace(gain=gain))


def _change_first_reset(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
    samples = params.resets.samples
    return _replace_reset_samples(params, samples + samples[:1] * (value / base - 1))


def _change_cycle(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
    samples = params.resets.samples
    return _replace_reset_samples(params, samples[:1] + (samples - samples[:1]) * (value / base))


def _replace_reset_samples(params: FilterParams, samples: Array) -> FilterParams:
    return params._replace(resets=params.resets._replace(samples=samples))


_CHANGES: dict[str, Change] = {
    "reset_first_s": _change_first_reset,
    "reset_cycle_s": _change_cycle,
    "r_scale": _change_r(1),
    "r_velocity_m_per_s": _change_r(2),
    "feedback_time_constant_s": _change_time_constant,
}
"""Changes of keys that concern no single state."""


def _state_changes(states: Sequence[str]) -> dict[str, Change]:
    """Return the effects of the keys of P0, resets and Q on a filter with these states."""
    kinds = [STATES[state] for state in states]

    def places(key_of: Callable[[StateKind], str | None], key: str) -> list[int]:
        return [place for place, kind in enumerate(kinds) if key_of(kind) == key]

    changes = dict(_CHANGES)
    for kind in dict.fromkeys(kinds):
        if kind.p0 is not None and kind.reset_to is not None:
            at = places(lambda kind: kind.p0, kind.p0)
            changes |= {kind.p0: _change_p0(at), kind.reset_to: _change_reset_to(at)}
    noisy = [place for place, kind in enumerate(kinds) if kind.q is not None]
    changes["q_scale"] = _change_q(noisy, 1)
    for key, densities in Q_DENSITIES.items():
        change = _change_q(places(lambda kind: kind.q, key), 2)
        changes |= dict.fromkeys((key, *densities), change)
    return changes


def _smooth_resets(params: FilterParams, times: Array | None, width: Scalar) -> FilterParams:
    resets = params.resets
    # Infinity has no derivative.
    samples = jnp.where(jnp.isfinite(resets.samples), resets.samples, _NEVER)
    if times is not None:
        samples = times
    return params._replace(resets=Windows(samples, width, resets.covariance_reset))


def _first_without_gradient(study: StudyView, smoothed: bool) -> str | None:
    """Return the first key of a study that has no gradient, see `Relaxation`."""
    if not study.has("resets"):
        return None
    if any_trigger(study):
        return "[resets] reset_trigger"
    if not smoothed:
        return None
    if any(point["reset_kind"] == "scale" for point in study.combinations("reset_kind")):
        return "[resets] reset_kind = 'scale'"
    for key in ("reset_at_feedback", "reset_restarts_feedback"):
        if any(point[key] for point in study.combinations(key)):
            return f"[resets] {key}"
    return None


def filter_relaxation(states: Sequence[str]) -> Relaxation:
    """Return the dependence of a filter's params on keys; its states are named as in `STATES`."""
    changes = _state_changes(states)
    # Left out, a reset sets P0, and the first reset is one cycle after the start.
    follows = {key: key.replace("p0_", "reset_") for key in changes if key.startswith("p0_")}
    follows["reset_cycle_s"] = "reset_first_s"
    moves = ("reset_first_s", "reset_cycle_s")
    return Relaxation(
        changes, follows, "reset_times_s", moves, _smooth_resets, _first_without_gradient
    )
