"""What a trigger did in a run, as columns of the results."""

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.columns import Column
from sinsjax.methods.description import OwnColumn
from sinsjax.methods.triggers.section import any_trigger


def _count(results: Any, rate_hz: float) -> NDArray:
    counts = results.trigger_counts
    return np.asarray(0.0 if counts is None else counts.count)


def _first_s(results: Any, rate_hz: float) -> NDArray:
    counts = results.trigger_counts
    return _time_s(0.0 if counts is None else counts.first, rate_hz)


def _last_s(results: Any, rate_hz: float) -> NDArray:
    counts = results.trigger_counts
    return _time_s(0.0 if counts is None else counts.last, rate_hz)


def _time_s(sample: Any, rate_hz: float) -> NDArray:
    """Time of a sample, s; NaN for 0, that of no reset."""
    sample = np.asarray(sample)
    return np.where(sample > 0, sample / rate_hz, np.nan)


TRIGGER_COUNTS = (
    OwnColumn(
        Column("triggered_count", pa.int64(), "", "resets that the trigger called for"),
        _count,
        0.0,
        any_trigger,
    ),
    OwnColumn(
        Column("triggered_first_s", pa.float64(), "s", "time of the first of them; null for none"),
        _first_s,
        where=any_trigger,
    ),
    OwnColumn(
        Column("triggered_last_s", pa.float64(), "s", "time of the last of them; null for none"),
        _last_s,
        where=any_trigger,
    ),
)
"""Columns of what a trigger did."""


def last_called(results: Any) -> NDArray | None:
    """Sample of the last reset that a trigger called for, (runs,); 0 for none. None without one."""
    counts = results.trigger_counts
    return None if counts is None else np.asarray(counts.last)
