"""Values for the keys of a schema: valid ones, derived from its types, and invalid ones."""

import copy
import datetime
import functools
import typing
from collections.abc import Mapping
from typing import Any, Literal, get_args, get_origin

from hypothesis import strategies as st
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from sinsjax.value_types import key_info

Strategy = st.SearchStrategy[Any]

NUMBERS = [
    *(0, 1, -1, 2, 3, 10, 100, 2**31, 2**53, 2**63, -(2**63), 2**64, 10**30, 10**400),
    *(0.0, -0.0, 0.5, 1e-3, 1e-12, 1e-300, 5e-324, 1e9, 1e12, 1e13, 1e300, 1.7976931348623157e308),
    *(-1e12, -1e300, float("inf"), float("-inf"), float("nan"), True, False),
]

TEXTS = [
    *("", " ", "\n", "a\nb", "\x00", "\x1b[31mred", "x" * 10_000, "é", "\u202eright", "\U0001f600"),
    *("[/b]", "[bold]", "[red", "<script>alert(1)</script>"),
    *("$x^$", "$$", "\\frac{", "%s%n", "{0}"),
    *("../../etc/passwd", "/", "~", "~nosuchuser/x", "none", "nan", "inf", "None", "true", "0x1F"),
    *("{{7*7}}", "`|`", "a|b", "|", "#", "&amp;", "'", '"', '"""', "\ud800"[:0] + "\ufffd"),
]


def _nest(depth: int, kind: str) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value] if kind == "list" else {"a": value}
    return value


@functools.cache
def misfit_values() -> Strategy:
    """Return a strategy for values that hardly any key accepts."""
    nested = [_nest(depth, kind) for depth in (5, 60) for kind in ("list", "table")]
    dates = [datetime.date(2026, 1, 1), datetime.time(1, 2), datetime.datetime(1, 1, 1)]
    names = st.sampled_from(["low", "high", "uniform", "a", ""])
    some = st.one_of(
        st.sampled_from([*NUMBERS, *TEXTS]),
        st.floats(),
        st.integers(),
        st.text(max_size=8),
        st.sampled_from([[], {}, [[]], [{}], {"a": 1}, [1, "a"], [None], [1, [2, [3]]]]),
        st.lists(st.floats(), max_size=4),
        st.lists(st.sampled_from([*NUMBERS, *TEXTS]), max_size=4),
        st.dictionaries(names, st.floats(), max_size=3),
        st.sampled_from([*nested, *dates]),
        st.builds(lambda n: [0.5] * n, st.sampled_from([1, 2, 7, 100, 3000])),
    )
    return some.map(copy.deepcopy)  # what one edit puts in, the next one may change


@functools.cache
def _leaves(annotation: Any) -> frozenset[Any]:
    """Return the types and literals within a type, such as float and "auto"."""
    if get_origin(annotation) is Literal:
        return frozenset(get_args(annotation))
    parts = get_args(annotation)[: 1 if get_origin(annotation) is typing.Annotated else None]
    return frozenset().union(*map(_leaves, parts)) if parts else frozenset([annotation])


@functools.cache
def _values_of_leaf(leaf: Any, low: float, high: float) -> Strategy:
    numbers = [x for x in (0.0, 0.01, 0.5, 1.0, 2.0, 6.0, 30.0, 600.0) if low <= x <= high]
    if leaf is float:  # half of them are those at which rules between keys hold
        return st.floats(low, high) | st.sampled_from([*numbers, low, high])
    if leaf is int:
        return st.integers(int(low), int(high)) | st.integers(0, 8)
    if leaf in (bool, str):
        return st.booleans() if leaf is bool else st.text(max_size=6) | st.sampled_from(TEXTS)
    if isinstance(leaf, type):
        return draw_table(leaf.model_fields) if issubclass(leaf, BaseModel) else misfit_values()
    return st.just(leaf) if isinstance(leaf, str) else misfit_values()


def values_of_field(field: FieldInfo) -> Strategy:
    """Return a strategy for values of a key according to its type, most of them valid."""
    low, high = key_info(field).usual_range or (0.0, 1e12)
    leaves = sorted(_leaves(field.annotation) - {type(None), Ellipsis}, key=repr)
    one = st.one_of([_values_of_leaf(leaf, low, high) for leaf in leaves])
    text = repr(field.annotation)
    if "dict" in text:
        return st.dictionaries(st.text(max_size=4), one, max_size=2)
    return one | st.lists(one, max_size=4) if "tuple" in text else one


def draw_table(fields: Mapping[str, FieldInfo], most: int = 4) -> Strategy:
    """Return a strategy for tables of a section with all required keys."""

    @st.composite
    def some(draw: st.DrawFn) -> dict[str, Any]:
        needed = [key for key, field in fields.items() if field.is_required()]
        keys = draw(st.lists(st.sampled_from(sorted(fields)), max_size=most, unique=True))
        return {key: draw(values_of_field(fields[key])) for key in dict.fromkeys([*needed, *keys])}

    return some()
