"""Progress of a running study: what is done, and its display on a terminal or as plain lines."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.progress import Progress as Bar

from sinsjax import console as screen

_PLAIN_EVERY_S = 10.0
_MEASURED_S = 1.0
"""Least time since the first chunk for a rate: threads end their first chunks together."""

_PYTHON_AFTER_S = 2.0
"""Time after which functions of Python begin to show their progress, s."""


class RunProgress(NamedTuple):
    """Progress of a study.

    Attributes:
        done: completed runs.
        total: number of runs; with [stop_when], at most.
        failures: runs of this session that diverged or became non-finite; None if there are none
            to count.
        done_before: runs completed before this session.
        unit: what is counted, in words.
        compiled: programs of the running stage that are compiled.
        programs: number of them; 0 if it is not known.
    """

    done: int
    total: int
    failures: int | None
    done_before: int
    unit: str = "runs"
    compiled: int = 0
    programs: int = 0

    @property
    def begins(self) -> bool:
        """Whether nothing has been done in this session."""
        return self.done == self.done_before

    @property
    def compiling(self) -> str:
        """State of the compilation, before the first runs."""
        if self.programs < 2:
            return "compiling"
        return f"compiling {min(self.compiled + 1, self.programs)} of {self.programs} programs"


ProgressCallback = Callable[[RunProgress], None]
"""Progress callback, called before the first chunk and after every one.

Also when a program has been compiled, then from another thread, though never at the same time.
"""


@contextmanager
def python_progress(
    name: str, shown: bool | None, on_progress: ProgressCallback | None = None
) -> Iterator[ProgressCallback | None]:
    """Show the progress of a function of Python on the standard error, after two seconds.

    Args:
        name: name of the study.
        shown: whether to show it; None for a terminal or a notebook, unless there is a callback.
        on_progress: callback of the caller.

    Yields:
        The callback to use.
    """
    if shown is None:
        seen = sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules)
        shown = seen and on_progress is None
    if not shown:
        yield on_progress
        return
    console = Console(stderr=True, markup=False, emoji=False, highlight=False, force_jupyter=False)
    with show_progress(console, name, after_s=_PYTHON_AFTER_S) as show:

        def show_and_call(now: RunProgress) -> None:
            show(now)
            if on_progress is not None:
                on_progress(now)

        yield show_and_call


@contextmanager
def show_progress(
    console: Console, name: str, *, after_s: float = 0.0
) -> Iterator[ProgressCallback]:
    """Show a bar on a terminal; otherwise plain lines, every 10 % of a stage or every 10 s.

    Both show the completed runs, the rate, the time left and the failures so far, and before the
    first runs which of several programs is being compiled.

    Args:
        console: where to show it.
        name: name of the study.
        after_s: time to wait first, s; nothing is shown of what ends before.
    """
    display = _Display(console, name)
    timer = threading.Timer(after_s, display.start)
    timer.daemon = True
    timer.start()
    if not after_s:
        timer.join()
    try:
        yield display.update
    finally:
        timer.cancel()
        timer.join()
        display.stop()


class _Display:
    """A bar, or lines, with the runs, their rate and the time left."""

    def __init__(self, console: Console, name: str) -> None:
        self._console, self._name, self._started = console, name, False
        self._first: tuple[float, int] | None = None  # end of the first chunk, and runs by then
        self._last_s, self._tenth, self._line = time.monotonic(), -1, ""
        self._bar = Bar(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[counted]}{task.fields[pace]}"),
            console=console,
        )
        self._task = self._bar.add_task(f"{name} (compiling)", total=None, counted="runs", pace="")

    def start(self) -> None:
        self._started = True
        if self._console.is_terminal:
            self._bar.start()

    def stop(self) -> None:
        self._started = False
        if self._bar.live.is_started:
            self._bar.stop()

    def update(self, now: RunProgress) -> None:
        pace = self._format_pace(now)
        if self._console.is_terminal:
            self._bar.update(
                self._task,
                description=self._name if pace else f"{self._name} ({now.compiling})",
                completed=now.done,
                total=now.total,
                counted=now.unit,
                pace=pace,
            )
        elif self._started:
            self._print_if_due(now, pace)

    def _print_if_due(self, now: RunProgress, pace: str) -> None:
        tenth, clock = now.done * 10 // now.total, time.monotonic()
        line = f"{now.done:,} of {now.total:,} {now.unit}{pace}"
        if now.begins and now.compiled < now.programs > 1:
            due, line = self._line != now.compiling, now.compiling
        elif now.begins:
            due, line = now.done_before > 0, f"{line} already done"
        else:
            due = tenth != self._tenth or clock >= self._last_s + _PLAIN_EVERY_S
        if due:
            self._tenth, self._last_s, self._line = tenth, clock, line
            screen.print_line(self._console, f"{self._name}: {line}")

    def _format_pace(self, now: RunProgress) -> str:
        """Return the rate, time left and failures as text; empty before the first chunk.

        The rate is that since the first chunk: the time before is mostly compilation.
        """
        if now.begins:
            return ""
        clock = time.monotonic()
        since, done = self._first = self._first or (clock, now.done)
        failed = "" if now.failures is None else f", {now.failures:,} failed"
        if clock < since + _MEASURED_S or now.done == done:
            return failed
        rate = (now.done - done) / (clock - since)
        minutes, s = divmod(round((now.total - now.done) / rate), 60)
        hours, m = divmod(minutes, 60)
        left = f"{hours}:{m:02d}:{s:02d}" if hours else f"{m}:{s:02d}"
        return f", {rate:,.0f} {now.unit}/s, {left} left{failed}"
