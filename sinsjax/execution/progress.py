"""Progress of a running study: what is done, and its display on a terminal or as plain lines."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

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
    display = (_BarDisplay if console.is_terminal else _LineDisplay)(console, name)
    timer = threading.Timer(after_s, display.start)
    timer.daemon = True
    if after_s:
        timer.start()
    else:
        display.start()
    try:
        yield display.update
    finally:
        if after_s:
            timer.cancel()
            timer.join()
        display.stop()


class _BarDisplay:
    """A bar with the runs, their rate and the time left."""

    def __init__(self, console: Console, name: str) -> None:
        self._name, self._pace = name, _Pace()
        self._bar = Bar(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[counted]}{task.fields[pace]}"),
            console=console,
        )
        text = f"{name} (compiling)"
        self._task = self._bar.add_task(text, total=None, counted="runs", pace="")

    def start(self) -> None:
        self._bar.start()

    def stop(self) -> None:
        if self._bar.live.is_started:
            self._bar.stop()

    def update(self, now: RunProgress) -> None:
        pace = self._pace.format(now)
        self._bar.update(
            self._task,
            description=self._name if pace else f"{self._name} ({now.compiling})",
            completed=now.done,
            total=now.total,
            counted=now.unit,
            pace=pace,
        )


class _LineDisplay:
    """Lines with the runs, their rate and the time left."""

    def __init__(self, console: Console, name: str) -> None:
        self._console, self._name, self._pace = console, name, _Pace()
        self._started, self._tenth, self._compiling = False, -1, ""
        self._last_s = time.monotonic()

    def start(self) -> None:
        self._started = True

    def stop(self) -> None:
        self._started = False

    def update(self, now: RunProgress) -> None:
        pace = self._pace.format(now)
        if not self._started:
            return
        if now.begins and now.compiled < now.programs > 1:
            if self._compiling != (compiling := now.compiling):
                self._compiling = compiling
                self._print(compiling)
            return
        tenth, clock = now.done * 10 // now.total, time.monotonic()
        if now.begins:
            due = now.done_before > 0
        else:
            due = tenth != self._tenth or clock >= self._last_s + _PLAIN_EVERY_S
        if due:
            self._tenth, self._last_s = tenth, clock
            pace = " already done" if now.begins else pace
            self._print(f"{now.done:,} of {now.total:,} {now.unit}{pace}")

    def _print(self, text: Any) -> None:
        screen.print_line(self._console, f"{self._name}: {text}")


class _Pace:
    """The rate of runs since the first chunk ended; the time before is mostly compilation."""

    def __init__(self) -> None:
        self._first: tuple[float, int] | None = None

    def format(self, now: RunProgress) -> str:
        """Return the rate, time left and failures as text; empty before the first chunk."""
        if now.begins:
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
