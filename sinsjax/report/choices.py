"""The options and the conditions of a study: what an engineer chooses, and what is imposed.

An axis with a starting error, a motion, a sensor or a site is a condition. Any other axis, such as
a reset schedule, a filter key or the method, is a choice. Options are compared over all conditions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax.analysis.formats import format_degrees
from sinsjax.messages import format_count
from sinsjax.methods.filters.keys import SCHEDULE_KEYS
from sinsjax.plots.labels import describe_point, describe_schedule, format_value, name_and_unit
from sinsjax.study.keys import is_condition_key
from sinsjax.study.study import Study

_ANGLES = {"phi_e0_deg": "east", "phi_n0_deg": "north", "phi_u0_deg": "up"}
_MAX_OPTION_LENGTH = 80  # characters of an option; the tables have all its keys


@dataclass(frozen=True)
class Choices:
    """The variants of a study by option and condition.

    Attributes:
        study: the study.
        variants: (options, conditions) number of the variant; copies of others are left out.
        dimensions: per axis, whether it is a condition, and the keys that identify its points.
    """

    study: Study
    variants: NDArray
    dimensions: tuple[tuple[bool, tuple[str, ...]], ...]

    @classmethod
    def from_study(cls, study: Study) -> "Choices":
        """Sort the axes of a study into choices and conditions."""
        conditions = [_is_condition(dimension) for dimension in study.dimensions]
        dimensions = tuple(zip(conditions, study.axes_shown, strict=True))
        sizes = [len(next(iter(dimension.values()))) for dimension in study.dimensions]
        place = np.arange(study.n_variants).reshape(sizes)
        chosen = [axis for axis, given in enumerate(conditions) if not given]
        place = np.moveaxis(place, chosen, range(len(chosen)))
        options = int(np.prod([sizes[axis] for axis in chosen], dtype=int))
        variants = place.reshape(options, -1)
        first = study.duplicate_of[variants] == variants
        return cls(study, variants[first.any(axis=1)][:, first.any(axis=0)], dimensions)

    def arrange_runs(self, column: NDArray) -> NDArray:
        """Lay out a column of the summary, ordered by run_id, as (options, conditions, draws)."""
        return column.reshape(-1, self.study.n_variants).T[self.variants]

    @cached_property
    def options(self) -> list[str]:
        """Description of each option."""
        return [self._describe_option(int(variant)) for variant in self.variants[:, 0]]

    @cached_property
    def reset_counts(self) -> list[int | None]:
        """The number of scheduled resets of each option; None if no axis is a schedule."""
        if not any({*keys} <= {*SCHEDULE_KEYS} for keys in self._option_axes):
            return [None] * len(self.variants)
        return [len(self._reset_schedules[row[0]]) for row in self.variants]

    @property
    def _option_axes(self) -> list[tuple[str, ...]]:
        return [keys for is_condition, keys in self.dimensions if not is_condition]

    @cached_property
    def _reset_schedules(self) -> list[tuple[float, ...]]:
        return self.study.reset_times()

    def conditions_by_point(self, keys: Sequence[str]) -> dict[tuple[Any, ...], list[int]]:
        """The conditions at each point of an axis, by the values of its keys."""
        columns = [self.study.values(key) for key in keys]
        conditions: dict[tuple[Any, ...], list[int]] = {}
        for place, variant in enumerate(self.variants[0].tolist()):
            conditions.setdefault(tuple(values[variant] for values in columns), []).append(place)
        return conditions

    def most_influential_axis(self, values: NDArray) -> tuple[str, ...] | None:
        """The condition axis along which some values (conditions,) vary most; None without one."""
        ranges: dict[tuple[str, ...], float] = {}
        for keys in self.condition_axes:
            means = [
                float(np.mean(values[conditions]))
                for conditions in self.conditions_by_point(keys).values()
            ]
            if len(means) > 1:
                ranges[keys] = max(means) - min(means)
        return max(ranges, key=ranges.__getitem__) if ranges else None

    @property
    def option_noun(self) -> str:
        """Kind of the options: schedule, method or option."""
        if all({*keys} <= {*SCHEDULE_KEYS} for keys in self._option_axes):
            return "schedule"
        return "method" if self._option_axes == [("method",)] else "option"

    @property
    def options_without_reset(self) -> list[int]:
        """The options without a scheduled reset, if an axis is a schedule."""
        return [place for place, count in enumerate(self.reset_counts) if count == 0]

    def rival_options(self, best: int) -> list[list[int]]:
        """The options of each kind that the best is compared with.

        With schedules: the options with a single reset and those without; else all other options.
        """
        counts = self.reset_counts
        kinds = [[i for i, count in enumerate(counts) if count == number] for number in (1, 0)]
        kinds = [kind for kind in kinds if kind and best not in kind]
        return kinds or [[i for i in range(len(counts)) if i != best]]

    @property
    def condition_axes(self) -> list[tuple[str, ...]]:
        """The axes that are conditions, by the keys that identify their points."""
        return [keys for is_condition, keys in self.dimensions if is_condition]

    def _describe_option(self, variant: int) -> str:
        """The option of a variant in words."""
        words: list[str] = []
        for keys in self._option_axes:
            for key in keys:
                if key in SCHEDULE_KEYS:
                    times = self._reset_schedules[variant]
                    words += (
                        [describe_schedule(times)] if times or {*keys} <= {*SCHEDULE_KEYS} else []
                    )
                else:
                    value = self.study.values(key)[variant]
                    words.append(
                        format_value(value) if key == "method" else describe_point({key: value})
                    )
        first, *more = dict.fromkeys(words) or [""]
        text = first
        for place, word in enumerate(more):
            if len(text) + len(word) > _MAX_OPTION_LENGTH:
                return f"{text} + {format_count(len(more) - place, 'key')}"
            text += f", {word}"
        return text


def _is_condition(axis: Mapping[str, Sequence[Any]]) -> bool:
    return any(is_condition_key(key) or key == "start_s" for key in axis)


def condition_name_and_unit(key: str) -> tuple[str, str]:
    """The name of a condition, of a starting error without ``initial``, and its unit."""
    name, unit = name_and_unit(key)
    return name.removeprefix("initial "), unit


def condition_header(keys: Sequence[str]) -> str:
    """The header of a column with the points of a condition."""
    angles = [key for key in keys if key in _ANGLES]
    if len(angles) < 2:
        return ", ".join(condition_name_and_unit(key)[0] for key in keys)
    others = [condition_name_and_unit(key)[0] for key in keys if key not in angles]
    axes = ", ".join(_ANGLES[key] for key in angles)
    return ", ".join([f"errors {axes}", *others])


def format_condition(keys: Sequence[str], point: Sequence[Any]) -> str:
    """A point of a condition: ``30 deg``, or ``(5, 5, 30) deg`` for starting errors together."""
    values = dict(zip(keys, point, strict=True))
    angles = [key for key in keys if key in _ANGLES]
    cells = []
    if len(angles) > 1:
        cells.append(format_degrees(*(values.pop(key) for key in angles)))
    for key, value in values.items():
        text, unit = format_value(value), condition_name_and_unit(key)[1]
        cells.append(f"{text} {unit}" if unit and text[-1:].isdigit() else text)
    return ", ".join(cells)


def best_option(time_s: NDArray, unsettled_time_s: float) -> int:
    """Return the option with the fewest runs that never settle; of equals, the fastest on average.

    Args:
        time_s: (options, conditions, draws) settling times, infinite for never.
        unsettled_time_s: time that such a run counts in the average, s.
    """
    never = np.isinf(time_s).sum(axis=(1, 2))
    mean = np.minimum(time_s, unsettled_time_s).mean(axis=(1, 2))
    return int(np.lexsort((mean, never))[0])
