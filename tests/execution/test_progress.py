"""The progress of a running study, and its interruption by a signal."""

import io
import os
import signal
import threading

import pytest
from rich.console import Console

from sinsjax.cli import running
from sinsjax.execution.progress import RunProgress, callback_or_progress_bar, show_progress


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_first_signal_requests_stop_and_second_exits(monkeypatch, number):
    """A stream that is being written to must not be written to by a handler."""

    class Busy(io.StringIO):
        writing = rang = False

        def write(self, text):
            if self.writing and threading.current_thread() is threading.main_thread():
                raise RuntimeError("reentrant call")
            if "first" in text and not self.rang:
                self.writing = self.rang = True
                os.kill(os.getpid(), number)
                self.writing = False
            return super().write(text)

    ended, screen = [], Console(file=Busy(), width=200)
    handlers = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setattr(running.os, "_exit", ended.append)
    with pytest.raises(ZeroDivisionError), running.stop_on_signal(screen) as stop:
        screen.print("the first line")
        assert stop.wait(60) and not ended
        os.kill(os.getpid(), number)
        assert ended == [128 + number]
        raise ZeroDivisionError
    assert {n: signal.getsignal(n) for n in handlers} == handlers


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_counts_runs_and_failures(terminal):
    file = io.StringIO()
    console = Console(file=file, width=100, force_terminal=terminal)
    with show_progress(console, "swing") as show:
        for done, failures in ((0, 0), (1000, 3), (1001, 3), (2000, 4)):
            show(RunProgress(done, 2000, failures, 0))
    if terminal:
        assert all(word in file.getvalue() for word in ("compiling", "2000/2000", "runs 4 failed"))
    else:
        lines = ["0 of 2,000 runs, compiling", "1,000 of 2,000 runs, 3 failed"]
        lines += ["2,000 of 2,000 runs, 4 failed"]
        assert file.getvalue().splitlines() == [f"swing: {line}" for line in lines]


def test_python_shows_progress_on_request_or_calls_back(capsys, monkeypatch):
    calls = []
    for callback, after_s in ((calls.append, 0.0), (None, 60.0), (None, 0.0)):
        monkeypatch.setattr("sinsjax.execution.progress._PYTHON_AFTER_S", after_s)
        with callback_or_progress_bar("swing", True, callback) as show:
            show(RunProgress(1000, 2000, 3, 0))
    assert len(calls) == 1
    assert capsys.readouterr().err == "swing: 1,000 of 2,000 runs, 3 failed\n"
