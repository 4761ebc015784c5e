"""End of a process of the command line."""

import subprocess
import sys
from pathlib import Path

import pytest

_REFUSED_WHILE_IMPORTING = """
import jax.monitoring
from sinsjax.cli import running

running._import_while_compiling("slow")
jax.monitoring.record_event_duration_secs(running._LOWERED, 0.1)
raise SystemExit(2)
"""


@pytest.mark.nightly
def test_process_waits_for_import_thread_before_exit(tmp_path: Path) -> None:
    """Python would stop the thread in an extension module with "terminate called"."""
    (tmp_path / "slow.py").write_text("import time\ntime.sleep(0.3)\nprint('imported')\n")
    ended = subprocess.run(
        [sys.executable, "-c", _REFUSED_WHILE_IMPORTING],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (2, "imported\n", "")
