"""The command line in a process that kills itself: ``MOMENT PATTERN NUMBER PAUSE_S WORD...``.

A process gets a SIGKILL at the N-th file whose directory and name match a pattern, at one of
three moments of its writing: ``half`` of it is in the temporary file, ``before`` that is renamed,
``after`` it is. It waits when it has written a part, s: what is to be killed at a moment must not
be done before a busy machine comes to that.
"""

import fnmatch
import io
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

from sinsjax import plots
from sinsjax.__main__ import command
from sinsjax.platform import files


class FileKiller:
    """Counter of file operations that determines when to kill the process."""

    def __init__(self, moment: str, pattern: str, number: int) -> None:
        self.moment, self.pattern, self.left = moment, pattern, number

    def count(self, moment: str, target: Path) -> bool:
        """Whether the process is to be killed at this operation."""
        if moment == self.moment and fnmatch.fnmatch("/".join(target.parts[-2:]), self.pattern):
            self.left -= 1
            return self.left == 0
        return False

    def kill_if_due(self, moment: str, target: Path) -> None:
        if self.count(moment, target):
            os.kill(os.getpid(), signal.SIGKILL)


def arm_killer(killer: FileKiller, pause_s: float) -> None:
    """Let the killer check every file of `files.atomic_write` writes; pause after each part."""
    original_replace = Path.replace

    class Half(io.BufferedWriter):
        def write(self, content: Any) -> int:
            name = Path(self.name)
            target = name.parent / name.name.removeprefix(".").rsplit(".", 2)[0]
            if killer.count("half", target):
                super().write(content[: len(content) // 2])
                self.flush()
                os.kill(os.getpid(), signal.SIGKILL)
            return super().write(content)

    def replace(self: Path, target: Path) -> Path:
        killer.kill_if_due("before", target)
        path = original_replace(self, target)
        killer.kill_if_due("after", target)
        if target.suffix == ".parquet":
            time.sleep(pause_s)
        return path

    files.open = lambda path, mode: (
        Half(io.FileIO(path, mode)) if mode == "xb" else open(path, mode)
    )
    Path.replace = replace


if __name__ == "__main__":
    moment, pattern, number, pause_s, *words = sys.argv[1:]
    plots.render_png = lambda *_: b"not drawn"  # takes as long as all else
    arm_killer(FileKiller(moment, pattern, int(number)), float(pause_s))
    sys.argv = ["sinsjax", *words]
    command()
