"""Command lines run in the test's own process, and scripts in another."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from sinsjax import cli

Command = Callable[..., tuple[int, str, str]]


def command_line(monkeypatch, capsys):
    """Return a function that runs ``sinsjax``: exit code, output and error output."""

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["sinsjax", *map(str, words)])
        # Under `python -m pytest`, help would name that module.
        monkeypatch.setattr(sys.modules["__main__"], "__package__", None)
        with pytest.raises(SystemExit) as stop:
            cli.main()
        output = capsys.readouterr()
        return int(stop.value.code or 0), output.out, output.err

    return call


def run_python(script, **environment):
    """Run a script in a fresh interpreter, free of this one's settings."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("XLA_", "JAX_", "SINSJAX_"))}
    kept["PYTHONPATH"] = str(Path(cli.__file__).parents[2])
    command = [sys.executable, "-W", "always", "-c", script]
    return subprocess.run(
        command, env=kept | environment, capture_output=True, text=True, check=True, timeout=300
    )
