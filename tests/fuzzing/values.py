"""Values for the keys of a schema: of its usual range, or hardly accepted by any."""

import copy
import datetime
import functools
import typing
from collections.abc import Mapping
from typing import Any, Literal, get_args, get_origin

from hypothesis import strategies as st
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
    *(
        "[/b]",
        "[bold]",
        "[red",
        "<script>alert(1)</script>",
        "$x^$",
        "$$",
        "\\frac{",
        "%s%n",
        "{0}",
    ),
    *("../../etc/passwd", "/", "~", "~nosuchuser/x", "none", "nan", "inf", "None", "true", "0x1F"),
    *("{{7*7}}", "`|`", "a|b", "|", "#", "&amp;", "'", '"', '"""', "\ufffd"),
]


@functools.cache
def misfit_values() -> Strategy:
    """Return a strategy for values that hardly any key accepts."""
    leaf = st.sampled_from([*NUMBERS, *TEXTS]) | st.floats() | st.integers() | st.text(max_size=8)
    deep = [functools.reduce(lambda value, _: [value], range(60), 1)]
    deep += [functools.reduce(lambda value, _: {"a": value}, range(60), 1)]
    dates = [datetime.date(2026, 1, 1), datetime.time(1, 2), datetime.datetime(1, 1, 1)]
    odd = st.sampled_from([[], {}, [[]], [{}], [None], *deep, *dates, [0.5] * 3000])
    names = st.sampled_from(["low", "high", "uniform", "a", ""])
    tables = st.dictionaries(names, leaf, max_size=3)
    some = leaf | leaf | odd | tables | st.lists(leaf | st.lists(leaf, max_size=2), max_size=4)
    return some.map(copy.deepcopy)  # what one edit puts in, the next one may change


def _words(annotation: Any) -> list[Any]:
    """Return the literals within a type, such as "auto"."""
    if get_origin(annotation) is Literal:
        return [*get_args(annotation)]
    parts = get_args(annotation)[: 1 if get_origin(annotation) is typing.Annotated else None]
    return [word for part in parts for word in _words(part)]


def values_of_field(field: FieldInfo) -> Strategy:
    """Return a strategy for values of a key: its words, or numbers of its usual range."""
    low, high = key_info(field).usual_range or (0.0, 1e12)
    # At half of the numbers rules between keys hold.
    round_ones = [x for x in (0.0, 0.01, 0.5, 1.0, 2.0, 6.0, 30.0, 600.0) if low <= x <= high]
    one = st.floats(low, high) | st.sampled_from([*round_ones, low, high]) | st.integers(0, 8)
    if words := _words(field.annotation):
        one = st.sampled_from(words) | st.sampled_from(words) | one
    text = repr(field.annotation)
    if "str" in text or "bool" in text:
        one |= st.booleans() | st.text(max_size=6) | st.sampled_from(TEXTS)
    return one | st.lists(one, max_size=4) if "tuple" in text else one


@st.composite
def draw_table(draw: st.DrawFn, fields: Mapping[str, FieldInfo]) -> dict[str, Any]:
    """Draw a table of a section with all required keys and some others."""
    needed = [key for key, field in fields.items() if field.is_required()]
    keys = draw(st.lists(st.sampled_from(sorted(fields)), max_size=4, unique=True))
    return {key: draw(values_of_field(fields[key])) for key in dict.fromkeys([*needed, *keys])}
