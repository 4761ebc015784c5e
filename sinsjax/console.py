"""What a person sees of a running study, and how to stop it."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.progress import Progress as Bar

from sinsjax.campaign import Progress, Tell

_PLAIN_EVERY_S = 10.0
_STOPPING = "Stopping: the chunks under way are finished first (again: drop them)."
_SIGNALS = (signal.SIGINT, signal.SIGTERM)  # a cluster's scheduler sends the second


@contextmanager
def progress(console: Console, name: str) -> Iterator[Tell]:
    """A bar on a terminal; elsewhere a plain line every tenth of the way, or every 10 s.

    Both tell the runs done, runs a second, the time left and the failures so far.
    """
    since = time.monotonic()
    if not console.is_terminal:
        yield _plainly(console, name, since)
        return
    bar = Bar(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("runs {task.fields[pace]}"),
        console=console,
    )
    with bar:
        shown = bar.add_task(f"{name} (compiling)", total=None, pace="")

        def tell(now: Progress) -> None:
            name_now = name if now.done > now.before else f"{name} (compiling)"
            pace = _pace(now, time.monotonic() - since)
            bar.update(shown, description=name_now, completed=now.done, total=now.total, pace=pace)

        yield tell


def _plainly(console: Console, name: str, since: float) -> Callable[[Progress], None]:
    told, last = -1, since

    def tell(now: Progress) -> None:
        nonlocal told, last
        tenth, time_now = now.done * 10 // now.total, time.monotonic()
        first = now.done == now.before
        if (
            first
            and not now.before
            or not first
            and tenth == told
            and time_now < last + _PLAIN_EVERY_S
        ):
            return
        told, last = tenth, time_now
        text = f"{name}: {now.done:,} of {now.total:,} runs"
        pace = "there already" if first else _pace(now, time_now - since)
        console.print(f"{text}, {pace}", highlight=False, soft_wrap=True)

    return tell


def _pace(now: Progress, elapsed_s: float) -> str:
    rate = (now.done - now.before) / elapsed_s if elapsed_s > 0 else 0.0
    left = f"{_clock((now.total - now.done) / rate)} left" if rate else "time left unknown"
    return f"{rate:,.0f} runs/s, {left}, {now.failures:,} failed"


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
        threading.Thread(target=console.print, args=(_STOPPING,), daemon=True).start()

    before = {number: signal.signal(number, handle) for number in _SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
