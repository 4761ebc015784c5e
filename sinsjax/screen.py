"""Where text meets a terminal: what is printed is text, and never rich's markup."""

from rich.console import Console
from rich.text import Text


def plain_console() -> Console:
    """A console on the standard output to which ``[bold]`` and ``:smile:`` are words."""
    return Console(markup=False, emoji=False, highlight=False)


def say(console: Console, text: str, *, style: str = "", wrap: bool = False) -> None:
    """Prints a line as it stands, on any console, whatever that one makes of markup.

    Args:
        console: where.
        text: to print.
        style: of all of it.
        wrap: whether it is broken at the width of a terminal; a file or a pipe has none.
    """
    soft = not (wrap and console.is_terminal)
    console.print(Text(text, style=style), highlight=False, soft_wrap=soft)
