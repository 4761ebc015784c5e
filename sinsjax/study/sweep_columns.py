"""The columns of a sweep: the distinct values of its keys, and a code per variant.

A sweep repeats few values many times. Functions of a value are therefore evaluated once for each
distinct value, or each distinct combination, and expanded over the variants by NumPy.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

Dimension = dict[str, tuple[Any, ...]]
"""Values by key, which vary together; a sweep is the product of its dimensions."""


class CodedColumn(NamedTuple):
    """A column as a code per variant, (variants,), and the distinct values, in the file's units."""

    codes: np.ndarray
    choices: tuple[Any, ...]

    def __eq__(self, other: object) -> bool:
        """Return whether a column has the same values; studies that cache columns are compared."""
        if not isinstance(other, CodedColumn):
            return False
        return self.choices == other.choices and np.array_equal(self.codes, other.codes)

    def map(self, function: Callable[[Any], Any]) -> "CodedColumn":
        """Return the column of a function of the values."""
        return CodedColumn(self.codes, tuple(map(function, self.choices)))

    def expand(self, dtype: Any = float) -> np.ndarray:
        """Return the values as an array, (variants, ...)."""
        values = np.asarray(self.choices, dtype)
        if len(values) == 1:  # most columns
            return np.broadcast_to(values[0], (len(self.codes), *values.shape[1:]))
        return values[self.codes]

    def compute(self, function: Callable[[Any], Any], dtype: Any = float) -> np.ndarray:
        """Return a function of the values, called once per distinct value; (variants, ...)."""
        return self.map(function).expand(dtype)

    def take(self, ids: np.ndarray) -> "CodedColumn":
        """Return the column of some variants, without choices that none of them has."""
        codes = self.codes[ids]
        present = np.flatnonzero(np.bincount(codes, minlength=len(self.choices)))
        code_of = np.zeros(len(self.choices), np.int32)
        code_of[present] = np.arange(len(present))
        return CodedColumn(code_of[codes], tuple(self.choices[code] for code in present))

    def merged(self) -> "CodedColumn":
        """Return the column with one code for equal choices."""
        code_of = {choice: code for code, choice in enumerate(dict.fromkeys(self.choices))}
        merged = np.array([code_of[choice] for choice in self.choices], np.int32)
        return CodedColumn(merged[self.codes], tuple(code_of))

    def to_list(self) -> list[Any]:
        """Return the values, one per variant."""
        return list(map(self.choices.__getitem__, self.codes.tolist()))


def iter_points(dimensions: Sequence[Dimension], keys: Collection[str]) -> Iterator[dict[str, Any]]:
    """Yield the distinct combinations of some keys in a product, the last dimension fastest."""
    parts = []
    for dimension in dimensions:
        present = [key for key in dimension if key in keys]
        rows = dict.fromkeys(_rows(dimension, keys))
        parts.append([dict(zip(present, row, strict=True)) for row in rows])
    for combination in product(*parts):
        yield {key: value for part in combination for key, value in part.items()}


def point_codes(dimensions: Sequence[Dimension], keys: Collection[str]) -> np.ndarray:
    """Return the index in `iter_points` of the combination of each variant; (variants,)."""
    codes = np.zeros(1, np.int32)
    for dimension in dimensions:
        rows = _rows(dimension, keys)
        code_of = {row: code for code, row in enumerate(dict.fromkeys(rows))}
        of_rows = np.array([code_of[row] for row in rows], np.int32)
        codes = np.add.outer(codes * len(code_of), of_rows).ravel()
    return codes


def _rows(dimension: Dimension, keys: Collection[str]) -> list[tuple[Any, ...]]:
    """Return the values of the keys that a dimension has, a row for each of its points."""
    present = [values for key, values in dimension.items() if key in keys]
    return list(zip(*present, strict=True)) or [()] * len(next(iter(dimension.values())))
