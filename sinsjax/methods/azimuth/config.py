"""The filters with a large azimuth as studies know them: params and descriptions."""

from functools import partial
from typing import Any

import numpy as np

from sinsjax.methods.description import Implementation
from sinsjax.methods.filters.config import describe_filter
from sinsjax.methods.filters.section import FilterSection, ResetsSection
from sinsjax.methods.parameters import Columns
from sinsjax.value_types import Section

SIGMA_POINT_ALPHA = 0.5
"""Spread of the unscented filter's sigma points: alpha sqrt(5) standard deviations."""


def parameters(columns: Columns, site: Any, ug: float) -> Any:
    """Return the params of these filters, leaves (variants,); see `filters.parameters`."""
    from sinsjax.methods.azimuth.method import STATES
    from sinsjax.methods.filters.parameters import parameters as filter_parameters

    params = filter_parameters(STATES, columns, site, ug)
    return params._replace(extra=np.full(columns.count, SIGMA_POINT_ALPHA))


def _load(prediction: str) -> Implementation:
    from sinsjax.methods.azimuth import method
    from sinsjax.methods.filters.parameters import filter_relaxation

    build = partial(method.build, getattr(method, prediction))
    return Implementation(build, parameters, relaxation=filter_relaxation(method.STATES))


_SECTIONS: dict[str, type[Section]] = {"filter": FilterSection, "resets": ResetsSection}

EKF_AZIMUTH = describe_filter(
    name="ekf_azimuth",
    summary="extended Kalman filter, its model nonlinear in the azimuth",
    source="after Yan, Strapdown Inertial Navigation, eq. (4-23)",
    sections=_SECTIONS,
    load=partial(_load, "predict_linearised"),
    step_s=25e-9,
)

UNSCENTED = describe_filter(
    name="unscented",
    summary="the same model with an unscented transform",
    source="Julier (2002); Wan and van der Merwe (2000)",
    sections=_SECTIONS,
    load=partial(_load, "predict_unscented"),
    step_s=60e-9,
)
