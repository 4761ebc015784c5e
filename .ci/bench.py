"""Read ``benchmarks/bench.py --json`` from standard input, check its rows and print them."""

import json
import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from cases import SHORT

KEYS = (
    "name",
    "ns_per_step_run",
    "runs",
    "steps",
    "dtype",
    "devices",
    "compile_s",
    "median_s",
    "spread_s",
)


def main() -> None:
    """Fail with a message if a row or a key is missing, or a time is no positive number."""
    rows = [json.loads(line) for line in sys.stdin]
    for row in rows:
        if missing := [key for key in KEYS if key not in row]:
            sys.exit(f"{row.get('name')}: no {missing}")
        if not (math.isfinite(row["ns_per_step_run"]) and row["ns_per_step_run"] > 0):
            sys.exit(f"{row['name']}: ns_per_step_run is {row['ns_per_step_run']}")
        print(f"{row['name']:24} {row['ns_per_step_run']:10.1f} ns a step and run")
    if missing_rows := sorted(set(SHORT) - {row["name"] for row in rows}):
        sys.exit(f"no rows {missing_rows}")


if __name__ == "__main__":
    main()
