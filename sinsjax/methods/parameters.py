"""What a method is told of a study: columns of its variants, which it takes to SI.

A method turns them into its own numbers, leaves (variants, ...), and knows nothing else of studies.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from sinsjax.errors import InputError


@runtime_checkable
class Columns(Protocol):
    """Values that keys take over some variants, in the units of the file; keys of one method."""

    @property
    def count(self) -> int:
        """How many variants there are."""
        ...

    @property
    def rate_hz(self) -> float:
        """Samples a second."""
        ...

    def has(self, section: str) -> bool:
        """Whether the study has a section; without it none of its keys may be asked for."""
        ...

    def common(self, key: str) -> Any:
        """The value of a key that is the same for all of them."""
        ...

    def value(self, key: str, variant: int) -> Any:
        """The value of a key for one of them, by its place among them."""
        ...

    def column(self, key: str, factor: float = 1.0) -> np.ndarray:
        """Numbers times a factor, (variants,); NaN where the key is left out."""
        ...

    def each(self, function: Callable[..., Any], *keys: str, dtype: Any = float) -> np.ndarray:
        """A function of the values of some keys, (variants, ...)."""
        ...

    def lists(self, function: Callable[..., Any], *keys: str, rest: float) -> np.ndarray:
        """The same of a function that gives lists, (variants, longest), filled up with ``rest``."""
        ...

    def refused(self, key: str, why: str) -> InputError:
        """The error of a value that cannot be run, naming the study, and where the key stands."""
        ...


def column_or(columns: Columns, key: str, default: float) -> np.ndarray:
    """Values of a numeric key, (variants,); the default where a variant leaves it out."""
    return columns.each(lambda value: default if value is None else value, key)


def in_samples(
    columns: Columns, times_s: Callable[..., tuple[float, ...]], *keys: str
) -> np.ndarray:
    """(variants, longest) times in samples, from a function of keys; inf where there are fewer."""
    rate = columns.rate_hz
    return columns.lists(
        lambda *values: np.round(np.asarray(times_s(*values)) * rate).tolist(), *keys, rest=np.inf
    )
