"""One writer at a time, of two processes; no compiling."""

import subprocess
import sys
from pathlib import Path

import pytest

from sinsjax.errors import InputError
from sinsjax.execution.directory import WRITER, check_unlocked, lock

HOLD = """
import sys, pathlib
from sinsjax.execution import locking
held = lock(pathlib.Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


def test_lock_names_other_writer_until_it_dies(tmp_path: Path) -> None:
    """Killed, it leaves both files, and neither blocks."""
    out = tmp_path / "out"
    check_unlocked(out)
    assert not out.exists()  # asking makes nothing
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, out], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        for ask in (lock, check_unlocked):
            told = rf"out: another process is writing there: pid {holder.pid} on \S+ \(wait until"
            with pytest.raises(InputError, match=told):
                ask(out)
        (out / WRITER).unlink()
        with pytest.raises(InputError, match=r"out: another process is writing there \(wait"):
            check_unlocked(out)
    finally:
        holder.kill()
        holder.communicate()
    (out / WRITER).write_text(f"pid {holder.pid} on here\n")
    check_unlocked(out)
    lock(out).release()
    assert str(holder.pid) not in (out / WRITER).read_text()
