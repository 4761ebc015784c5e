"""Short displays of an object as text, for interactive sessions and notebooks."""

from collections.abc import Mapping

from sinsjax.messages import escape_controls, shorten

WIDTH = 80
"""Longest line of a text, in characters."""


def format_text(title: str, facts: Mapping[str, str]) -> str:
    """Return a title and facts, short texts by name, one line each."""
    width = max(map(len, facts))
    lines = (title, *(f"  {name:<{width}}  {fact}" for name, fact in facts.items()))
    return "\n".join(shorten(escape_controls(line), WIDTH) for line in lines)
