"""Values of a study that no run ever comes to: times after its end, and keys that nobody reads."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from sinsjax.errors import InputError
from sinsjax.study.study import PASS_KEYS, ROUNDING, SECTION_OF, SECTIONS, Study

UNREAD_BESIDE = {"level_gains": "level_damping", "azimuth_gains": "azimuth_damping"}
"""Keys that give a whole loop, and those that nobody reads beside them."""

Point = dict[str, Any]


class _Timed(NamedTuple):
    """A key whose value is a time of a run, or gives one.

    Attributes:
        key: leaf key.
        reader: the key that decides whether a run reads it.
        reads: whether it does with a value of the reader.
        default: which is filled in for any study, however short.
        by_passes: whether it counts passes over the tape.
    """

    key: str
    reader: str
    reads: Callable[[Any], bool]
    default: float | None = None
    by_passes: bool = False


def _of_compass(method: Any) -> bool:
    return bool(method == "compass")


def _has_trigger(name: Any) -> bool:
    return name not in (None, "none")


_TIMED = (
    _Timed("level_time_s", "method", _of_compass, 150.0),
    _Timed("level_passes", "method", _of_compass, by_passes=True),
    _Timed("sigma_times_s", "method", _of_compass),
    _Timed("sigma_passes", "method", _of_compass, by_passes=True),
    _Timed("trigger_until_s", "reset_trigger", _has_trigger),
    _Timed("trigger_refractory_s", "reset_trigger", _has_trigger, 5.0),
)


def check(study: Study, where: Mapping[str, str]) -> None:
    """Refuses what no run comes to.

    A time may be after the end of some runs of a sweep, where others with it go on for longer.

    Args:
        study: checked study, whose rate is known.
        where: the table, in brackets, of every key that the file gives.

    Raises:
        InputError: ``[section] key: what is wrong``.
    """
    for timed in _TIMED:
        if getattr(study, SECTION_OF[timed.key]) is not None:
            _check_time(study, where, timed)
    for gains, damping in UNREAD_BESIDE.items():
        default = SECTIONS["compass"].model_fields[damping].default
        if gains in where and any(p[damping] != default for p in study.combinations(damping)):
            text = f"is read by nobody beside {gains} in {where[gains]} (give one of them)"
            raise InputError(f"{where.get(damping, '[compass]')} {damping}: {text}")


def _check_time(study: Study, where: Mapping[str, str], timed: _Timed) -> None:
    latest: dict[float, float] = {}  # the end of the longest run with each value
    every_s = study.study.record_interval_s
    for point in _points(study, timed):
        value = point[timed.key]
        span = study.span(**{k: point[k] for k in PASS_KEYS} if study.passes else {})
        last = value[-1] if isinstance(value, tuple) and value else value
        if last in (None, (), timed.default) or not timed.reads(point[timed.reader]):
            continue
        time = last * span.tape * every_s if timed.by_passes else last
        latest[time] = max(latest.get(time, 0.0), span.records * every_s)
    for time, end in latest.items():
        if time > end * (1 + ROUNDING):
            told = f"{time:.12g} s is after the end of all runs with it, at {end:.12g} s"
            place = where.get(timed.key, f"[{SECTION_OF[timed.key]}]")
            raise InputError(f"{place} {timed.key}: {told}")


def _points(study: Study, timed: _Timed) -> Iterator[Point]:
    passes = PASS_KEYS if study.passes else ()
    return study.combinations(timed.key, timed.reader, *passes)
