"""What the scripts of this folder share: their flags, their conditions, and how rows are printed.

A script has a function ``rows(quick, repeats)`` that measures and returns rows, and ends with
``common.main(rows)``. Everything that times is in `sinsjax.bench`.
"""

import argparse
import json
import os
import sys
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from sinsjax.bench.timing import Row, TimingSpread, measurement_conditions, pin_to_one_core
from sinsjax.errors import InputError
from sinsjax.platform import compile_cache, runtime

ROOT = Path(__file__).resolve().parents[1]

Rows = Callable[[bool, int], list[Row]]
"""Measures: (quick, repeats) to rows. Quick is tiny, to see that the script works."""

UNSHOWN = {"runs", "steps", "dtype", "devices", "ratios"}
"""Keys that the table leaves out, beside the conditions."""

HEADINGS = {"ns_per_step_run": "ns"}


def source_version() -> str:
    """The version of the tree that this folder is part of."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    return str(tomllib.loads(text)["project"]["version"])


def main(
    rows: Rows, arguments: Sequence[str] | None = None, *, one_core: bool = True, repeats: int = 7
) -> None:
    """Run a script: read its flags, measure, print.

    Args:
        rows: what the script measures.
        arguments: of the command line; None takes the process's own.
        one_core: whether the process keeps to one core, with one CPU device; else JAX gets a
            virtual CPU device a core.
        repeats: timings a row, unless ``--repeats`` says otherwise.
    """
    told = sys.modules[rows.__module__].__doc__ or ""
    parser = argparse.ArgumentParser(description=told.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    parser.add_argument("--quick", action="store_true", help="tiny sizes: does it work?")
    parser.add_argument("--repeats", type=int, default=repeats, help=f"timings a row ({repeats})")
    flags = parser.parse_args(arguments)
    if flags.repeats < 1:
        parser.error("--repeats: at least 1")
    if one_core:
        pin_to_one_core()
    else:
        os.environ[compile_cache.VARIABLE] = "0"  # as `pin_to_one_core` does
        runtime.configure()
    try:
        measured = rows(flags.quick, flags.repeats)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    if measured:
        show(measured, measurement_conditions(), as_json=flags.json)


def seconds(name: str, taken: Sequence[float]) -> Row:
    """A row of some times: their median, and half their range."""
    found = TimingSpread.from_values(taken)
    return {
        "name": name,
        "median_s": round(found.median, 4),
        "spread_s": round(found.half_range, 4),
    }


def show(rows: Sequence[Row], holds: Row, *, as_json: bool) -> None:
    """Print rows as a table, or as JSON lines that carry the conditions too.

    Args:
        rows: to print. What a row says of its own conditions stands.
        holds: the conditions of this process.
        as_json: whether for a program to read.
    """
    if as_json:
        for row in rows:
            print(json.dumps(holds | row), flush=True)
        return
    keys = list(dict.fromkeys(key for row in rows for key in row))
    hidden = UNSHOWN | holds.keys() | {f"{key}_spread" for key in keys} | {"spread_s"}
    shown = [key for key in keys if key not in hidden]
    table = Table(box=box.SIMPLE)
    for key in shown:
        heading = HEADINGS.get(key, key.replace("_", " "))
        table.add_column(heading, justify="left" if key == "name" else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(_cell(row, key) for key in shown))
    console = Console()
    console.print(table)
    console.print(f"{holds['cpu']}, {holds['device']}, jax {holds['jax']}", highlight=False)


def _cell(row: Row, key: str) -> str:
    spread = row.get("spread_s" if key == "median_s" else f"{key}_spread")
    return _text(row.get(key)) + (f" +- {spread:.2g}" if spread is not None else "")


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return " ".join(map(_text, value))
    return "" if value is None else str(value)
