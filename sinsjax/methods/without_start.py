"""Descriptions of methods that need no initial attitude and read a record once. Free of JAX."""

from functools import partial
from typing import Any

from sinsjax.methods.description import COMMON_KEYS, INITIAL_KEYS, CheckedStudy, Description


def describe_without_start(*, name: str, **parts: Any) -> Description:
    """Return the `Description` of a method that needs no initial attitude and reads a record once.

    Args:
        name: of the method.
        parts: all other fields but those of keys; its own rules come last.
    """
    rules = (partial(_check_passes, name), partial(_check_coarse, name), *parts.pop("rules", ()))
    return Description(
        name=name,
        reads=INITIAL_KEYS,
        without_effect=(*INITIAL_KEYS, *COMMON_KEYS),
        rules=rules,
        **parts,
    )


def _check_passes(name: str, study: CheckedStudy) -> None:
    """Refuse repeated passes, which add no information."""
    if not study.has("passes"):
        return
    for point in study.combinations("method", "stored_s"):
        if point["method"] == name and point["stored_s"] is not None:
            text = f"does not apply to method {name}, which reads a record once (drop it)"
            study.refuse("stored_s", text)


def _check_coarse(name: str, study: CheckedStudy) -> None:
    """Refuse coarse alignment before a method that needs no initial attitude."""
    if study.is_recorded or not study.has("coarse"):
        return
    for point in study.combinations("method", "coarse_method"):
        if point["method"] == name and point["coarse_method"] != "none":
            text = f"method {name} needs no coarse alignment (give 'none')"
            study.refuse("coarse_method", text)
