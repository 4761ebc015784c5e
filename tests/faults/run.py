"""Apply each fault to a copy of the repository and record the tests that notice it, by stages.

    python tests/faults/run.py [NAME ...] [--jobs 2]
    python tests/faults/run.py [NAME ...] --recorded     # whether the recorded killers still kill

    golden     tests/golden, until one fails
    commands   tests/acceptance: all functions that fail
    oracles    test files with an independent calculation (`oracles`): all functions that fail
    other      the files that the fault's entry names, the folders of tests that belong to its
               folder, and everything, until one fails

In each stage fast tests come first; nightly ones run where none of them fails. `outcome.csv` gets
the killers of a fault, ``-`` for none, and the tier of the fastest.
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
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from queue import Queue

sys.path.insert(0, str(Path(__file__).parents[1]))

from faults.patches import HERE, Fault, load  # noqa: E402

STAGES = ("golden", "commands", "oracles", "other")
COLUMNS = ("fault", *STAGES, "tier", "seconds")
OUTCOME = HERE / "outcome.csv"
TIERS = {"fast": "not nightly", "nightly": "nightly"}
NONE, SEPARATOR = "-", " | "
DATA = HERE.parents[2] / "shared" / "data"  # recorded data; a copy has none beside it
HANGS_S = 3600  # a fault may make a test wait for ever

_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+(?: \S+)*?)(?: - .*)?$", re.MULTILINE)
_ORACLES = re.compile(r"^ *(?:from|import) oracles", re.MULTILINE)

Row = dict[str, str]


def selections(fault: Fault, stage: str, tree: Path) -> Iterator[list[str]]:
    """Yield the arguments that select the tests of a stage, one set after the other."""
    if stage == "golden":
        yield ["-x", "tests/golden"]
    elif stage == "commands":
        yield ["tests/acceptance"]
    elif stage == "oracles":
        files = sorted(tree.glob("tests/**/test_*.py"))
        yield [str(f.relative_to(tree)) for f in files if _ORACLES.search(f.read_text())]
    else:
        yield ["-x", *fault.tests]
        yield ["-x", *fault.folder_tests]
        yield ["-x", "tests", "--ignore=tests/faults"]  # these notice every patch


def killers(row: Row) -> list[str]:
    """Return the recorded killers of a fault, those of the first stage first."""
    cells = [row[stage].split(SEPARATOR) for stage in STAGES]
    return [name for cell in cells for name in cell if name and not name.startswith(NONE)]


def copy_tree(tree: Path, to: Path) -> None:
    """Copy a repository without what is generated or cached."""
    left_out = shutil.ignore_patterns(".*_cache", ".git", ".venv", "__pycache__", "out*", "site")

    def ignore(folder: str, names: list[str]) -> set[str]:
        return left_out(folder, names) if Path(folder) == tree else {"__pycache__"} & {*names}

    shutil.copytree(tree, to, ignore=ignore, dirs_exist_ok=True)


def failures(copy: Path, selected: list[str]) -> list[str]:
    """Run tests; return the names of those that fail."""
    command = [sys.executable, "-m", "pytest", "-q", "-rfE", "--tb=no", "--no-header"]
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
        return [f"no end within {HANGS_S} s"]
    if (found := _FAILED.findall(done.stdout)) or done.returncode in (0, 5):  # 5: none selected
        return found
    raise RuntimeError(f"pytest {' '.join(selected)}:\n{done.stdout}{done.stderr}")


@contextmanager
def patched(fault: Fault, copies: Queue[Path]) -> Iterator[Path]:
    """Give a copy of the repository with a fault, which is taken back at the end."""
    copy = copies.get()
    file = copy / fault.file
    sound = file.read_bytes()
    _forget_bytecode(file)
    try:
        file.write_text(fault.patched(sound.decode()))
        yield copy
    finally:
        file.write_bytes(sound)
        _forget_bytecode(file)
        copies.put(copy)


def find_killers(fault: Fault, copies: Queue[Path]) -> Row:
    """Return the row of a fault: by stages, the tests that fail with it in a copy."""
    row, started = {"fault": fault.name, "tier": ""}, time.monotonic()
    with patched(fault, copies) as copy:
        for stage in STAGES:
            found: list[str] = []
            for tier, marker in TIERS.items():
                for selected in selections(fault, stage, copy):
                    found = found or failures(copy, [*selected, "-m", marker])
                if found:
                    row["tier"] = min(row["tier"] or tier, tier)  # fast before nightly
                    break
            if stage in ("commands", "oracles"):  # functions, not cases
                found = list(dict.fromkeys(name.partition("[")[0] for name in found))
            row[stage] = SEPARATOR.join(found) or NONE
    return row | {"seconds": f"{time.monotonic() - started:.0f}"}


def survives(fault: Fault, row: Row | None, copies: Queue[Path]) -> bool:
    """Apply a fault to a copy and run the last killer recorded for it.

    A test runs with all its cases, whose names change; a golden study alone.
    """
    if row is None or not (recorded := killers(row)):
        return True
    name, bracket, case = recorded[-1].partition("[")
    killer = name + bracket + case if name.startswith("tests/golden") else name
    with patched(fault, copies) as copy:
        return not failures(copy, ["-x", killer])


def _forget_bytecode(file: Path) -> None:
    """Python compares time stamps in whole seconds, and sizes: a changed sign leaves both."""
    for compiled in (file.parent / "__pycache__").glob(f"{file.stem}.*"):
        compiled.unlink()


def known_outcomes(path: Path) -> dict[str, Row]:
    """Return the rows of a file of outcomes by fault; empty if there is no file."""
    lines = path.read_text().splitlines() if path.exists() else []
    return {row["fault"]: row for row in csv.DictReader(lines)}


def main() -> int:
    """Try faults; 1 if one of them survives."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--recorded", action="store_true")
    asked = parser.parse_args()

    everything, rows = load(), known_outcomes(OUTCOME)
    order = [fault.name for fault in everything]
    if unknown := sorted({*asked.names} - {*order}):
        sys.exit(f"no fault named {', '.join(unknown)}")
    faults = [fault for fault in everything if fault.name in asked.names or not asked.names]
    with tempfile.TemporaryDirectory(prefix="sinsjax-faults-") as work:
        copies: Queue[Path] = Queue()
        for number in range(asked.jobs):
            copies.put(Path(work) / str(number))
            copy_tree(HERE.parents[1], Path(work) / str(number))

        with ThreadPoolExecutor(asked.jobs) as pool:
            if asked.recorded:
                lives = pool.map(lambda f: survives(f, rows.get(f.name), copies), faults)
                alive = [f.name for f, lived in zip(faults, lives, strict=True) if lived]
            else:
                for row in pool.map(lambda fault: find_killers(fault, copies), faults):
                    rows[row["fault"]] = row
                    with OUTCOME.open("w", newline="") as file:
                        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
                        writer.writeheader()
                        writer.writerows(rows[name] for name in order if name in rows)
                alive = [fault.name for fault in faults if not killers(rows[fault.name])]
    print(f"survivors, of {len(faults)}: {alive or 'none'}")
    return int(bool(alive))


if __name__ == "__main__":
    sys.exit(main())
