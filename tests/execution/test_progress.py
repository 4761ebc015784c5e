"""The progress of a running study, and its interruption by a signal."""

import io
import os
import signal
import threading

import pytest
from rich.console import Console
from support.studies import small_study

import sinsjax
from sinsjax.cli import running
from sinsjax.execution.progress import RunProgress, python_progress, show_progress


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_first_signal_requests_stop_and_second_exits(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """A stream that is being written to must not be written to by a handler."""

    class Busy(io.StringIO):
        writing = rang = False

        def write(self, text: str) -> int:
            if self.writing and threading.current_thread() is threading.main_thread():
                raise RuntimeError("reentrant call")
            if "first" in text and not self.rang:
                self.writing = self.rang = True
                os.kill(os.getpid(), number)
                self.writing = False
            return super().write(text)

    ended, screen = list[int](), Console(file=Busy(), width=200)
    handlers = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setattr(running.os, "_exit", ended.append)
    with pytest.raises(ZeroDivisionError), running.stop_on_signal(screen) as stop:
        assert not stop.is_set()
        screen.print("the first line")
        assert stop.wait(60) and not ended
        os.kill(os.getpid(), number)
        assert ended == [128 + number]
        raise ZeroDivisionError
    assert {n: signal.getsignal(n) for n in handlers} == handlers


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_counts_runs_and_failures(terminal: bool) -> None:
    file = io.StringIO()
    console = Console(file=file, width=100, force_terminal=terminal)
    with show_progress(console, "swing") as show:
        show(RunProgress(0, 2000, 0, 0))
        show(RunProgress(1000, 2000, 3, 0))
        show(RunProgress(1001, 2000, 3, 0))
        show(RunProgress(2000, 2000, 4, 0))
    printed = file.getvalue()
    if terminal:
        assert "compiling" in printed
        assert "2000/2000" in printed and "runs 4 failed" in printed
    else:
        lines = ["0 of 2,000 runs, compiling", "1,000 of 2,000 runs, 3 failed"]
        lines += ["2,000 of 2,000 runs, 4 failed"]
        assert printed.splitlines() == [f"swing: {line}" for line in lines]


def test_python_shows_progress_on_request_or_calls_back(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[RunProgress] = []
    for callback, after_s in ((calls.append, 0.0), (None, 60.0), (None, 0.0)):
        monkeypatch.setattr("sinsjax.execution.progress._PYTHON_AFTER_S", after_s)
        with python_progress("swing", True, callback) as show:
            assert show is not None
            show(RunProgress(1000, 2000, 3, 0))
    assert len(calls) == 1
    assert capsys.readouterr().err == "swing: 1,000 of 2,000 runs, 3 failed\n"


@pytest.mark.optimised(False)
def test_callback_learns_which_program_is_compiled() -> None:
    methods, seen = {"method": ["level", "compass"]}, list[RunProgress]()
    study = small_study(study={"duration_s": 2.0, "window_s": [0, 2]}, axes=methods)
    sinsjax.run(study, on_progress=seen.append)
    assert (seen[0].state, seen[0].programs) == ("compiling 1 of 2 programs", 2)
    assert {now.compiled for now in seen} == {0, 1, 2}
    assert seen[-1].done == 6
