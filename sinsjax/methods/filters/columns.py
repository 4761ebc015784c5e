"""Columns of the results that every filter has."""

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.columns import Column
from sinsjax.methods.description import OwnColumn, StudyView


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
