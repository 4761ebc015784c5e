"""Time stamps: the rate that they tell, and the sample that each of them belongs to.

A stamp may come a few milliseconds late: what counts is that the next ones are where their number
puts them. Where they stay behind for good, samples are missing.
"""

from collections.abc import Callable
from datetime import UTC, datetime
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.records.layout import FloatArray, Layout, agreed_rate

_LATE_S = 0.02  # as late as a busy logger stamps
_CATCHES_UP_S = 0.1  # and as long as it takes to be in time again
_MOST_MISSING = 10  # times the samples that are there; beyond it a clock was set


class Sampling(NamedTuple):
    """When the samples of a file were taken.

    Attributes:
        rate_hz: samples a second.
        t0_s: when the first sample begins.
        number: (T,) of each sample from the first one on; it leaps where samples are missing.
    """

    rate_hz: float
    t0_s: float
    number: NDArray[np.int64]


def from_iso(text: str) -> float:
    """Seconds from 1970 of a date with time, in UTC if it names no zone; ValueError for others."""
    try:
        moment = datetime.fromisoformat(text.strip())
    except ValueError:
        raise ValueError(f"{text.strip()[:32]!r} is no date and time (ISO 8601)") from None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def sampling(
    source: str, layout: Layout, time_s: FloatArray, row: Callable[[int], int]
) -> Sampling:
    """Rate and numbers of samples from the stamps at their ends.

    Args:
        source: the file, which messages begin with.
        layout: its time_column is named; its rate_hz rules where it is given.
        time_s: (T,) finite stamps, T > 0.
        row: the row to name in a message about sample k.

    Raises:
        InputError: the stamps do not go on, or tell another rate; the line names the row.
    """
    where = f"{source}: column {layout.time_column!r}"
    step_s = np.diff(time_s)
    if len(step_s) == 0:
        if layout.rate_hz is None:
            raise InputError(f"{source}: rate_hz: needed, since there is only one sample")
        return Sampling(layout.rate_hz, float(time_s[0]) - 1 / layout.rate_hz, np.zeros(1, int))
    # The mean undoes rounded time stamps; the median, itself a step, keeps gaps out of it.
    median = np.quantile(step_s, 0.5, method="lower")
    clean = step_s[(step_s >= 0.5 * median) & (step_s <= 1.5 * median) & (step_s > 0)]

    def refuse(k: int, what: str) -> NoReturn:
        raise InputError(f"{where}: row {row(k + 1)}: {what}, {between(time_s, k)}")

    if not clean.size:
        k = int((step_s <= 0).argmax())
        refuse(k, "time repeats" if step_s[k] == 0 else "time runs backward")
    rate = agreed_rate(float(1 / clean.mean()), layout, 1 / len(clean), where)
    steps = np.ones(len(step_s), int)
    in_time = 0  # the first stamp that is yet to be looked at
    for k in np.flatnonzero((step_s < 0.5 / rate) | (step_s > 1.5 / rate)).tolist():
        if k < in_time:
            continue
        in_time = _in_time_again(time_s, k, rate)
        if in_time:
            continue
        if step_s[k] <= 0:
            refuse(k, "time repeats" if step_s[k] == 0 else "time runs backward")
        if step_s[k] < 0.5 / rate:
            refuse(k, f"a short step at {rate:g} Hz")
        if step_s[k] * rate > _MOST_MISSING * len(time_s):
            refuse(k, f"a gap at {rate:g} Hz")
        steps[k] = round(step_s[k] * rate)
    number = np.concatenate([[0], np.cumsum(steps)])
    return Sampling(rate, float(time_s[0]) - 1 / rate, number)


def between(time_s: FloatArray, k: int) -> str:
    """The times of a stamp and the next one, in words."""
    return f"from {float(time_s[k])!r} to {float(time_s[k + 1])!r} s"


def _in_time_again(time_s: FloatArray, k: int, rate: float) -> int:
    """The first stamp after the late ones that follow stamp k; 0 where samples are missing."""
    most = max(2, round(_CATCHES_UP_S * rate))
    after = time_s[k + 1 : k + 1 + most]
    late = (after - time_s[k]) * rate - np.arange(1, len(after) + 1)
    back = np.flatnonzero(np.abs(late) <= 0.5)
    if not back.size:
        return 0
    late = late[: back[0] + 1]
    if late.max() > _LATE_S * rate or late.min() < -0.5:  # no clock stamps early
        return 0
    return k + 1 + int(back[0])
