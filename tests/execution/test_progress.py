"""The progress display of a running study, and its interruption."""

import io
import os
import signal
import threading
from collections.abc import Iterator

import pytest
from rich.console import Console

from sinsjax.cli import progress
from sinsjax.execution.run import RunProgress


class Clock:
    """A clock that goes on when it is told to."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


def plain() -> tuple[Console, io.StringIO]:
    file = io.StringIO()
    return Console(file=file, width=40), file


def test_plain_progress_prints_every_tenth_with_pace_and_failures(clock: Clock) -> None:
    screen, file = plain()
    with progress.show_progress(screen, "swing") as on_progress:
        on_progress(RunProgress(0, 20_000, 0, 0))
        for done in range(100, 20_001, 100):
            clock.now += 0.1
            on_progress(RunProgress(done, 20_000, done // 1000, 0))
    lines = file.getvalue().splitlines()
    assert lines == [
        # The pace is that since the first chunk: what is before it is compiling.
        "swing: 100 of 20,000 runs, 0 failed",
        *(
            f"swing: {n},000 of 20,000 runs, 1,000 runs/s, 0:{20 - n:02d} left, {n} failed"
            for n in range(2, 21, 2)
        ),
    ]


def test_stored_runs_are_reported_and_excluded_from_pace(clock: Clock) -> None:
    screen, file = plain()
    with progress.show_progress(screen, "swing") as on_progress:
        on_progress(RunProgress(900, 1000, 0, 900))
        clock.now += 5.0
        on_progress(RunProgress(950, 1000, 0, 900))
        clock.now += 5.0
        on_progress(RunProgress(1000, 1000, 2, 900))
    assert file.getvalue().splitlines() == [
        "swing: 900 of 1,000 runs already done",
        "swing: 1,000 of 1,000 runs, 10 runs/s, 0:00 left, 2 failed",
    ]


# --- signals ------------------------------------------------------------------------------------


@pytest.fixture
def handlers() -> Iterator[None]:
    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    yield
    assert {n: signal.getsignal(n) for n in before} == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_first_signal_requests_stop_and_second_exits(
    handlers: None, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    screen, file = plain()
    ended: list[int] = []
    monkeypatch.setattr(progress.os, "_exit", ended.append)
    with progress.stop_on_signal(screen) as stop:
        assert not stop.is_set()
        os.kill(os.getpid(), number)
        assert stop.wait(60)
        for thread in threading.enumerate():
            if thread is not threading.current_thread() and thread.daemon:
                thread.join(0.2)
        assert " ".join(file.getvalue().split()).startswith("Stopping after the running chunks")
        assert not ended
        os.kill(os.getpid(), number)
        assert ended == [128 + number]


def test_signal_during_console_write_is_safe(handlers: None) -> None:
    """A stream that is being written to must not be written to by a handler."""

    class Busy(io.StringIO):
        writing = False
        rang = False

        def write(self, text: str) -> int:
            if self.writing and threading.current_thread() is threading.main_thread():
                raise RuntimeError("reentrant call")
            if "first" in text and not self.rang:
                self.writing = self.rang = True
                signal.raise_signal(signal.SIGINT)
                self.writing = False
            return super().write(text)

    screen = Console(file=Busy(), width=200)
    with progress.stop_on_signal(screen) as stop:
        screen.print("the first line")
        assert stop.is_set()


def test_signal_handlers_are_restored_after_error(handlers: None) -> None:
    with pytest.raises(ZeroDivisionError), progress.stop_on_signal(plain()[0]):
        raise ZeroDivisionError
