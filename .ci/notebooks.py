"""Execute every notebook, in its own folder and on a copy, two at a time.

    .ci/notebooks.py [OUT]

The executed copies go to the folder OUT, if one is given. Fails if a notebook raises or is stored
with outputs.
"""

import os
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from traitlets.config import Config

TIMEOUT_S = 300
AT_A_TIME = 2
SHORT = {"advise", "own_record", "reset_law", "sweep_tables", "tuning", "why_p_lies"}
"""Notebooks that compile longer than they compute, so that optimising compilation does not pay."""


def execute(path: Path, out: Path | None) -> tuple[str, float]:
    """Run one notebook; what is wrong with it, or an empty string, and the seconds it took."""
    started = time.monotonic()
    return _wrong(path, out), time.monotonic() - started


def _wrong(path: Path, out: Path | None) -> str:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    if any(cell.outputs or cell.execution_count for cell in code):
        return "stored with outputs: strip them (pre-commit does)"
    with tempfile.TemporaryDirectory() as sockets:
        client = NotebookClient(
            notebook,
            timeout=TIMEOUT_S,
            kernel_name="python3",
            resources={"metadata": {"path": str(path.parent)}},
            # Over TCP, the default, a kernel warns that it is not encrypted.
            config=Config(KernelManager={"transport": "ipc", "ip": f"{sockets}/kernel"}),
        )
        try:
            fast = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"} if path.stem in SHORT else {}
            client.execute(env=os.environ | fast)
        except CellExecutionError as error:
            return str(error)
    if out is not None:
        nbformat.write(notebook, out / path.name)
    return ""


def main() -> int:
    """Run them all; 1 if one fails."""
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else None
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    # Backward: the longest is the last by name, and would run alone in the end.
    paths = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"), reverse=True)
    failed = False
    with ProcessPoolExecutor(AT_A_TIME) as pool:
        told = pool.map(partial(execute, out=out), paths)
        for path, (wrong, seconds) in zip(paths, told, strict=True):
            failed = failed or bool(wrong)
            print(f"{path.name}: {wrong or f'{seconds:.0f} s'}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
