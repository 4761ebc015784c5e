"""Rows of several sensors in one file, by a column that labels them or by their order.

From one row to the next, a base moves smoothly; a mean that jumps with a label, again and again by
the same vector, is that of another sensor. A status that the measurements ignore does not jump.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax.messages import shorten
from sinsjax.records.layout import FloatArray
from sinsjax.records.tables import MAX_LABELS

_SENSOR_NUMBER = re.compile(r"i|instance|(imu|sensor|device)_?(id|no|number)?", re.IGNORECASE)
_MIN_CHANGES = 8
_MIN_SIGMA = 10.0  # neighbouring changes share rows, which nearly doubles the true uncertainty
_MIN_JUMP = {"specific force": 1e-3, "rate": 0.1}
"""Jumps that matter, relative to the mean: 3 arc minutes of level, 0.1 rad of heading."""


def find_several_sensors(
    labels: Mapping[str, tuple[FloatArray, Sequence[str]]], gyro: FloatArray, accel: FloatArray
) -> str:
    """Return how the rows of a file are those of several sensors; "" if they are not.

    Args:
        labels: by column, the number (T,) of the text in each row, and the texts by number.
        gyro: (T, 3) samples of the gyros, in any unit.
        accel: (T, 3) samples of the accelerometers, in any unit.
    """
    for name, (numbers, texts) in labels.items():
        named = [text for text in texts if text]
        if not 1 < len(texts) <= MAX_LABELS:
            continue
        place = f"column {name!r} is {shorten(', '.join(named), 40)}"
        if _SENSOR_NUMBER.fullmatch(name) and len(named) > 1:
            return f"{place}: rows of several sensors (keep those of one)"
        if quantity := _find_jumping_mean(numbers, gyro, accel):
            return (
                f"{place}, and the mean {quantity} jumps with it: rows of several sensors (keep"
                " those of one)"
            )
    for count in (2, 3, 4):
        in_turn = np.arange(len(gyro), dtype=np.float64) % count
        if quantity := _find_jumping_mean(in_turn, gyro, accel):
            return (
                f"the mean {quantity} jumps from each row to the next and is back after {count}:"
                f" rows of {count} sensors in turn (keep those of one)"
            )
    return ""


def _find_jumping_mean(labels: FloatArray, gyro: FloatArray, accel: FloatArray) -> str:
    """Return the quantity whose mean jumps with the label (T,) of the rows; "" for none."""
    complete = np.isfinite(np.column_stack([gyro, accel])).all(axis=1)
    labels = labels[complete]
    changes = np.flatnonzero(np.diff(labels[1:-1])) + 2
    if len(changes) < _MIN_CHANGES:
        return ""
    before, after = labels[changes - 1], labels[changes]
    pairs = np.minimum(before, after) * MAX_LABELS + np.maximum(before, after)
    for quantity, samples in (("specific force", accel), ("rate", gyro)):
        values = samples[complete]
        # The steps around a change, which a motion continues, are subtracted from its own.
        jumps = 1.5 * (values[changes] - values[changes - 1])
        jumps -= 0.5 * (values[changes + 1] - values[changes - 2])
        jumps *= np.sign(after - before)[:, None]
        limit = _MIN_JUMP[quantity] * float(np.linalg.norm(values.mean(axis=0)))
        if any(_jumps_beyond(jumps[pairs == pair], limit) for pair in np.unique(pairs)):
            return quantity
    return ""


def _jumps_beyond(jumps: FloatArray, limit: float) -> bool:
    """Return whether the mean of jumps (n, 3) is significant, and larger than a limit."""
    if len(jumps) < _MIN_CHANGES:
        return False
    mean = jumps.mean(axis=0)
    sigma = jumps.std(axis=0) / np.sqrt(len(jumps))
    significant: NDArray[Any] = np.where(np.abs(mean) > _MIN_SIGMA * sigma, mean, 0.0)
    return float(np.linalg.norm(significant)) > limit
