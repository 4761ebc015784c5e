"""How a filter's numbers follow the keys of a study, to be differentiated by them."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from sinsjax.alignment.base import Change, Relaxed
from sinsjax.alignment.description import StudyView
from sinsjax.alignment.schedules import Windows
from sinsjax.alignment.triggers.section import any_trigger
from sinsjax.alignment.zero_velocity.method import FilterParams
from sinsjax.strapdown.error_model import (
    EPS_X,
    EPS_Y,
    EPS_Z,
    NABLA_X,
    NABLA_Y,
    PHI_E,
    PHI_N,
    PHI_U,
    VE,
    VN,
)
from sinsjax.types import Array, Scalar

_NEVER = 1e15
"""Sample of a reset that there is not, instead of infinity."""

_LEVEL, _VELOCITY = (PHI_E, PHI_N), (VE, VN)
_ACCEL_BIASES, _GYRO_BIASES = (NABLA_X, NABLA_Y), (EPS_X, EPS_Y, EPS_Z)


def _scaled(values: tuple[Scalar, ...], states: Sequence[int], factor: Scalar) -> tuple:
    return tuple(factor * v if i in states else v for i, v in enumerate(values))


def _p0(states: Sequence[int]) -> Change:
    def change(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
        return params._replace(p0=_scaled(params.p0, states, (value / base) ** 2))

    return change


def _reset_to(states: Sequence[int]) -> Change:
    def change(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
        return params._replace(reset_to=_scaled(params.reset_to, states, (value / base) ** 2))

    return change


def _q(states: Sequence[int], power: int) -> Change:
    def change(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
        return params._replace(q=_scaled(params.q, states, (value / base) ** power))

    return change


def _r(power: int) -> Change:
    def change(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
        return params._replace(r=params.r * (value / base) ** power)

    return change


def _feedback(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
    # 1 - gain = exp(-interval / constant).
    gain = -jnp.expm1(jnp.log1p(-params.feedback.gain) * base / value)
    return params._replace(feedback=params.feedback._replace(gain=gain))


def _first(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
    samples = params.resets.samples
    return _with_samples(params, samples + samples[:1] * (value / base - 1))


def _cycle(params: FilterParams, _: int | None, value: Scalar, base: Scalar) -> Any:
    samples = params.resets.samples
    return _with_samples(params, samples[:1] + (samples - samples[:1]) * (value / base))


def _with_samples(params: FilterParams, samples: Array) -> FilterParams:
    return params._replace(resets=params.resets._replace(samples=samples))


_CHANGES: dict[str, Change] = {
    "reset_first_s": _first,
    "reset_cycle_s": _cycle,
    "reset_velocity_m_per_s": _reset_to(_VELOCITY),
    "reset_level_deg": _reset_to(_LEVEL),
    "reset_yaw_deg": _reset_to((PHI_U,)),
    "reset_accel_bias_ug": _reset_to(_ACCEL_BIASES),
    "reset_gyro_bias_deg_per_h": _reset_to(_GYRO_BIASES),
    "p0_velocity_m_per_s": _p0(_VELOCITY),
    "p0_level_deg": _p0(_LEVEL),
    "p0_yaw_deg": _p0((PHI_U,)),
    "p0_accel_bias_ug": _p0(_ACCEL_BIASES),
    "p0_gyro_bias_deg_per_h": _p0(_GYRO_BIASES),
    "q_scale": _q((*_VELOCITY, *_LEVEL, PHI_U), 1),
    "q_accel_ug": _q(_VELOCITY, 2),
    "q_gyro_deg_per_h": _q((*_LEVEL, PHI_U), 2),
    "q_accel_ug_per_sqrt_hz": _q(_VELOCITY, 2),
    "q_gyro_deg_per_h_per_sqrt_hz": _q((*_LEVEL, PHI_U), 2),
    "q_gyro_arw_deg_per_sqrt_h": _q((*_LEVEL, PHI_U), 2),
    "r_scale": _r(1),
    "r_velocity_m_per_s": _r(2),
    "feedback_time_constant_s": _feedback,
}

_FOLLOWS = {key: key.replace("p0_", "reset_") for key in _CHANGES if key.startswith("p0_")} | {
    "reset_cycle_s": "reset_first_s"
}
"""What P is reset to is what it is at the start; the first reset comes after a cycle."""


def _soften(params: FilterParams, times: Array | None, width: Scalar) -> FilterParams:
    resets = params.resets
    # An infinity has no slope.
    samples = jnp.where(jnp.isfinite(resets.samples), resets.samples, _NEVER)
    if times is not None:
        samples = times
    return params._replace(resets=Windows(samples, width, resets.covariance_reset))


def _refused(study: StudyView) -> str | None:
    if not study.has("resets"):
        return None
    if any(point["reset_kind"] == "scale" for point in study.combinations("reset_kind")):
        return "[resets] reset_kind = 'scale'"
    return "[resets] reset_trigger" if any_trigger(study) else None


RELAXED = Relaxed(_CHANGES, _FOLLOWS, "reset_times_s", _soften, _refused)
