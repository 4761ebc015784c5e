"""Sample rate and sample numbers from time stamps.

A stamp may be a few milliseconds late as long as the following ones are back in step with the
sample count. Where the stamps stay behind, samples are missing. Stamps that all scatter, early and
late alike, are numbered by the means of many, see `scattered`.
"""

import math
from collections.abc import Callable
from datetime import UTC, datetime
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.records.layout import FloatArray, Layout, agreed_rate, given_as, spans_of

_LATE_S = 0.02  # the latest that a busy logger stamps a sample
_CATCHES_UP_S = 0.1  # the longest it takes to catch up
_AVERAGED = 32  # stamps before and after a place, whose means tell a missing sample from scatter
_SCATTER = 0.3  # samples, of the median: above that of uniform scatter by half a sample, 0.25
_FURTHEST = 9.0  # times the median: 6 sigma of normal scatter
_COUNTED = 1e12  # samples that a clock may be set by, so that means are exact
_ROUNDS = 8  # of gaps that lie near each other one is found at a time
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
    if len(time_s) == 1:
        if layout.rate_hz is None:
            raise InputError(f"{source}: rate_hz: required with only one sample")
        return Sampling(layout.rate_hz, float(time_s[0]) - 1 / layout.rate_hz, np.zeros(1, int))
    try:
        return _in_steps(where, layout, time_s, row)
    except InputError:
        line = scattered(time_s)
        if line is None:
            if (set_back := _set_back(time_s)) is not None:  # it spoils the rate, and rows before
                _refuse(where, layout, time_s, set_back, row)
            raise
    found_hz = _meant(line.rate_hz, time_s, line.unsure)
    rate = agreed_rate(found_hz, layout, line.unsure, where)
    steps = np.diff(line.number)
    for k in np.flatnonzero((steps < 1) | (steps > _MOST_MISSING * len(time_s))).tolist():
        _refuse(where, layout, time_s, k, row, rate)
    # One stamp, the first, is as much off as any: the mean of all is not.
    t0_s = float(time_s.mean()) - (float(line.number.mean()) + 1) / rate
    return Sampling(rate, t0_s, line.number)


def _set_back(time_s: FloatArray) -> int | None:
    """The first stamp after which time runs backward by more than stamps scatter, None without."""
    step_s = np.diff(time_s)
    usual_s = float(np.median(step_s))
    typical_s = float(np.median(np.abs(step_s - usual_s)))
    found = np.flatnonzero(step_s < -_FURTHEST * typical_s)
    return int(found[0]) if found.size and usual_s > 0 else None


def _in_steps(
    where: str, layout: Layout, time_s: FloatArray, row: Callable[[int], int]
) -> Sampling:
    """As `sampling`, of two or more stamps that are in time but for a few late ones."""
    step_s = np.diff(time_s)
    # The mean averages out the rounding of the stamps; steps near the median exclude gaps.
    median = np.quantile(step_s, 0.5, method="lower")
    clean = step_s[(step_s >= 0.5 * median) & (step_s <= 1.5 * median) & (step_s > 0)]
    if not clean.size:
        _refuse(where, layout, time_s, int((step_s <= 0).argmax()), row)
    rate = agreed_rate(_meant(float(1 / clean.mean()), time_s), layout, 1 / len(clean), where)
    steps = np.ones(len(step_s), int)
    in_time = 0  # the first stamp not yet examined
    for k in np.flatnonzero((step_s < 0.5 / rate) | (step_s > 1.5 / rate)).tolist():
        if k < in_time:
            continue
        in_time = _in_time_again(time_s, k, rate)
        if in_time:
            continue
        if step_s[k] < 0.5 / rate or step_s[k] * rate > _MOST_MISSING * len(time_s):
            _refuse(where, layout, time_s, k, row, rate)
        steps[k] = round(step_s[k] * rate)
    number = np.concatenate([[0], np.cumsum(steps)])
    return Sampling(rate, float(time_s[0]) - 1 / rate, number)


def _refuse(
    where: str,
    layout: Layout,
    time_s: FloatArray,
    k: int,
    row: Callable[[int], int],
    rate: float = 0.0,
) -> NoReturn:
    """Raise the error of the step after stamp k; without a rate it does not increase."""
    step_s = float(time_s[k + 1] - time_s[k])
    otherwise = f" (of bad stamps leave {given_as(layout, 'time_column')} out and give rate_hz)"
    if step_s < 0:
        what, otherwise = "time runs backward", ""
    elif step_s == 0:
        what = "time repeats"
    elif step_s * rate > _MOST_MISSING:
        what, otherwise = f"a gap at {rate:g} Hz", ""
    else:
        what = f"a short step at {rate:g} Hz"
    text = f"{where}: row {row(k + 1)}: {what}, {between(time_s, k)}{otherwise}"
    raise InputError(text)


def _meant(rate_hz: float, time_s: FloatArray, unsure: float = 0.0) -> float:
    """A whole rate where the stamps cannot tell it from that: those since 1970 are to 0.2 us."""
    rounding_s = float(np.spacing(np.abs(time_s).max()))
    off = 2 * rounding_s / float(np.ptp(time_s)) + unsure
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


class Line(NamedTuple):
    """Stamps that scatter about a straight line, but for samples that are missing.

    Attributes:
        rate_hz: by least squares, Hz.
        unsure: relative uncertainty of the rate, 3 sigma.
        number: (T,) of each stamp, from 0; it does not increase where a clock was set back.
    """

    rate_hz: float
    unsure: float
    number: NDArray[np.int64]


def scattered(time_s: FloatArray) -> Line | None:
    """The line about which stamps scatter, None where they do not.

    Half of the stamps are within 0.3 samples of it, and none is further off than such scatter is.
    A missing sample, a repeated one or a clock that was set moves the mean of all that follow.

    Args:
        time_s: (T,) stamps.
    """
    count = len(time_s)
    if count < 2 * _AVERAGED:
        return None
    reach = min(4 * _AVERAGED, count // 2)
    step_s = float(np.median(time_s[reach:] - time_s[:-reach])) / reach
    if step_s <= 0:
        return None
    number = np.arange(count)
    ahead = (time_s - time_s[0]) / step_s - number  # samples
    typical = float(np.median(np.abs(np.diff(ahead)))) / math.sqrt(2)
    if not 0 < typical <= _SCATTER or np.abs(ahead).max() > _COUNTED:
        return None
    for _ in range(_ROUNDS):
        jumps = _jumps(ahead, typical)
        if not jumps.any():
            break
        ahead = ahead - np.cumsum(jumps)
        number = number + np.cumsum(jumps)
    else:
        return None
    off = np.abs(ahead - _mean_near(ahead))
    if np.median(off) > _SCATTER or off.max() > _FURTHEST * np.median(off):
        return None
    around = number - number.mean()
    size = float(around @ around)
    slope_s = float(around @ (time_s - time_s.mean())) / size
    unsure = 3 * float(np.sqrt(np.mean(off**2))) / math.sqrt(size)
    return Line(1 / slope_s, unsure, number)


def _mean_near(values: FloatArray) -> FloatArray:
    """(T,) means over the neighbours of each on both sides."""
    sums, k = np.concatenate([[0.0], np.cumsum(values)]), np.arange(len(values))
    first, last = np.maximum(k - _AVERAGED, 0), np.minimum(k + _AVERAGED + 1, len(values))
    return np.asarray((sums[last] - sums[first]) / (last - first))


def _jumps(ahead: FloatArray, typical: float) -> NDArray[np.int64]:
    """(T,) whole samples by which the mean after each stamp's predecessor differs from before."""
    count = len(ahead)
    sums, k = np.concatenate([[0.0], np.cumsum(ahead)]), np.arange(1, count)
    first, last = np.maximum(k - _AVERAGED, 0), np.minimum(k + _AVERAGED, count)
    found = (sums[last] - sums[k]) / (last - k) - (sums[k] - sums[first]) / (k - first)
    # Near the ends the means are of few.
    noise = 1.5 * typical * np.sqrt(1 / (last - k) + 1 / (k - first))
    flagged = np.abs(found) > np.maximum(0.5, 5 * noise)
    jumps = np.zeros(count, np.int64)
    for begin, end in spans_of(flagged):
        most = begin + int(np.abs(found[begin:end]).argmax())
        jumps[most + 1] = round(float(found[most]))
    return jumps
