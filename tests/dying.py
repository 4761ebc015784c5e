"""The command line in a process that kills itself: ``python dying.py MOMENT PATTERN N WORDS...``.

The process gets a SIGKILL at the N-th file whose directory and name match the pattern, at one of
three moments of its writing: ``half`` of it is in the temporary file, ``before`` that is renamed,
``after`` it is. It begins when a line comes in, so that a next one can be made ready ahead.
"""

import fnmatch
import io
import os
import signal
import sys
from pathlib import Path
from typing import Any

from sinsjax import cli, files


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


def arm(killer: Killer) -> None:
    """Has every file that `files.replacing` writes pass by the killer."""
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
        return path

    files.open = lambda path, mode: Half(io.FileIO(path, mode))
    Path.replace = replace


if __name__ == "__main__":
    moment, pattern, number, *words = sys.argv[1:]
    arm(Killer(moment, pattern, int(number)))
    sys.stdin.readline()
    sys.argv = ["sinsjax", *words]
    cli.main()
