"""Runs the benchmarks and writes their rows to ``history/``, a file a version and machine.

Each set runs in a process of its own, because cores and devices are chosen once a process. A set
that is measured again replaces its rows; the others stay.
"""

import argparse
import datetime
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import common
import store

from sinsjax.bench.timing import Row
from sinsjax.errors import InputError

SCRIPTS = (
    "pairs",
    "throughput",
    "noise",
    "methods",
    "devices",
    "scaling",
    "cold_start",
    "first_command",
    "resolve",
    "derivative",
    "memory",
    "loops",
    "single_precision",
    "instructions",
    "gpu",
)
"""Scripts beside this one, each a set. The set ``short`` is ``sinsjax bench --limit``."""

SETS = ("short", *SCRIPTS)


def command(name: str, repeats: int | None) -> list[str]:
    """What measures a set and prints its rows as JSON lines."""
    flags = ["--json"] if repeats is None else ["--json", "--repeats", str(repeats)]
    if name == "short":
        return [sys.executable, "-m", "sinsjax", "bench", "--limit", *flags]
    return [sys.executable, str(Path(__file__).parent / f"{name}.py"), *flags]


def measured(name: str, repeats: int | None = None) -> list[Row]:
    """Run a set on this tree's source.

    Returns:
        Its rows, with ``set``, ``date`` and this tree's version.

    Raises:
        InputError: it failed; what it complained about is on stderr.
    """
    path = os.pathsep.join(filter(None, [str(common.ROOT), os.environ.get("PYTHONPATH")]))
    ended = subprocess.run(
        command(name, repeats),
        stdout=subprocess.PIPE,
        text=True,
        cwd=common.ROOT,
        env=os.environ | {"PYTHONPATH": path},
    )
    if ended.returncode:
        raise InputError(f"{name}: failed with exit status {ended.returncode}")
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    told = {"set": name, "date": today, "sinsjax": common.source_version()}
    # First in the row, and right also where the tree is not installed.
    return [told | json.loads(line) | told for line in ended.stdout.splitlines()]


def main(arguments: Sequence[str] | None = None, folder: Path = store.HISTORY) -> None:
    """Measure the sets that are asked for, one after another; 1 if one of them failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", help=f"sets, comma between: {', '.join(SETS)}")
    parser.add_argument("--repeats", type=int, help="timings a row; each script's own if left out")
    flags = parser.parse_args(arguments)
    wanted = flags.only.split(",") if flags.only else list(SETS)
    if unknown := [name for name in wanted if name not in SETS]:
        parser.error(f"--only: no set {', '.join(unknown)}; there are {', '.join(SETS)}")
    failed = False
    for name in wanted:
        print(f"{name} ...", flush=True)
        try:
            rows = measured(name, flags.repeats)
            written = ", ".join(path.name for path in store.keep(rows, SETS, folder)) or "nothing"
            print(f"{name}: {len(rows)} rows to {written}", flush=True)
        except InputError as error:
            print(f"error: {error}", file=sys.stderr)
            failed = True
    sys.exit(int(failed))


if __name__ == "__main__":
    main()
