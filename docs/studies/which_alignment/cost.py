"""What each method reaches for the same arithmetic and for the same time of a core."""

import json
from pathlib import Path
from typing import NamedTuple

from sinsjax.report.base import Table

from .field import TIMES_S, Cell, Field, Start, angle, reach

HISTORY = Path(__file__).parents[3] / "benchmarks" / "history" / "0.6.0_amd-epyc-avx512.json"
RATE_HZ = 100
MILLIONS = (2, 5, 15, 50)
"""Budgets in operations, 10^6."""

MILLISECONDS = (0.1, 0.3, 1.0, 3.0)
"""Budgets in time of one core, ms."""

_ROWS = {"kalman5": "kalman"}


class Cost(NamedTuple):
    """Of a sample and run: arithmetic, and time of one core, ns."""

    operations: float
    ns: float


def costs() -> dict[str, Cost]:
    """By method, from the benchmarks' history."""
    rows = json.loads(HISTORY.read_text(encoding="utf-8"))
    found = {row["name"]: row for row in rows if row["set"] == "methods"}
    return {
        name: Cost(row["operations"], row["ns_per_step_run"])
        for name, row in ((_name(key), row) for key, row in found.items())
        if "operations" in row
    }


def table(field: Field, starts: tuple[Start, ...], base: str, grade: float) -> Table:
    """The error that a budget buys, at the last time told that it lasts for."""
    known = costs()
    rows = []
    for arm, method in field.methods.items():
        if (cost := known.get(method)) is None or "reset_trigger" in arm:
            continue
        cells = []
        for budgets, each in ((MILLIONS, cost.operations / 1e6), (MILLISECONDS, cost.ns / 1e6)):
            for budget in budgets:
                lasts = budget / (each * RATE_HZ)
                times = [t for t in TIMES_S if t <= lasts]
                if not times:
                    cells.append("-")
                    continue
                cell = Cell(starts, field.bases[base], grade, times[-1])
                cells.append(f"{angle(reach(field.errors(arm, cell)))} ({times[-1]} s)")
        rows.append([arm, f"{cost.operations:.0f}", f"{cost.ns:.1f}", *cells])
    header = ["method", "operations a sample", "ns a sample"]
    header += [f"{m} million operations" for m in MILLIONS]
    header += [f"{ms:g} ms" for ms in MILLISECONDS]
    note = (
        "Heading error from true north that 95 % of the runs stay below, by what the budget of a"
        f" run lasts for at {RATE_HZ} Hz: the last of {', '.join(map(str, TIMES_S))} s that it"
        " reaches. One core with AVX-512, float64, 64 runs side by side, silent sensors."
    )
    title = f"What the same arithmetic and the same time buy: {base}, gyro bias {grade:g} deg/h"
    return Table(title, header, rows, note, folded=True)


def _name(row: str) -> str:
    """The method of a benchmark's row."""
    return {row_name: method for method, row_name in _ROWS.items()}.get(row, row)
