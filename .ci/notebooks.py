"""Execute every notebook on a copy and compare its outputs with the stored ones.

    .ci/notebooks.py [NOTEBOOK ...]          # as CI does
    .ci/notebooks.py --write [NOTEBOOK ...]  # store the outputs of this execution
    .ci/notebooks.py --tidy [NOTEBOOK ...]   # without execution: tidy the stored outputs

Each notebook runs in its own folder, two at a time. Stored outputs are tidy: no times in the
metadata, cells counted from 1, figures of at most 256 colours. A notebook fails if a cell raises
or writes to stderr, if its outputs are missing, contain a path, a date or an address in memory, or
make it 200 kB or larger.

Outputs agree if they have the same kinds and words and their numbers differ by at most 5 % or 2 of
the last printed digit, since CPUs of other vector instructions round differently. Durations and
rates fail this comparison, as they should. Of figures only their presence is compared.
"""

import argparse
import base64
import io
import math
import os
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbformat import NotebookNode
from PIL import Image
from traitlets.config import Config

FOLDER = Path(__file__).parents[1] / "notebooks"
TIMEOUT_S = 300
AT_A_TIME = 2
LIMIT_KB = 200
SHORT = {"advise", "own_record", "reset_law", "sweep_tables", "tuning"}
"""Notebooks that compile longer than they compute, so that optimising compilation does not pay."""

_LOCAL = re.compile(
    r"(?<![\w.)/])~?/(?:[\w.-]+/)+|[A-Z]:\\|\d{4}-\d\d-\d\d|\d\d:\d\d:\d\d|0x[0-9a-f]{6}"
)
_ANSI = re.compile(r"\x1b\[[\d;]*m")
_TOKEN = re.compile(r"(?P<number>[-+]?\d+(?:\.(?P<decimals>\d+))?(?:[eE][-+]?\d+)?)|[^\W\d]+")


def execute(notebook: NotebookNode, path: Path) -> None:
    """Run the cells of a notebook in the folder of its path.

    Raises:
        CellExecutionError: a cell raised.
    """
    fast = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"} if path.stem in SHORT else {}
    with tempfile.TemporaryDirectory() as sockets:
        NotebookClient(
            notebook,
            timeout=TIMEOUT_S,
            kernel_name="python3",
            coalesce_streams=True,
            record_timing=False,
            resources={"metadata": {"path": str(path.parent)}},
            # Over TCP, the default, a kernel warns that it is not encrypted.
            config=Config(KernelManager={"transport": "ipc", "ip": f"{sockets}/kernel"}),
        ).execute(env=os.environ | fast)


def tidy(notebook: NotebookNode) -> None:
    """Keep only what does not depend on the machine, with small figures."""
    notebook.metadata = nbformat.from_dict(
        {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        }
    )
    for number, cell in enumerate(code_cells(notebook), 1):
        cell.metadata = NotebookNode()
        if cell.execution_count:
            cell.execution_count = number
        for output in cell.outputs:
            if "execution_count" in output:
                output.execution_count = number
            if "text" in output:
                output.text = _ANSI.sub("", output.text)
            if "metadata" in output:
                output.metadata = NotebookNode()
            if figure := output.get("data", {}).get("image/png"):
                output.data["image/png"] = _shrink(figure)


def _shrink(figure: str) -> str:
    """Return a base64 PNG with a palette in place of full colour."""
    image = Image.open(io.BytesIO(base64.b64decode(figure)))
    if image.mode == "P":
        return figure
    small = io.BytesIO()
    palette = image.convert("RGB").quantize(256, Image.Quantize.FASTOCTREE)
    palette.save(small, "png", optimize=True)
    return base64.b64encode(small.getvalue()).decode()


def code_cells(notebook: NotebookNode) -> list[NotebookNode]:
    """Return the cells of code."""
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def stored_faults(notebook: NotebookNode) -> Iterator[str]:
    """Yield what must not be stored."""
    size = len(nbformat.writes(notebook)) / 1000
    if size >= LIMIT_KB:
        yield f"{size:.0f} kB, {LIMIT_KB} kB or more"
    cells = code_cells(notebook)
    if not any(cell.outputs for cell in cells):
        yield "no outputs (.ci/notebooks.py --write stores them)"
    for number, cell in enumerate(cells, 1):
        if cell.execution_count != number:
            yield f"cell of code {number}: execution count {cell.execution_count}"
        for output in cell.outputs:
            if output.output_type == "error" or output.get("name") == "stderr":
                yield f"cell of code {number}: an error, or text on stderr"
            for text in _texts(output):
                if found := _LOCAL.search(text):
                    yield f"cell of code {number}: output contains {found[0]}"


def differences(stored: NotebookNode, executed: NotebookNode) -> Iterator[str]:
    """Yield where executed outputs differ from stored ones by more than rounding."""
    pairs = zip(code_cells(stored), code_cells(executed), strict=True)
    for number, (old, new) in enumerate(pairs, 1):
        if [_kind(output) for output in old.outputs] != [_kind(output) for output in new.outputs]:
            yield f"cell of code {number}: other kinds of outputs"
            continue
        for a, b in zip(old.outputs, new.outputs, strict=True):
            for was, now in zip(_texts(a), _texts(b), strict=True):
                if fault := _differ(was, now):
                    yield f"cell of code {number}: {fault}"


def _kind(output: NotebookNode) -> tuple[str, ...]:
    return (output.output_type, output.get("name", ""), *sorted(output.get("data", {})))


def _texts(output: NotebookNode) -> list[str]:
    """Return the texts of an output but for HTML, which repeats the plain text."""
    data = output.get("data", {})
    texts = [data[kind] for kind in sorted(data) if kind in ("text/plain", "text/markdown")]
    return [output.text] if "text" in output else texts


def _differ(was: str, now: str) -> str:
    """Return how two texts differ, or an empty string; rules and spaces of tables do not count."""
    old, new = list(_TOKEN.finditer(was)), list(_TOKEN.finditer(now))
    if len(old) != len(new):
        return f"{was!r} is now {now!r}"
    for a, b in zip(old, new, strict=True):
        if a["number"] and b["number"]:
            digit = 10.0 ** -len(a["decimals"] or "")
            alike = math.isclose(float(a[0]), float(b[0]), rel_tol=0.05, abs_tol=2.1 * digit)
        else:
            alike = a[0] == b[0]
        if not alike:
            return f"{a[0]} is now {b[0]}"
    return ""


def check(path: Path, *, write: bool) -> tuple[str, float]:
    """Execute one notebook; return its faults, or an empty string, and the seconds it took."""
    started = time.monotonic()
    stored = nbformat.read(path, as_version=4)
    executed = nbformat.read(path, as_version=4)
    nbformat.validate(executed)
    try:
        execute(executed, path)
    except CellExecutionError as error:
        return str(error), time.monotonic() - started
    tidy(executed)
    faults = list(stored_faults(executed if write else stored))
    if write:
        nbformat.write(executed, path)
    elif not faults:
        faults += differences(stored, executed)
    return "\n".join(faults), time.monotonic() - started


def main() -> int:
    """Check, write or tidy the notebooks; 1 if one fails."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--write", action="store_true", help="store the outputs")
    parser.add_argument("--tidy", action="store_true", help="tidy stored outputs, no execution")
    parser.add_argument("paths", nargs="*", type=Path, help="all notebooks by default")
    args = parser.parse_args()
    paths = [path.resolve() for path in args.paths] or sorted(FOLDER.glob("*.ipynb"), reverse=True)
    failed = False
    if args.tidy:
        for path in paths:
            notebook = nbformat.read(path, as_version=4)
            tidy(notebook)
            nbformat.write(notebook, path)
            for fault in stored_faults(notebook):
                failed = True
                print(f"{path.name}: {fault}")
        return int(failed)
    with ProcessPoolExecutor(AT_A_TIME) as pool:
        for path, (faults, seconds) in zip(
            paths, pool.map(partial(check, write=args.write), paths), strict=True
        ):
            failed = failed or bool(faults)
            print(f"{path.name}: {faults or f'{seconds:.0f} s'}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
