"""How the loops' numbers follow the keys of a study, to be differentiated by them."""

from typing import Any

import jax.numpy as jnp

from sinsjax.methods.base import Change, Relaxed
from sinsjax.methods.compass import design
from sinsjax.methods.compass.method import LoopParams
from sinsjax.types import Scalar


def _pace(params: LoopParams, entry: int | None, value: Scalar, base: Scalar) -> Any:
    values = params.pace.values.at[entry].multiply(value / base)
    return params._replace(pace=params.pace._replace(values=values))


def _azimuth_sigma(params: LoopParams, _: int | None, value: Scalar, base: Scalar) -> Any:
    return params._replace(azimuth=design.at_pace(params.azimuth, value / base))


def _level_sigma(params: LoopParams, _: int | None, value: Scalar, base: Scalar) -> Any:
    return params._replace(level=design.level_at_pace(params.level, value / base))


def _smoothing(params: LoopParams, _: int | None, value: Scalar, base: Scalar) -> Any:
    share = -jnp.expm1(jnp.log1p(-params.smoothing) * base / value)
    return params._replace(smoothing=share)


_CHANGES: dict[str, Change] = {
    "sigma_factors": _pace,
    "azimuth_sigma_per_s": _azimuth_sigma,
    "level_sigma_per_s": _level_sigma,
    "turn_smoothing_s": _smoothing,
}

RELAXED = Relaxed(_CHANGES)
