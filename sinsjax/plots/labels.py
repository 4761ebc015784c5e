"""Plain-English names of a study's keys, for figures."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sinsjax.messages import escape_controls
from sinsjax.units import split_unit

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


def axis_label(column: str) -> str:
    """A key or column as an axis label: ``phi_u0_deg`` becomes ``initial heading error (deg)``."""
    name, unit = name_and_unit(column)
    return f"{name} ({unit})" if unit else name


def format_setting(key: str, value: str) -> str:
    """A key with its value: ``phi_u0_deg`` at 30 becomes ``initial heading error 30 deg``."""
    name, unit = name_and_unit(key)
    return f"{name} {value} {unit}" if unit and value[-1:].isdigit() else f"{name} {value}"


def describe_point(point: Mapping[str, Any]) -> str:
    """A variant in words: ``number of resets 3, q scale 4``; a case by its label alone."""
    return ", ".join(_describe_setting(k, v) for k, v in point.items()) or "all runs"


def _describe_setting(key: str, value: Any) -> str:
    if key == "reset_times_s" and value is not None:
        return describe_schedule(value)
    return format_value(value) if key == "case" else format_setting(key, format_value(value))


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


def format_value(value: Any) -> str:
    """A key's value as a reader wants it: 50 for 50.0, ``none`` for an empty list."""
    if isinstance(value, list | tuple):
        return ", ".join(map(format_value, value)) or "none"
    if isinstance(value, float):
        return f"{value:g}"
    return "-" if value is None else escape_controls(str(value))


def name_and_unit(column: str) -> tuple[str, str]:
    """Plain-English name of a column, and its unit as printed."""
    name, unit = split_unit(column)
    return KEY_NAMES.get(name, name.replace("_", " ")), unit.replace("ug", "µg")
