"""Sample rate and sample numbers from time stamps.

A stamp may be a few milliseconds late if the following ones are again in step with the sample
count. If the stamps remain late, samples are missing. Stamps that all scatter, early and late, are
numbered by the means of many, see `fit_stamp_line`.
"""

import math
import re
from collections.abc import Callable
from datetime import UTC, date, datetime, time
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.records.files import is_number
from sinsjax.records.layout import FloatArray, RecordLayout, find_spans, message_key, resolve_rate

_DAY_FIRST = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})[ T]+(\d{1,2})(?=:)")
_MAX_LATE_S = 0.02  # largest delay of a busy logger
_MAX_CATCH_UP_S = 0.1  # longest time to catch up
_AVERAGED_STAMPS = 32  # stamps averaged on each side, to distinguish a missing sample from scatter
_MAX_SCATTER = 0.3  # samples, of the median: above that of uniform scatter by half a sample, 0.25
_MAX_OUTLIER = 9.0  # times the median: 6 sigma of normal scatter
_MAX_CLOCK_JUMP = 1e12  # samples by which a clock may be set, for exact means
_MAX_ROUNDS = 8  # only one of several close gaps is found at a time
_MAX_MISSING_FACTOR = 10  # times the samples present; a larger gap is a set clock


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


def parse_iso(text: str) -> float:
    """Return the seconds since 1970 of an ISO date and time, in UTC unless it has a zone.

    Those since midnight of a time of day, such as 12:00:00.040. Dots in a date separate day, month
    and year, as in 11.03.2026 09:35:12,000.
    """
    text = text.strip()
    if day_first := _DAY_FIRST.match(text):
        day, month, year, hour = day_first.groups()
        text = f"{year}-{month:0>2}-{day:0>2} {hour:0>2}{text[day_first.end() :]}"
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        try:
            clock = time.fromisoformat(text if ":" in text else "")
        except ValueError:
            raise ValueError(f"{text[:32]!r} is not an ISO 8601 date and time") from None
        moment = datetime.combine(date(1970, 1, 1), clock)
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def is_date(cell: str) -> bool:
    """Return whether a cell is a date with time or a time of day, and not a number."""
    try:
        parse_iso(cell)
    except ValueError:
        return False
    return not is_number(cell)


def unwrap_midnight(time_s: FloatArray) -> FloatArray:
    """Return times of day (T,) that increase beyond midnight; dates are left as they are."""
    day_s = 86400.0
    if np.nanmax(time_s) >= day_s or np.nanmin(time_s) < 0:
        return time_s
    wraps = np.diff(np.nan_to_num(time_s), prepend=time_s[:1]) < -day_s / 2
    return np.asarray(time_s + day_s * np.cumsum(wraps))


def find_sampling(
    source: str, layout: RecordLayout, time_s: FloatArray, row_number: Callable[[int], int]
) -> Sampling:
    """Return the sample rate and sample numbers from the stamps at the ends of the samples.

    Args:
        source: the file, for messages.
        layout: its time_column is named in messages; its rate_hz takes precedence if given.
        time_s: (T,) finite stamps, T > 0.
        row_number: function of sample k that returns its row, for messages.

    Raises:
        InputError: the stamps do not increase, or imply another rate; the message names the row.
    """
    place = f"{source}: column {layout.time_column!r}"
    if len(time_s) == 1:
        if layout.rate_hz is None:
            raise InputError(f"{source}: rate_hz: required with only one sample")
        return Sampling(layout.rate_hz, float(time_s[0]) - 1 / layout.rate_hz, np.zeros(1, int))
    try:
        return _sampling_from_steps(place, layout, time_s, row_number)
    except InputError:
        line = fit_stamp_line(time_s)
        if line is None:
            if (set_back := _find_clock_setback(time_s)) is not None:  # which also spoils the rate
                _raise_step_error(place, layout, time_s, set_back, row_number)
            raise
    stamp_hz = _round_rate(line.rate_hz, time_s, line.rate_uncertainty)
    rate = resolve_rate(stamp_hz, layout, line.rate_uncertainty, place)
    steps = np.diff(line.number)
    for k in np.flatnonzero((steps < 1) | (steps > _MAX_MISSING_FACTOR * len(time_s))).tolist():
        _raise_step_error(place, layout, time_s, k, row_number, rate)
    # The first stamp scatters like any other: the mean of all does not.
    t0_s = float(time_s.mean()) - (float(line.number.mean()) + 1) / rate
    return Sampling(rate, t0_s, line.number)


def _find_clock_setback(time_s: FloatArray) -> int | None:
    """Return the first stamp after which time runs backward by more than scatter, or None."""
    step_s = np.diff(time_s)
    median_s = float(np.median(step_s))
    typical_s = float(np.median(np.abs(step_s - median_s)))
    backward_steps = np.flatnonzero(step_s < -_MAX_OUTLIER * typical_s)
    return int(backward_steps[0]) if backward_steps.size and median_s > 0 else None


def _sampling_from_steps(
    place: str, layout: RecordLayout, time_s: FloatArray, row_number: Callable[[int], int]
) -> Sampling:
    """Return the sampling of two or more stamps that are on time, except for a few late ones."""
    step_s = np.diff(time_s)
    # The mean averages out the rounding of the stamps; steps near the median exclude gaps.
    median = np.quantile(step_s, 0.5, method="lower")
    clean = step_s[(step_s >= 0.5 * median) & (step_s <= 1.5 * median) & (step_s > 0)]
    if not clean.size:
        _raise_step_error(place, layout, time_s, int((step_s <= 0).argmax()), row_number)
    rate = resolve_rate(_round_rate(float(1 / clean.mean()), time_s), layout, 1 / len(clean), place)
    steps = np.ones(len(step_s), int)
    in_time = 0  # the first stamp not yet examined
    for k in np.flatnonzero((step_s < 0.5 / rate) | (step_s > 1.5 / rate)).tolist():
        if k < in_time:
            continue
        in_time = _find_first_stamp_on_time(time_s, k, rate)
        if in_time:
            continue
        if step_s[k] < 0.5 / rate or step_s[k] * rate > _MAX_MISSING_FACTOR * len(time_s):
            _raise_step_error(place, layout, time_s, k, row_number, rate)
        steps[k] = round(step_s[k] * rate)
    number = np.concatenate([[0], np.cumsum(steps)])
    return Sampling(rate, float(time_s[0]) - 1 / rate, number)


def _raise_step_error(
    place: str,
    layout: RecordLayout,
    time_s: FloatArray,
    k: int,
    row_number: Callable[[int], int],
    rate: float = 0.0,
) -> NoReturn:
    """Raise the error of the step after stamp k; without a rate it does not increase."""
    step_s = float(time_s[k + 1] - time_s[k])
    hint = f" (drop {message_key(layout, 'time_column')} and give rate_hz if the stamps are bad)"
    if step_s < 0:
        problem, hint = "time runs backward", ""
    elif step_s == 0:
        problem = "time repeats"
    elif step_s * rate > _MAX_MISSING_FACTOR:
        problem, hint = f"a gap at {rate:g} Hz", ""
    else:
        problem = f"a short step at {rate:g} Hz"
    text = f"{place}: row {row_number(k + 1)}: {problem}, {format_step(time_s, k)}{hint}"
    raise InputError(text)


def _round_rate(rate_hz: float, time_s: FloatArray, uncertainty: float = 0.0) -> float:
    """Return a whole rate, or one of four digits, within the resolution of the stamps.

    The resolution is 0.2 us for seconds since 1970.
    """
    rounding_s = float(np.spacing(np.abs(time_s).max()))
    tolerance_hz = rate_hz * (2 * rounding_s / float(np.ptp(time_s)) + uncertainty)
    for rounded in (float(round(rate_hz)), float(f"{rate_hz:.4g}")):
        if abs(rounded - rate_hz) <= tolerance_hz:
            return rounded
    return rate_hz


def format_step(time_s: FloatArray, k: int) -> str:
    """Return the times of a stamp and the next one, for messages."""
    return f"from {float(time_s[k])!r} to {float(time_s[k + 1])!r} s"


def _find_first_stamp_on_time(time_s: FloatArray, k: int, rate: float) -> int:
    """Return the first stamp on time after the late ones following stamp k; 0 for a gap."""
    max_stamps = max(2, round(_MAX_CATCH_UP_S * rate))
    following = time_s[k + 1 : k + 1 + max_stamps]
    late = (following - time_s[k]) * rate - np.arange(1, len(following) + 1)
    on_time = np.flatnonzero(np.abs(late) <= 0.5)
    if not on_time.size:
        return 0
    late = late[: on_time[0] + 1]
    if late.max() > _MAX_LATE_S * rate or late.min() < -0.5:  # no logger stamps early
        return 0
    return k + 1 + int(on_time[0])


class StampLine(NamedTuple):
    """Straight line about which stamps scatter, apart from missing samples.

    Attributes:
        rate_hz: sample rate by least squares, Hz.
        rate_uncertainty: relative uncertainty of the rate, 3 sigma.
        number: (T,) number of each sample, from 0; it does not increase if a clock was set back.
    """

    rate_hz: float
    rate_uncertainty: float
    number: NDArray[np.int64]


def fit_stamp_line(time_s: FloatArray) -> StampLine | None:
    """Return the line about which stamps scatter; None if they do not.

    Half of the stamps are within 0.3 samples of it, and none deviates more than such scatter does.
    A missing or repeated sample, or a set clock, moves the mean of all following stamps.

    Args:
        time_s: (T,) stamps.
    """
    count = len(time_s)
    if count < 2 * _AVERAGED_STAMPS:
        return None
    reach = min(4 * _AVERAGED_STAMPS, count // 2)
    step_s = float(np.median(time_s[reach:] - time_s[:-reach])) / reach
    if step_s <= 0:
        return None
    number = np.arange(count)
    ahead = (time_s - time_s[0]) / step_s - number  # samples
    typical = float(np.median(np.abs(np.diff(ahead)))) / math.sqrt(2)
    if not 0 < typical <= _MAX_SCATTER or np.abs(ahead).max() > _MAX_CLOCK_JUMP:
        return None
    for _ in range(_MAX_ROUNDS):
        jumps = _find_sample_jumps(ahead, typical)
        if not jumps.any():
            break
        ahead = ahead - np.cumsum(jumps)
        number = number + np.cumsum(jumps)
    else:
        return None
    deviation = np.abs(ahead - _moving_mean(ahead))
    if np.median(deviation) > _MAX_SCATTER or deviation.max() > _MAX_OUTLIER * np.median(deviation):
        return None
    centred = number - number.mean()
    sum_of_squares = float(centred @ centred)
    slope_s = float(centred @ (time_s - time_s.mean())) / sum_of_squares
    rate_uncertainty = 3 * float(np.sqrt(np.mean(deviation**2))) / math.sqrt(sum_of_squares)
    return StampLine(1 / slope_s, rate_uncertainty, number)


def _moving_mean(values: FloatArray) -> FloatArray:
    """Return the means over the neighbours of each value on both sides, (T,)."""
    sums, k = np.concatenate([[0.0], np.cumsum(values)]), np.arange(len(values))
    first, last = (
        np.maximum(k - _AVERAGED_STAMPS, 0),
        np.minimum(k + _AVERAGED_STAMPS + 1, len(values)),
    )
    return np.asarray((sums[last] - sums[first]) / (last - first))


def _find_sample_jumps(offset_samples: FloatArray, scatter: float) -> NDArray[np.int64]:
    """Return the whole samples by which the mean changes before each stamp, (T,)."""
    count = len(offset_samples)
    sums, k = np.concatenate([[0.0], np.cumsum(offset_samples)]), np.arange(1, count)
    first, last = np.maximum(k - _AVERAGED_STAMPS, 0), np.minimum(k + _AVERAGED_STAMPS, count)
    differences = (sums[last] - sums[k]) / (last - k) - (sums[k] - sums[first]) / (k - first)
    # Near the ends the means are over few stamps.
    noise = 1.5 * scatter * np.sqrt(1 / (last - k) + 1 / (k - first))
    flagged = np.abs(differences) > np.maximum(0.5, 5 * noise)
    jumps = np.zeros(count, np.int64)
    for begin, end in find_spans(flagged):
        largest = begin + int(np.abs(differences[begin:end]).argmax())
        jumps[largest + 1] = round(float(differences[largest]))
    return jumps
