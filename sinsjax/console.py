"""Terminal output as plain text, without rich's markup; failures of output do not stop the work.

The reader may leave early (``| head -1``), and the disk it is redirected to may be full.
"""

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

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


class _FailsafeStream:
    """A stream whose write errors are remembered instead of raised; nothing if it is closed."""

    def __init__(self, stream: Any) -> None:
        self._stream = io.StringIO() if stream is None else stream
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        self._try(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        self._try(self._stream.flush)

    def _try(self, operation: Any, *arguments: str) -> None:
        try:
            if self.error is None:
                operation(*arguments)
        except OSError as error:
            self.error = error
            # Discards buffered text, or Python reports the same error once more at exit.
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def tolerate_broken_pipe() -> Iterator[None]:
    """Keep working when the standard output can no longer be written.

    Raises:
        SystemExit: at the end of the block; with code 2 and one line on the standard error if
            output was lost, for example on a full disk. A pipe closed by its reader is no error.
    """
    streams = sys.stdout, sys.stderr
    out, err = map(_FailsafeStream, streams)
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
        reason = out.error.strerror or out.error
        err.write(f"error: standard output: cannot be written: {reason}\n")
        err.flush()
        code = code or 2
    raise SystemExit(code)
