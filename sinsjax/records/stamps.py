"""Sample rate and sample numbers from time stamps.

A stamp may be a few milliseconds late as long as the following ones are back in step with the
sample count. Where the stamps stay behind, samples are missing.
"""

from collections.abc import Callable
from datetime import UTC, datetime
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.records.layout import FloatArray, Layout, agreed_rate

_LATE_S = 0.02  # the latest that a busy logger stamps a sample
_CATCHES_UP_S = 0.1  # the longest it takes to catch up
_MOST_MISSING = 10  # times the samples present; a larger gap means that the clock was set


class Sampling(NamedTuple):
    """Sampling times of a file.

    Attributes:
        rate_hz: sample rate, Hz.
        t0_s: start of the first sample, s.
        number: (T,) number of each sample, from 0; it jumps where samples are missing.
    """

    rate_hz: float
    t0_s: float
    number: NDArray[np.int64]


def from_iso(text: str) -> float:
    """Seconds since 1970 of an ISO date and time, in UTC unless it has a zone, or ValueError."""
    try:
        moment = datetime.fromisoformat(text.strip())
    except ValueError:
        raise ValueError(f"{text.strip()[:32]!r} is not an ISO 8601 date and time") from None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def sampling(
    source: str, layout: Layout, time_s: FloatArray, row: Callable[[int], int]
) -> Sampling:
    """Sample rate and sample numbers from the stamps at the ends of the samples.

    Args:
        source: the file, for messages.
        layout: its time_column is named in messages; its rate_hz takes precedence if given.
        time_s: (T,) finite stamps, T > 0.
        row: the row to name in a message about sample k.

    Raises:
        InputError: the stamps do not increase, or imply another rate; the message names the row.
    """
    where = f"{source}: column {layout.time_column!r}"
    step_s = np.diff(time_s)
    if len(step_s) == 0:
        if layout.rate_hz is None:
            raise InputError(f"{source}: rate_hz: required with only one sample")
        return Sampling(layout.rate_hz, float(time_s[0]) - 1 / layout.rate_hz, np.zeros(1, int))
    # The mean averages out the rounding of the stamps; steps near the median exclude gaps.
    median = np.quantile(step_s, 0.5, method="lower")
    clean = step_s[(step_s >= 0.5 * median) & (step_s <= 1.5 * median) & (step_s > 0)]

    def refuse(k: int, what: str) -> NoReturn:
        raise InputError(f"{where}: row {row(k + 1)}: {what}, {between(time_s, k)}")

    if not clean.size:
        k = int((step_s <= 0).argmax())
        refuse(k, "time repeats" if step_s[k] == 0 else "time runs backward")
    rate = agreed_rate(_meant(float(1 / clean.mean()), time_s), layout, 1 / len(clean), where)
    steps = np.ones(len(step_s), int)
    in_time = 0  # the first stamp not yet examined
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


def _meant(rate_hz: float, time_s: FloatArray) -> float:
    """A whole rate where the stamps cannot tell it from that: those since 1970 are to 0.2 us."""
    rounding_s = float(np.spacing(np.abs(time_s).max()))
    off = 2 * rounding_s / float(np.ptp(time_s))
    return float(round(rate_hz)) if abs(round(rate_hz) - rate_hz) <= off * rate_hz else rate_hz


def between(time_s: FloatArray, k: int) -> str:
    """The times of a stamp and the next, for messages."""
    return f"from {float(time_s[k])!r} to {float(time_s[k + 1])!r} s"


def _in_time_again(time_s: FloatArray, k: int, rate: float) -> int:
    """The first stamp back in step after the late ones following stamp k; 0 for a real gap."""
    most = max(2, round(_CATCHES_UP_S * rate))
    after = time_s[k + 1 : k + 1 + most]
    late = (after - time_s[k]) * rate - np.arange(1, len(after) + 1)
    back = np.flatnonzero(np.abs(late) <= 0.5)
    if not back.size:
        return 0
    late = late[: back[0] + 1]
    if late.max() > _LATE_S * rate or late.min() < -0.5:  # no logger stamps early
        return 0
    return k + 1 + int(back[0])
