"""The variables of a tuning, and the points that they span.

A *box point* has a place in [0, 1] for every free variable, in the order written, each entry of a
list being a variable of its own. Its *values* are in the units of the file. A *point* is the table
of keys that they come to, with one combination of all candidates: what is put into the study.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple, NoReturn

from sinsjax.errors import InputError
from sinsjax.study.keys import SECTION_OF, SECTIONS, TUNABLE, TomlTable, info, rivals
from sinsjax.study.schema import Range
from sinsjax.study.study import Study
from sinsjax.study.sweep import COUNT, TIMES, Ranges
from sinsjax.value_types import KeyInfo

GRID_MOST = 2
"""Free variables of a full grid, at the most."""


class Variable(NamedTuple):
    """A number that is searched between two ends.

    Attributes:
        key: leaf key of the study.
        entry: which number of a list, from 0; None where the key is one number.
        low: least value, in the unit of the key.
        high: greatest value.
        log: whether the way from low to high is geometric.
    """

    key: str
    entry: int | None
    low: float
    high: float
    log: bool

    @property
    def name(self) -> str:
        """``p0_yaw_deg``, or ``reset_times_s[0]`` for an entry of a list."""
        return self.key if self.entry is None else f"{self.key}[{self.entry}]"

    def value(self, place: Any) -> Any:
        """The value at a place from 0 to 1; of arrays and traced numbers too."""
        if self.log:
            return self.low * (self.high / self.low) ** place
        return self.low + (self.high - self.low) * place

    def place(self, value: float) -> float:
        """The place of a value, the inverse of `value`."""
        if self.log:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)


@dataclass(frozen=True)
class SearchSpace:
    """All points that a tuning may look at.

    Attributes:
        ranges: of [tune.variables], by key.
        variables: the free ones, in the order written: the dimensions of the box.
        combinations: of the candidates of all keys that have some, the last one fastest; fixed
            values are in each of them.
        rate_hz: samples a second of the study.
        record_interval_s: of the study.
    """

    ranges: Ranges
    variables: tuple[Variable, ...]
    combinations: tuple[TomlTable, ...]
    rate_hz: float
    record_interval_s: float

    @classmethod
    def of(cls, study: Study) -> "SearchSpace":
        """The space of a study with [tune]."""
        assert study.tune is not None
        ranges = study.tune.variables
        chosen = {
            key: kind.candidates or (kind.fixed,)
            for key, kind in ranges.items()
            if isinstance(kind, Range) and not kind.is_free
        }
        combinations = tuple(
            dict(zip(chosen, values, strict=True)) for values in product(*chosen.values())
        )
        settings = study.study
        return cls(
            ranges, _free(ranges), combinations, settings.rate_hz, settings.record_interval_s
        )

    def used(self, combination: TomlTable) -> list[int]:
        """Numbers of the variables that a combination leaves something to do."""
        count = combination.get(COUNT, math.inf)
        return [
            number
            for number, variable in enumerate(self.variables)
            if variable.key != TIMES or variable.entry is None or variable.entry < count
        ]

    def values(self, box: Iterable[Any]) -> list[Any]:
        """The values at a box point: one a variable, those that are not used too."""
        return [v.value(place) for v, place in zip(self.variables, box, strict=True)]

    def box(self, values: Sequence[float]) -> list[float]:
        """The box point of some values, the inverse of `values`."""
        return [v.place(value) for v, value in zip(self.variables, values, strict=True)]

    def point(self, values: Sequence[float], combination: TomlTable) -> TomlTable:
        """The keys that values and a combination come to.

        Times are whole numbers of samples and ascend. Resets on one sample are one.
        """
        numbers = iter(
            min(max(float(value), v.low), v.high)
            for v, value in zip(self.variables, values, strict=True)
        )
        out: TomlTable = {}
        for key, kind in self.ranges.items():
            if isinstance(kind, Range):
                out[key] = next(numbers) if kind.is_free else combination[key]
            else:
                out[key] = tuple(next(numbers) if k.is_free else k.fixed for k in kind)
        if COUNT in out and TIMES in out:
            out[TIMES] = out[TIMES][: out.pop(COUNT)]
        return {
            key: self._whole(value, about) if (about := info(key)).whole else value
            for key, value in out.items()
        }

    def located(self, case: TomlTable, combination: TomlTable) -> list[float] | None:
        """Values of the variables that a combination uses in a case; None if it is no such point.

        It is none with other candidates, another number of entries, or a value out of its range.
        """
        if any(case[key] != value for key, value in combination.items() if key in case):
            return None
        used = [self.variables[i] for i in self.used(combination)]
        values = []
        for variable in used:
            value = case[variable.key]
            if variable.entry is not None:
                entries = [v.entry for v in used if v.key == variable.key]
                if len(value) != len(entries):
                    return None
                value = value[entries.index(variable.entry)]
            if not variable.low <= value <= variable.high:
                return None
            values.append(value)
        return values

    def _whole(self, value: Any, about: KeyInfo) -> Any:
        """Times as whole numbers of samples or of record intervals; those of a list ascend."""
        if about.whole == "record":
            return max(1, round(value / self.record_interval_s)) * self.record_interval_s
        if not isinstance(value, tuple):
            return max(1, round(value * self.rate_hz)) / self.rate_hz
        samples = sorted(max(1, round(time * self.rate_hz)) for time in value)
        if about.merged:
            samples = list(dict.fromkeys(samples))
        for number in range(1, len(samples)):  # a piece each, be it a sample long
            samples[number] = max(samples[number], samples[number - 1] + 1)
        return tuple(sample / self.rate_hz for sample in samples)


def _free(ranges: Ranges) -> tuple[Variable, ...]:
    found = []
    for key, kind in ranges.items():
        entries = [(None, kind)] if isinstance(kind, Range) else list(enumerate(kind))
        for entry, own in entries:
            if own.low is not None and own.high is not None:
                found.append(Variable(key, entry, own.low, own.high, own.scale == "log"))
    return tuple(found)


def _refuse(place: str, text: str) -> NoReturn:
    raise InputError(f"{place}: {text}")


def corners(study: Study) -> Iterator[tuple[str, TomlTable]]:
    """The points at which all ranges are at one of their ends, and what to call them."""
    space = SearchSpace.of(study)
    ends = {"low": 0.0, "high": 1.0} if space.variables else {}
    for combination in space.combinations:
        for name, place in ends.items():
            values = space.values([place] * len(space.variables))
            yield f"with every range at its {name} end", space.point(values, combination)
        if not ends:
            yield "with these values", space.point([], combination)


def told(study: Study, keys: Iterable[str]) -> TomlTable:
    """The values that keys have in a study, none of them swept or drawn; None where it has none.

    What a key that is left out stands for is told too, and ``reset_times_s`` of counted resets.
    """
    out = {}
    for key in keys:
        section = getattr(study, SECTION_OF[key])
        out[key] = None if section is None else getattr(section, key)
        if section is not None and key == TIMES:
            out[key] = study.reset_times()[0]
        elif section is not None and out[key] is None and info(key).same_as is not None:
            other = info(key).same_as
            if isinstance(other, str):
                other = getattr(getattr(study, SECTION_OF[other]), other)
            out[key] = other
    return out


def comparable(study: Study, based: Study, points: Mapping[str, TomlTable]) -> dict[str, TomlTable]:
    """Points and the baseline, each with the same keys, so that they can be cases of one study.

    Args:
        study: with [tune], whose points they are.
        based: the study with the baseline put in.
        points: by name.

    Raises:
        InputError: the baseline lacks a key of the points, or the study one of the baseline.
    """
    assert study.tune is not None
    keys = list(next(iter(points.values())))
    taken = {*keys, *(other for key in keys for other in rivals(key))}
    own = told(study, [key for key in study.tune.baseline if key not in taken])
    out = {"baseline": told(based, [*keys, *own])}
    for key, value in own.items():
        if value is None:
            _refuse(f"[tune.baseline] {key}", "must have a value in the study too, for all others")
    for key, value in out["baseline"].items():
        if value is None:
            _refuse(f"[tune.baseline] {key}", "required, as the study itself gives none")
    return out | {name: own | point for name, point in points.items()}


def cleared(tables: TomlTable, keys: Sequence[str]) -> TomlTable:
    """A study's tables without some keys and what says them in another way, and without [tune]."""
    gone = {*keys, *(other for key in keys for other in rivals(key))}
    for condition in (c for section in SECTIONS.values() for c in section.conditions):
        if condition.refused and not {*condition.given}.isdisjoint(keys):
            gone |= {*condition.keys} - {*keys}
    return {
        name: {key: value for key, value in table.items() if key not in gone}
        if name in TUNABLE
        else table
        for name, table in tables.items()
        if name != "tune"
    }


def put(tables: TomlTable, point: TomlTable) -> TomlTable:
    """A study's tables with the keys of a point in their sections, and without [tune]."""
    out = cleared(tables, list(point))
    for key, value in point.items():
        out[SECTION_OF[key]] = out.get(SECTION_OF[key], {}) | {key: value}
    return out
