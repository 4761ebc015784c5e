"""Which keys of a study act on a run, as its sections and methods tell it."""

from collections.abc import Mapping
from functools import cache
from typing import Any

from sinsjax.alignment.methods import METHODS
from sinsjax.study.study import SECTION_OF, SECTIONS
from sinsjax.value_types import ActsWhere


@cache
def conditions(key: str) -> tuple[ActsWhere, ...]:
    """The conditions of its section for a key to act."""
    section = SECTIONS[SECTION_OF[key]]
    return tuple(condition for condition in section.conditions if key in condition.keys)


@cache
def deciding(key: str) -> tuple[str, ...]:
    """The keys whose values decide whether a key acts."""
    own = (given for condition in conditions(key) for given in condition.given)
    return tuple(dict.fromkeys([*([] if _of_all(key) else ["method"]), *own]))


@cache
def _of_all(key: str) -> bool:
    """Whether a key acts whatever the method."""
    methods = METHODS.values()
    return not any(key in method.keys for method in methods) or all(
        key in method.keys and key not in method.silent for method in methods
    )


def acts(key: str, values: Mapping[str, Any]) -> bool:
    """Whether a key acts on a run with some values of the keys that decide it.

    Args:
        key: leaf key.
        values: of the keys of `deciding`; None of a drawn one.
    """
    if not _of_all(key):
        method = METHODS[values["method"]]
        if key not in method.keys or key in method.silent:
            return False
    return all(c.acts(*(values[given] for given in c.given)) for c in conditions(key))
