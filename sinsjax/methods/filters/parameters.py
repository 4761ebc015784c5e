"""[filter], [resets] and the feedback of [alignment] as the numbers of a filter."""

import math
from bisect import bisect_left
from collections.abc import Sequence
from functools import partial

import numpy as np

from sinsjax.methods.base import Site
from sinsjax.methods.filters.section import (
    OF_RESETS,
    Q_DENSITIES,
    WHITE_NOISE,
    q_readings,
    times_of_resets,
    white_density,
)
from sinsjax.methods.filters.stages import FilterParams
from sinsjax.methods.filters.states import STATES, StateKind
from sinsjax.methods.parameters import Columns, column_or, in_samples
from sinsjax.methods.schedules import UNCHANGED, CovarianceReset, Feedback, Resets
from sinsjax.methods.triggers.base import TriggerParams
from sinsjax.units import DEG, DEG_PER_H, STANDARD_GRAVITY

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


def parameters(states: Sequence[str], columns: Columns, site: Site, ug: float) -> FilterParams:
    """Numbers of a filter, leaves (variants,).

    Args:
        states: names of its states in `STATES`.
        columns: of variants with one method.
        site: Earth and place; a filter asks nothing of them.
        ug: micro-g in m/s^2.
    """
    dt = 1 / columns.rate_hz
    zero = np.zeros(columns.count)
    q_scale, r_scale = (column_or(columns, key, 1.0) for key in ("q_scale", "r_scale"))
    units = {"q_accel_ug": ug, "q_gyro_deg_per_h": DEG_PER_H}
    q = {key: _q(columns, key, unit) * q_scale for key, unit in units.items()}
    spread = columns.each(lambda name: 1.0 if name == "per_update" else dt, "r_reading")
    kinds = [STATES[state] for state in states]
    p0 = [_p0(columns, kind, ug) for kind in kinds]
    return FilterParams(
        p0=tuple(p0),
        q=tuple(zero if kind.q is None else q[kind.q] for kind in kinds),
        r=columns.column("r_velocity_m_per_s") ** 2 / spread * r_scale,
        feedback=_feedback(columns),
        resets=_resets(columns),
        reset_to=tuple(
            _reset_to(columns, kind, start, ug) for kind, start in zip(kinds, p0, strict=True)
        ),
        turn=_covariance_reset(columns, "turn_covariance", "turn_inflation")
        if columns.has("passes")
        else CovarianceReset(*(np.broadcast_to(k, zero.shape) for k in UNCHANGED)),
        trigger=_trigger(columns),
    )


def level_settling_s(
    rate_hz: float,
    p0_velocity_m_per_s: float,
    p0_level_deg: float,
    r_velocity_m_per_s: float,
    r_reading: str,
    r_scale: float | None,
) -> float:
    """Return the time in which the standard deviation of level falls to a tenth of its P0, s.

    In that time a level error phi is a slope g phi of the velocity, measured with R at each sample.
    The information on it after n samples is 1/p0^2 + S2/R - (S1/R)^2 / (1/p_v^2 + n/R), with S1 and
    S2 the sums of g t and (g t)^2: from a large p_v it grows as g^2 t^3 / (12 R dt). Q is left out,
    since its effect comes later.
    """
    dt = 1 / rate_hz
    r = r_velocity_m_per_s**2 * (1.0 if r_scale is None else r_scale)
    r /= dt if r_reading == "psd" else 1.0
    step = STANDARD_GRAVITY * dt
    information_at_start = (p0_level_deg * DEG) ** -2

    def information(n: int) -> float:
        s1, s2 = step * n * (n + 1) / 2, step**2 * n * (n + 1) * (2 * n + 1) / 6
        return information_at_start + s2 / r - (s1 / r) ** 2 / (p0_velocity_m_per_s**-2 + n / r)

    longest = range(1, 10**8)
    return (1 + bisect_left(longest, 100 * information_at_start, key=information)) * dt


def _p0(columns: Columns, kind: StateKind, ug: float) -> np.ndarray:
    """The initial variance of a state, (variants,)."""
    if kind.p0 is None:
        return np.full(columns.count, kind.variance)
    return columns.column(kind.p0, ug if kind.unit is None else kind.unit) ** 2


def _q(columns: Columns, key: str, unit: float) -> np.ndarray:
    """Return the variance that a step adds, (variants,): a form of a key, or the sensors' own."""
    forms, readings = {key: 1.0, **Q_DENSITIES[key]}, q_readings(1 / columns.rate_hz)
    given = next((form for form in forms if columns.common(form) is not None), None)
    if given is None:
        white = partial(white_density, key, columns.rate_hz)
        return (columns.each(white, *WHITE_NOISE[key][:2]) * unit) ** 2 * readings["psd"]
    reading = columns.each(readings.__getitem__, "q_reading")
    return (columns.column(given, forms[given]) * unit) ** 2 * reading


def _reset_to(columns: Columns, kind: StateKind, p0: np.ndarray, ug: float) -> np.ndarray:
    """The variance of a state that P is reset to: its own, or that of the start."""
    if kind.reset_to is None:
        return p0
    unit = ug if kind.unit is None else kind.unit
    own = columns.each(lambda v: math.nan if v is None else (v * unit) ** 2, kind.reset_to)
    return np.where(np.isnan(own), p0, own)


def _trigger(columns: Columns) -> TriggerParams | None:
    if columns.common("reset_trigger") in (None, "none"):
        return None
    rate_hz = columns.rate_hz
    return TriggerParams(
        threshold=columns.column("trigger_threshold"),
        window=np.round(columns.column("trigger_window_s") * rate_hz),
        refractory=np.round(columns.column("trigger_refractory_s") * rate_hz),
        most=columns.column("trigger_most"),
        until=np.round(column_or(columns, "trigger_until_s", math.inf) * rate_hz),
        at_feedback=_where_any(columns, "reset_at_feedback"),
    )


def _feedback(columns: Columns) -> Feedback:
    rate_hz = columns.rate_hz

    def one(interval_s: float, constant_s: float) -> tuple[float, float]:
        samples = np.round(interval_s * rate_hz)
        return samples, -np.expm1(-samples / rate_hz / constant_s) if constant_s > 0 else 1.0

    every, gain = columns.each(one, "feedback_interval_s", "feedback_time_constant_s").T
    return Feedback(every, gain, _where_any(columns, "reset_restarts_feedback"))


def _resets(columns: Columns) -> Resets:
    samples = in_samples(columns, partial(times_of_resets, columns.rate_hz), *OF_RESETS)
    return Resets(samples, _covariance_reset(columns, "reset_kind", "reset_scale"))


def _where_any(columns: Columns, key: str) -> np.ndarray | None:
    """1 where a key holds and 0 elsewhere, (variants,); None where it holds in no variant."""
    holds = columns.each(float, key)
    return holds if holds.any() else None


def _covariance_reset(columns: Columns, kind: str, factor: str) -> CovarianceReset:
    def numbers(name: str, own: float) -> list[float]:
        return [own if number is None else number for number in _COVARIANCE_RESETS[name]]

    return CovarianceReset(*columns.each(numbers, kind, factor).T)
