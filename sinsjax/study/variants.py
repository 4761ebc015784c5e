"""The values that keys take in some variants of a study: those of a part."""

import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np

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

    @cached_property
    def _are_all(self) -> bool:
        return len(self.ids) == self._study.n_variants and bool(np.all(np.diff(self.ids) == 1))

    def of(self, column: Coded) -> Coded:
        """These variants' part of a column."""
        return column if self._are_all else column._replace(codes=column.codes[self.ids])

    def coded(self, *keys: str) -> Coded:
        """See `Resolved.column`."""
        return self.of(self._study.resolved.column(*keys))

    def raw(self, key: str) -> list[Any]:
        """Values of one key, in the file's units."""
        return self.coded(key).to_list()

    def column(self, key: str, factor: float = 1.0) -> np.ndarray:
        """Values of a numeric key times a factor, (variants,); zero for what is drawn."""
        if key in self._study.drawn_keys:
            return np.zeros(len(self.ids))
        column = self.coded(key)
        return column.each(lambda value: math.nan if value is None else value * factor)

    def common(self, key: str) -> Any:
        """The one value of a key that does not differ between these variants.

        Of a drawn key, None or the draws' values, (draws, ...), if they were given.
        """
        if key in self._drawn:
            return self._drawn[key]
        codes, choices = self._study.resolved.column(key)
        return choices[codes[self.ids[0]]]
