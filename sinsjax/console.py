"""Where text meets a terminal: it is text there, never rich's markup, and ends no work.

Who reads it may leave before the end (``| head -1``), and a disk that it goes to may be full.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

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


class _Outlet:
    """A stream that falls silent where it would fail; the rest is that stream's.

    None is one that was closed before Python began, as of a daemon.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        if self._stream is not None:
            self._attempt(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        if self._stream is not None:
            self._attempt(self._stream.flush)

    def _attempt(self, act: Any, *given: str) -> None:
        if self.error is not None:
            return
        try:
            act(*given)
        except OSError as error:
            self.error = error
            # What is still held back is lost here, and not told of once more as Python ends.
            with suppress(OSError, ValueError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def lasting() -> Iterator[None]:
    """Lets work go on when what it prints can go nowhere any more.

    Raises:
        SystemExit: at its end, with code 2 and one line on the standard error, if a disk was full
            or the like. Who closes a pipe has seen enough: that is no error.
    """
    streams = sys.stdout, sys.stderr
    out, err = map(_Outlet, streams)
    sys.stdout, sys.stderr = out, err
    code: Any = 0
    try:
        yield
    except SystemExit as stop:
        code = stop.code
    finally:
        out.flush()
        sys.stdout, sys.stderr = streams
    if out.error is not None and not isinstance(out.error, BrokenPipeError):
        said = out.error.strerror or out.error
        err.write(f"error: standard output: cannot be written: {said}\n")
        err.flush()
        code = code or 2
    raise SystemExit(code)
