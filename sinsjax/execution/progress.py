"""Progress of a running study: what is done, and its display on a terminal or as plain lines."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sinsjax.messages import print_line

_PLAIN_EVERY_S = 10.0

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
        compiled: compiled programs.
        programs: number of programs to compile; 0 if they are compiled elsewhere.
    """

    done: int
    total: int
    failures: int | None
    done_before: int
    unit: str = "runs"
    compiled: int = 0
    programs: int = 0

    @property
    def state(self) -> str:
        """The failures so far, or what precedes the first chunk, in words."""
        if self.failures is None:
            return ""
        if self.done == self.done_before:
            if self.done:
                return "already done"
            which = f" {min(self.compiled + 1, self.programs)} of {self.programs} programs"
            return f"compiling{which if self.programs > 1 else ''}"
        return f"{self.failures:,} failed"


ProgressCallback = Callable[[RunProgress], None]
"""Progress callback, called before the first chunk and after every one."""


@contextmanager
def callback_or_progress_bar(
    name: str, shown: bool | None, on_progress: ProgressCallback | None = None
) -> Iterator[ProgressCallback | None]:
    """Yield the callback that shows the progress of a function of Python, after two seconds.

    A callback of the user takes its place. ``shown = None`` shows on a terminal or in a notebook.
    """
    if shown is None:
        shown = sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules)
    if on_progress is not None or not shown:
        yield on_progress
        return
    console = Console(stderr=True, markup=False, emoji=False, highlight=False, force_jupyter=False)
    with show_progress(console, name, after_s=_PYTHON_AFTER_S) as show:
        yield show


@contextmanager
def show_progress(
    console: Console, name: str, *, after_s: float = 0.0
) -> Iterator[ProgressCallback]:
    """Show a bar on a terminal; otherwise plain lines, every 10 % or every 10 s.

    Both show the completed runs and the failures so far, the bar also the time left. Nothing is
    shown of what ends within ``after_s``.
    """
    if not console.is_terminal:
        yield _plain_lines(console, name, time.monotonic() + after_s)
        return
    bar = Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[unit]} {task.fields[state]}", markup=False),
        TimeRemainingColumn(),
        console=console,
    )
    task = bar.add_task(name, total=None, unit="runs", state="compiling")

    def update(now: RunProgress) -> None:
        bar.update(task, completed=now.done, total=now.total, unit=now.unit, state=now.state)

    timer = threading.Timer(after_s, bar.start)
    timer.daemon = True
    timer.start()
    if not after_s:
        timer.join()
    try:
        yield update
    finally:
        timer.cancel()
        timer.join()
        bar.stop()


def _plain_lines(console: Console, name: str, silent_until_s: float) -> ProgressCallback:
    """Return a callback that prints a line when due, and none before a time."""
    last_tenth, last_s = -1, silent_until_s

    def print_if_due(now: RunProgress) -> None:
        nonlocal last_tenth, last_s
        tenth, clock = now.done * 10 // now.total, time.monotonic()
        if clock >= silent_until_s and (tenth != last_tenth or clock >= last_s + _PLAIN_EVERY_S):
            last_tenth, last_s = tenth, clock
            state = f", {now.state}" if now.state else ""
            print_line(console, f"{name}: {now.done:,} of {now.total:,} {now.unit}{state}")

    return print_if_due
