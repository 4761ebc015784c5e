"""Short displays of an object as text, for interactive sessions and notebooks."""

from collections.abc import Mapping, Sequence
from typing import Any

from sinsjax.messages import escape_controls, shorten

WIDTH = 80
"""Longest line of a text, in characters."""

_MAX_LISTED_VALUES = 3
"""Number of values up to which an axis shows all of them."""


def format_text(title: str, facts: Mapping[str, str]) -> str:
    """Return a title and facts, short texts by name, one line each."""
    width = max(map(len, facts))
    lines = (title, *(f"  {name:<{width}}  {fact}" for name, fact in facts.items()))
    return "\n".join(shorten(escape_controls(line), WIDTH) for line in lines)


def describe_axis(keys: Sequence[str], values: Sequence[Any]) -> str:
    """Return an axis in words: its keys, the range of its values and their number.

    Args:
        keys: keys that identify the points of the axis.
        values: their values; tuples for several keys.

    Returns:
        For example ``phi_u0_deg 0..120 (8)``, ``turn flip, fold`` or ``case (6)``.
    """
    first, *others = keys
    if others:
        return f"{first} and {len(others)} more ({len(values)})"
    numeric = [isinstance(value, int | float) and not isinstance(value, bool) for value in values]
    texts = [f"{v:g}" if number else str(v) for v, number in zip(values, numeric, strict=True)]
    short = (number or t.isidentifier() for number, t in zip(numeric, texts, strict=True))
    if len(texts) <= _MAX_LISTED_VALUES and all(short):
        return f"{first} {', '.join(texts)}"
    if all(numeric):
        return f"{first} {min(values):g}..{max(values):g} ({len(values)})"
    return f"{first} ({len(values)})"
