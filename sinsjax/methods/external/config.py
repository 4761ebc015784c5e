"""A program outside sinsjax as studies and results know it: a name, without keys or code."""

from typing import Any

from sinsjax.methods.description import COMMON_KEYS, INITIAL_KEYS, Description, Implementation
from sinsjax.methods.parameters import Columns


def parameters(columns: Columns, site: Any, ug: float) -> Any:
    """Return no params."""
    return ()


def _load() -> Implementation:
    from sinsjax.methods.external.method import build

    return Implementation(build, parameters)


def describe_external(name: str) -> Description:
    """Return the description of a program by the name that its results are stored under."""
    return Description(
        name=name,
        summary="a program outside sinsjax, whose results were scored",
        source="`sinsjax score`",
        sections={},
        reads=INITIAL_KEYS,
        load=_load,
        without_effect=COMMON_KEYS,
        is_external=True,
    )
