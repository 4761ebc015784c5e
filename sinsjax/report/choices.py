"""The options and the conditions of a study: what an engineer chooses, and what is imposed.

An axis with a starting error, a motion, a sensor or a site is a condition. Any other axis, such as
a reset schedule, a filter key or the method, is a choice. Options are compared over all conditions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax.methods.filters.keys import SCHEDULE_KEYS
from sinsjax.plots.labels import describe_point, describe_schedule, format_value, name_and_unit
from sinsjax.study.keys import is_condition_key
from sinsjax.study.study import Study


@dataclass(frozen=True)
class Choices:
    """The variants of a study by option and condition.

    Attributes:
        study: the study.
        variants: (options, conditions) number of the variant; copies of others are left out.
        option_axes: keys that identify the points of each axis that is a choice.
        condition_axes: keys of each other axis.
    """

    study: Study
    variants: NDArray
    option_axes: list[tuple[str, ...]]
    condition_axes: list[tuple[str, ...]]

    @classmethod
    def from_study(cls, study: Study) -> "Choices":
        """Sort the axes of a study into choices and conditions."""
        chosen = [
            place
            for place, axis in enumerate(study.dimensions)
            if not any(is_condition_key(key) or key == "start_s" for key in axis)
        ]
        keys = list(study.axes_shown)
        sizes = [len(next(iter(axis.values()))) for axis in study.dimensions]
        variants = np.moveaxis(
            np.arange(study.n_variants).reshape(sizes), chosen, range(len(chosen))
        ).reshape(int(np.prod([sizes[axis] for axis in chosen], dtype=int)), -1)
        first = study.duplicate_of[variants] == variants
        variants = variants[first.any(axis=1)][:, first.any(axis=0)]
        option_axes = [keys[axis] for axis in chosen]
        return cls(study, variants, option_axes, [axis for axis in keys if axis not in option_axes])

    def runs(self, draws: int) -> NDArray:
        """The numbers of the runs, (options, conditions, draws)."""
        return self.variants[..., None] + self.study.n_variants * np.arange(draws)

    @cached_property
    def _reset_times(self) -> list[tuple[float, ...]]:
        return self.study.reset_times()

    @property
    def without_resets(self) -> list[int]:
        """The options without scheduled resets; none if no axis is a schedule."""
        if not any({*keys} <= {*SCHEDULE_KEYS} for keys in self.option_axes):
            return []
        first = self.variants[:, 0].tolist()
        return [option for option, variant in enumerate(first) if not self._reset_times[variant]]

    @cached_property
    def options(self) -> list[str]:
        """Each option in words."""
        return [self._describe_option(variant) for variant in self.variants[:, 0].tolist()]

    def _describe_option(self, variant: int) -> str:
        words: list[str] = []
        for keys in self.option_axes:
            for key in keys:
                value = self.study.values(key)[variant]
                if key == "method":
                    words.append(format_value(value))
                elif key not in SCHEDULE_KEYS:
                    words.append(describe_point({key: value}))
                elif self._reset_times[variant] or {*keys} <= {*SCHEDULE_KEYS}:
                    words.append(describe_schedule(self._reset_times[variant]))
        return ", ".join(dict.fromkeys(words))

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
            points = self.conditions_by_point(keys).values()
            if len(points) > 1:
                ranges[keys] = np.ptp([np.mean(values[conditions]) for conditions in points])
        return max(ranges, key=ranges.__getitem__) if ranges else None


def condition_header(keys: Sequence[str]) -> str:
    """The header of a column with the points of a condition."""
    return ", ".join(name_and_unit(key)[0].removeprefix("initial ") for key in keys)


def format_condition(keys: Sequence[str], point: Sequence[Any]) -> str:
    """A point of a condition: ``30 deg``."""
    cells = []
    for key, value in zip(keys, point, strict=True):
        text, unit = format_value(value), name_and_unit(key)[1]
        cells.append(f"{text} {unit}" if unit and text[-1:].isdigit() else text)
    return ", ".join(cells)
