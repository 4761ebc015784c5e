"""What a person sees of a running study, and how to stop it."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.progress import Progress as Bar

from sinsjax import console as screen
from sinsjax.execution.run import RunProgress, Tell

_PLAIN_EVERY_S = 10.0
_STOPPING = "Stopping: the chunks under way are finished first (again: drop them)."
_SIGNALS = (signal.SIGINT, signal.SIGTERM)  # a cluster's scheduler sends the second


@contextmanager
def progress(console: Console, name: str) -> Iterator[Tell]:
    """A bar on a terminal; elsewhere a plain line every tenth of the way, or every 10 s.

    Both tell the runs done, runs a second, the time left and the failures so far.
    """
    if not console.is_terminal:
        yield _plainly(console, name, _Pace())
        return
    bar = Bar(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("runs{task.fields[pace]}"),
        console=console,
    )
    with bar:
        shown = bar.add_task(f"{name} (compiling)", total=None, pace="")
        pace = _Pace()

        def tell(now: RunProgress) -> None:
            text = pace.text(now)
            called = name if text else f"{name} (compiling)"
            bar.update(shown, description=called, completed=now.done, total=now.total, pace=text)

        yield tell


def _plainly(console: Console, name: str, pace: "_Pace") -> Tell:
    told, last = -1, time.monotonic()

    def tell(now: RunProgress) -> None:
        nonlocal told, last
        text = pace.text(now)
        tenth, clock = now.done * 10 // now.total, time.monotonic()
        began = now.done == now.before
        news = now.before > 0 if began else tenth != told or clock >= last + _PLAIN_EVERY_S
        if not news:
            return
        told, last = tenth, clock
        there = ", there already" if began else text
        screen.say(console, f"{name}: {now.done:,} of {now.total:,} runs{there}")

    return tell


class _Pace:
    """Runs a second since the first chunk came in: what is before it is mostly compiling."""

    def __init__(self) -> None:
        self._first: tuple[float, int] | None = None

    def text(self, now: RunProgress) -> str:
        """The pace in words; empty before there is a chunk."""
        if now.done == now.before:
            return ""
        clock = time.monotonic()
        since, done = self._first = self._first or (clock, now.done)
        if now.done == done:
            return f", {now.failures:,} failed"
        rate = (now.done - done) / max(clock - since, 1e-3)
        left = _clock((now.total - now.done) / rate)
        return f", {rate:,.0f} runs/s, {left} left, {now.failures:,} failed"


def _clock(seconds: float) -> str:
    minutes, s = divmod(round(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02d}:{s:02d}" if hours else f"{m}:{s:02d}"


@contextmanager
def interruptible(console: Console) -> Iterator[threading.Event]:
    """An event that Ctrl-C or a termination signal sets; a second one ends the process at once.

    At once loses the chunks under way and nothing else: files appear whole or not at all.
    """
    stop = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            os._exit(128 + number)
        stop.set()
        # In a thread: the signal may have come while this one was printing.
        threading.Thread(target=screen.say, args=(console, _STOPPING), daemon=True).start()

    before = {number: signal.signal(number, handle) for number in _SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
