"""Whether the numbers of a study are what such numbers usually are: nonsense is asked about.

The ranges stand beside their keys, see `value_types.Usual`, and are generous: a value outside is
rather one of another unit, or a slip of a finger. ``[study] unchecked = true`` insists on it.
"""

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from sinsjax.errors import InputError
from sinsjax.study.keys import EARTH_CONSTANTS, SECTION_OF, SECTIONS
from sinsjax.study.study import Study
from sinsjax.value_types import ROUNDING, Usual, mark

INSIST = "[study] unchecked = true insists on it"

_FEEDBACK = "feedback_interval_s"
_DEEPEST = 0.99  # of the radius; the least one of an ellipsoid is smaller than its own
_LEAST_S = 1.0  # the default, which also stands in a study that is shorter


def check(study: Study, where: Mapping[str, str]) -> None:
    """Asks about values of sections, axes, zips and cases; of drawn keys see `axes.check_draws`.

    Args:
        study: checked study.
        where: the table, in brackets, of every key that the file gives.

    Raises:
        InputError: ``[section] key: X is outside the usual A to B (hint)``. A place that is not
            above the centre of the Earth, whoever insists.
    """
    _check_centre(study, where)
    if study.study.unchecked:
        return
    for section in SECTIONS:
        given = getattr(study, section)
        for key in SECTIONS[section].model_fields if given else ():
            _check_value(f"[{section}] {key}", section, key, getattr(given, key))
    for dimension in study.dimensions:
        for key, values in dimension.items():
            for value in dict.fromkeys(values) if key != "case" else ():
                if doubt(key, value):
                    place = f"{where[key]} {key}[{values.index(value)}]"
                    _check_value(place, SECTION_OF[key], key, value)
    if study.study.rate_hz:
        _check_feedback(study, where)


def doubt(key: str, value: Any, section: str | None = None) -> str | None:
    """What to ask about a value of a key; None where it is as usual.

    Args:
        key: leaf key.
        value: a number, numbers in lists, or whatever else the key takes.
        section: of the key, where two have one of that name.
    """
    for at, number in _numbers(value):
        if found := _beyond(section or SECTION_OF[key], key, number):
            return f"{at}{found}"
    return None


def _check_value(place: str, section: str, key: str, value: Any) -> None:
    if value is None or range_of(section, key) is None:
        return
    for at, number in _numbers(value):
        if found := _beyond(section, key, number):
            raise InputError(f"{place}{at}: {found}")


def _beyond(section: str, key: str, number: float) -> str | None:
    usual = range_of(section, key)
    if usual is None or usual.low <= number <= usual.high:
        return None
    return f"{number:.12g} is outside the usual {usual.low:g} to {usual.high:g} ({INSIST})"


def _numbers(value: Any, at: str = "") -> Iterator[tuple[str, float]]:
    """The numbers of a value, each behind its place in lists."""
    if isinstance(value, tuple):
        for i, entry in enumerate(value):
            yield from _numbers(entry, f"{at}[{i}]")
    elif isinstance(value, int | float):
        yield at, float(value)


@cache
def range_of(section: str, key: str) -> Usual | None:
    """What the numbers of a key usually are; None where every number is as good as another."""
    return mark(SECTIONS[section].model_fields[key], Usual)


def _check_feedback(study: Study, where: Mapping[str, str]) -> None:
    """Asks about a feedback that no run ever comes to."""
    longest = max(span.records for span in study.distinct_spans) * study.record_every
    run_s = longest / study.rate_hz
    for point in study.combinations(_FEEDBACK):
        interval = point[_FEEDBACK]
        if interval is not None and interval > max(run_s, _LEAST_S) * (1 + ROUNDING):
            raise InputError(
                f"{where.get(_FEEDBACK, '[alignment]')} {_FEEDBACK}: {interval:.12g} s is longer"
                f" than a run of {run_s:.12g} s: nothing would be fed back ({INSIST})"
            )


def _check_centre(study: Study, where: Mapping[str, str]) -> None:
    """Refuses a place where there is no north, east and up."""
    for point in study.combinations("height_m", "radius_m"):
        radius = point["radius_m"] or EARTH_CONSTANTS["radius_m"]
        if point["height_m"] is not None and point["height_m"] <= -_DEEPEST * radius:
            text = f"{point['height_m']:.12g} m is at the centre of the Earth or below it"
            raise InputError(f"{where.get('height_m', '[earth]')} height_m: {text}")
