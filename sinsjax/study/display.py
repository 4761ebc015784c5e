"""Short displays of an object as text, for interactive sessions and notebooks."""

from collections.abc import Mapping, Sequence
from typing import Any

from sinsjax.messages import escape_controls, shorten

WIDTH = 80
"""Longest line of a text, in characters."""


def format_text(title: str, facts: Mapping[str, str]) -> str:
    """Return a title and facts, short texts by name, one line each."""
    width = max(map(len, facts))
    lines = (title, *(f"  {name:<{width}}  {fact}" for name, fact in facts.items()))
    return "\n".join(shorten(escape_controls(line), WIDTH) for line in lines)


def describe_axis(keys: Sequence[str], values: Sequence[Any]) -> str:
    """Return an axis in words: ``phi_u0_deg 0..120 (8)``, ``turn flip, fold`` or ``case (6)``.

    Args:
        keys: keys that identify the points of the axis.
        values: their values; tuples for several keys.
    """
    first, *others = keys
    if others:
        return f"{first} and {len(others)} more ({len(values)})"
    numeric = all(type(value) in (int, float) for value in values)
    texts = [f"{value:g}" if numeric else str(value) for value in values]
    if len(texts) <= 3 and (numeric or all(map(str.isidentifier, texts))):
        return f"{first} {', '.join(texts)}"
    return f"{first} {f'{min(values):g}..{max(values):g} ' if numeric else ''}({len(values)})"
