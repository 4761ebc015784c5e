"""Command lines in processes that find packages of their own.

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
    """What became of a command line, by the names that `subprocess` gives them."""

    returncode: int
    stdout: str
    stderr: str


class CommandServer:
    """Forks a process for some command lines, one after the other; ends with `close`."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __call__(self, *commands: tuple[str, ...], site: Path, cwd: Path) -> list[CompletedCommand]:
        """Run command lines in a process of their own.

        Args:
            commands: words of each.
            site: where packages are found besides those that are installed.
            cwd: where it runs.
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
        """End it."""
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
