"""The variables of a tuning, and the points that they span.

A *box point* has a position in [0, 1] for each free variable, its *values* are in the units of the
file, and a *point* is the table of keys with these values and one combination of all candidates.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, product
from operator import attrgetter
from typing import Any, NamedTuple

from sinsjax.errors import InputError
from sinsjax.study.keys import SECTION_OF, SECTIONS, TUNABLE, TomlTable, alternative_keys, leaf_info
from sinsjax.study.schema import Range
from sinsjax.study.study import Study
from sinsjax.study.sweep import COUNT, TIMES, Ranges

MAX_GRID_VARIABLES = 2
"""Largest number of free variables of a full grid."""


class Variable(NamedTuple):
    """A number that is searched from low to high, in the unit of its key."""

    key: str
    entry: int | None  # index in a list, from 0; None if the key is one number
    low: float
    high: float
    log: bool  # whether the scale from low to high is logarithmic

    @property
    def name(self) -> str:
        """``p0_yaw_deg``, or ``reset_times_s[0]`` for an entry of a list."""
        return self.key if self.entry is None else f"{self.key}[{self.entry}]"

    def value(self, position: Any) -> Any:
        """Return the value at a position from 0 to 1, which may be an array or a traced number."""
        if self.log:
            return self.low * (self.high / self.low) ** position
        return self.low + (self.high - self.low) * position

    def position(self, value: float) -> float:
        """Return the position of a value, the inverse of `value`."""
        if self.log:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)


@dataclass(frozen=True)
class SearchSpace:
    """All points of a tuning."""

    ranges: Ranges
    variables: tuple[Variable, ...]  # in the order of the file, the dimensions of the box
    combinations: tuple[TomlTable, ...]  # of all candidates, the last key fastest
    rate_hz: float
    record_interval_s: float

    @property
    def names(self) -> list[str]:
        """Names of the variables."""
        return [variable.name for variable in self.variables]

    @classmethod
    def from_study(cls, study: Study) -> "SearchSpace":
        """Return the search space of a study with [tune]."""
        assert study.tune is not None
        ranges = study.tune.variables
        choices = {
            key: key_range.candidates or (key_range.fixed,)
            for key, key_range in ranges.items()
            if isinstance(key_range, Range) and not key_range.is_free
        }
        combinations = tuple(
            dict(zip(choices, values, strict=True)) for values in product(*choices.values())
        )
        rate_hz, interval_s = study.study.rate_hz, study.study.record_interval_s
        return cls(ranges, _free_variables(ranges), combinations, rate_hz, interval_s)

    def used_variables(self, combination: TomlTable) -> list[int]:
        """Return the indices of the variables that have an effect in a combination."""
        count = combination.get(COUNT, math.inf)
        return [i for i, v in enumerate(self.variables) if v.key != TIMES or (v.entry or 0) < count]

    def to_values(self, box: Iterable[Any]) -> list[Any]:
        """Return the values at a box point, one per variable, including unused variables."""
        return [v.value(position) for v, position in zip(self.variables, box, strict=True)]

    def to_box(self, values: Sequence[float]) -> list[float]:
        """Return the box point of some values, the inverse of `to_values`."""
        return [v.position(value) for v, value in zip(self.variables, values, strict=True)]

    def make_point(self, values: Sequence[float], combination: TomlTable) -> TomlTable:
        """Return the keys of some values and a combination.

        Times are rounded to whole samples and increase. Resets at the same sample are merged.
        """
        numbers = iter(
            min(max(float(value), v.low), v.high)
            for v, value in zip(self.variables, values, strict=True)
        )
        result: TomlTable = {}
        for key, key_range in self.ranges.items():
            if isinstance(key_range, Range):
                result[key] = next(numbers) if key_range.is_free else combination[key]
            else:
                result[key] = tuple(next(numbers) if k.is_free else k.fixed for k in key_range)
        if COUNT in result and TIMES in result:
            result[TIMES] = result[TIMES][: result.pop(COUNT)]
        return {key: self._round_times(key, value) for key, value in result.items()}

    def values_of_case(self, case: TomlTable, combination: TomlTable) -> list[float] | None:
        """Return the values in a case of the variables that a combination uses.

        None if the case has other candidates, another number of entries, or a value out of range.
        """
        if any(case[key] != value for key, value in combination.items() if key in case):
            return None
        used = (self.variables[i] for i in self.used_variables(combination))
        values: list[float] = []
        for key, group in groupby(used, key=attrgetter("key")):
            variables = list(group)
            given = case[key] if variables[0].entry is not None else (case[key],)
            if len(given) != len(variables):
                return None
            if not all(v.low <= value <= v.high for v, value in zip(variables, given, strict=True)):
                return None
            values += given
        return values

    def _round_times(self, key: str, value: Any) -> Any:
        """Round times to whole samples or record intervals; those of a list increase."""
        whole = leaf_info(key).whole
        if whole == "record":
            return max(1, round(value / self.record_interval_s)) * self.record_interval_s
        if whole is None or not isinstance(value, tuple):
            return max(1, round(value * self.rate_hz)) / self.rate_hz if whole else value
        samples = sorted(max(1, round(time * self.rate_hz)) for time in value)
        if key == TIMES:
            samples = list(dict.fromkeys(samples))
        for number in range(1, len(samples)):  # at least one sample between two times
            samples[number] = max(samples[number], samples[number - 1] + 1)
        return tuple(sample / self.rate_hz for sample in samples)


def _free_variables(ranges: Ranges) -> tuple[Variable, ...]:
    variables = []
    for key, key_range in ranges.items():
        single = isinstance(key_range, Range)
        for entry, r in enumerate([key_range] if isinstance(key_range, Range) else key_range):
            if r.low is not None and r.high is not None:
                number = None if single else entry
                variables.append(Variable(key, number, r.low, r.high, r.scale == "log"))
    return tuple(variables)


def lowest_and_highest_points(study: Study) -> dict[str, TomlTable]:
    """Return the points with all ranges at their low or high end, each by its description."""
    space, points = SearchSpace.from_study(study), dict[str, TomlTable]()
    ends = {"with every range at its low end": 0.0, "with every range at its high end": 1.0}
    for combination in space.combinations:
        several = combination.items() if len(space.combinations) > 1 else ()
        chosen = "".join(f", {key} = {value!r}" for key, value in several)
        for name, position in (ends if space.variables else {"with these values": 0.0}).items():
            values = space.to_values([position] * len(space.variables))
            points[f"[tune.variables] {name}{chosen}"] = space.make_point(values, combination)
    return points


def effective_values(study: Study, keys: Iterable[str]) -> TomlTable:
    """Return the values of keys in a study, which neither sweeps nor draws them; None without one.

    An omitted key has the value of the key that it defaults to, and ``reset_times_s`` the times of
    counted resets.
    """
    values: TomlTable = {}
    for key in keys:
        section, default = getattr(study, SECTION_OF[key]), leaf_info(key).same_as
        if section is None:
            values[key] = None
            continue
        values[key] = study.reset_times()[0] if key == TIMES else getattr(section, key)
        follows_surge = study.is_active("surge_m_per_s")  # of each variant
        if values[key] is None and not (key == "r_velocity_m_per_s" and follows_surge):
            if isinstance(default, str):
                default = getattr(getattr(study, SECTION_OF[default]), default)
            values[key] = default
    return values


def add_baseline_of_same_keys(
    study: Study, baseline_study: Study, points: Mapping[str, TomlTable]
) -> dict[str, TomlTable]:
    """Return points and the baseline with the same keys, as cases of one study with [tune].

    An `InputError` says that the baseline lacks a key of the points, or the study one of it.
    """
    assert study.tune is not None
    keys = list(next(iter(points.values())))
    others = [key for key in study.tune.baseline if key not in _with_alternatives(keys)]
    study_values = effective_values(study, others)
    result = {"baseline": effective_values(baseline_study, [*keys, *study_values])}
    for values, text in (
        (study_values, "needs a value in the study too, for the other points"),
        (result["baseline"], "required, as the study has no value of it"),
    ):
        if lacking := [key for key, value in values.items() if value is None]:
            raise InputError(f"[tune.baseline] {lacking[0]}: {text}")
    return result | {name: study_values | point for name, point in points.items()}


def _with_alternatives(keys: Iterable[str]) -> set[str]:
    return {other for key in keys for other in (key, *alternative_keys(key))}


def remove_tune_and_keys(tables: TomlTable, keys: Iterable[str]) -> TomlTable:
    """Return a study's tables without some keys and their alternatives, and without [tune]."""
    removed = _with_alternatives(keys)
    for condition in (c for section in SECTIONS.values() for c in section.conditions):
        if condition.refused and not {*condition.given}.isdisjoint(keys):
            removed |= {*condition.keys} - {*keys}
    result = {name: table for name, table in tables.items() if name != "tune"}
    for name in {*TUNABLE} & result.keys():
        result[name] = {key: value for key, value in result[name].items() if key not in removed}
    return result


def insert_point(tables: TomlTable, point: TomlTable) -> TomlTable:
    """Return a study's tables with the keys of a point in their sections, and without [tune]."""
    result = remove_tune_and_keys(tables, point)
    for key, value in point.items():
        result[SECTION_OF[key]] = result.get(SECTION_OF[key], {}) | {key: value}
    return result
