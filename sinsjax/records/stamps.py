"""Sample rate and sample numbers from time stamps at the ends of the samples.

A stamp may be late, as one of a busy logger is, if the following ones are in step with the sample
count again within 0.1 s. If the stamps remain late, samples are missing.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.records.layout import TIME_UNITS, FloatArray, RecordLayout, resolve_rate

_CATCH_UP_S = 0.1  # longest time for which stamps are late
_AVERAGED_STEPS = 8  # of which some may be late
_MAX_MISSING_FACTOR = 10  # times the samples present; a larger gap is a set clock


class Sampling(NamedTuple):
    """Sampling times of a file."""

    rate_hz: float
    t0_s: float  # start of the first sample
    number: NDArray[np.int64]  # (T,) of each sample, from 0; it jumps where samples are missing
    remark: str = ""  # how many stamps are late


def combine_times(times: Sequence[FloatArray], layout: RecordLayout) -> FloatArray:
    """Return stamps (T,) in s from the time columns of a layout."""
    time_s = times[0] * (TIME_UNITS[layout.time_unit] * layout.time_scale)
    if len(times) > 1:
        time_s += times[1] * TIME_UNITS[layout.time_fraction_unit]
    return time_s


def find_sampling(
    source: str, layout: RecordLayout, time_s: FloatArray, row_number: Callable[[int], int]
) -> Sampling:
    """Return the sampling from the stamps at the ends of the samples, (T,), finite, T > 0.

    The rate of the layout takes precedence if given. Stamps that do not increase or imply another
    rate are refused, with their row.
    """
    place = f"{source}: column {layout.time_column!r}"
    if len(time_s) == 1:
        raise InputError(f"{source}: has only one sample")

    def refuse(k: int, problem: str) -> NoReturn:
        hint = "drop this column and give rate_hz if the stamps are bad"
        row = f"row {row_number(k + 1)}"
        raise InputError(f"{place}: {row}: {problem}, {format_step(time_s, k)} ({hint})")

    step_s = np.diff(time_s)
    if step_s.min() <= 0:
        k = int((step_s <= 0).argmax())
        refuse(k, "time runs backward" if step_s[k] < 0 else "time repeats")
    clean_s = _clean_steps(time_s)  # whose mean averages out the rounding of the stamps
    rate = resolve_rate(
        _round_rate(float(1 / clean_s.mean()), time_s), layout, 1 / len(clean_s), place
    )
    ahead = (time_s - time_s[0]) * rate - np.arange(len(time_s))
    window = max(2, round(min(_CATCH_UP_S * rate, len(time_s))))
    on_time = _min_of_following(ahead, window)
    if len(time_s) > window:  # the last stamps, which none follow, may be as late as others
        latest, last = float((ahead - on_time)[:-window].max()), on_time[-window - 1]
        end = on_time[-window:]
        on_time[-window:] = np.where(end <= last + latest, np.minimum(end, last), end)
    before = -_min_of_following(-on_time[::-1], 2 * window)[::-1]  # an early stamp is no gap
    jumps = on_time[1:] - before[:-1]
    steps = 1 + np.where(jumps > 0, np.rint(jumps), -np.floor(0.1 - jumps)).astype(np.int64)
    if steps.min() < 1:
        k = int((steps < 1).argmax())
        refuse(k + int(step_s[k : k + window].argmin()), f"a short step at {rate:g} Hz")
    if steps.max() > _MAX_MISSING_FACTOR * len(time_s):
        refuse(int(steps.argmax()), f"a gap at {rate:g} Hz")
    number, late, remark = np.concatenate([[0], np.cumsum(steps)]), ahead - on_time, ""
    if count := int((late > 0.5).sum()):
        longest_ms = 1e3 * float(late.max()) / rate
        remark = f"{count} stamps are late by up to {longest_ms:.3g} ms: read as if on time"
    return Sampling(rate, float(time_s[0]) - 1 / rate, number, remark)


def _clean_steps(time_s: FloatArray) -> FloatArray:
    """Return the steps of increasing stamps without gaps; of several steps if these alternate."""
    step_s = np.diff(time_s)
    count = max(1, min(_AVERAGED_STEPS, len(step_s) // 8))
    long_step_s = (time_s[count:] - time_s[:-count]) / count
    typical_s = float(np.quantile(long_step_s, 0.5, method="lower"))
    clean = step_s[(step_s >= 0.5 * typical_s) & (step_s <= 1.5 * typical_s)]
    if 2 * len(clean) < len(step_s):  # stamps alternate, or come in bursts
        clean = long_step_s[np.abs(long_step_s - typical_s) < 0.5 * typical_s]
    return clean


def _round_rate(rate_hz: float, time_s: FloatArray) -> float:
    """Return a whole rate, or one of four digits, if the resolution of the stamps allows it."""
    tolerance_hz = rate_hz * 2 * float(np.spacing(np.abs(time_s).max())) / float(np.ptp(time_s))
    rounded = (float(round(rate_hz)), float(f"{rate_hz:.4g}"))
    return next((hz for hz in rounded if abs(hz - rate_hz) <= tolerance_hz), rate_hz)


def _min_of_following(values: FloatArray, count: int) -> FloatArray:
    """Return the smallest of each value (T,) and those after it, ``count`` in all."""
    padded = np.concatenate([values, np.full(count - 1, np.inf)])
    return np.asarray(sliding_window_view(padded, count).min(axis=1))


def format_step(time_s: FloatArray, k: int) -> str:
    """Return the times of a stamp and the next one, for messages."""
    return f"from {float(time_s[k])!r} to {float(time_s[k + 1])!r} s"
