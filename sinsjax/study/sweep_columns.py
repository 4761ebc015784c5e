"""The columns of a sweep: the distinct values of its keys, and a code per variant.

A sweep repeats few values many times. Functions of a value are therefore evaluated once for each
distinct value, or each distinct combination, and expanded over the variants by NumPy.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

Dimension = dict[str, tuple[Any, ...]]


class CodedColumn(NamedTuple):
    """A dictionary-coded column.

    Attributes:
        codes: (variants,) index of each variant's value in ``choices``.
        choices: the distinct values, in the units of the file.
    """

    codes: np.ndarray
    choices: tuple[Any, ...]

    def compute(self, function: Callable[[Any], Any], dtype: Any = float) -> np.ndarray:
        """Return a function of the values, called once per distinct value; (variants, ...)."""
        results = np.asarray([function(value) for value in self.choices], dtype)
        if len(results) == 1:  # most columns
            return np.broadcast_to(results[0], (len(self.codes), *results.shape[1:]))
        return results[self.codes]

    def map(self, function: Callable[[Any], Any]) -> "CodedColumn":
        """Return the column of a function of the values."""
        return CodedColumn(self.codes, tuple(map(function, self.choices)))

    def merged(self) -> "CodedColumn":
        """Return the column with one code for equal choices."""
        code_of = {choice: code for code, choice in enumerate(dict.fromkeys(self.choices))}
        merged = np.array([code_of[choice] for choice in self.choices], np.int32)
        return CodedColumn(merged[self.codes], tuple(code_of))

    def to_list(self) -> list[Any]:
        """Return the values, one per variant."""
        return list(map(self.choices.__getitem__, self.codes.tolist()))


def constant_column(count: int, value: Any) -> CodedColumn:
    """Return the column of one value for some variants."""
    return CodedColumn(np.zeros(count, np.int32), (value,))


class SweepColumns:
    """The columns of a study, each computed at its first use."""

    def __init__(self, dimensions: Sequence[Dimension], constant: Callable[[str], Any]) -> None:
        """Take a sweep as the product of its dimensions.

        Args:
            dimensions: values by key, the slowest first; the keys of a dimension vary together.
            constant: function that returns the value of a key outside all dimensions.
        """
        lengths = [len(next(iter(dimension.values()))) for dimension in dimensions]
        self._dimensions, self._constant = dimensions, constant
        self._repeats = [math.prod(lengths[i + 1 :]) for i in range(len(lengths))]
        self.n_variants = math.prod(lengths)
        self._cache: dict[tuple[str, ...], CodedColumn] = {}
        self._derived: dict[tuple[str, ...], CodedColumn] = {}

    def derive(
        self,
        keys: Sequence[str],
        inputs: Sequence[str],
        function: Callable[[dict[str, Any]], dict[str, Any]],
    ) -> None:
        """Replace the columns of some keys by functions of others, and of themselves.

        Args:
            keys: keys to replace.
            inputs: keys that they depend on.
            function: values of the inputs by key -> values of the keys.
        """
        codes, choices = self.column(*inputs)
        points = [function(dict(zip(inputs, values, strict=True))) for values in choices]
        for key in keys:
            values = tuple(point[key] for point in points)
            self._derived[(key,)] = CodedColumn(codes, values).merged()
        self._cache = {**self._derived}

    def column(self, *keys: str) -> CodedColumn:
        """Return the column of a key, or of the combinations of several keys, as tuples.

        Raises:
            KeyError: no sweepable section of the study has the key.
        """
        if keys not in self._cache:
            self._cache[keys] = (
                self._single_column(*keys) if len(keys) == 1 else self._joint_column(keys)
            )
        return self._cache[keys]

    def _single_column(self, key: str) -> CodedColumn:
        for dimension, repeats in zip(self._dimensions, self._repeats, strict=True):
            if key in dimension:
                count = len(dimension[key])
                once = CodedColumn(np.arange(count), dimension[key]).merged()
                repetitions = self.n_variants // (repeats * count)
                codes = np.tile(np.repeat(once.codes, repeats), repetitions)
                return CodedColumn(codes, once.choices)
        return constant_column(self.n_variants, self._constant(key))

    def _joint_column(self, keys: Sequence[str]) -> CodedColumn:
        columns = [self.column(key) for key in keys]
        mixed, sizes = np.zeros(self.n_variants, np.int64), [len(c.choices) for c in columns]
        for column, size in zip(columns, sizes, strict=True):
            mixed = mixed * size + column.codes if size > 1 else mixed
        present, codes = unique_with_inverse(mixed, math.prod(sizes))
        places = zip(*(p.tolist() for p in np.unravel_index(present, sizes)), strict=True)
        choices = [tuple(c.choices[i] for c, i in zip(columns, p, strict=True)) for p in places]
        return CodedColumn(codes, tuple(choices))


def unique_with_inverse(
    numbers: np.ndarray, upper_bound: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct values of integers below ``upper_bound``, and the index of each."""
    if upper_bound is None or upper_bound > 8 * len(numbers):
        return np.unique(numbers, return_inverse=True)
    if upper_bound == 1:
        return np.zeros(1, int), numbers
    present = np.flatnonzero(
        np.bincount(numbers, minlength=upper_bound)
    )  # much faster than sorting
    index_of = np.zeros(upper_bound, np.int32)
    index_of[present] = np.arange(len(present))
    return present, index_of[numbers]
