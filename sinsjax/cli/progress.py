"""Progress display of a running study, and stopping it by a signal."""

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
from sinsjax.execution.run import ProgressCallback, RunProgress

_PLAIN_EVERY_S = 10.0
_MEASURED_S = 1.0
"""Least time since the first chunk for a rate: threads end their first chunks together."""

_STOPPING = "Stopping after the running chunks (repeat to abandon them)."
_SIGNALS = (signal.SIGINT, signal.SIGTERM)  # batch systems send the second


@contextmanager
def show_progress(console: Console, name: str) -> Iterator[ProgressCallback]:
    """A progress bar on a terminal; otherwise a plain line every 10 % of a stage, or every 10 s.

    Both show the completed runs, the rate, the time left and the failures so far, and before the
    first runs which of several programs is being compiled.
    """
    if not console.is_terminal:
        yield _plain_progress(console, name, _RateMeter())
        return
    bar = Bar(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[counted]}{task.fields[pace]}"),
        console=console,
    )
    with bar:
        task = bar.add_task(f"{name} (compiling)", total=None, counted="runs", pace="")
        pace = _RateMeter()

        def on_progress(now: RunProgress) -> None:
            text = pace.format_rate(now)
            bar.update(
                task,
                description=name if text else f"{name} ({_describe_compiling(now)})",
                completed=now.done,
                total=now.total,
                counted=now.unit,
                pace=text,
            )

        yield on_progress


def _plain_progress(console: Console, name: str, rate: "_RateMeter") -> ProgressCallback:
    last_tenth, last, compiling = -1, time.monotonic(), ""

    def on_progress(now: RunProgress) -> None:
        nonlocal last_tenth, last, compiling
        text = rate.format_rate(now)
        if now.done == now.done_before and now.programs > 1 and now.compiled < now.programs:
            if compiling != (compiling := _describe_compiling(now)):
                screen.print_line(console, f"{name}: {compiling}")
            return
        tenth, clock = now.done * 10 // now.total, time.monotonic()
        began = now.done == now.done_before
        due = (
            now.done_before > 0 if began else tenth != last_tenth or clock >= last + _PLAIN_EVERY_S
        )
        if not due:
            return
        last_tenth, last = tenth, clock
        pace_text = " already done" if began else text
        screen.print_line(console, f"{name}: {now.done:,} of {now.total:,} {now.unit}{pace_text}")

    return on_progress


def _describe_compiling(now: RunProgress) -> str:
    if now.programs < 2:
        return "compiling"
    return f"compiling {min(now.compiled + 1, now.programs)} of {now.programs} programs"


class _RateMeter:
    """The rate of runs since the first chunk ended; the time before is mostly compilation."""

    def __init__(self) -> None:
        self._first: tuple[float, int] | None = None

    def format_rate(self, now: RunProgress) -> str:
        """The pace as text; empty before the first chunk."""
        if now.done == now.done_before:
            return ""
        clock = time.monotonic()
        since, done = self._first = self._first or (clock, now.done)
        failed = "" if now.failures is None else f", {now.failures:,} failed"
        if clock < since + _MEASURED_S or now.done == done:
            return failed
        rate = (now.done - done) / (clock - since)
        left = _format_duration((now.total - now.done) / rate)
        return f", {rate:,.0f} {now.unit}/s, {left} left{failed}"


def _format_duration(seconds: float) -> str:
    minutes, s = divmod(round(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02d}:{s:02d}" if hours else f"{m}:{s:02d}"


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
