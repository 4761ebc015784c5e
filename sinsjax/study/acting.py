"""Which keys of a study act on a run, as its sections and methods tell it."""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from sinsjax.alignment.description import INITIAL_KEYS
from sinsjax.alignment.methods import METHODS
from sinsjax.study.keys import SECTION_OF, SECTIONS
from sinsjax.study.resolved import Coded, distinct
from sinsjax.study.study import Study
from sinsjax.value_types import ActsWhere

_COARSE = ("coarse_method", "coarse_then")


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
    return len(readers(key)) == len(METHODS)


def readers(key: str) -> tuple[str, ...]:
    """The methods that a key acts on; all of them where no method claims it."""
    methods = METHODS.values()
    if not any(key in method.keys for method in methods):
        return tuple(METHODS)
    return tuple(m.name for m in methods if key in m.keys and key not in m.silent)


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


def silent(study: Study, key: str) -> np.ndarray:
    """(variants,) whether a swept key does not act on a variant."""
    column = _acting_column(study, key)
    return column.each(lambda value: not value, bool)


def first_alike(study: Study) -> np.ndarray:
    """(variants,) the first variant that is equal to each in every key that acts.

    One that no key tells from an earlier one has the same runs: ``reset_count = 0`` is one schedule
    whatever the cycle. The label of a case is no key.
    """
    alike = np.zeros(study.n_variants, np.int64)
    for key in study.axis_keys:
        if key != "case":
            column = _acting_column(study, key)
            alike = distinct(alike * len(column.choices) + column.codes)[1]
    _, first = np.unique(alike, return_index=True)
    return first[alike]


def idle_keys(study: Study) -> list[str]:
    """The swept keys whose values differ between variants with the same runs."""
    first = first_alike(study)
    told = {key: study.values(key) for key in study.axis_keys if key != "case"}
    return [k for k, v in told.items() if any(v[i] != v[at] for i, at in enumerate(first))]


def _acting_column(study: Study, key: str) -> Coded:
    """Values of a key over the variants, those that do not act being one value of their own."""
    coarse = _COARSE if key in INITIAL_KEYS and study.coarse else ()
    keys = tuple(dict.fromkeys((key, *deciding(key), *coarse)))

    def value(values: tuple[Any, ...]) -> tuple[Any, ...]:
        told = dict(zip(keys, values, strict=True))
        # What coarse alignment finds takes the place of what is given.
        found = coarse and study.has_coarse_stage(*(told[key] for key in coarse))
        return (told[key],) if acts(key, told) and not found else ()

    codes, choices = study.resolved.column(*keys).map(value if len(keys) > 1 else lambda v: (v,))
    place = {choice: code for code, choice in enumerate(dict.fromkeys(choices))}
    return Coded(np.asarray([place[choice] for choice in choices])[codes], tuple(place))
