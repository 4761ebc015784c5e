"""Values of a study that no run ever comes to: times after its end, and keys that nobody reads."""

from collections.abc import Mapping
from functools import cache
from typing import Any

from sinsjax.errors import InputError
from sinsjax.study import acting
from sinsjax.study.keys import PASS_KEYS, SECTIONS
from sinsjax.study.study import Study
from sinsjax.value_types import ROUNDING, ActsWhere, Default, RunTime, mark


def check(study: Study, where: Mapping[str, str]) -> None:
    """Refuses what no run comes to.

    A time may be after the end of some runs of a sweep, where others with it go on for longer.

    Args:
        study: checked study, whose rate is known.
        where: the table, in brackets, of every key that the file gives.

    Raises:
        InputError: ``[section] key: what is wrong``.
    """
    for name, section in SECTIONS.items():
        if not study.has(name):
            continue
        for key, (time, default) in _times(name).items():
            _check_time(study, f"{where.get(key, f'[{name}]')} {key}", key, time, default)
        for condition in section.conditions:
            if condition.refused:
                _check_unread(study, where, name, condition)


@cache
def _times(section: str) -> dict[str, tuple[RunTime, Default | None]]:
    """The keys of a section that are times within a run."""
    fields = SECTIONS[section].model_fields.items()
    times = {key: (mark(field, RunTime), mark(field, Default)) for key, field in fields}
    return {key: (time, default) for key, (time, default) in times.items() if time}


def _check_time(study: Study, place: str, key: str, time: RunTime, default: Default | None) -> None:
    latest: dict[float, float] = {}  # the end of the longest run with each value
    every_s = study.study.record_interval_s
    passes = PASS_KEYS if study.passes else ()
    for point in study.combinations(key, *acting.deciding(key), *passes):
        value = point[key]
        span = study.span(**{k: point[k] for k in passes})
        last = value[-1] if isinstance(value, tuple) and value else value
        filled_in = default is not None and last == default.value
        if last in (None, ()) or filled_in or not acting.acts(key, point):
            continue
        until = last * span.pass_records * every_s if time.unit == "pass" else last
        latest[until] = max(latest.get(until, 0.0), span.records * every_s)
    for until, end in latest.items():
        if until > end * (1 + ROUNDING):
            told = f"{until:.12g} s is after the end of all runs with it, at {end:.12g} s"
            raise InputError(f"{place}: {told}")


def _check_unread(
    study: Study, where: Mapping[str, str], section: str, condition: ActsWhere
) -> None:
    """Refuses values of keys, other than their defaults, where they do not act."""
    for key in condition.keys:
        default: Any = SECTIONS[section].model_fields[key].default
        for point in study.combinations(key, *condition.given):
            values = [point[given] for given in condition.given]
            if point[key] != default and not condition.acts(*values):
                given = next(k for k in condition.given if k in where)
                text = f"is ignored beside {given} in {where[given]} (give one of them)"
                raise InputError(f"{where.get(key, f'[{section}]')} {key}: {text}")
