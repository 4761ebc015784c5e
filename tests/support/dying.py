"""The command line in processes that kill themselves.

A process gets a SIGKILL at the N-th file whose directory and name match a pattern, at one of
three moments of its writing: ``half`` of it is in the temporary file, ``before`` that is renamed,
``after`` it is. It begins when it is told to, so that a next one can be made ready ahead. All are
forked from a server that has imported everything and started nothing: no thread and no JAX.
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


class Killer:
    """Counts what happens to files, and kills."""

    def __init__(self, moment: str, pattern: str, number: int) -> None:
        self.moment, self.pattern, self.left = moment, pattern, number

    def comes(self, moment: str, target: Path) -> bool:
        """Whether this is what the process is to be killed at."""
        if moment == self.moment and fnmatch.fnmatch("/".join(target.parts[-2:]), self.pattern):
            self.left -= 1
            return self.left == 0
        return False


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def arm(killer: Killer, pause_s: float) -> None:
    """Make every file of `files.atomic_write` pass the killer, with a pause after each part."""
    rename = Path.replace

    class Half(io.BufferedWriter):
        def write(self, content: Any) -> int:
            name = Path(self.name)
            target = name.parent / name.name.removeprefix(".").rsplit(".", 2)[0]
            if killer.comes("half", target):
                super().write(content[: len(content) // 2])
                self.flush()
                kill()
            return super().write(content)

    def replace(self: Path, target: Path) -> Path:
        if killer.comes("before", target):
            kill()
        path = rename(self, target)
        if killer.comes("after", target):
            kill()
        if target.suffix == ".parquet":
            time.sleep(pause_s)
        return path

    files.open = lambda path, mode: (
        Half(io.FileIO(path, mode)) if mode == "xb" else open(path, mode)
    )
    Path.replace = replace


class Dying:
    """A process that waits for `go`, then does what a command line says.

    Attributes:
        process: to wait for, and to be sent signals.
    """

    def __init__(
        self,
        words: list[str],
        environment: dict[str, str],
        said: Path,
        *,
        point: tuple[str, str, int],
        pause_s: float = 0.0,
    ) -> None:
        """Fork it.

        Args:
            words: of the command line.
            environment: variables that it has besides those of the server.
            said: where its output goes; that to standard error is beside it, with ``.error``.
            point: moment, pattern and number.
            pause_s: for which a thread waits when it has written a part, s: what is to be killed
                at a moment must not be done before a busy machine comes to that.
        """
        self._said = said, said.with_suffix(".error")
        begin, self._go = _SERVER.Pipe(duplex=False)
        self.process = _SERVER.Process(
            target=_obey, args=(words, environment, self._said, point, pause_s, begin)
        )
        self.process.start()
        begin.close()

    def go(self) -> "Dying":
        """Let it begin."""
        self._go.send(None)
        return self

    def send(self, number: int) -> None:
        """Send it a signal."""
        os.kill(self.process.pid, number)

    def said(self) -> tuple[str, str]:
        """Its output and error output so far."""
        output, error = (path.read_text() if path.exists() else "" for path in self._said)
        return output, error

    def close(self) -> None:
        """End it, if it has not ended."""
        self.process.kill()
        self.process.join()
        self.process.close()
        self._go.close()


def _obey(
    words: list[str],
    environment: dict[str, str],
    said: tuple[Path, Path],
    point: tuple[str, str, int],
    pause_s: float,
    begin: Connection,
) -> None:
    for number, path in enumerate(said, start=1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    os.environ |= environment
    plots.render_png = lambda *_: b"not drawn"  # takes as long as all else
    arm(Killer(*point), pause_s)
    begin.recv()
    sys.argv = ["sinsjax", *words]
    cli.main()
