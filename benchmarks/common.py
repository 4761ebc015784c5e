"""What the scripts of this folder share: their flags, their conditions, and how rows are printed.

A script has a function ``rows(quick, repeats)`` that measures and returns rows, and ends with
``common.main(rows)``.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from timing import Row, measurement_conditions, pin_to_one_core

from sinsjax.errors import InputError
from sinsjax.platform import runtime

ROOT = Path(__file__).resolve().parents[1]

Rows = Callable[[bool, int], list[Row]]
"""Measures: (quick, repeats) to rows. Quick is tiny, to see that the script works."""

UNSHOWN = {"runs", "steps", "dtype", "devices", "ratios", "spread_s"}
"""Keys that the table leaves out, beside the conditions."""


def parser(text: str, repeats: int) -> argparse.ArgumentParser:
    """Return a parser of ``--json`` and ``--repeats``."""
    made = argparse.ArgumentParser(description=text.partition("\n")[0])
    made.add_argument("--json", action="store_true", help="one JSON object a line")
    made.add_argument(
        "--repeats",
        type=int,
        choices=range(1, 1000),
        metavar="N",
        default=repeats,
        help=f"timings ({repeats})",
    )
    return made


def or_exit(measure: Callable[[], list[Any]]) -> list[Any]:
    """Return what a function measures; a mistake is a line and exit code 2."""
    try:
        return measure()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def main(rows: Rows, *, one_core: bool = True, repeats: int = 7) -> None:
    """Run a script: read its flags, measure on one core or on all, print."""
    options = parser(sys.modules[rows.__module__].__doc__ or "", repeats)
    options.add_argument("--quick", action="store_true", help="tiny sizes: does it work?")
    flags = options.parse_args()
    if one_core:
        pin_to_one_core()
    else:
        os.environ[runtime.CACHE_VARIABLE] = "0"  # as `pin_to_one_core` does
        runtime.configure()
    if measured := or_exit(lambda: rows(flags.quick, flags.repeats)):
        show(measured, measurement_conditions(), as_json=flags.json)


def show(rows: Sequence[Row], holds: Row, *, as_json: bool) -> None:
    """Print rows as a table, or as JSON lines that carry the conditions too."""
    if as_json:
        for row in rows:
            print(json.dumps(holds | row), flush=True)
        return
    keys = list(dict.fromkeys(key for row in rows for key in row))
    hidden = UNSHOWN | holds.keys() | {f"{key}_spread" for key in keys}
    table = Table(box=box.SIMPLE)
    for key in (shown := [key for key in keys if key not in hidden]):
        heading = "ns" if key == "ns_per_step_run" else key.replace("_", " ")
        table.add_column(heading, justify="left" if key == "name" else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(_cell(row, key) for key in shown))
    console = Console()
    console.print(table)
    console.print(f"{holds['cpu']}, {holds['device']}, jax {holds['jax']}", highlight=False)


def _cell(row: Row, key: str) -> str:
    value: Any = row.get(key)
    spread = row.get("spread_s" if key == "median_s" else f"{key}_spread")
    text = f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)
    return text + (f" +- {spread:.2g}" if spread is not None else "")
