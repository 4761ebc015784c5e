"""Values for the keys of a schema: valid ones, derived from its types, and invalid ones."""

import copy
import datetime
import functools
import itertools
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from hypothesis import strategies as st
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from sinsjax.value_types import KeyInfo, key_info

Strategy = st.SearchStrategy[Any]

_CLOSED = 1e-9  # inside of an open bound, relatively

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


_fields: dict[int, Strategy] = {}


def values_of_field(field: FieldInfo) -> Strategy:
    """Return a strategy for values that a key accepts, according to its type."""
    if id(field) not in _fields:  # which live as long as the schema
        _fields[id(field)] = values_of_type(field.annotation, (*field.metadata, key_info(field)))
    return _fields[id(field)]


def values_of_type(annotation: Any, metadata: tuple[Any, ...] = ()) -> Strategy:
    """Return a strategy for values of a type with its bounds."""
    while get_origin(annotation) is typing.Annotated:
        annotation, *more = get_args(annotation)
        fields = (extra.metadata if isinstance(extra, FieldInfo) else [extra] for extra in more)
        metadata = (*metadata, *itertools.chain.from_iterable(fields))
    made = _PLAIN.get(annotation)
    if made is not None:
        return made(metadata)
    origin, inside = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return st.sampled_from(inside)
    if origin in (Union, types.UnionType):
        parts = [part for part in inside if part is not type(None)]
        return st.one_of([values_of_type(part, metadata) for part in parts])
    if origin is tuple:
        usual = tuple(m for m in metadata if isinstance(m, KeyInfo))
        if Ellipsis in inside:
            most = next((m.max_length for m in metadata if isinstance(m, MaxLen)), 4)
            least = next((m.min_length for m in metadata if isinstance(m, MinLen)), 0)
            return st.lists(
                values_of_type(inside[0], usual), min_size=least, max_size=max(4, least, most)
            )
        return st.tuples(*(values_of_type(part, usual) for part in inside)).map(list)
    if origin is dict:
        return st.dictionaries(st.text(max_size=4), values_of_type(inside[1]), max_size=2)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return draw_table(annotation.model_fields)
    return misfit_values()


def draw_table(fields: Mapping[str, FieldInfo], most: int = 4) -> Strategy:
    """Return a strategy for tables of a section with all required keys and valid values."""
    needed = {key: values_of_field(field) for key, field in fields.items() if field.is_required()}

    @st.composite
    def some(draw: st.DrawFn) -> dict[str, Any]:
        keys = draw(st.lists(st.sampled_from(sorted(fields)), max_size=most, unique=True))
        made = {key: draw(strategy) for key, strategy in needed.items()}
        return made | {key: draw(values_of_field(fields[key])) for key in keys}

    return some()


def _bounds(metadata: tuple[Any, ...], low: float, high: float) -> tuple[float, float]:
    for rule in metadata:
        if isinstance(rule, Ge):
            low = max(low, float(rule.ge))  # type: ignore[arg-type]
        elif isinstance(rule, Gt):
            least = float(rule.gt)  # type: ignore[arg-type]
            low = max(low, least + _CLOSED * max(1.0, abs(least)))
        elif isinstance(rule, Le):
            high = min(high, float(rule.le))  # type: ignore[arg-type]
        elif isinstance(rule, Lt):
            most = float(rule.lt)  # type: ignore[arg-type]
            high = min(high, most - _CLOSED * max(1.0, abs(most)))
        elif isinstance(rule, KeyInfo) and rule.usual_range:
            low, high = max(low, rule.usual_range[0]), min(high, rule.usual_range[1])
    return low, high


def _floats(metadata: tuple[Any, ...]) -> Strategy:
    low, high = _bounds(metadata, -1e12, 1e12)
    handy = [x for x in (0.0, 0.01, 0.5, 1.0, 2.0, 6.0, 30.0, 600.0) if low <= x <= high]
    # Half of them are those at which rules between keys hold.
    return st.floats(low, high) | st.sampled_from([*handy, low, high])


def _integers(metadata: tuple[Any, ...]) -> Strategy:
    low, high = map(int, _bounds(metadata, -(2.0**40), 2.0**40))
    return st.integers(low, high) | st.integers(max(low, 0), min(high, 8))


_PLAIN: dict[Any, Callable[[tuple[Any, ...]], Strategy]] = {
    float: _floats,
    int: _integers,
    bool: lambda metadata: st.booleans(),
    str: lambda metadata: st.text(min_size=1, max_size=6) | st.sampled_from(TEXTS),
}
