"""Apply each fault to a copy of the repository and record the tests that notice it, by stages.

    python tests/faults/run.py [NAME ...] [--stages golden] [--tiers fast] [--jobs 2]
    python tests/faults/run.py [NAME ...] --recorded     # whether the recorded killers still kill

    golden     tests/golden, until one fails
    commands   tests/acceptance: all functions that fail
    oracles    test files with an independent calculation (`oracles`): all functions that fail
    other      the files that the fault's entry names, the folders of tests that belong to its
               folder, and everything, until one fails

Stage by stage, fast tests first. `outcome.csv` (or ``--results FILE``) gets the killers of a fault
as soon as they are known, ``-`` for none and ``- fast`` for none that is fast, and the tier of the
fastest killer. What is known is not run again, so that an interrupted run goes on: delete a cell or
a row to repeat it.
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
from contextlib import contextmanager
from pathlib import Path
from queue import Queue

sys.path.insert(0, str(Path(__file__).parents[1]))

from faults.patches import HERE, Fault, load  # noqa: E402

STAGES = ("golden", "commands", "oracles", "other")
COLUMNS = ("fault", *STAGES, "tier", "seconds")
OUTCOME = HERE / "outcome.csv"
TIERS = {"fast": "not nightly", "nightly": "nightly"}
NONE, NONE_FAST, SEPARATOR = "-", "- fast", " | "
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
    return [name for cell in cells for name in cell if name not in ("", NONE, NONE_FAST)]


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


def try_fault(fault: Fault, stage: str, copies: Queue[Path], tiers: dict[str, str]) -> Row:
    """Apply a fault to a copy, run a stage and take the fault back; what its row then says."""
    started, found, tier = time.monotonic(), [], ""
    with patched(fault, copies) as copy:
        for name, marker in tiers.items():
            for selected in selections(fault, stage, copy):
                if not (found and "-x" in selected):  # which ends with the first killer
                    found += failures(copy, [*selected, "-m", marker])
                    tier = tier or name * bool(found)
    if "-x" not in selected:
        found = list(dict.fromkeys(name.partition("[")[0] for name in found))
    seconds = f"{time.monotonic() - started:.0f}"
    none = NONE if "nightly" in tiers else NONE_FAST
    return {stage: SEPARATOR.join(found) or none, "tier": tier, "seconds": seconds}


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


def merged(row: Row, new: Row) -> Row:
    """Return a row with what one more stage has found."""
    tier = min({row["tier"], new["tier"]} - {""}, default="")
    seconds = int(row["seconds"] or 0) + int(new["seconds"])
    return row | new | {"tier": tier, "seconds": str(seconds)}


def _forget_bytecode(file: Path) -> None:
    """Python compares time stamps in whole seconds, and sizes: a changed sign leaves both."""
    for compiled in (file.parent / "__pycache__").glob(f"{file.stem}.*"):
        compiled.unlink()


def known_outcomes(path: Path) -> dict[str, Row]:
    """Return the rows of a file of outcomes by fault; empty if there is no file."""
    lines = path.read_text().splitlines() if path.exists() else []
    return {row["fault"]: row for row in csv.DictReader(lines)}


def write_outcomes(path: Path, rows: dict[str, Row], order: list[str]) -> None:
    """Write the rows in the order of the list of faults."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows[name] for name in order if name in rows)


def main() -> int:
    """Run what is not known yet; 1 if a fault of those asked for survives what has been run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--results", type=Path, default=OUTCOME)
    parser.add_argument("--tiers", default="fast,nightly")
    parser.add_argument("--stages", default=",".join(STAGES))
    parser.add_argument("--recorded", action="store_true")
    asked = parser.parse_args()

    everything = load()
    order = [fault.name for fault in everything]
    if unknown := sorted({*asked.names} - {*order}):
        sys.exit(f"no fault named {', '.join(unknown)}")
    faults = [fault for fault in everything if fault.name in asked.names or not asked.names]
    tiers = {tier: TIERS[tier] for tier in asked.tiers.split(",")}
    rows = known_outcomes(asked.results)
    for fault in faults:
        rows.setdefault(fault.name, dict.fromkeys(COLUMNS, "") | {"fault": fault.name})
    with tempfile.TemporaryDirectory(prefix="sinsjax-faults-") as work:
        copies: Queue[Path] = Queue()
        for number in range(asked.jobs):
            copies.put(Path(work) / str(number))
            copy_tree(HERE.parents[1], Path(work) / str(number))

        pool = ThreadPoolExecutor(asked.jobs)
        if asked.recorded:
            known = known_outcomes(asked.results)
            results = pool.map(lambda f: survives(f, known.get(f.name), copies), faults)
            alive = [f.name for f, lives in zip(faults, results, strict=True) if lives]
            print(f"not killed as recorded, of {len(faults)}: {alive or 'none'}")
            return int(bool(alive))

        open_cells = ("", NONE_FAST) if "nightly" in tiers else ("",)
        pairs = [(f, s) for s in asked.stages.split(",") for f in faults]
        waiting = [(f, s) for f, s in pairs if rows[f.name][s] in open_cells]
        try:
            jobs = {pool.submit(try_fault, f, s, copies, tiers): (f.name, s) for f, s in waiting}
            for job in as_completed(jobs):
                (name, stage), new = jobs[job], job.result()
                rows[name] = merged(rows[name], new)
                write_outcomes(asked.results, rows, order)
                print(f"{name}: {stage}: {new[stage]} ({new['seconds']} s)", flush=True)
        finally:
            pool.shutdown(cancel_futures=True)
    survivors = [fault.name for fault in faults if not killers(rows[fault.name])]
    print(f"survivors, of {len(faults)}: {survivors or 'none'}")
    return int(bool(survivors))


if __name__ == "__main__":
    sys.exit(main())
