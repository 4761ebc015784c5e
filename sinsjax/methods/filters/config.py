"""Descriptions of filters that measure zero velocity: common keys, columns and rules.

Free of JAX. The keys themselves are in `section`, the numbers made of them in `parameters`.
"""

from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.columns import Column
from sinsjax.methods.description import INITIAL_KEYS, Description, OwnColumn, StudyView
from sinsjax.methods.filters.section import (
    FilterSection,
    ResetsSection,
    check_resets,
)
from sinsjax.methods.triggers.config import TRIGGER_COUNTS, check_trigger, last_triggered_sample

FILTER_KEYS = (
    *INITIAL_KEYS,
    *("feedback_interval_s", "feedback_time_constant_s"),
    *("turn_covariance", "turn_inflation"),
)
"""The keys of [alignment] and [passes] that act on every filter."""

BIAS_KEYS = (
    *("p0_gyro_bias_deg_per_h", "p0_accel_bias_ug"),
    *("reset_gyro_bias_deg_per_h", "reset_accel_bias_ug"),
)
"""The keys of sensor bias states: without effect on a filter that has none."""


def _mean_nis(results: Any, rate_hz: float) -> NDArray:
    return np.asarray(results.innovations.sum) / np.asarray(results.innovations.count)


def _degrees_of_freedom(results: Any, rate_hz: float) -> NDArray:
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
        applies_to=_is_recorded,
    ),
    OwnColumn(
        Column(
            "innovation_freedom", pa.float64(), "", "degrees of freedom of their sum: 2 an update"
        ),
        _degrees_of_freedom,
        applies_to=_is_recorded,
    ),
)
"""Columns of a filter's innovations in a recorded study; 2 is expected of a consistent filter."""

FILTER_COLUMNS = (*TRIGGER_COUNTS, *INNOVATIONS)

describe_filter = partial(
    Description,
    sections={"filter": FilterSection, "resets": ResetsSection},
    reads=FILTER_KEYS,
    without_effect=BIAS_KEYS,
    turning="none",
    rules=(check_trigger, check_resets),
    columns=FILTER_COLUMNS,
    last_triggered_sample=last_triggered_sample,
)
"""Return the `Description` of a filter without sensor bias states; the arguments add the rest."""


def estimates_biases(method: Description) -> bool:
    """Return whether a filter has states of sensor biases."""
    return not {*BIAS_KEYS} <= {*method.without_effect}
