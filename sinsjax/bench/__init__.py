"""The short benchmark set: time of the engine's step on one core, in ns per step per run.

Every row times a compiled function of the engine. The scripts in ``benchmarks/`` time more with the
same modules: `timing` is the timer, `cases` and `limit` define the workloads.
"""

import json
import sys
import tempfile
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from sinsjax import console as screen
from sinsjax.bench.cases import SHORT
from sinsjax.bench.limit import find_compiler, limit_kernel_workload
from sinsjax.bench.timing import (
    Row,
    Workload,
    measure_workloads,
    measurement_conditions,
    pin_to_one_core,
)
from sinsjax.errors import InputError
from sinsjax.platform import runtime
from sinsjax.platform.assets import asset_path

__all__ = [
    "SHORT",
    "Workload",
    "Row",
    "asset_path",
    "measurement_conditions",
    "measure_workloads",
    "run_benchmarks",
    "short_workloads",
]


def run_benchmarks(console: Console, *, as_json: bool, limit: bool, repeats: int) -> None:
    """Time the short set on one core and print it.

    Args:
        console: where to print.
        as_json: whether to print one JSON object per line instead of a table.
        limit: whether to time the limit kernel too, if gcc works.
        repeats: timings per row.

    Raises:
        InputError: the limit kernel cannot be built or crashes.
    """
    pin_to_one_core()
    runtime.start_backend()
    with tempfile.TemporaryDirectory(prefix="sinsjax-limit-") as folder:
        rows = measure_workloads(short_workloads(limit_folder=folder if limit else None), repeats)
    conditions = measurement_conditions()
    if conditions["platform"] == "cpu" and conditions["options"] != "all":
        print("warning: not all compiler options are set, see `sinsjax info`", file=sys.stderr)
    if as_json:
        for row in rows:
            screen.print_line(console, json.dumps(row | conditions))
        return
    console.print(_results_table(rows))
    about = f"{conditions['cpu']}, jax {conditions['jax']}, median of {repeats} turns on one core"
    screen.print_line(console, about, wrap=True)


def short_workloads(*, limit_folder: str | None) -> list[Workload]:
    """The rows of the short set, compiled and ready to time.

    Args:
        limit_folder: where to build the limit kernel; None to omit it. If gcc does not work, it is
            omitted with a warning on stderr.
    """
    out = []
    if limit_folder:
        try:
            gcc = find_compiler()
        except InputError as error:
            print(f"warning: no limit kernel: {error}", file=sys.stderr)
        else:
            out.append(limit_kernel_workload(gcc, limit_folder))
    return out + [make() for make in SHORT.values()]


def _results_table(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="ns per step per run", box=box.SIMPLE)
    headings = {
        "name": "name",
        "ns_per_step_run": "ns",
        "compile_s": "compile s",
        "median_s": "median s",
        "spread_s": "+- s",
    }
    for key, heading in headings.items():
        table.add_column(heading, justify="left" if key == "name" else "right", no_wrap=True)
    kernel = next((r["ns_per_step_run"] for r in rows if r["name"] == "limit_kernel"), None)
    if kernel:
        table.add_column("x limit", justify="right", no_wrap=True)
    for row in rows:
        ratio = [f"{row['ns_per_step_run'] / kernel:.2f}"] if kernel else []
        table.add_row(*(str(row[key]) for key in headings), *ratio)
    return table
