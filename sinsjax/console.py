"""Terminal output as plain text, without rich's markup."""

import sys

from rich.console import Console
from rich.text import Text

from sinsjax.messages import escape_controls


def plain_console() -> Console:
    """A console on the standard output that prints ``[bold]`` and ``:smile:`` literally."""
    return Console(markup=False, emoji=False, highlight=False)


def literal_text(text: str, style: str = "") -> Text:
    """Return text for rich that shows every character, control characters as escapes."""
    return Text(escape_controls(text), style=style)


def print_warning(line: str) -> None:
    """Print a warning on the standard error."""
    print(f"Warning: {escape_controls(line)}", file=sys.stderr, flush=True)


def print_line(console: Console, text: str, *, style: str = "", wrap: bool = False) -> None:
    """Print a line literally, on a console with or without markup.

    Args:
        console: the console.
        text: the line.
        style: style of the whole line.
        wrap: whether to wrap it at the width of a terminal; files and pipes are never wrapped.
    """
    soft = not (wrap and console.is_terminal)
    console.print(literal_text(text, style), highlight=False, soft_wrap=soft)
