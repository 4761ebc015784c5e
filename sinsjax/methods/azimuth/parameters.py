"""[azimuth] as numbers, beside those of every filter."""

from typing import Any

import numpy as np

from sinsjax.methods.azimuth.method import AzimuthParams
from sinsjax.methods.azimuth.model import STATES
from sinsjax.methods.filters import parameters as filters
from sinsjax.methods.parameters import Columns

SIGMA_POINT_ALPHA = 0.5
"""Spread of the unscented filter's sigma points: alpha sqrt(5) standard deviations."""


def parameters(columns: Columns, site: Any, ug: float) -> Any:
    """Numbers of a filter with a large azimuth, leaves (variants,); see `filters.parameters`."""
    by_angles = columns.each(lambda form: float(form == "angles"), "azimuth_feedback")
    alpha = np.full(columns.count, SIGMA_POINT_ALPHA)
    of_filter = filters.parameters(STATES, columns, site, ug)
    return of_filter._replace(own=AzimuthParams(by_angles, alpha))
