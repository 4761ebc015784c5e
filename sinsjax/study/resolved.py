"""The values that a study's keys take, variant by variant."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sinsjax.study.study import Study

Lookup = Callable[[str], Any]
"""The one value of a key for all variants of a part, or its draws'."""


class Variants:
    """Values of a study's sweepable keys, for some of its variants.

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

    def raw(self, key: str) -> list[Any]:
        """Values of one key, in the file's units."""
        values = self._study.values(key)
        return [values[i] for i in self.ids]

    def column(self, key: str, factor: float = 1.0) -> np.ndarray:
        """Values of a numeric key times a factor, (variants,); zero for what is drawn."""
        if key in self._study.drawn_keys:
            return np.zeros(len(self.ids))
        return np.asarray(self.raw(key), dtype=float) * factor

    def common(self, key: str) -> Any:
        """The one value of a key that does not differ between these variants.

        Of a drawn key, None or the draws' values, (draws, ...), if they were given.
        """
        return self._drawn[key] if key in self._drawn else self._study.values(key)[self.ids[0]]
