"""The filters with sine and cosine of the azimuth as studies know them.

Section [surge] of `kalman_surge`, numbers, result columns and descriptions. Free of JAX.
"""

from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field

from sinsjax.columns import Column
from sinsjax.methods.description import CheckedStudy, Implementation, OwnColumn
from sinsjax.methods.filters.config import BIAS_KEYS, FILTER_COLUMNS, describe_filter
from sinsjax.methods.filters.section import FilterSection, ResetsSection, check_resets
from sinsjax.methods.parameters import Columns
from sinsjax.methods.triggers.config import check_trigger, has_trigger
from sinsjax.units import DEG_PER_H
from sinsjax.value_types import Seconds, Section, SpeedSigma


class SurgeSection(Section):
    """[surge]: assumed surge of the base."""

    r_surge_m_per_s: SpeedSigma = Field(0.1, description="rms velocity along east and north, m/s")
    r_surge_time_s: Seconds = Field(5.0, description="correlation time of the velocity, s")


def check_no_trigger(study: CheckedStudy) -> None:
    """Refuse triggers, which assume that the first two states are measured."""
    if not study.has("resets"):
        return
    for point in study.combinations("method", "reset_trigger"):
        if point["method"] == "kalman_surge" and has_trigger(point["reset_trigger"]):
            text = "does not apply to method kalman_surge (use reset_times_s or reset_count)"
            study.refuse("reset_trigger", text)


def surge_parameters(columns: Columns, site: Any, ug: float) -> Any:
    """Return the params of the filter with states of the surge, leaves (variants,)."""
    from sinsjax.methods.filters.parameters import parameters
    from sinsjax.methods.sincos.method import STATES, SurgeParams

    params = parameters(STATES, columns, site, ug, models_surge=True)
    variance = columns.column("r_surge_m_per_s") ** 2
    time = columns.column("r_surge_time_s")
    p0 = (*(variance * time**2,) * 2, *(variance,) * 2)
    q = 2 * variance / time / columns.rate_hz
    return params._replace(
        p0=(*params.p0, *p0),
        q=(*params.q, *(0.0 * q,) * 2, *(q,) * 2),
        reset_to=(*params.reset_to, *p0),
        extra=SurgeParams(1 / time),
    )


def _load() -> Implementation:
    from sinsjax.methods.filters.parameters import filter_relaxation, parameters
    from sinsjax.methods.sincos.method import STATES, build

    return Implementation(build, partial(parameters, STATES), relaxation=filter_relaxation(STATES))


def _load_surge() -> Implementation:
    from sinsjax.methods.filters.parameters import filter_relaxation
    from sinsjax.methods.sincos.method import STATES, build_surge

    return Implementation(build_surge, surge_parameters, relaxation=filter_relaxation(STATES))


def _north_drift(results: Any, rate_hz: float) -> NDArray:
    return np.asarray(results.extra.value) / DEG_PER_H


def _north_drift_sigma(results: Any, rate_hz: float) -> NDArray:
    return np.asarray(results.extra.sigma) / DEG_PER_H


NORTH_DRIFT = (
    OwnColumn(
        Column(
            "gyro_north_drift_deg_per_h",
            pa.float64(),
            "deg/h",
            "north gyro drift by the estimated sine and cosine of the azimuth",
        ),
        _north_drift,
    ),
    OwnColumn(
        Column(
            "gyro_north_drift_sigma_deg_per_h", pa.float64(), "deg/h", "the filter's sigma of it"
        ),
        _north_drift_sigma,
    ),
)

SINCOS = describe_filter(
    name="kalman_sincos",
    summary="Kalman filter with sine and cosine of the azimuth, linear from any heading",
    source="Dmitriyev, Stepanov and Shepel (1997), Rogers (1997)",
    load=_load,
    without_effect=(*BIAS_KEYS, "p0_yaw_deg", "reset_yaw_deg"),
    columns=(*FILTER_COLUMNS, *NORTH_DRIFT),
    step_s=15e-9,
)

SURGE = describe_filter(
    name="kalman_surge",
    summary="the same with states for the velocity of a base that surges",
    source="`methods.sincos.method`",
    sections={"filter": FilterSection, "resets": ResetsSection, "surge": SurgeSection},
    load=_load_surge,
    without_effect=(*BIAS_KEYS, "p0_yaw_deg", "reset_yaw_deg"),
    rules=(check_no_trigger, check_trigger, check_resets),
    columns=(*FILTER_COLUMNS, *NORTH_DRIFT),
    turning="many",
    step_s=25e-9,
)
