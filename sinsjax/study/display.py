"""Short displays of an object as text and as HTML, for interactive sessions and notebooks."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from sinsjax.messages import escape_controls, shorten

WIDTH = 80
"""Longest line of a text, in characters."""

_MAX_LISTED_VALUES = 3
"""Number of values up to which an axis shows all of them."""


def format_text(title: str, facts: Mapping[str, str]) -> str:
    """Return a title and facts, one line each.

    Args:
        title: what is displayed.
        facts: short texts by name.
    """
    width = max(map(len, facts))
    lines = (title, *(f"  {name:<{width}}  {fact}" for name, fact in facts.items()))
    return "\n".join(shorten(escape_controls(line), WIDTH) for line in lines)


def format_html(title: str, facts: Mapping[str, str]) -> str:
    """Return a title and facts as an HTML table, in which all text is escaped.

    Args:
        title: what is displayed.
        facts: short texts by name.
    """
    rows = (
        f"<tr><th>{_escape_html(name)}</th><td>{_escape_html(fact)}</td></tr>"
        for name, fact in facts.items()
    )
    return f"<table><caption>{_escape_html(title)}</caption>{''.join(rows)}</table>"


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
    texts = [f"{value:g}" if _is_number(value) else str(value) for value in values]
    if len(texts) <= _MAX_LISTED_VALUES and all(
        _is_number(v) or text.isidentifier() for v, text in zip(values, texts, strict=True)
    ):
        return f"{first} {', '.join(texts)}"
    if all(map(_is_number, values)):
        return f"{first} {min(values):g}..{max(values):g} ({len(values)})"
    return f"{first} ({len(values)})"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _escape_html(text: str) -> str:
    return escape(escape_controls(text))
