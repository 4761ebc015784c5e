"""The filter with sine and cosine of the azimuth, as studies know it."""

from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.columns import Column
from sinsjax.methods.description import Implementation, OwnColumn
from sinsjax.methods.filters.description import COLUMNS, OF_BIASES, filter_description
from sinsjax.methods.filters.section import FilterSection, ResetsSection, check_resets
from sinsjax.methods.sincos.section import SurgeSection, check_no_trigger
from sinsjax.methods.triggers.section import TriggerKeys, check_trigger
from sinsjax.units import DEG_PER_H


def _load() -> Implementation:
    from sinsjax.methods.filters.parameters import parameters
    from sinsjax.methods.filters.relaxed import relaxed
    from sinsjax.methods.sincos.method import STATES, build

    return Implementation(build, partial(parameters, STATES), relaxed=relaxed(STATES))


def _load_surge() -> Implementation:
    from sinsjax.methods.filters.relaxed import relaxed
    from sinsjax.methods.sincos.method import STATES
    from sinsjax.methods.sincos.parameters import with_surge
    from sinsjax.methods.sincos.surge import build

    return Implementation(build, with_surge, relaxed=relaxed(STATES))


def _drift(results: Any, rate_hz: float) -> NDArray:
    return np.asarray(results.own.value) / DEG_PER_H


def _drift_sigma(results: Any, rate_hz: float) -> NDArray:
    return np.asarray(results.own.sigma) / DEG_PER_H


NORTH_DRIFT = (
    OwnColumn(
        Column(
            "gyro_north_drift_deg_per_h",
            pa.float64(),
            "deg/h",
            "north gyro drift by the estimated sine and cosine of the azimuth",
        ),
        _drift,
    ),
    OwnColumn(
        Column(
            "gyro_north_drift_sigma_deg_per_h", pa.float64(), "deg/h", "the filter's sigma of it"
        ),
        _drift_sigma,
    ),
)

SINCOS = filter_description(
    name="kalman_sincos",
    summary="Kalman filter with sine and cosine of the azimuth, linear from any heading",
    source="Dmitriyev, Stepanov and Shepel (1997), Rogers (1997)",
    load=_load,
    silent=(*OF_BIASES, "p0_yaw_deg", "reset_yaw_deg"),
    columns=(*COLUMNS, *NORTH_DRIFT),
    step_s=15e-9,
    estimate_runs=5.0,
)

SURGE = filter_description(
    name="kalman_surge",
    summary="the same with states for the velocity of a base that surges",
    source="`methods.sincos.surge`",
    sections={"filter": FilterSection, "resets": ResetsSection, "surge": SurgeSection},
    load=_load_surge,
    silent=(*OF_BIASES, "p0_yaw_deg", "reset_yaw_deg"),
    refuses=tuple(TriggerKeys.model_fields),
    rules=(check_no_trigger, check_trigger, check_resets),
    columns=(*COLUMNS, *NORTH_DRIFT),
    has_error_step=False,
    step_s=25e-9,
)
