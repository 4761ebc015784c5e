"""Stopping a running study by a signal."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from rich.console import Console

from sinsjax import console as screen

_STOPPING = "Stopping after the running chunks (repeat to abandon them)."
_SIGNALS = (signal.SIGINT, signal.SIGTERM)  # batch systems send the second


@contextmanager
def stop_on_signal(console: Console) -> Iterator[threading.Event]:
    """An event set by Ctrl-C or a termination signal; a second signal ends the process at once.

    Ending at once loses only the running chunks: files are written atomically.
    """
    stop = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            os._exit(128 + number)
        stop.set()
        # In a thread, because the signal may have interrupted this one while printing.
        threading.Thread(target=screen.print_line, args=(console, _STOPPING)).start()

    before = {number: signal.signal(number, handle) for number in _SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
