"""The command line in processes that kill themselves.

A process gets a SIGKILL at the N-th file whose directory and name match a pattern, at one of
three moments of its writing: ``half`` of it is in the temporary file, ``before`` that is renamed,
``after`` it is. It begins on request, so the next one can be prepared in advance. All are forked
 from a server that has imported everything and started nothing: no thread and no JAX.
"""

import fnmatch
import io
import multiprocessing
import os
import signal
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from sinsjax import cli, plots
from sinsjax.platform import files

_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload(["sinsjax.cli", "sinsjax.report"])


class FileKiller:
    """Counter of file operations that determines when to kill the process."""

    def __init__(self, moment: str, pattern: str, number: int) -> None:
        self.moment, self.pattern, self.left = moment, pattern, number

    def is_due(self, moment: str, target: Path) -> bool:
        """Whether the process is to be killed at this operation."""
        if moment == self.moment and fnmatch.fnmatch("/".join(target.parts[-2:]), self.pattern):
            self.left -= 1
            return self.left == 0
        return False


def kill_process() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def arm_killer(killer: FileKiller, pause_s: float) -> None:
    """Let the killer check every file of `files.atomic_write` writes; pause after each part."""
    original_replace = Path.replace

    class Half(io.BufferedWriter):
        def write(self, content: Any) -> int:
            name = Path(self.name)
            target = name.parent / name.name.removeprefix(".").rsplit(".", 2)[0]
            if killer.is_due("half", target):
                super().write(content[: len(content) // 2])
                self.flush()
                kill_process()
            return super().write(content)

    def replace(self: Path, target: Path) -> Path:
        if killer.is_due("before", target):
            kill_process()
        path = original_replace(self, target)
        if killer.is_due("after", target):
            kill_process()
        if target.suffix == ".parquet":
            time.sleep(pause_s)
        return path

    files.open = lambda path, mode: (
        Half(io.FileIO(path, mode)) if mode == "xb" else open(path, mode)
    )
    Path.replace = replace


class KilledCommand:
    """A process that waits for `proceed`, then runs a command line.

    Attributes:
        process: process to wait for, and to send signals to.
    """

    def __init__(
        self,
        arguments: list[str],
        environment: dict[str, str],
        output_path: Path,
        *,
        point: tuple[str, str, int],
        pause_s: float = 0.0,
    ) -> None:
        """Fork the process.

        Args:
            arguments: arguments of the command line.
            environment: variables in addition to those of the server.
            output_path: file of its output; that of standard error has the suffix ``.error``.
            point: moment, pattern and number.
            pause_s: for which a thread waits when it has written a part, s: what is to be killed
                at a moment must not be done before a busy machine comes to that.
        """
        self._output_paths = output_path, output_path.with_suffix(".error")
        begin, self._start_pipe = _SERVER.Pipe(duplex=False)
        self.process = _SERVER.Process(
            target=_run_child,
            args=(arguments, environment, self._output_paths, point, pause_s, begin),
        )
        self.process.start()
        begin.close()

    def proceed(self) -> "KilledCommand":
        """Let the process begin."""
        self._start_pipe.send(None)
        return self

    def send_signal(self, number: int) -> None:
        """Send a signal to the process."""
        os.kill(self.process.pid, number)

    def read_output(self) -> tuple[str, str]:
        """Return output and error output so far."""
        output, error = (path.read_text() if path.exists() else "" for path in self._output_paths)
        return output, error

    def close(self) -> None:
        """End the process if it has not ended."""
        self.process.kill()
        self.process.join()
        self.process.close()
        self._start_pipe.close()


def _run_child(
    arguments: list[str],
    environment: dict[str, str],
    output_paths: tuple[Path, Path],
    point: tuple[str, str, int],
    pause_s: float,
    start_pipe: Connection,
) -> None:
    for number, path in enumerate(output_paths, start=1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    os.environ |= environment
    plots.render_png = lambda *_: b"not drawn"  # takes as long as all else
    arm_killer(FileKiller(*point), pause_s)
    start_pipe.recv()
    sys.argv = ["sinsjax", *arguments]
    cli.main()
