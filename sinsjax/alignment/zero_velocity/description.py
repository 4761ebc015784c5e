"""The zero-velocity Kalman filters, as studies know them."""

from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.alignment.description import (
    INITIAL_KEYS,
    Description,
    Implementation,
    OwnColumn,
    StudyView,
)
from sinsjax.alignment.triggers.columns import TRIGGER_COUNTS, last_called
from sinsjax.alignment.triggers.section import check_trigger
from sinsjax.alignment.zero_velocity.section import FilterSection, ResetsSection, check_resets
from sinsjax.columns import Column


def _mean_nis(results: Any, rate_hz: float) -> NDArray:
    return np.asarray(results.innovations.sum) / np.asarray(results.innovations.count)


def _freedom(results: Any, rate_hz: float) -> NDArray:
    return 2 * np.asarray(results.innovations.count)


def _is_recorded(study: StudyView) -> bool:
    return study.is_recorded  # a simulation has the truth to be judged by


INNOVATIONS = (
    OwnColumn(
        Column(
            "innovation_nis",
            pa.float64(),
            "",
            "mean r' S^-1 r of the filter's velocity innovations r; null of methods without",
        ),
        _mean_nis,
        where=_is_recorded,
    ),
    OwnColumn(
        Column(
            "innovation_freedom", pa.float64(), "", "degrees of freedom of their sum: 2 an update"
        ),
        _freedom,
        where=_is_recorded,
    ),
)
"""Columns of a filter's innovations, of a recorded study: 2 is expected of a true belief."""


def _load(model: str) -> Implementation:
    from sinsjax.alignment.zero_velocity.method import build
    from sinsjax.alignment.zero_velocity.parameters import parameters
    from sinsjax.alignment.zero_velocity.relaxed import RELAXED
    from sinsjax.strapdown.error_model import MODELS

    return Implementation(partial(build, MODELS[model]), parameters, relaxed=RELAXED)


_filter = partial(
    Description,
    sections={"filter": FilterSection, "resets": ResetsSection},
    reads=(
        *INITIAL_KEYS,
        *("specific_force", "feedback_interval_s", "feedback_time_constant_s"),
        *("turn_covariance", "turn_inflation"),
    ),
    rules=(check_trigger, check_resets),
    columns=(*TRIGGER_COUNTS, *INNOVATIONS),
    last_called=last_called,
    step_s=20e-9,
)

KALMAN5 = _filter(
    name="kalman5",
    summary="Kalman filter of velocity and attitude errors, zero velocity measured",
    source="[P1] eq. (1)",
    load=partial(_load, "kalman5"),
    silent=(
        *("p0_gyro_bias_deg_per_h", "p0_accel_bias_ug"),
        *("reset_gyro_bias_deg_per_h", "reset_accel_bias_ug"),
    ),
)

KALMAN10 = _filter(
    name="kalman10",
    summary="the same with states of gyro and level accelerometer biases",
    source="[P1] eq. (1), biases as states",
    load=partial(_load, "kalman10"),
    gyro_bias_keys=(
        ("p0_gyro_bias_deg_per_h", "p0_yaw_deg"),
        ("reset_gyro_bias_deg_per_h", "reset_yaw_deg"),
    ),
)
