"""The values that keys take in some variants of a study: those of a part."""

import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from sinsjax.errors import InputError
from sinsjax.study.keys import SECTION_OF
from sinsjax.study.resolved import Coded
from sinsjax.study.study import Study

Lookup = Callable[[str], Any]
"""The one value of a key for all variants of a part, or its draws'."""


class Variants:
    """Columns of a study for some of its variants.

    Attributes:
        ids: (variants,) their numbers in the study.
    """

    def __init__(
        self, study: Study, ids: np.ndarray, drawn: Mapping[str, np.ndarray] | None = None
    ) -> None:
        """Take the variants ``ids`` of a study, and perhaps the values of its draws."""
        self._study = study
        self._drawn = drawn or {}
        self.ids = ids

    @property
    def count(self) -> int:
        """How many they are."""
        return len(self.ids)

    @property
    def rate_hz(self) -> float:
        """Samples a second, of the study."""
        return self._study.rate_hz

    def has(self, section: str) -> bool:
        """Whether the study has a section."""
        return getattr(self._study, section) is not None

    @cached_property
    def _are_all(self) -> bool:
        return len(self.ids) == self._study.n_variants and bool(np.all(np.diff(self.ids) == 1))

    def coded(self, *keys: str) -> Coded:
        """These variants' part of a column, see `Resolved.column`."""
        whole = self._study.resolved.column(*keys)
        return whole if self._are_all else whole._replace(codes=whole.codes[self.ids])

    def raw(self, key: str) -> list[Any]:
        """Values of one key, in the file's units."""
        return self.coded(key).to_list()

    def value(self, key: str, variant: int) -> Any:
        """The value of a key for one of them, by its place among them."""
        codes, choices = self._study.resolved.column(key)
        return choices[codes[self.ids[variant]]]

    def column(self, key: str, factor: float = 1.0) -> np.ndarray:
        """Values of a numeric key times a factor, (variants,); zero for what is drawn."""
        if key in self._study.drawn_keys:
            return np.zeros(len(self.ids))
        return self.each(lambda value: math.nan if value is None else value * factor, key)

    def each(self, function: Callable[..., Any], *keys: str, dtype: Any = float) -> np.ndarray:
        """A function of the values of some keys, called once for each combination that is taken."""
        column = self.coded(*keys)
        if len(keys) == 1:
            return column.each(function, dtype)
        return column.each(lambda values: function(*values), dtype)

    def lists(self, function: Callable[..., Any], *keys: str, rest: float) -> np.ndarray:
        """The same of a function that gives lists, (variants, longest), filled up with ``rest``."""
        column = self.coded(*keys)
        made = column.map(function if len(keys) == 1 else lambda values: function(*values))
        taken = np.flatnonzero(np.bincount(made.codes, minlength=len(made.choices)))
        longest = max(len(made.choices[code]) for code in taken)
        return made.each(lambda own: [*own, *([rest] * (longest - len(own)))][:longest])

    def common(self, key: str) -> Any:
        """The one value of a key that does not differ between these variants.

        Of a drawn key, None or the draws' values, (draws, ...), if they were given.
        """
        return self._drawn[key] if key in self._drawn else self.value(key, 0)

    def takes(self, *keys: str) -> bool:
        """Whether one of some keys is drawn, or not zero; they differ between no variants."""
        drawn = self._study.drawn_keys
        return any(key in drawn or np.any(self.value(key, 0) or 0) for key in keys)

    def refused(self, key: str, why: str) -> InputError:
        """The error of a value that cannot be run, naming the study, and where the key stands."""
        study = self._study
        zipped = (f"[axes.{name}]" for name, keys in study.zips.items() if key in keys)
        where = next(zipped, "[axes]" if key in study.axes else f"[{SECTION_OF[key]}]")
        if study.cases and key in study.cases[0]:
            where = "[cases]"
        return InputError(f"{study.name}: {where} {key}: {why}")
