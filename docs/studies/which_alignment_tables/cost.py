"""What each method reaches for the same arithmetic and for the same time of a core."""

import json
from pathlib import Path
from typing import NamedTuple

from sinsjax.report.base import Table

from .field import TIMES_S, Cell, Field, Start, angle, reach

HISTORY = Path(__file__).parents[3] / "benchmarks" / "history" / "0.6.0_amd-epyc-avx512.json"
RATE_HZ = 100
MILLIONS = (1, 3, 10, 30)
"""Budgets of a run in operations, 10^6."""

MILLISECONDS = (0.03, 0.1, 0.3, 1.0)
"""Budgets of a run in time of one core, ms."""

ROWS = {"kalman5": "kalman"}
"""What the benchmarks call a method, where they call it otherwise."""

TRIGGER = "linearisation"
"""What they call the plain filter with that trigger."""


class Cost(NamedTuple):
    """Of a sample and run: arithmetic, and time of one core, ns."""

    operations: float
    ns: float


def costs(field: Field) -> dict[str, Cost]:
    """By arm, from the benchmarks' history; of those that are one method from the first sample."""
    rows = json.loads(HISTORY.read_text(encoding="utf-8"))
    timed = {row["name"]: row for row in rows if row["set"] == "methods"}
    names = {
        arm: TRIGGER if "triggered" in arm else ROWS.get(method, method)
        for arm, method in field.methods.items()
        if "coarse" not in arm
    }
    return {
        arm: Cost(timed[name]["operations"], timed[name]["ns_per_step_run"])
        for arm, name in names.items()
        if name in timed
    }


def table(field: Field, starts: tuple[Start, ...], base: str, grade: float) -> Table:
    """The error that a budget buys, at the last time told that it lasts for."""

    def bought(arm: str, budget: float, each: float) -> str:
        times = [t for t in TIMES_S if t * RATE_HZ * each <= budget]
        if not times:
            return "-"
        cell = Cell(starts, field.bases[base], grade, times[-1])
        return f"{angle(reach(field.errors(arm, cell)))} ({times[-1]} s)"

    rows = [
        [
            arm,
            f"{cost.operations:.0f}",
            f"{cost.ns:.1f}",
            *(bought(arm, 1e6 * budget, cost.operations) for budget in MILLIONS),
            *(bought(arm, 1e6 * budget, cost.ns) for budget in MILLISECONDS),
        ]
        for arm, cost in costs(field).items()
    ]
    header = ["method", "operations per sample", "time per sample (ns)"]
    header += [f"{budget} million operations" for budget in MILLIONS]
    header += [f"{budget:g} ms" for budget in MILLISECONDS]
    note = (
        "One core, AVX-512, float64, without the sensors' noise; in parentheses the data covered."
    )
    title = f"Equal arithmetic or time, {base}"
    return Table(title, header, rows, note, folded=True)
