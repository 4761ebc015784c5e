"""Command lines in processes with additional packages.

They are forked from a server that has imported the libraries which ``sinsjax`` takes most of a
second to import, and nothing of ``sinsjax``, which looks for methods of other packages as it is
imported.
"""

import json
import os
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

_LIBRARIES = (
    *("jax.numpy", "jax.scipy.linalg", "jax.scipy.special", "jaxtyping", "pyarrow.dataset"),
    *("pyarrow.parquet", "pydantic", "rich.console", "scipy.stats", "typer"),
)


class CompletedCommand(NamedTuple):
    """Result of a command line, with the field names of `subprocess`."""

    returncode: int
    stdout: str
    stderr: str


class CommandServer:
    """Server that forks a process for some command lines, one after the other."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __call__(self, *commands: tuple[str, ...], site: Path, cwd: Path) -> list[CompletedCommand]:
        """Run command lines in a separate process.

        Args:
            commands: arguments of each command line.
            site: folder of additional packages.
            cwd: working directory.
        """
        requests, answers = self._process.stdin, self._process.stdout
        assert requests is not None and answers is not None
        with tempfile.TemporaryDirectory() as folder:
            output_paths = [
                [f"{folder}/{n}.{name}" for name in CompletedCommand._fields]
                for n in range(len(commands))
            ]
            request = {
                "commands": commands,
                "output_paths": output_paths,
                "site": str(site),
                "cwd": str(cwd),
            }
            print(json.dumps(request), file=requests, flush=True)
            assert answers.readline() == "done\n"
            texts = [[Path(path).read_text() for path in paths] for paths in output_paths]
        return [CompletedCommand(int(code), output, error) for code, output, error in texts]

    def close(self) -> None:
        """End the server."""
        self._process.communicate()


def _serve() -> None:
    for name in _LIBRARIES:
        import_module(name)
    for line in sys.stdin:
        process = os.fork()
        if not process:
            _run_commands(**json.loads(line))
        os.waitpid(process, 0)
        print("done", flush=True)


def _run_commands(
    commands: list[list[str]], output_paths: list[list[str]], site: str, cwd: str
) -> None:
    os.chdir(cwd)
    sys.path.insert(0, site)
    for words, (code, *outputs) in zip(commands, output_paths, strict=True):
        for number, path in enumerate(outputs, start=1):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
        Path(code).write_text(str(_run_command(words)))
    os._exit(0)


def _run_command(arguments: list[str]) -> Any:
    from sinsjax import cli

    sys.argv = ["sinsjax", *arguments]
    try:
        cli.main()
    except SystemExit as stop:
        return stop.code or 0
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0


if __name__ == "__main__":
    _serve()
