"""Apply each fault to a copy of the repository and record the first test that notices it.

    python tests/faults/run.py [NAME ...] [--part 1/3] [--jobs 2] [--results FILE]

For each fault the test files that its entry names run first, then the golden studies, the folders
of tests that belong to its folder and the whole fast tier, and for survivors the slow tests in the
same order. The first failing test ends it. `outcome.csv` gets one row per fault as soon as it is
known, and faults that have a row are skipped: delete the row, or the file, to run them again.

    --tree DIR     the repository to test, if not this one (an older version, to compare)
    --one-tier     tests of that version have no tiers: ignore the marker `slow`
    --stages LIST  any of named, golden, folders, all; by default all four
"""

import argparse
import csv
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

sys.path.insert(0, str(Path(__file__).parents[1]))

from faults.patches import HERE, Fault, load  # noqa: E402

COLUMNS = ("fault", "killed_by", "tier", "stage", "seconds")
OUTCOME = HERE / "outcome.csv"
TIERS = {"fast": "not slow", "slow": "slow"}
DATA = HERE.parents[2] / "shared" / "data"
"""Recorded data; a copy has none beside it."""
HANGS_S = 3600  # a fault may make a test wait for ever

_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+(?: \S+)*?)(?: - .*)?$", re.MULTILINE)


@dataclass(frozen=True)
class Plan:
    """What to run: stages in order, and each tier's marker expression."""

    stages: tuple[str, ...]
    tiers: dict[str, str]

    def selections(self, fault: Fault) -> Iterator[tuple[str, str, list[str]]]:
        """Yield tier, stage and the arguments that select its tests."""
        paths = {
            "named": fault.tests,
            "golden": ("tests/golden",),
            "folders": fault.folder_tests,
            "all": ("tests", "--ignore=tests/faults"),  # these notice every patch
        }
        for tier, marker in self.tiers.items():
            for stage in self.stages:
                yield tier, stage, [*paths[stage], "-m", marker]


def copy_tree(tree: Path, to: Path) -> None:
    """Copy a repository without what is generated or cached."""
    left_out = shutil.ignore_patterns(".*_cache", ".git", ".venv", "__pycache__", "out*", "site")

    def ignore(folder: str, names: list[str]) -> set[str]:
        return left_out(folder, names) if Path(folder) == tree else {"__pycache__"} & {*names}

    shutil.copytree(tree, to, ignore=ignore, dirs_exist_ok=True)


def first_failure(copy: Path, selected: list[str]) -> str | None:
    """Run tests until one fails; its name, or None."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-rfE", "--tb=no", "--no-header"]
    paths = filter(None, [str(copy), os.environ.get("PYTHONPATH")])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    if DATA.is_dir():
        environment.setdefault("SINSJAX_DATA", str(DATA))
    try:
        done = subprocess.run(
            [*command, "-p", "no:cacheprovider", "-m", "", *selected],
            cwd=copy, env=environment, capture_output=True, text=True, timeout=HANGS_S,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"no end within {HANGS_S} s"
    if done.returncode in (0, 5):  # all passed, or none selected
        return None
    if found := _FAILED.search(done.stdout):
        return found[1]
    raise RuntimeError(f"pytest {' '.join(selected)}:\n{done.stdout}{done.stderr}")


def try_fault(fault: Fault, copy: Path, plan: Plan) -> dict[str, object]:
    """Apply a fault to a copy, run its tests and take the fault back; the row of its outcome."""
    file = copy / fault.file
    sound = file.read_bytes()
    started = time.monotonic()
    row: dict[str, object] = {"fault": fault.name, "killed_by": "", "tier": "", "stage": ""}
    try:
        file.write_text(fault.patched(sound.decode()))
        _forget_bytecode(file)
        for tier, stage, selected in plan.selections(fault):
            if test := first_failure(copy, selected):
                row |= {"killed_by": test, "tier": tier, "stage": stage}
                break
    finally:
        file.write_bytes(sound)
        _forget_bytecode(file)
    return row | {"seconds": round(time.monotonic() - started)}


def _forget_bytecode(file: Path) -> None:
    """Python compares time stamps in whole seconds, and sizes: a changed sign leaves both."""
    for compiled in (file.parent / "__pycache__").glob(f"{file.stem}.*"):
        compiled.unlink()


def known_outcomes(path: Path) -> dict[str, dict[str, str]]:
    """Return the rows of a file of outcomes by fault; empty if there is no file."""
    if not path.exists():
        return {}
    with path.open(newline="") as file:
        return {row["fault"]: row for row in csv.DictReader(file)}


def write_outcomes(path: Path, rows: dict[str, dict[str, str]], order: list[str]) -> None:
    """Write the rows in the order of the list of faults."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows[name] for name in order if name in rows)


def chosen(faults: list[Fault], names: list[str], part: str) -> list[Fault]:
    """Return the faults of these names, or the K-th of N parts of all."""
    if names:
        if unknown := set(names) - {fault.name for fault in faults}:
            sys.exit(f"no fault named {', '.join(sorted(unknown))}")
        return [fault for fault in faults if fault.name in names]
    number, parts = map(int, part.split("/"))
    return faults[number - 1 :: parts]


def main() -> int:
    """Run what has no row yet; 1 if a fault of those asked for survives."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--part", default="1/1")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--results", type=Path, default=OUTCOME)
    parser.add_argument("--tree", type=Path, default=HERE.parents[1])
    parser.add_argument("--one-tier", action="store_true")
    parser.add_argument("--stages", default="named,golden,folders,all")
    asked = parser.parse_args()

    everything = load()
    order = [fault.name for fault in everything]
    faults = chosen(everything, asked.names, asked.part)
    tiers = {"only": ""} if asked.one_tier else TIERS
    plan = Plan(tuple(asked.stages.split(",")), tiers)
    rows = known_outcomes(asked.results)
    waiting = [fault for fault in faults if fault.name not in rows]
    with tempfile.TemporaryDirectory(prefix="sinsjax-faults-") as work:
        copies: Queue[Path] = Queue()
        for number in range(asked.jobs):
            copies.put(Path(work) / str(number))
            copy_tree(asked.tree, Path(work) / str(number))

        def attempt(fault: Fault) -> dict[str, object]:
            copy = copies.get()
            try:
                return try_fault(fault, copy, plan)
            finally:
                copies.put(copy)

        with ThreadPoolExecutor(asked.jobs) as pool:
            for done in as_completed([pool.submit(attempt, fault) for fault in waiting]):
                row = done.result()
                rows[str(row["fault"])] = {key: str(value) for key, value in row.items()}
                write_outcomes(asked.results, rows, order)
                print(
                    f"{row['fault']}: {row['killed_by'] or 'SURVIVED'} ({row['seconds']} s)",
                    flush=True,
                )
    survivors = [fault.name for fault in faults if not rows[fault.name]["killed_by"]]
    print(
        f"{len(faults) - len(survivors)} of {len(faults)} killed; survivors: {survivors or 'none'}"
    )
    return int(bool(survivors))


if __name__ == "__main__":
    sys.exit(main())
