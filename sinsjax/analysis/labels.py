"""Keys, their values and estimates in words, for figures and reports."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sinsjax.analysis.estimates import Estimate
from sinsjax.messages import escape_controls
from sinsjax.units import split_unit

FEW_DRAWS = "few draws"  # for an end of an interval that they do not bound
KEY_NAMES = {
    "phi_e0": "initial level error about east",
    "phi_n0": "initial level error about north",
    "phi_u0": "initial heading error",
    "yaw_center": "yaw, counter-clockwise",
    "start": "start in the record",
    "reset_count": "number of resets",
    "reset_first": "first reset at",
    "reset_cycle": "time between resets",
    "reset_times": "resets at",
    "q_reading": "Q read as",
    "r_reading": "R read as",
    "p0_yaw": "heading sigma in P0",
    "p0_level": "level sigma in P0",
    "p0_velocity": "velocity sigma in P0",
    "q_accel": "accelerometer noise in Q",
    "q_gyro": "gyro noise in Q",
    "q_scale": "factor on Q",
    "r_velocity": "velocity noise in R",
    "stored": "length of the stored record",
    "accel_bias": "accelerometer bias",
    "accel_noise": "accelerometer noise",
}
"""Names by key without its unit; for other keys underscores are replaced by spaces."""

_MOST_TIMES = 4  # reset times listed in a phrase


def name_and_unit(column: str) -> tuple[str, str]:
    """Plain-English name of a column, and its unit as printed."""
    name, unit = split_unit(column)
    return KEY_NAMES.get(name, name.replace("_", " ")), unit.replace("ug", "µg")


def axis_label(column: str) -> str:
    """A key or column as an axis label: ``phi_u0_deg`` becomes ``initial heading error (deg)``."""
    name, unit = name_and_unit(column)
    return f"{name} ({unit})" if unit else name


def format_value(value: Any) -> str:
    """A key's value as a reader wants it: 50 for 50.0, ``none`` for an empty list."""
    if isinstance(value, list | tuple):
        return ", ".join(map(format_value, value)) or "none"
    if isinstance(value, float):
        return f"{value:g}"
    return "-" if value is None else escape_controls(str(value))


def value_with_unit(key: str, value: Any) -> str:
    """A key's value with its unit: ``phi_u0_deg`` at 30 becomes ``30 deg``."""
    text, unit = format_value(value), name_and_unit(key)[1]
    return f"{text} {unit}" if unit and text[-1:].isdigit() else text


def format_setting(key: str, value: Any) -> str:
    """A key with its value: ``phi_u0_deg`` at 30 becomes ``initial heading error 30 deg``."""
    return f"{name_and_unit(key)[0]} {value_with_unit(key, value)}"


def describe_point(point: Mapping[str, Any]) -> str:
    """A variant in words: ``number of resets 3, q scale 4``; a case by its label alone."""
    words = []
    for key, value in point.items():
        if key == "reset_times_s" and value is not None:
            words.append(describe_schedule(value))
        else:
            words.append(format_value(value) if key == "case" else format_setting(key, value))
    return ", ".join(words) or "all runs"


def describe_schedule(times_s: Sequence[float]) -> str:
    """A reset schedule in words: ``3 resets, every 50 s``."""
    if not times_s:
        return "no reset"
    if len(times_s) == 1:
        return f"1 reset at {times_s[0]:g} s"
    steps = np.diff([0.0, *times_s])
    if np.allclose(steps, steps[0]):
        return f"{len(times_s)} resets, every {steps[0]:g} s"
    if len(times_s) <= _MOST_TIMES:
        return f"resets at {', '.join(f'{time:g}' for time in times_s)} s"
    return f"{len(times_s)} resets from {times_s[0]:g} to {times_s[-1]:g} s"


def format_estimate(
    estimate: Estimate,
    unit: str = "",
    digits: int = 1,
    infinite: str = "never",
    negative: str = "-never",
) -> str:
    """An estimate as text, such as ``12.3 [11.9, 12.8] s``.

    Infinite numbers become the words given, a value of NaN ``unknown``, and one end of NaN ``few
    draws``, since too few do not bound it. An interval with neither end known, or of infinite
    numbers alone, is omitted.
    """
    words = {"nan": FEW_DRAWS, "inf": infinite, "-inf": negative}
    printed = (f"{number:.{digits}f}" for number in estimate[:3])
    value, low, high = (words.get(text, text) for text in printed)
    if math.isinf(estimate.value) and value == low == high:
        return value
    interval = "" if low == high == FEW_DRAWS else f"[{low}, {high}] "
    return f"{'unknown' if math.isnan(estimate.value) else value} {interval}{unit}".rstrip()


def format_number(value: float | None, digits: int = 1) -> str:
    """A number as text; None and NaN are unknown."""
    return "unknown" if value is None or value != value else f"{value:.{digits}f}"


def format_time_difference(seconds: Estimate) -> str:
    """A difference of two settling times in whole seconds, or which of the two never settles."""
    value, low, high, n = seconds
    if math.isnan(value):
        return "neither settles" if n else "unknown"
    if math.isinf(value) and {low, high} <= {value, 0.0}:  # an end is 0 if neither settles
        seconds = Estimate(value, value, value, n)
    return format_estimate(seconds, "", 0, "it never settles", "the first never settles")


def format_heading_error(error_arcmin: Estimate) -> str:
    """A heading error without its unit, to a tenth where it is below 100 arcmin."""
    digits = 0 if error_arcmin.value >= 100 else 1
    return format_estimate(error_arcmin, digits=digits, infinite="no number")


def format_percent(share: Estimate) -> str:
    """A share with its interval as a number of percent."""
    low, value, high = (100 * x for x in (share.low, share.value, share.high))
    return format_estimate(Estimate(value, low, high, share.n), digits=0)
