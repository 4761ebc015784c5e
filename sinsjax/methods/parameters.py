"""The keys of a study's variants as columns, from which a method makes its params.

Params are in SI units with leaves (variants, ...). A method knows nothing else of studies.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from sinsjax.errors import InputError


@runtime_checkable
class Columns(Protocol):
    """Values of the keys of one method over some variants, in the units of the study."""

    @property
    def count(self) -> int:
        """Number of variants."""
        ...

    @property
    def rate_hz(self) -> float:
        """Samples per second."""
        ...

    def has(self, section: str) -> bool:
        """Return whether the study has a section; its keys may be read only then."""
        ...

    def common(self, key: str) -> Any:
        """Return the value of a key that is the same for all variants."""
        ...

    def value(self, key: str, variant: int) -> Any:
        """Return the value of a key for one variant, by its place among them."""
        ...

    def column(self, key: str, factor: float = 1.0) -> np.ndarray:
        """Return numbers times a factor, (variants,); NaN if the key is left out."""
        ...

    def rms(self, key: str) -> np.ndarray:
        """Return the size of a numeric key, (variants,): rms over draws of the largest axis."""
        ...

    def compute(self, function: Callable[..., Any], *keys: str, dtype: Any = float) -> np.ndarray:
        """Return a function of the values of some keys, (variants, ...)."""
        ...

    def padded_lists(self, function: Callable[..., Any], *keys: str, padding: float) -> np.ndarray:
        """Return lists of a function of some keys, (variants, longest), padded with ``padding``."""
        ...

    def input_error(self, key: str, reason: str) -> InputError:
        """Return the error of a value that cannot be run, with study and place of the key."""
        ...


def column_with_default(columns: Columns, key: str, default: float) -> np.ndarray:
    """Return a numeric key, (variants,); the default if a variant leaves it out."""
    return columns.compute(lambda value: default if value is None else value, key)


def times_in_samples(
    columns: Columns, times_s: Callable[..., tuple[float, ...]], *keys: str
) -> np.ndarray:
    """Return times in samples from a function of keys, (variants, longest); inf for none."""
    rate = columns.rate_hz
    return columns.padded_lists(
        lambda *values: np.round(np.asarray(times_s(*values)) * rate).tolist(),
        *keys,
        padding=np.inf,
    )
