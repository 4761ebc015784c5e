"""The options and the conditions of a study: what an engineer decides, and what is given.

An axis with a starting error, a motion, a sensor or a site is a condition. Any other axis, such as
a reset schedule, a filter key or the method, is a choice. Options are compared over all conditions.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax.analysis.grids import held_out_choice
from sinsjax.analysis.words import degrees
from sinsjax.messages import counted
from sinsjax.methods.filters.section import OF_SCHEDULES
from sinsjax.plots.words import name_of, schedule_words, value_text, words_and_unit
from sinsjax.report.base import Table
from sinsjax.study.keys import is_condition_key
from sinsjax.study.study import Study

LEAST_DRAWS = 8
"""Fewest draws whose halves choose and judge in turn."""

_ANGLES = {"phi_e0_deg": "east", "phi_n0_deg": "north", "phi_u0_deg": "up"}
_MOST_WORDS = 80  # characters of an option; the tables have all its keys


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
        shown = tuple(zip(conditions, study.axes_shown, strict=True))
        sizes = [len(next(iter(dimension.values()))) for dimension in study.dimensions]
        place = np.arange(study.n_variants).reshape(sizes)
        chosen = [axis for axis, given in enumerate(conditions) if not given]
        place = np.moveaxis(place, chosen, range(len(chosen)))
        options = int(np.prod([sizes[axis] for axis in chosen], dtype=int))
        variants = place.reshape(options, -1)
        first = study.duplicate_of[variants] == variants
        return cls(study, variants[first.any(axis=1)][:, first.any(axis=0)], shown)

    def runs(self, column: NDArray) -> NDArray:
        """Lay out a column of the summary, ordered by run_id, as (options, conditions, draws)."""
        return column.reshape(-1, self.study.n_variants).T[self.variants]

    @cached_property
    def options(self) -> list[str]:
        """Each option in words."""
        return [self._words(int(variant)) for variant in self.variants[:, 0]]

    @cached_property
    def reset_counts(self) -> list[int | None]:
        """The number of scheduled resets of each option; None if no axis is a schedule."""
        if not any({*keys} <= {*OF_SCHEDULES} for keys in self._chosen):
            return [None] * len(self.variants)
        return [len(self._schedules[row[0]]) for row in self.variants]

    @property
    def _chosen(self) -> list[tuple[str, ...]]:
        return [keys for is_condition, keys in self.dimensions if not is_condition]

    @cached_property
    def _schedules(self) -> list[tuple[float, ...]]:
        return self.study.reset_times()

    def places(self, keys: Sequence[str]) -> dict[tuple[Any, ...], list[int]]:
        """The conditions at each point of an axis, by the values of its keys."""
        columns = [self.study.values(key) for key in keys]
        found: dict[tuple[Any, ...], list[int]] = {}
        for place, variant in enumerate(self.variants[0].tolist()):
            found.setdefault(tuple(values[variant] for values in columns), []).append(place)
        return found

    def axis_that_matters(self, values: NDArray) -> tuple[str, ...] | None:
        """The condition axis along which some values (conditions,) vary most; None without one."""
        ranges: dict[tuple[str, ...], float] = {}
        for keys in self.condition_axes:
            means = [float(np.mean(values[here])) for here in self.places(keys).values()]
            if len(means) > 1:
                ranges[keys] = max(means) - min(means)
        return max(ranges, key=ranges.__getitem__) if ranges else None

    @property
    def noun(self) -> str:
        """What an option is."""
        if all({*keys} <= {*OF_SCHEDULES} for keys in self._chosen):
            return "schedule"
        return "method" if self._chosen == [("method",)] else "option"

    @property
    def without_reset(self) -> list[int]:
        """The options without a scheduled reset, if an axis is a schedule."""
        return [place for place, count in enumerate(self.reset_counts) if count == 0]

    def rivals(self, best: int) -> list[list[int]]:
        """The options of each kind that the best is compared with.

        With schedules those with a single reset and those with none; else all the others.
        """
        counts = self.reset_counts
        kinds = [[i for i, count in enumerate(counts) if count == number] for number in (1, 0)]
        kinds = [kind for kind in kinds if kind and best not in kind]
        return kinds or [[i for i in range(len(counts)) if i != best]]

    def table(
        self, axis: tuple[str, ...], row: Callable[[list[int]], list[str]], settles: str
    ) -> Table:
        """The table of a verdict with the points of a condition axis.

        Args:
            axis: the keys of the axis.
            row: returns the cells of some conditions: the best option, its settling time and that
                of its rival; or success, settling time and heading error of a single option.
            settles: header of the settling times, without its unit.
        """
        rival = "no reset (s)" if self.without_reset else "best overall (s)"
        header = ["settled (%)", f"{settles} (s)", "error, rms (arcmin)"]
        if len(self.options) > 1:
            header = [f"best {self.noun}", f"{settles} (s)", rival]
        first = point_header(axis)
        rows = [[point_cell(axis, point), *row(here)] for point, here in self.places(axis).items()]
        return Table(f"Per {first}", [first, *header], rows)

    @property
    def condition_axes(self) -> list[tuple[str, ...]]:
        """The axes that are conditions, by the keys that identify their points."""
        return [keys for is_condition, keys in self.dimensions if is_condition]

    def _words(self, variant: int) -> str:
        """The option of a variant in words."""
        words: list[str] = []
        for keys in self._chosen:
            for key in keys:
                if key in OF_SCHEDULES:
                    times = self._schedules[variant]
                    words += [schedule_words(times)] if times or {*keys} <= {*OF_SCHEDULES} else []
                else:
                    value = self.study.values(key)[variant]
                    words.append(value_text(value) if key == "method" else name_of({key: value}))
        first, *more = dict.fromkeys(words) or [""]
        text = first
        for place, word in enumerate(more):
            if len(text) + len(word) > _MOST_WORDS:
                return f"{text} + {counted(len(more) - place, 'key')}"
            text += f", {word}"
        return text


def _is_condition(dimension: Mapping[str, Sequence[Any]]) -> bool:
    return any(is_condition_key(key) or key == "start_s" for key in dimension)


def name_and_unit(key: str) -> tuple[str, str]:
    """The name of a condition, of a starting error without ``initial``, and its unit."""
    name, unit = words_and_unit(key)
    return name.removeprefix("initial "), unit


def point_header(keys: Sequence[str]) -> str:
    """The header of a column with the points of a condition."""
    angles = [key for key in keys if key in _ANGLES]
    if len(angles) < 2:
        return ", ".join(name_and_unit(key)[0] for key in keys)
    others = [name_and_unit(key)[0] for key in keys if key not in angles]
    axes = ", ".join(_ANGLES[key] for key in angles)
    return ", ".join([f"errors {axes}", *others])


def point_cell(keys: Sequence[str], point: Sequence[Any]) -> str:
    """A point of a condition: ``30 deg``, or ``(5, 5, 30) deg`` for starting errors together."""
    values = dict(zip(keys, point, strict=True))
    angles = [key for key in keys if key in _ANGLES]
    cells = []
    if len(angles) > 1:
        cells.append(degrees(*(values.pop(key) for key in angles)))
    for key, value in values.items():
        text, unit = value_text(value), name_and_unit(key)[1]
        cells.append(f"{text} {unit}" if unit and text[-1:].isdigit() else text)
    return ", ".join(cells)


def choose(time_s: NDArray, longest_s: float) -> int:
    """Return the option with the fewest runs that never settle; of equals, the fastest on average.

    Args:
        time_s: (options, conditions, draws) settling times, infinite for never.
        longest_s: what such a run counts in the average, s.
    """
    never = np.isinf(time_s).sum(axis=(1, 2))
    mean = np.minimum(time_s, longest_s).mean(axis=(1, 2))
    return int(np.lexsort((mean, never))[0])


def choose_by_halves(time_s: NDArray, longest_s: float) -> NDArray:
    """Return the option with which each draw is judged, chosen by draws it does not belong to.

    Every other draw chooses for the rest, and the rest for it. Fewer than `LEAST_DRAWS` choose and
    judge together.

    Args:
        time_s: (options, conditions, draws) settling times, infinite for never.
        longest_s: as for `choose`.

    Returns:
        (draws,) option.
    """
    draws = time_s.shape[-1]
    if draws < LEAST_DRAWS:
        return np.full(draws, choose(time_s, longest_s))
    return held_out_choice(time_s, lambda some: choose(some, longest_s))
