"""The axes of a study as a reader counts them."""

from typing import Any

from sinsjax.errors import InputError
from sinsjax.study.study import Study


def swept(study: Study) -> dict[tuple[str, ...], tuple[Any, ...]]:
    """What a study sweeps as a reader counts it: the values of each axis by the keys that tell it.

    Keys that go together, in cases or in axes, are one axis. It is told by the label or the first
    of its keys if no two of its points share that value, else by all of them, and by tuples then.
    """
    axes: dict[tuple[str, ...], tuple[Any, ...]] = {}
    for dimension in study.dimensions:
        first, values = next(iter(dimension.items()))
        if len(set(values)) == len(values):
            axes[(first,)] = tuple(values)
        else:
            axes[tuple(dimension)] = tuple(zip(*dimension.values(), strict=True))
    return axes


def shown_keys(study: Study) -> tuple[str, ...]:
    """The swept keys that tell variants apart, see `swept`."""
    return tuple(key for keys in swept(study) for key in keys)


def only(study: Study, key: str) -> Any:
    """The one value of a key.

    Raises:
        InputError: the study sweeps it.
    """
    first, *rest = study.combinations(key)
    if rest:
        raise InputError(f"{study.name}: one {key} is needed, not a sweep of it")
    return first[key]


def shown_axes(study: Study) -> tuple[dict[str, tuple[Any, ...]], list[str]]:
    """The axes of a study's figures with their values, and all other swept keys.

    They are the first two swept numbers; without any the first key whose values are lists, such as
    reset times.
    """
    numeric, listed = {}, {}
    for (key, *more), values in swept(study).items():
        if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
            numeric[key] = tuple(map(float, values))
        elif not more and all(isinstance(v, tuple) for v in values):
            listed[key] = values
    shown = dict([*numeric.items()][:2] or [*listed.items()][:1])
    return shown, [key for key in shown_keys(study) if key not in shown]
