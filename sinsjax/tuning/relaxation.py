"""Variables as numbers of the engine, to be differentiated by.

Each variable changes the `Params` of its method by the ratio of its value to that of a base point,
whose numbers were made as those of any study: no unit and no formula of a method's `parameters` is
said twice. Resets become smooth windows.
"""

from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import jax.numpy as jnp

from sinsjax.alignment.compass import design as loops
from sinsjax.alignment.compass import method as compass
from sinsjax.alignment.schedules import Windows
from sinsjax.alignment.zero_velocity import method as zero_velocity
from sinsjax.errors import InputError
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
from sinsjax.study.load import with_point
from sinsjax.study.search_space import SearchSpace, Variable
from sinsjax.study.study import Study, TomlTable
from sinsjax.study.tuned_keys import COUNT, TIMES
from sinsjax.types import Array, Scalar

Change = Callable[[Any, Variable, Scalar, Scalar], Any]
"""(params of one run, variable, its value, its value at the base point) -> params."""

_NEVER = 1e15
"""Sample of a reset that there is not, instead of infinity."""

_LEVEL, _VELOCITY = (PHI_E, PHI_N), (VE, VN)
_ACCEL_BIASES, _GYRO_BIASES = (NABLA_X, NABLA_Y), (EPS_X, EPS_Y, EPS_Z)


def _scaled(values: tuple[Scalar, ...], states: Sequence[int], factor: Scalar) -> tuple:
    return tuple(factor * v if i in states else v for i, v in enumerate(values))


def _p0(states: Sequence[int]) -> Change:
    def change(params: zero_velocity.FilterParams, _: Variable, value: Scalar, base: Scalar) -> Any:
        return params._replace(p0=_scaled(params.p0, states, (value / base) ** 2))

    return change


def _reset_to(states: Sequence[int]) -> Change:
    def change(params: zero_velocity.FilterParams, _: Variable, value: Scalar, base: Scalar) -> Any:
        return params._replace(reset_to=_scaled(params.reset_to, states, (value / base) ** 2))

    return change


def _q(states: Sequence[int], power: int) -> Change:
    def change(params: zero_velocity.FilterParams, _: Variable, value: Scalar, base: Scalar) -> Any:
        return params._replace(q=_scaled(params.q, states, (value / base) ** power))

    return change


def _r(power: int) -> Change:
    def change(params: zero_velocity.FilterParams, _: Variable, value: Scalar, base: Scalar) -> Any:
        return params._replace(r=params.r * (value / base) ** power)

    return change


def _feedback(params: zero_velocity.FilterParams, _: Variable, value: Scalar, base: Scalar) -> Any:
    # 1 - gain = exp(-interval / constant).
    gain = -jnp.expm1(jnp.log1p(-params.feedback.gain) * base / value)
    return params._replace(feedback=params.feedback._replace(gain=gain))


def _first(params: zero_velocity.FilterParams, _: Variable, value: Scalar, base: Scalar) -> Any:
    samples = params.resets.samples
    return _with_samples(params, samples + samples[:1] * (value / base - 1))


def _cycle(params: zero_velocity.FilterParams, _: Variable, value: Scalar, base: Scalar) -> Any:
    samples = params.resets.samples
    return _with_samples(params, samples[:1] + (samples - samples[:1]) * (value / base))


def _with_samples(params: zero_velocity.FilterParams, samples: Array) -> zero_velocity.FilterParams:
    return params._replace(resets=params.resets._replace(samples=samples))


def _pace(params: compass.LoopParams, variable: Variable, value: Scalar, base: Scalar) -> Any:
    values = params.pace.values.at[variable.entry].multiply(value / base)
    return params._replace(pace=params.pace._replace(values=values))


def _azimuth_sigma(params: compass.LoopParams, _: Variable, value: Scalar, base: Scalar) -> Any:
    return params._replace(azimuth=loops.at_pace(params.azimuth, value / base))


def _level_sigma(params: compass.LoopParams, _: Variable, value: Scalar, base: Scalar) -> Any:
    return params._replace(level=loops.level_at_pace(params.level, value / base))


def _smoothing(params: compass.LoopParams, _: Variable, value: Scalar, base: Scalar) -> Any:
    share = -jnp.expm1(jnp.log1p(-params.smoothing) * base / value)
    return params._replace(smoothing=share)


CHANGES: dict[str, Change] = {
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
    "sigma_factors": _pace,
    "azimuth_sigma_per_s": _azimuth_sigma,
    "level_sigma_per_s": _level_sigma,
    "turn_smoothing_s": _smoothing,
}
"""What a variable of each key does; keys that are missing have no gradient."""

_FOLLOWS = {key: key.replace("p0_", "reset_") for key in CHANGES if key.startswith("p0_")} | {
    "reset_cycle_s": "reset_first_s"
}
"""The keys that a value is also that of, unless they are given: what P is reset to is what it is
at the start, the first reset comes after a cycle."""


class Relaxation:
    """Takes the numbers of runs from a base point to any other, resets spread over windows."""

    def __init__(self, study: Study, space: SearchSpace, combination: TomlTable) -> None:
        """Check that there is a gradient.

        Args:
            study: with [tune].
            space: of the tuning.
            combination: of candidates.

        Raises:
            InputError: ``[tune.variables] key: what is wrong (hint)``.
        """
        self._variables = {i: space.variables[i] for i in space.used(combination)}
        self.point = space.point(space.values([0.5] * len(space.variables)), combination)
        based = with_point(study, self.point)
        for variable in self._variables.values():
            if variable.key not in (TIMES, *CHANGES):
                _refuse(study, f"[tune.variables] {variable.key}")
        kinds = based.values("reset_kind") if based.resets else []
        if "scale" in kinds:
            _refuse(study, "[resets] reset_kind = 'scale'")
        if based.has_trigger:
            _refuse(study, "[resets] reset_trigger")
        self._follows = {
            key: twin
            for key, twin in _FOLLOWS.items()
            if not based.resets or based.values(twin)[0] is None
        }
        self._rate_hz = study.rate_hz
        ranges = space.ranges.get(TIMES, ())
        assert isinstance(ranges, tuple)
        count = combination.get(COUNT, len(ranges))
        self._fixed = [kind.fixed for kind in ranges[:count]]

    def __call__(self, params: Any, box: Array, width: Scalar) -> Any:
        """The method's numbers of one run at a point.

        Args:
            params: of the method, at the base point.
            box: (p,) places of the variables that are used, from 0 to 1.
            width: half width of the windows, samples.
        """
        times: list[Any] = list(self._fixed)
        for place, variable in zip(box, self._variables.values(), strict=True):
            value, base = variable.value(place), variable.value(0.5)
            if variable.key == TIMES:
                times[variable.entry or 0] = value
                continue
            params = CHANGES[variable.key](params, variable, value, base)
            if twin := self._follows.get(variable.key):
                params = CHANGES[twin](params, variable, value, base)
        if not isinstance(params, zero_velocity.FilterParams):
            return params
        resets = params.resets
        # An infinity has no slope.
        samples = jnp.where(jnp.isfinite(resets.samples), resets.samples, _NEVER)
        if times:
            samples = jnp.stack([jnp.asarray(time) for time in times]) * self._rate_hz
        return params._replace(resets=Windows(samples, width, resets.covariance_reset))


def _refuse(study: Study, what: str) -> NoReturn:
    text = "has no gradient (use 'sobol' instead of 'gradient')"
    raise InputError(f"{study.name}: {what}: {text}")
