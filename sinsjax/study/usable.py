"""Methods that a study names and that another package brings, but not as it should."""

from collections.abc import Iterator, Mapping
from typing import Any

from sinsjax.alignment.methods import BROKEN, METHODS
from sinsjax.errors import InputError


def check_usable(data: Any) -> None:
    """Refuses a study with a method that cannot be used, before its keys are looked at.

    Args:
        data: of the study, as it was read.

    Raises:
        InputError: says why.
    """
    for name in sorted({*_methods(data)} & (BROKEN.keys() - METHODS.keys())):
        raise InputError(f"[alignment] method: {name!r} cannot be used: {BROKEN[name]}")


def _methods(data: Any, key: str = "") -> Iterator[str]:
    """All words under keys called ``method``, be they values, axes or cases."""
    if isinstance(data, Mapping):
        for name, value in data.items():
            yield from _methods(value, name)
    elif isinstance(data, list | tuple):
        for value in data:
            yield from _methods(value, key)
    elif key == "method" and isinstance(data, str):
        yield data
