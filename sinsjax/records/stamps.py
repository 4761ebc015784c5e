"""Sample rate and sample numbers from time stamps at the ends of the samples.

A stamp may be late, as one of a busy logger is, if the following ones are in step with the sample
count again within 0.1 s. If the stamps remain late, samples are missing.
"""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from datetime import UTC, date, datetime, time
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.records.layout import (
    TIME_UNITS,
    FloatArray,
    Note,
    RecordLayout,
    message_key,
    resolve_rate,
)

_CATCH_UP_S = 0.1  # longest time for which stamps are late
_AVERAGED_STEPS = 8  # of which some may be late
_MAX_MISSING_FACTOR = 10  # times the samples present; a larger gap is a set clock
_POSSIBLE_HZ = 0.5, 5000.0  # rates of IMUs
_PLACEHOLDER_HZ = 100.0
_MIN_NEW = 0.8  # share of stamps that differ from the one before, among repeated rows
_UNIT = re.compile(r"(?:^|[\s_.\[(])(nano|micro|milli|[nmu])?s(?:ec(?:ond)?s?)?[\])\s]*$")
_UNITS = {"n": "ns", "nano": "ns", "u": "us", "micro": "us", "m": "ms", "milli": "ms", None: "s"}
_TIME_NAME = re.compile(
    r"time|stamp|epoch|clock|(^|[._\s])(t|tow|sow|utc|[mun]?secs?|(milli|micro|nano)?seconds?"
    r"|(milli|micro|nano)sec)($|[\s_\[(])",
    re.IGNORECASE,
)


class Sampling(NamedTuple):
    """Sampling times of a file."""

    rate_hz: float
    t0_s: float  # start of the first sample
    number: NDArray[np.int64]  # (T,) of each sample, from 0; it jumps where samples are missing
    remark: str = ""  # how many stamps are late


def parse_iso(text: str) -> float:
    """Return the seconds since 1970 of an ISO date and time, in UTC unless it has a zone.

    Those since midnight of a time of day, such as 12:00:00.040.
    """
    text = text.strip()
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        try:
            clock = time.fromisoformat(text if ":" in text else "")
        except ValueError:
            raise ValueError(f"{text[:32]!r} is not an ISO 8601 date and time") from None
        moment = datetime.combine(date(1970, 1, 1), clock)
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def combine_times(times: Sequence[FloatArray], layout: RecordLayout) -> FloatArray:
    """Return stamps (T,) in s from the time columns of a layout.

    Times of day increase beyond midnight.
    """
    time_s = times[0] * (TIME_UNITS[layout.time_unit] * layout.time_scale)
    day_s = 86400.0
    if layout.time_unit == "iso" and np.nanmax(time_s) < day_s and np.nanmin(time_s) >= 0:
        wraps = np.diff(np.nan_to_num(time_s), prepend=time_s[:1]) < -day_s / 2
        time_s = time_s + day_s * np.cumsum(wraps)
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
        if layout.rate_hz is None:
            raise InputError(f"{source}: rate_hz: required with only one sample")
        return Sampling(layout.rate_hz, float(time_s[0]) - 1 / layout.rate_hz, np.zeros(1, int))

    def refuse(k: int, rate: float = 0.0) -> NoReturn:
        hint = f"drop {message_key(layout, 'time_column')} and give rate_hz if the stamps are bad"
        step_s, problem = float(time_s[k + 1] - time_s[k]), f"a gap at {rate:g} Hz"
        if step_s < 0:
            problem = "time runs backward"
        elif step_s == 0:
            problem = "time repeats"
        elif step_s * rate < 1:
            problem = f"a short step at {rate:g} Hz"
        row = f"row {row_number(k + 1)}"
        raise InputError(f"{place}: {row}: {problem}, {format_step(time_s, k)} ({hint})")

    step_s = np.diff(time_s)
    if (step_s <= 0).any():
        refuse(int((step_s <= 0).argmax()))
    found = _find_rate(time_s)
    rate = resolve_rate(found.rate_hz, layout, found.uncertainty, place)
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
    if (steps < 1).any():
        k = int((steps < 1).argmax())
        refuse(k + int(step_s[k : k + window].argmin()), rate)
    if (is_set := steps > _MAX_MISSING_FACTOR * len(time_s)).any():
        refuse(int(is_set.argmax()), rate)
    number = np.concatenate([[0], np.cumsum(steps)])
    late = ahead - on_time
    remark = ""
    if count := int((late > 0.5).sum()):
        longest_ms = 1e3 * float(late.max()) / rate
        remark = f"{count} stamps are late by up to {longest_ms:.3g} ms: read as if on time"
    return Sampling(rate, float(time_s[0]) - 1 / rate, number, remark)


class _Rate(NamedTuple):
    """A rate, Hz, and its relative uncertainty."""

    rate_hz: float
    uncertainty: float


def _find_rate(time_s: FloatArray) -> _Rate:
    """Return the rate of increasing stamps: a whole one, or one of four digits, if they may be.

    The resolution of the stamps is 0.2 us for seconds since 1970.
    """
    step_s = np.diff(time_s)
    count = max(1, min(_AVERAGED_STEPS, len(step_s) // 8))
    long_step_s = (time_s[count:] - time_s[:-count]) / count
    typical_s = float(np.quantile(long_step_s, 0.5, method="lower"))
    # The mean averages out the rounding of the stamps; steps near the median exclude gaps.
    clean = step_s[(step_s >= 0.5 * typical_s) & (step_s <= 1.5 * typical_s)]
    if 2 * len(clean) < len(step_s):  # stamps alternate, or come in bursts
        clean = long_step_s[np.abs(long_step_s - typical_s) < 0.5 * typical_s]
    rate_hz = float(1 / clean.mean())
    tolerance_hz = rate_hz * 2 * float(np.spacing(np.abs(time_s).max())) / float(np.ptp(time_s))
    for rounded in (float(round(rate_hz)), float(f"{rate_hz:.4g}")):
        if abs(rounded - rate_hz) <= tolerance_hz:
            rate_hz = rounded
            break
    return _Rate(rate_hz, 1 / len(clean))


def _min_of_following(values: FloatArray, count: int) -> FloatArray:
    """Return the smallest of each value (T,) and those after it, ``count`` in all."""
    padding = np.full(2 * count - len(values) % count, np.inf)
    blocks = np.concatenate([values, padding]).reshape(-1, count)
    to_end = np.minimum.accumulate(blocks[:, ::-1], axis=1)[:, ::-1].ravel()
    from_begin = np.minimum.accumulate(blocks, axis=1).ravel()
    last = np.arange(len(values)) + count - 1
    return np.asarray(np.minimum(to_end[: len(values)], from_begin[last]))


def format_step(time_s: FloatArray, k: int) -> str:
    """Return the times of a stamp and the next one, for messages."""
    return f"from {float(time_s[k])!r} to {float(time_s[k + 1])!r} s"


class Clock(NamedTuple):
    """A proposed clock of a file."""

    fields: dict[str, Any]  # of the layout: columns and units; none if they cannot be read
    rate_hz: float  # a placeholder if it is an open question
    notes: dict[str, Note]  # reasons and questions by key of the layout

    @property
    def is_open(self) -> bool:
        """Whether it has an open question."""
        return any(note.question for note in self.notes.values())


def propose_clock(
    path: str, table: Any, answers: Mapping[str, Any], taken: Collection[str] = ()
) -> Clock:
    """Propose the clock of a table from the names of its columns, and the steps of their stamps.

    Args:
        path: the file, for messages.
        table: the opened file, a `reader.Table`.
        answers: keys of the layout that the user has given.
        taken: columns of the sensors.
    """
    given, dates = answers.get("time_column"), table.dates
    numbers = table.numbers
    names = [
        name for name in filter(None, table.names)
        if name == given or name not in taken and table.names.count(name) == 1
        and (name in dates or name in numbers and _TIME_NAME.search(name))
    ]  # fmt: skip
    read = table.read(names, blanks=True, dates=dates) if names else []
    found = zip(names, read, strict=True)
    columns = {name: stamps for name, stamps in found if np.isfinite(stamps).sum() > 1}
    units = {name: "iso" if name in dates else _unit_by_name(table, name) for name in columns}
    fractions = {
        name: units[name] for name in columns
        if units[name] in ("ms", "us", "ns")
        and _is_fraction(columns[name] * TIME_UNITS[units[name]])
    }  # fmt: skip
    clocks = [
        _try_clock(path, columns, name, answers.get("time_unit", units[name]), fractions, answers)
        for name in columns
        if name == (given or name)
    ]
    if clocks:
        return min(clocks, key=lambda clock: (clock.is_open, not clock.fields))
    question = "no column has times: give the true rate"
    return Clock({}, _PLACEHOLDER_HZ, {"rate_hz": Note("Hz", "", question)})


def _unit_by_name(table: Any, name: str) -> str:
    """Return the unit of a column of times by the row of units or its name; "" for none."""
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", table.units.get(name) or name)  # as TimeUS
    found = _UNIT.search(text.lower())
    return _UNITS[found[1]] if found else ""


def _is_fraction(values_s: FloatArray) -> bool:
    """Return whether values (T,) may be fractions of a second, which begin again with each."""
    return bool(np.nanmin(values_s) >= 0 and np.nanmax(values_s) < 1 < len(values_s)) and bool(
        (np.diff(values_s) < 0).any()
    )


def _try_clock(
    path: str,
    columns: Mapping[str, FloatArray],
    name: str,
    unit: str,
    fractions: Mapping[str, str],
    answers: Mapping[str, Any],
) -> Clock:
    """Return the clock of a column of times, perhaps with a column of fractions of a second."""
    stamps = columns[name]
    fields: dict[str, Any]
    fields, note = {"time_column": name, "time_unit": unit or "s"}, Note("by its name")
    is_whole = unit in ("", "s") and np.array_equal(stamps, np.floor(stamps), equal_nan=True)
    if is_whole and (fraction := next((other for other in fractions if other != name), "")):
        fields |= {"time_fraction_column": fraction, "time_fraction_unit": fractions[fraction]}
        note = Note("seconds and their fraction")
    elif unit != "iso" and "time_unit" not in answers:
        fields["time_unit"], note = _unit_by_steps(name, unit, stamps)
    layout = RecordLayout("csv", **fields, time_scale=answers.get("time_scale", 1.0))
    time_s = combine_times([columns[column] for column in layout.time_columns], layout)
    time_s = time_s[np.isfinite(time_s)]
    is_new = np.diff(time_s, prepend=-np.inf) != 0
    if is_new.mean() > _MIN_NEW:
        time_s = time_s[is_new]
    try:
        rate_hz = find_sampling(path, layout, time_s, lambda k: k + 1).rate_hz
    except InputError as error:
        problem = str(error).removeprefix(f"{path}: ").partition(" (drop")[0]
        span_s = float(np.ptp(time_s)) if len(time_s) > 1 else 0.0
        rate_hz = (len(time_s) - 1) / span_s if span_s else _PLACEHOLDER_HZ
        mean = f"; the mean step would give {rate_hz:.6g} Hz" if span_s else ""
        question = f"{problem}{mean}: give the true rate"
        return Clock({}, rate_hz, {"rate_hz": Note("Hz", "", question)})
    reason = "the stamps are taken for the ends of the samples"
    return Clock(fields, rate_hz, {"time_column": Note(reason), "time_unit": note})


def _unit_by_steps(name: str, named: str, stamps: FloatArray) -> tuple[str, Note]:
    """Return the unit of stamps (T,): the named one, or what their steps can be, or a question."""
    steps = np.diff(stamps[np.isfinite(stamps)])
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    rates = {unit: 1 / (step * TIME_UNITS[unit]) for unit in ("s", "ms", "us", "ns")}
    possible = [unit for unit in rates if _POSSIBLE_HZ[0] <= rates[unit] <= _POSSIBLE_HZ[1]]
    unit = named or (possible or ["s"])[0]
    if unit in possible and (named or len(possible) == 1):
        return unit, Note(f"steps of {step:.4g} {unit}: {rates[unit]:.4g} Hz")
    shown = ", ".join(f'"{other}": {rates[other]:.4g} Hz' for other in possible or rates)
    problem = f"is named as {named}, but" if named else "does not tell its unit:"
    return unit, Note("", "", f"column {name!r} {problem} its steps of {step:.4g} are {shown}")
