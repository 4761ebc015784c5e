"""The command line in a process that kills itself: ``MOMENT PATTERN NUMBER PAUSE_S WORD...``.

A process gets a SIGKILL at the N-th file whose directory and name match a pattern, at one of
three moments of its writing: ``half`` of it is in the temporary file, ``before`` that is renamed,
``after`` it is. It waits when it has written a part, s: what is to be killed at a moment must not
be done before a busy machine comes to that.
"""

import fnmatch
import io
import itertools
import os
import signal
import sys
import time
from pathlib import Path

from sinsjax import plots
from sinsjax.__main__ import command
from sinsjax.platform import files


def arm_killer(moment, pattern, number, pause_s):
    """Check every file that `files.atomic_write` writes; pause after each part."""
    original_replace, left = Path.replace, itertools.count(number - 1, -1)

    def is_due(now, target):
        is_counted = now == moment and fnmatch.fnmatch("/".join(target.parts[-2:]), pattern)
        return is_counted and next(left) == 0

    def kill():
        os.kill(os.getpid(), signal.SIGKILL)

    class Half(io.BufferedWriter):
        def write(self, content):
            name = Path(self.name)
            if is_due("half", name.parent / name.name.removeprefix(".").rsplit(".", 2)[0]):
                super().write(content[: len(content) // 2])
                self.flush()
                kill()
            return super().write(content)

    def replace(self, target):
        if is_due("before", target):
            kill()
        path = original_replace(self, target)
        if is_due("after", target):
            kill()
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
    arm_killer(moment, pattern, int(number), float(pause_s))
    sys.argv = ["sinsjax", *words]
    command()
