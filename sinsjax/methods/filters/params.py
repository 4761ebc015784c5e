"""A filter as a method, and its params from [filter], [resets], [alignment] and [passes]."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from sinsjax.methods.filters import keys as filter_keys
from sinsjax.methods.filters.keys import (
    ACCEL_NOISE,
    BIAS_KEYS,
    FILTER_COLUMNS,
    GYRO_NOISE,
    FilterSection,
    ProcessNoise,
    ResetsSection,
    StateKind,
    check_resets,
)
from sinsjax.methods.filters.loop import Filter, FilterParams, closed_loop
from sinsjax.methods.filters.triggers import TriggerParams
from sinsjax.methods.method import Method, Options, StudyKeys
from sinsjax.methods.schedules import UNCHANGED, CovarianceReset, FeedbackSchedule, Resets
from sinsjax.units import si_factor
from sinsjax.value_types import keys_of

LOOP_KEYS = (
    *("feedback_interval_s", "feedback_time_constant_s"),
    *("turn_covariance", "turn_inflation"),
)
"""The keys of [alignment] and [passes] that act on every filter."""


def filter_method(
    states: Sequence[StateKind], build: Callable[[Options], Filter], **parts: Any
) -> Method:
    """Return the method of a filter in closed loop, by default one without sensor bias states."""
    usual: dict[str, Any] = {
        "params": partial(filter_params, states),
        "sections": {"filter": FilterSection, "resets": ResetsSection},
        "reads": LOOP_KEYS,
        "without_effect": BIAS_KEYS,
        "turning": "none",
        "rules": (check_resets,),
        "columns": FILTER_COLUMNS,
    }
    return Method(
        build=lambda options: closed_loop(states, build(options), options), **usual | parts
    )


def filter_params(
    states: Sequence[StateKind], keys: StudyKeys, xp: Any, *, models_surge: bool = False
) -> FilterParams:
    """Return the params of a filter with states of these kinds, leaves (variants,).

    R does not follow the surge if other states model that; see `Method.params`.
    """
    zero = np.zeros(keys.count)

    def variances(when: str) -> list[Any]:
        return [
            zero + kind.variance if kind.name is None else keys.si(f"{when}_{kind.name}") ** 2
            for kind in states
        ]

    p0, after = variances("p0"), variances("reset")
    q_scale = keys.compute(lambda scale: 1.0 if scale is None else scale, "q_scale")
    q = {noise: _process_noise(keys, noise) * q_scale for noise in (ACCEL_NOISE, GYRO_NOISE)}
    reads_surge = keys.has("motion") and not models_surge
    of_r = keys_of(filter_keys.update_variance)[: None if reads_surge else 3]
    return FilterParams(
        p0=tuple(p0),
        q=tuple(zero if kind.q is None else q[kind.q] for kind in states),
        r=keys.compute(partial(filter_keys.update_variance, keys.rate_hz), *of_r),
        feedback=_feedback_schedule(keys, xp),
        resets=_reset_schedule(keys),
        # Left out, a reset sets P as at the start.
        reset_to=tuple(
            xp.where(xp.isnan(to), start, to) for to, start in zip(after, p0, strict=True)
        ),
        reversal=_covariance_reset(keys, "turn_covariance", "turn_inflation")
        if keys.has("passes")
        else CovarianceReset(*(np.broadcast_to(k, zero.shape) for k in UNCHANGED)),
        trigger=_trigger_params(keys),
    )


def _process_noise(keys: StudyKeys, noise: ProcessNoise) -> Any:
    """Return the variance added per step, (variants,), by a form of a key or the sensors' noise."""
    readings = filter_keys.q_unit_factors(1 / keys.rate_hz)
    given = next((form for form in noise.forms if keys.common(form) is not None), None)
    if given is None:
        white = keys.compute(partial(noise.density, keys.rate_hz), *noise.white)
        return (white * si_factor(noise.key, keys.micro_g)) ** 2 * readings["psd"]
    reading = keys.compute(readings.__getitem__, "q_reading")
    return keys.si(given) ** 2 * reading


def _trigger_params(keys: StudyKeys) -> TriggerParams | None:
    """Return the params of the trigger; None without one."""
    if not filter_keys.has_trigger(keys.common("reset_trigger")):
        return None
    rate_hz = keys.rate_hz
    until = keys.compute(lambda time: np.inf if time is None else time, "trigger_until_s")
    return TriggerParams(
        threshold=keys.column("trigger_threshold"),
        window=np.round(keys.column("trigger_window_s") * rate_hz),
        refractory=np.round(keys.column("trigger_refractory_s") * rate_hz),
        most=keys.column("trigger_most"),
        until=np.round(until * rate_hz),
    )


def _feedback_schedule(keys: StudyKeys, xp: Any) -> FeedbackSchedule:
    """Return intervals in samples and gains 1 - exp(-interval/time constant)."""
    every = xp.round(keys.column("feedback_interval_s") * keys.rate_hz)
    constant_s = keys.column("feedback_time_constant_s")
    lags = constant_s > 0
    gain = -xp.expm1(-every / keys.rate_hz / xp.where(lags, constant_s, 1.0))
    restarts = keys.compute(float, "reset_restarts_feedback")
    gain = xp.where(lags, gain, 1.0)
    return FeedbackSchedule(every, gain, restarts if restarts.any() else None)


def _reset_schedule(keys: StudyKeys) -> Resets:
    acting = partial(filter_keys.acting_reset_times, keys.rate_hz)
    samples = keys.lists(acting, *filter_keys.RESET_KEYS, padding=np.inf) * keys.rate_hz
    if isinstance(samples, np.ndarray):  # traced, a window moves with its time
        samples = np.round(samples)
    return Resets(samples, _covariance_reset(keys, "reset_kind", "reset_scale"))


def _covariance_reset(keys: StudyKeys, kind: str, factor: str) -> CovarianceReset:
    """Return the effects on P of ``reset_kind`` or ``turn_covariance``."""

    def numbers(name: str, given: Any) -> Sequence[Any]:
        full, scaled = (0.0, 0.0, 1.0, 1.0), (given, given, 0.0, 0.0)
        kinds = {"full": full, "yaw": (1.0, 0.0, 0.0, 1.0), "scale": scaled}
        return {**kinds, "carried": UNCHANGED, "inflated": scaled, "reset": full}[name]

    return CovarianceReset(*keys.compute(numbers, kind, factor).T)
