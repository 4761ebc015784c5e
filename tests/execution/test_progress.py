"""The interruption of a running study."""

import io
import os
import signal
import threading
from collections.abc import Iterator

import pytest
from rich.console import Console

from sinsjax.cli import running


def plain() -> tuple[Console, io.StringIO]:
    file = io.StringIO()
    return Console(file=file, width=40), file


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
    monkeypatch.setattr(running.os, "_exit", ended.append)
    with running.stop_on_signal(screen) as stop:
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
    with running.stop_on_signal(screen) as stop:
        screen.print("the first line")
        assert stop.is_set()


def test_signal_handlers_are_restored_after_error(handlers: None) -> None:
    with pytest.raises(ZeroDivisionError), running.stop_on_signal(plain()[0]):
        raise ZeroDivisionError
